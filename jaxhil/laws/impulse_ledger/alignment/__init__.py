"""Alignment: measured position and velocity, delayed like the force measurement."""
