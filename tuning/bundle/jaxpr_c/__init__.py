"""Generator of C99 from JAX programs: it prints a jaxpr as functions that need only `math.h`."""
