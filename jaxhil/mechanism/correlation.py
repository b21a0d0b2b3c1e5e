"""Uncertain numbers that vary together: the ``[correlation]`` table of a mechanism file.

Each key keeps its own distribution; what the table correlates are standard normal numbers behind them, a
Gaussian copula (Nelsen, "An Introduction to Copulas", 2006, 2.3.6). A uniform number u of a key becomes

    u' = Phi( sum_j L_ij Phi^-1(u_j) ),    L L^T = matrix,

over the named keys in their order, which is uniform as well, and u' then goes through the key's own quantile
function. A key that is correlated with none before it keeps its numbers to the last bit.

Keys with numbers of their own for each entry of a list (``independent = true``) come last in that order. The
matrix holds for each entry: entry i goes with entry i of another such list, the last one repeating, and with
all that is drawn once. Given the latter, entries are independent of one another.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from jaxhil.errors import shown
from jaxhil.mechanism.conversion import KeyProblem, close_match
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Correlation, Mechanism

__all__ = ["certain", "check_correlation", "correlated", "correlated_groups", "remaining"]

AnyMechanism = Mechanism | SixAxisMechanism

LEAST_EIGENVALUE = 1e-10  # of a matrix that counts as positive definite

_LEAST, _LARGEST = 2.0**-54, 1.0 - 2.0**-53  # of what has a finite normal number, and is below 1


def correlated(mechanism: AnyMechanism, uniform: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The uniform numbers (number, columns) of every key, made to vary together as the mechanism says."""
    table = mechanism.correlation
    if table is None:
        return dict(uniform)
    from scipy import special  # takes long to import, and reading a file needs none

    order = sorted(range(len(table.keys)), key=lambda place: uniform[table.keys[place]].shape[1] > 1)
    keys = [table.keys[place] for place in order]
    factor = _factor(_matrix(table)[np.ix_(order, order)])
    normal = [special.ndtri(np.clip(uniform[key], _LEAST, _LARGEST)) for key in keys]
    together = {}
    for place, key in enumerate(keys):
        if np.any(factor[place, :place]):
            columns = np.arange(normal[place].shape[1])
            # A sum of its own for each draw: a matrix product may round by how many there are.
            mixed = sum(
                factor[place, other] * normal[other][:, np.minimum(columns, normal[other].shape[1] - 1)]
                for other in range(place + 1)
            )
            together[key] = np.clip(special.ndtr(mixed), 0.0, _LARGEST)
    return {**uniform, **together}


def correlated_groups(mechanism: AnyMechanism) -> list[tuple[str, ...]]:
    """The keys of ``[correlation]`` in groups that are independent of one another, in their order there."""
    table = mechanism.correlation
    if table is None:
        return []
    linked = _matrix(table) != 0.0
    for _ in table.keys:
        linked = linked @ linked
    groups = dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in linked)
    return [tuple(table.keys[place] for place in group) for group in groups]


def certain(mechanism: Mechanism, keys: Collection[str]) -> Mechanism:
    """The mechanism with these keys at their nominal values; the others vary as before."""
    uncertainty = {key: one for key, one in mechanism.uncertainty.items() if key not in keys}
    table = mechanism.correlation
    left = table and remaining(table.keys, table.matrix, keys)
    return msgspec.structs.replace(
        mechanism,
        uncertainty=uncertainty,
        correlation=Correlation(keys=left[0], matrix=left[1]) if left else None,
    )


def remaining(
    keys: Sequence[str], matrix: Sequence[Sequence[Any]], gone: Collection[str]
) -> tuple[list[str], list[list[Any]]] | None:
    """Keys and lower triangle without the keys that are gone; None where none is left."""
    kept = [place for place, key in enumerate(keys) if key not in gone]
    triangle = [[matrix[row][column] for column in kept if column <= row] for row in kept]
    return ([keys[place] for place in kept], triangle) if kept else None


def check_correlation(mechanism: AnyMechanism) -> None:
    """Raises `KeyProblem` unless the table names uncertain keys, each once, and its matrix is one of
    correlations."""
    table = mechanism.correlation
    if table is None:
        return
    uncertain = mechanism.uncertainty
    for place, key in enumerate(table.keys):
        where = ("correlation", "keys", place)
        if key not in uncertain:
            allowed = f"a key of [uncertainty]{close_match(key, uncertain)}, or no correlation"
            raise KeyProblem(where, shown(key), allowed)
        if key in table.keys[:place]:
            raise KeyProblem(where, f"{shown(key)} once more", "each key once")
    if len(table.matrix) != len(table.keys):
        raise KeyProblem(
            ("correlation", "matrix"), f"{len(table.matrix)} rows", f"{len(table.keys)}, one a key"
        )
    for place, row in enumerate(table.matrix):
        path = ("correlation", "matrix", place)
        if len(row) != place + 1:
            allowed = f"{place + 1}: the matrix up to its diagonal"
            raise KeyProblem(path, f"{len(row)} entries", allowed)
        if row[-1] != 1.0:
            raise KeyProblem((*path, place), shown(row[-1]), "1 on the diagonal")
    least = float(np.linalg.eigvalsh(_matrix(table))[0])
    if not least > LEAST_EIGENVALUE:
        found = f"a least eigenvalue of {least:.3g}"
        allowed = f"a positive definite matrix, with one > {LEAST_EIGENVALUE:g}"
        raise KeyProblem(("correlation", "matrix"), found, allowed)


def _matrix(table: Correlation) -> np.ndarray:
    """The whole of it, symmetric."""
    whole = np.zeros((len(table.keys), len(table.keys)))
    for place, row in enumerate(table.matrix):
        whole[place, : place + 1] = whole[: place + 1, place] = row
    return whole


def _factor(matrix: np.ndarray) -> np.ndarray:
    """L of L L^T = matrix (Cholesky), by the same operations on every machine: draws are repeatable."""
    factor = np.zeros_like(matrix)
    for row in range(len(matrix)):
        for column in range(row + 1):
            rest = matrix[row, column]
            for before in range(column):
                rest = rest - factor[row, before] * factor[column, before]
            factor[row, column] = np.sqrt(rest) if row == column else rest / factor[column, column]
    return factor
