"""Bundles: folders with gains, controller, test vectors and self-test for a rig computer."""
