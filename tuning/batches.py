"""Joining and splitting of batches, whose elements are along the last axis of every array of a tree."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np


def join_batches(batches: Sequence[Any]) -> Any:
    """Join several batches, trees of equal structure, to one."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *batches)


def split_batch(batch: Any, lanes: int) -> list[Any]:
    """Split a batch into batches of `lanes` elements; the last one may have fewer."""
    number = jax.tree.leaves(batch)[0].shape[-1]
    return [
        jax.tree.map(lambda leaf, begin=begin: leaf[..., begin : begin + lanes], batch)
        for begin in range(0, number, lanes)
    ]
