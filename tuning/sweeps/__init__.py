"""Monte Carlo sweeps: scenarios by index, evaluated in chunks, kept in a store that survives interruptions."""
