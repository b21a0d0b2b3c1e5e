"""A rig's log files, read, checked and put on the grid of ticks. Needs no jax."""
