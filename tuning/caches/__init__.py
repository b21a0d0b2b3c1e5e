"""Checkpoints on disk, from which interrupted work can resume, and distribution of work to a cluster."""
