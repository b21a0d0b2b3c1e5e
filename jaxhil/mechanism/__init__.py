"""Mechanism files: their structs, reading and validation, and random draws of the uncertain numbers."""
