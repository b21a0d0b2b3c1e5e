"""Sensor readings of a tick: corrected wrench, aligned pose, contact detection, means over free flight."""
