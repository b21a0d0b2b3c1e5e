"""Command line `jaxhil`."""
