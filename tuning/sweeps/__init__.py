"""Monte Carlo sweeps: scenarios by index, computed in chunks, kept in a store that survives interruptions.

What options may say is here, where nothing imports jax: it must not start before it is configured.
"""

SAMPLINGS = ("random", "sobol")
PRECISIONS = ("float64", "float32")
MOST = 2**32  # scenarios: the noise's keys have 32 bits for the index
LARGEST_CHUNK = 2**20  # scenarios
LARGEST_SEED = 2**63 - 1
