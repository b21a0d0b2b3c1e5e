"""Reading of a rig's log files: checks and conversion to the grid of ticks, without jax."""
