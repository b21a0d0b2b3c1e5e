"""Correlation of uncertain numbers: the ``[correlation]`` table of a mechanism file.

Each key keeps its distribution; the table correlates the standard normal numbers behind the keys, a Gaussian
copula (Nelsen, "An Introduction to Copulas", 2006, 2.3.6). The uniform number u_i of a key becomes

    u'_i = Phi( sum_j L_ij Phi^-1(u_j) ),    L L^T = matrix,

over the named keys in their order. It is uniform as well, and goes through the key's quantile function. The
numbers of a key that has no correlation with an earlier one do not change by any bit.

Keys with separate draws for each entry of a list (``independent = true``) come last in that order. The matrix
holds for each entry: entry i is correlated with entry i of another such list (the last entry repeats) and
with all keys that have a single draw. Conditional on the single draws, entries are independent.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from jaxhil.errors import format_value
from jaxhil.mechanism.conversion import KeyProblem, suggest_names
from jaxhil.mechanism.six_axes import AnyMechanism
from jaxhil.mechanism.structs import Correlation, Mechanism

__all__ = ["check_correlation", "correlate", "find_correlated_groups", "fix_at_nominal", "remove_keys"]

MIN_EIGENVALUE = 1e-10  # a matrix with a smaller eigenvalue does not count as positive definite

_MIN_UNIFORM, _MAX_UNIFORM = (
    2.0**-54,
    1.0 - 2.0**-53,
)  # bounds of uniform numbers, so that normal numbers are finite


def correlate(mechanism: AnyMechanism, uniform: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the uniform numbers (draws, columns) of every key after applying the mechanism's correlation."""
    table = mechanism.correlation
    if table is None:
        return dict(uniform)
    from scipy import special  # takes long to import, and reading a file needs none

    order = sorted(range(len(table.keys)), key=lambda i: uniform[table.keys[i]].shape[1] > 1)
    keys = [table.keys[i] for i in order]
    factor = _cholesky_factor(_full_matrix(table)[np.ix_(order, order)])
    normal = [special.ndtri(np.clip(uniform[key], _MIN_UNIFORM, _MAX_UNIFORM)) for key in keys]
    changed = {}
    for i, key in enumerate(keys):
        if np.any(factor[i, :i]):
            columns = np.arange(normal[i].shape[1])
            # The rounding of a matrix product may depend on the number of draws; that of this sum does not.
            mixed = sum(
                factor[i, j] * normal[j][:, np.minimum(columns, normal[j].shape[1] - 1)] for j in range(i + 1)
            )
            changed[key] = np.clip(special.ndtr(mixed), 0.0, _MAX_UNIFORM)
    return {**uniform, **changed}


def find_correlated_groups(mechanism: AnyMechanism) -> list[tuple[str, ...]]:
    """Return the keys of ``[correlation]`` in mutually independent groups, in the order of the table."""
    table = mechanism.correlation
    if table is None:
        return []
    linked = _full_matrix(table) != 0.0
    for _ in table.keys:
        linked = linked @ linked
    groups = dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in linked)
    return [tuple(table.keys[i] for i in group) for group in groups]


def fix_at_nominal(mechanism: Mechanism, keys: Collection[str]) -> Mechanism:
    """Return the mechanism with these keys fixed at their nominal values; the others vary as before."""
    uncertainty = {key: entry for key, entry in mechanism.uncertainty.items() if key not in keys}
    table = mechanism.correlation
    rest = table and remove_keys(table.keys, table.matrix, keys)
    return msgspec.structs.replace(
        mechanism,
        uncertainty=uncertainty,
        correlation=Correlation(keys=rest[0], matrix=rest[1]) if rest else None,
    )


def remove_keys(
    keys: Sequence[str], matrix: Sequence[Sequence[Any]], gone: Collection[str]
) -> tuple[list[str], list[list[Any]]] | None:
    """Return keys and lower triangle of the matrix without the keys `gone`, or None if no key remains."""
    rest = [i for i, key in enumerate(keys) if key not in gone]
    triangle = [[matrix[row][column] for column in rest if column <= row] for row in rest]
    return ([keys[i] for i in rest], triangle) if rest else None


def check_correlation(mechanism: AnyMechanism) -> None:
    """Check the table ``[correlation]``.

    Raise `KeyProblem` unless it names uncertain keys, each once, and its matrix is a correlation matrix.
    """
    table = mechanism.correlation
    if table is None:
        return
    uncertain = mechanism.uncertainty
    for index, key in enumerate(table.keys):
        where = ("correlation", "keys", index)
        if key not in uncertain:
            allowed = f"a key of [uncertainty]{suggest_names(key, uncertain)}, or no correlation"
            raise KeyProblem(where, format_value(key), allowed)
        if key in table.keys[:index]:
            raise KeyProblem(where, f"{format_value(key)} once more", "each key once")
    if len(table.matrix) != len(table.keys):
        raise KeyProblem(
            ("correlation", "matrix"), f"{len(table.matrix)} rows", f"{len(table.keys)}, one a key"
        )
    for index, row in enumerate(table.matrix):
        path = ("correlation", "matrix", index)
        if len(row) != index + 1:
            allowed = f"{index + 1}: the matrix up to its diagonal"
            raise KeyProblem(path, f"{len(row)} entries", allowed)
        if row[-1] != 1.0:
            raise KeyProblem((*path, index), format_value(row[-1]), "1 on the diagonal")
    least = float(np.linalg.eigvalsh(_full_matrix(table))[0])
    if not least > MIN_EIGENVALUE:
        found = f"a least eigenvalue of {least:.3g}"
        allowed = f"a positive definite matrix, with one > {MIN_EIGENVALUE:g}"
        raise KeyProblem(("correlation", "matrix"), found, allowed)


def _full_matrix(table: Correlation) -> np.ndarray:
    """Return the full symmetric matrix (keys, keys)."""
    matrix = np.zeros((len(table.keys), len(table.keys)))
    for index, row in enumerate(table.matrix):
        matrix[index, : index + 1] = matrix[: index + 1, index] = row
    return matrix


def _cholesky_factor(matrix: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor L; it uses the same operations on every machine, so that draws repeat."""
    factor = np.zeros_like(matrix)
    for row in range(len(matrix)):
        for column in range(row + 1):
            rest = matrix[row, column]
            for before in range(column):
                rest = rest - factor[row, before] * factor[column, before]
            factor[row, column] = np.sqrt(rest) if row == column else rest / factor[column, column]
    return factor
