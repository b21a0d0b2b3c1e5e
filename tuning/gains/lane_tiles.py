"""Layout of the lanes (batch elements) of several problems: joined along one axis, and divided into tiles."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.tile_size import find_tile_size

# Number of lanes per tile on a processor if the scenarios have transparency probes.
PROBED_LANES_PER_TILE = 32


def map_over_tiles(function: Callable[[Any], Outcome], arguments: Any) -> Outcome:
    """Apply `function` to groups (tiles) of lanes, so that a slow lane delays only its own tile."""
    lanes = jax.tree.leaves(arguments)[0].shape[-1]
    # On an accelerator, the memory already limits the number of problems, and thereby the number of lanes.
    size = math.gcd(lanes, find_tile_size(lanes, PROBED_LANES_PER_TILE))
    chunks = jax.tree.map(
        lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], lanes // size, size), -2, 0), arguments
    )
    results = lax.map(function, chunks)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], lanes), results)


def flatten_lanes(leaf: Array) -> Array:
    """Join the axes of problems and scenarios: reshape (problems, ..., scenarios) to (..., lanes)."""
    return jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], leaf.shape[0] * leaf.shape[-1])
