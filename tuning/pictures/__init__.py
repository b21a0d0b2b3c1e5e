"""Plots of tuning results and of six-axis runs."""
