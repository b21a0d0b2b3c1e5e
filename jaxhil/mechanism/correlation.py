"""Correlation of uncertain numbers: the ``[correlation]`` table of a mechanism file.

Each key keeps its distribution; a Gaussian copula correlates the keys (Nelsen, "An Introduction to Copulas",
2006, 2.3.6). The uniform random number u_i of a key becomes

    u'_i = Phi( sum_j L_ij Phi^-1(u_j) ),    L L^T = matrix,

where i and j number the keys of the table. u'_i is uniform as well; the quantile function of the key converts
u'_i to a value. The numbers of a key that is not correlated with an earlier key stay exactly the same.

Lists with a separate draw for each entry (``independent = true``) come last in the order of the keys. Entry i
of such a list is correlated with all keys that have a single draw, and with entry i of every other such list
(or with the last entry, if the other list is shorter). For given values of the keys with a single draw,
entries with different indices are independent.
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

# minimum eigenvalue [1]; with a smaller one, rounding may make the Cholesky factorisation fail
MIN_EIGENVALUE = 1e-10

# Bounds of uniform numbers, so that normal numbers are finite.
_MIN_UNIFORM, _MAX_UNIFORM = 2.0**-54, 1.0 - 2.0**-53


def correlate(mechanism: AnyMechanism, uniform: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the uniform random numbers of every key, correlated by the table ``[correlation]``.

    `uniform` contains independent uniform random numbers, an array (draws, columns) for each key. The result
    has the same form.
    """
    table = mechanism.correlation
    if table is None:
        return dict(uniform)
    from scipy import special  # takes long to import, and reading a file does not need SciPy

    order = sorted(range(len(table.keys)), key=lambda i: uniform[table.keys[i]].shape[1] > 1)
    keys = [table.keys[i] for i in order]
    factor = _cholesky_factor(_full_matrix(table)[np.ix_(order, order)])
    normal = [special.ndtri(np.clip(uniform[key], _MIN_UNIFORM, _MAX_UNIFORM)) for key in keys]
    changed = {}
    for i, key in enumerate(keys):
        if np.any(factor[i, :i]):
            columns = np.arange(normal[i].shape[1])
            # This sum, unlike a matrix product, has the same rounding errors for any number of draws.
            mixed = sum(
                factor[i, j] * normal[j][:, np.minimum(columns, normal[j].shape[1] - 1)] for j in range(i + 1)
            )
            changed[key] = np.clip(special.ndtr(mixed), 0.0, _MAX_UNIFORM)
    return {**uniform, **changed}


def find_correlated_groups(mechanism: AnyMechanism) -> list[tuple[str, ...]]:
    """Group the keys of ``[correlation]`` so that keys in different groups are independent."""
    table = mechanism.correlation
    if table is None:
        return []
    linked = _full_matrix(table) != 0.0
    for _ in table.keys:
        linked = linked @ linked
    groups = dict.fromkeys(tuple(np.flatnonzero(row).tolist()) for row in linked)
    return [tuple(table.keys[i] for i in group) for group in groups]


def fix_at_nominal(mechanism: Mechanism, keys: Collection[str]) -> Mechanism:
    """Return the mechanism with `keys` fixed at their nominal values; the remaining keys stay uncertain."""
    uncertainty = {key: entry for key, entry in mechanism.uncertainty.items() if key not in keys}
    table = mechanism.correlation
    reduced = table and remove_keys(table.keys, table.matrix, keys)
    return msgspec.structs.replace(
        mechanism,
        uncertainty=uncertainty,
        correlation=Correlation(keys=reduced[0], matrix=reduced[1]) if reduced else None,
    )


def remove_keys(
    keys: Sequence[str], matrix: Sequence[Sequence[Any]], removed: Collection[str]
) -> tuple[list[str], list[list[Any]]] | None:
    """Return the remaining keys and the lower triangle of their correlation matrix; None if none remains."""
    rest = [i for i, key in enumerate(keys) if key not in removed]
    triangle = [[matrix[row][column] for column in rest if column <= row] for row in rest]
    return ([keys[i] for i in rest], triangle) if rest else None


def check_correlation(mechanism: AnyMechanism) -> None:
    """Check the table ``[correlation]``.

    Raise `KeyProblem` unless every key is uncertain and occurs once, and the matrix is a correlation matrix.
    """
    table = mechanism.correlation
    if table is None:
        return
    uncertain = mechanism.uncertainty
    for index, key in enumerate(table.keys):
        where = ("correlation", "keys", index)
        if key not in uncertain:
            expected = f"a key of [uncertainty]{suggest_names(key, uncertain)}, or no correlation"
            raise KeyProblem(where, format_value(key), expected)
        if key in table.keys[:index]:
            raise KeyProblem(where, f"{format_value(key)} twice", "each key once")
    if len(table.matrix) != len(table.keys):
        raise KeyProblem(
            ("correlation", "matrix"), f"{len(table.matrix)} rows", f"{len(table.keys)}, one for each key"
        )
    for index, row in enumerate(table.matrix):
        path = ("correlation", "matrix", index)
        if len(row) != index + 1:
            expected = f"{index + 1}, up to the diagonal"
            raise KeyProblem(path, f"{len(row)} entries", expected)
        if row[-1] != 1.0:
            raise KeyProblem((*path, index), format_value(row[-1]), "1 on the diagonal")
    smallest = float(np.linalg.eigvalsh(_full_matrix(table))[0])
    if not smallest > MIN_EIGENVALUE:
        found = f"a smallest eigenvalue of {smallest:.3g}"
        expected = f"a positive definite matrix, with eigenvalues > {MIN_EIGENVALUE:g}"
        raise KeyProblem(("correlation", "matrix"), found, expected)


def _full_matrix(table: Correlation) -> np.ndarray:
    matrix = np.zeros((len(table.keys), len(table.keys)))
    for index, row in enumerate(table.matrix):
        matrix[index, : index + 1] = matrix[: index + 1, index] = row
    return matrix


def _cholesky_factor(matrix: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor L by the same operations on every machine, so that draws are repeatable."""
    factor = np.zeros_like(matrix)
    for row in range(len(matrix)):
        for column in range(row + 1):
            rest = matrix[row, column]
            for inner in range(column):
                rest = rest - factor[row, inner] * factor[column, inner]
            factor[row, column] = np.sqrt(rest) if row == column else rest / factor[column, column]
    return factor
