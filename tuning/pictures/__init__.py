"""Pictures of tuning and of runs."""
