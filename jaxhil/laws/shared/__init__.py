"""Common parts of several compensators."""
