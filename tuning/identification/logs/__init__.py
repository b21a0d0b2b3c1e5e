"""Reading of a rig's log files: checks, and conversion to one row per tick (without jax)."""
