"""Functions that join and split batches: nested records of arrays whose last axis is the batch axis."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np


def join_batches(batches: Sequence[Any]) -> Any:
    """Concatenate batches that have the same structure, along the last axis of every array."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *batches)


def split_batch(batch: Any, lanes: int) -> list[Any]:
    """Split a batch into batches of `lanes` elements each; the last batch may be smaller."""
    number = jax.tree.leaves(batch)[0].shape[-1]
    return [
        jax.tree.map(lambda leaf, begin=begin: leaf[..., begin : begin + lanes], batch)
        for begin in range(0, number, lanes)
    ]
