"""Passivity control: a variable damper dissipates the energy that the contact seems to generate."""
