"""Gains: what tuning minimises, how it searches, and how the result is judged."""
