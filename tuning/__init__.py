"""Tuning, verification and the command line, on top of `jaxhil`."""
