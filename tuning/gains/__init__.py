"""Tuning of gains: objective, search and evaluation of the result."""
