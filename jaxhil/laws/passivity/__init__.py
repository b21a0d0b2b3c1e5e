"""Passivity control: an adjustable damper dissipates observed energy."""
