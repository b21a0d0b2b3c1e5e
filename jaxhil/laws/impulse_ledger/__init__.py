"""Impulse ledger, the compensator of this project; its parts are the subfolders."""
