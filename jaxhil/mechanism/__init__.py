"""Mechanism files: their content as structs, reading, validation, and random draws of uncertain numbers."""
