"""Whether a run still tests the hardware: pushes and damped twins, and the figures read off them."""
