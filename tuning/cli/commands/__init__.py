"""Commands, one per module with `run(options)`, which returns the exit code; imported on use."""
