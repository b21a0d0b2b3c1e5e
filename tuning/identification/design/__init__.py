"""Excitations for a rig whose numbers are roughly known: what logs should be taken."""
