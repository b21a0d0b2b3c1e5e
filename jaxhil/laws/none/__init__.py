"""No compensation: baseline for all compensators."""
