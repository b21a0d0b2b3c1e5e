"""Reader of six-axis gain files: returns checked numbers or raises `GainFileError` with one line.

In addition to the entries of a one-axis file, a file contains `constants`: what the controller knows about
the numerical model and the rig (`registry.ModelConstants`).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxhil.rig.bounds import TIMES
from jaxhil.rig.errors import format_value, make_gain_file_error
from jaxhil.rig.gain_document import (
    check_form,
    check_within,
    read_control_period,
    read_entry,
    read_gains,
    read_limits,
    read_number,
    read_object,
)
from jaxhil.rig.six_axes.limits import NO_SIX_AXIS_LIMITS, SIX_AXIS_LIMITS, complete_six_axis_limits
from jaxhil.rig.six_axes.registry import SIX_AXIS_COMPENSATORS, ModelConstants
from jaxhil.rig.six_axes.vectors import AXES, product

MATRICES = ("mass_matrix", "inverse_mass", "tool_correction")
MATRIX_ENTRIES = -1e9, 1e9  # lowest and highest entry, in SI units
INVERSE_TOLERANCE = 1e-6  # maximum entry of M M^-1 - 1, divided by the scale of its row and column
SYMMETRY_TOLERANCE = 1e-9  # maximum difference of mirrored entries, divided by the scale of row and column


class SixAxisGainFile(NamedTuple):
    """Checked content of a six-axis gain file."""

    compensator: str  # name
    gains: Mapping[str, float]  # by name, in SI units
    control_period: float  # [s]
    constants: ModelConstants
    limits: Mapping[str, float] = NO_SIX_AXIS_LIMITS  # by name, in SI units


def check_six_axis_document(document: Mapping[str, Any], source: str = "gain document") -> SixAxisGainFile:
    """Check a six-axis gain document and return what the controller needs from it.

    Args:
        document: content of a gain file.
        source: name of the document in error messages.

    Raises:
        GainFileError: if the document is invalid.
    """
    check_form(document, source)
    number = read_entry(document, "axes", source, "")
    if number != AXES:
        raise make_gain_file_error(source, "axes", format_value(number), str(AXES))
    name = read_entry(document, "compensator", source, "")
    if not isinstance(name, str) or name not in SIX_AXIS_COMPENSATORS:
        allowed = f"one of {', '.join(SIX_AXIS_COMPENSATORS)}"
        raise make_gain_file_error(source, "compensator", format_value(name), allowed)
    gains = read_gains(document, name, SIX_AXIS_COMPENSATORS[name].gains, source)
    period = read_control_period(document, source)
    limits = read_limits(document, source, SIX_AXIS_LIMITS, complete_six_axis_limits)
    return SixAxisGainFile(name, gains, period, _constants(document, source), limits)


def _constants(document: Mapping[str, Any], source: str) -> ModelConstants:
    """Check and return the constants of the numerical model and the rig."""
    entries = read_object(document, "constants", source, "")
    for name in entries:
        if name not in ModelConstants._fields:
            allowed = ", ".join(ModelConstants._fields)
            raise make_gain_file_error(source, "constants", f"an extra key {format_value(name)}", allowed)
    mass, inverse, correction = (_matrix(entries, name, source) for name in MATRICES)
    delay, sign = (
        read_number(read_entry(entries, name, source, "constants."), f"constants.{name}", source)
        for name in ("longest_delay", "sensor_sign")
    )
    check_within(delay, *TIMES, "constants.longest_delay", source)
    if abs(sign) != 1.0:
        raise make_gain_file_error(source, "constants.sensor_sign", format_value(sign), "1 or -1")
    load = _vector(read_entry(entries, "tool_load", source, "constants."), "constants.tool_load", source)
    constants = ModelConstants(mass, inverse, correction, delay, sign, load)
    if not _is_positive_definite(mass):
        allowed = "a symmetric, positive definite matrix"
        raise make_gain_file_error(source, "constants.mass_matrix", "another matrix", allowed)
    _check_inverse(constants, source)
    # With the tool's mass matrix M_t, this product is the inverse of M - M_t.
    if not _is_positive_definite([product(inverse, [row[i] for row in correction]) for i in range(AXES)]):
        allowed = "the matrix of a tool that is lighter than constants.mass_matrix"
        raise make_gain_file_error(source, "constants.tool_correction", "another matrix", allowed)
    return constants


def _matrix(entries: Mapping[str, Any], name: str, source: str) -> list[list[float]]:
    """Check and return the matrix `name` of the constants as lists of floats."""
    key, rows = f"constants.{name}", read_entry(entries, name, source, "constants.")
    is_square = isinstance(rows, (list, tuple)) and len(rows) == AXES
    if not is_square or not all(isinstance(row, (list, tuple)) and len(row) == AXES for row in rows):
        raise make_gain_file_error(source, key, format_value(rows), f"{AXES} rows of {AXES} numbers")
    return [_vector(row, key, source) for row in rows]


def _vector(entries: Any, key: str, source: str) -> list[float]:
    """Check and return a list of six numbers."""
    if not isinstance(entries, (list, tuple)) or len(entries) != AXES:
        raise make_gain_file_error(source, key, format_value(entries), f"{AXES} numbers")
    vector = [read_number(entry, key, source) for entry in entries]
    for entry in vector:
        check_within(entry, *MATRIX_ENTRIES, key, source)
    return vector


def _is_positive_definite(matrix: list[list[float]]) -> bool:
    """Return whether a matrix is symmetric and positive definite, by Cholesky's factorisation."""
    factor = [[0.0] * AXES for _ in range(AXES)]
    for i in range(AXES):
        for j in range(i + 1):
            difference = abs(matrix[i][j] - matrix[j][i])
            if not difference <= SYMMETRY_TOLERANCE * (abs(matrix[i][i]) * abs(matrix[j][j])) ** 0.5:
                return False
            rest = matrix[i][j] - sum(factor[i][k] * factor[j][k] for k in range(j))
            if i == j and not rest > 0.0:
                return False
            factor[i][j] = rest**0.5 if i == j else rest / factor[j][j]
    return True


def _check_inverse(constants: ModelConstants, source: str) -> None:
    """Raise GainFileError unless `inverse_mass` is the inverse of the mass matrix."""
    mass, inverse = constants.mass_matrix, constants.inverse_mass
    for i in range(AXES):
        column = product(mass, [row[i] for row in inverse])
        for j in range(AXES):
            error = abs(column[j] - (1.0 if i == j else 0.0))
            if not error <= INVERSE_TOLERANCE * max(1.0, (mass[j][j] * abs(inverse[i][i])) ** 0.5):
                allowed = "the inverse of constants.mass_matrix"
                raise make_gain_file_error(source, "constants.inverse_mass", "another matrix", allowed)
