"""Checkpoints on disk, with which interrupted work can resume, and distribution of work to a cluster."""
