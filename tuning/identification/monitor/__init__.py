"""Monitoring of a rig, contact by contact: comparison with its mechanism file."""
