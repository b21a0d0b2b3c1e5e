"""Passivity control: a variable damper dissipates the energy that delays add to a contact."""
