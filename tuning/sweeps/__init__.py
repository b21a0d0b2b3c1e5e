"""Monte Carlo sweeps: scenarios by index, computed in chunks, in a store that survives interruptions.

The values allowed for options are defined here, without importing JAX, which must be configured first.
"""

SAMPLINGS = ("random", "sobol")
PRECISIONS = ("float64", "float32")
MAX_SCENARIOS = 2**32  # largest number of scenarios; the noise's random keys have 32 bits for the index
MAX_CHUNK_SIZE = 2**20  # largest number of scenarios of a chunk
MAX_SEED = 2**63 - 1
