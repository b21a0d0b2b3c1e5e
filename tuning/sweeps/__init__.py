"""Monte Carlo sweeps: many random scenarios, computed in chunks, and stored so that a sweep can resume.

This module defines allowed values of options without importing JAX, which some of the options configure.
"""

SAMPLINGS = ("random", "sobol")
PRECISIONS = ("float64", "float32")
MAX_SCENARIOS = 2**32  # largest number of scenarios; the random keys of the noise have 32 bits for the index
MAX_CHUNK_SIZE = 2**20  # largest number of scenarios in a chunk
MAX_SEED = 2**63 - 1
