"""Functional Mock-up Units (FMUs): the controller, and the rig of the mechanism file, for other tools."""
