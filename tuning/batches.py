"""Batches of lanes, the last axis of every array of a tree, put side by side and cut apart again."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np


def join(batches: Sequence[Any]) -> Any:
    """Several batches, trees of the same form, as one."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *batches)


def cut(batch: Any, lanes: int) -> list[Any]:
    """A batch in parts of so many lanes; the last one has what is left."""
    whole = jax.tree.leaves(batch)[0].shape[-1]
    return [
        jax.tree.map(lambda leaf, begin=begin: leaf[..., begin : begin + lanes], batch)
        for begin in range(0, whole, lanes)
    ]
