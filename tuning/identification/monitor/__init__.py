"""Monitoring of a rig: comparison of each contact with the rig's mechanism file."""
