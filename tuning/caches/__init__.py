"""Checkpoints of results on disk, and workers of a cluster."""
