"""Calibration of the limits in a gain file, and of the watchdog's rates of alarm, from recorded runs.

The watchdog itself, `jaxhil.rig.watchdog`, trips the controller after a contact whose energy or restitution
is outside these limits.
"""
