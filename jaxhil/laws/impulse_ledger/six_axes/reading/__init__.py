"""Sensor readings of a tick: corrected wrench, aligned pose, contact detection, means of free flight."""
