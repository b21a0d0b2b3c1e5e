"""Impulse ledger: this project's own compensator; each subfolder contains one part of the method."""
