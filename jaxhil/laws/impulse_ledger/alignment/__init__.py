"""Alignment: delays the measured position and velocity by the delay of the force measurement."""
