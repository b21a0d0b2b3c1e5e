"""Uncertain parameters of a mechanism file, with their standard deviations and correlation."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np

from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw

UNCERTAINTY_DRAWS = 4096  # number of draws that determine standard deviations and correlations
# Prefixes of the parameters that affect the sensor readings.
READING_PREFIXES = (
    "contact.",
    "rig.simulator.",
    "rig.force_sensor.",
    "rig.position_sensor.",
    "rig.contact_plane",
)
# Minimum standard deviations of a delay [s], because of clock errors, and of the force sensor's scale [1].
MIN_DELAY_STD, MIN_SCALE_STD = 2e-5, 1e-3
DELAY_KEYS, STIFFNESS_KEY = ("rig.simulator.delay", "rig.force_sensor.delay"), "contact.stiffness"


class UncertainParameter(NamedTuple):
    """Uncertain parameter of a mechanism file (or entry of a list parameter) with its standard deviation."""

    path: str  # dotted key
    entry: tuple[int, ...] | None  # index of the list entry; None for a scalar or for all entries together
    std: float  # in the key's unit; for all entries together, the standard deviation of the first entry

    def step_parameter(self, mechanism: Mechanism) -> Mechanism:
        """Return the mechanism with this parameter increased by one standard deviation."""
        structs, names = [mechanism], self.path.split(".")
        for name in names[:-1]:
            structs.append(getattr(structs[-1], name))
        value: Any = _step_value(getattr(structs[-1], names[-1]), self.entry, self.std)
        for struct, name in zip(reversed(structs), reversed(names), strict=True):
            value = msgspec.structs.replace(struct, **{name: value})
        return value


def list_uncertain_parameters(mechanism: Mechanism) -> tuple[list[UncertainParameter], np.ndarray]:
    """Return the uncertain parameters that affect the sensor readings, and their correlation matrix.

    The parameters are those in the file's `[uncertainty]`, and always the delays and the stiffness.
    """
    result, columns = [], []
    drawn = draw(mechanism, UNCERTAINTY_DRAWS, 0)
    for path in [name for name in mechanism.uncertainty if name.startswith(READING_PREFIXES)]:
        values = drawn[path].reshape(UNCERTAINTY_DRAWS, -1)
        independent = mechanism.uncertainty[path].independent
        indices = [*np.ndindex(drawn[path].shape[1:])] if independent else [None]
        for index, column in zip(indices, values.T, strict=False):
            if column.std() > 0.0:
                result.append(
                    UncertainParameter(path, index, max(float(column.std()), get_min_std(mechanism, path)))
                )
                columns.append(column)
    correlation = np.atleast_2d(np.corrcoef(columns)) if columns else np.zeros((0, 0))
    missing = [
        path for path in (*DELAY_KEYS, STIFFNESS_KEY) if path not in {number.path for number in result}
    ]
    result += [UncertainParameter(path, None, get_min_std(mechanism, path)) for path in missing]
    matrix = np.eye(len(result))
    matrix[: len(columns), : len(columns)] = correlation
    return result, matrix


def get_min_std(mechanism: Mechanism, path: str) -> float:
    """Return the minimum standard deviation that the monitor assumes for a parameter."""
    if path in DELAY_KEYS:
        return MIN_DELAY_STD
    return MIN_SCALE_STD * float(np.ravel(value_at(mechanism, path))[0]) if path == STIFFNESS_KEY else 0.0


def _step_value(value: Any, entry: tuple[int, ...] | None, step: float) -> Any:
    """Increase a scalar, an entry of a list or, if `entry` is None, all entries of a list."""
    table = np.array(value, float)
    if entry is not None and table.ndim:
        table[entry] += step
    elif table.ndim and np.ptp(table) > 0.0:
        table *= 1.0 + step / table.flat[0]  # As in `draw`, all entries change by the same factor.
    else:
        table += step
    return table.tolist()
