"""Booking of impulses: onset, reference trajectory, and the command that pays the unpaid impulse."""
