"""Calibration of the limits in a gain file, and estimation of the watchdog's alarm rates, from recorded runs.

The watchdog, `jaxhil.rig.watchdog`, trips the controller after a contact whose energy or restitution violates
these limits.
"""
