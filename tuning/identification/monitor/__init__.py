"""Whether a rig still is the one of a mechanism file, contact by contact."""
