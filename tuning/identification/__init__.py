"""Identification of a rig from its logs: parameter values, their uncertainty, and a mechanism file."""
