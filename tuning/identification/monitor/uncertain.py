"""How far off a mechanism file's numbers may be: standard deviations, how they hang together, and steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import numpy as np

from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.mechanism.uncertainty import draw

DRAWS = 4096  # that standard deviations and correlations are taken of
KEYS = ("contact.", "rig.simulator.", "rig.force_sensor.", "rig.position_sensor.", "rig.contact_plane")
# Nobody knows a clock or a force sensor's scale better than that [s, 1].
CLOCK, CALIBRATION = 2e-5, 1e-3
DELAYS, STIFFNESS = ("rig.simulator.delay", "rig.force_sensor.delay"), "contact.stiffness"


class Uncertain(NamedTuple):
    """A number of a mechanism file, or one entry of a list, and its standard deviation."""

    path: str
    entry: tuple[int, ...] | None  # of a list; None: all entries together
    std: float  # in the key's unit; of a list, of its first entry

    def stepped(self, mechanism: Mechanism) -> Mechanism:
        """The mechanism with this number one standard deviation up."""
        structs, names = [mechanism], self.path.split(".")
        for name in names[:-1]:
            structs.append(getattr(structs[-1], name))
        value: Any = _stepped(getattr(structs[-1], names[-1]), self.entry, self.std)
        for struct, name in zip(reversed(structs), reversed(names), strict=True):
            value = msgspec.structs.replace(struct, **{name: value})
        return value


def uncertain(mechanism: Mechanism) -> tuple[list[Uncertain], np.ndarray]:
    """The numbers that decide what a log reads, with the correlation between them: those of `[uncertainty]`,
    and delays and stiffness in any case."""
    found, columns = [], []
    drawn = draw(mechanism, DRAWS, 0)
    for path in [one for one in mechanism.uncertainty if one.startswith(KEYS)]:
        values = drawn[path].reshape(DRAWS, -1)
        independent = mechanism.uncertainty[path].independent
        places = [*np.ndindex(drawn[path].shape[1:])] if independent else [None]
        for place, column in zip(places, values.T, strict=False):
            if column.std() > 0.0:
                found.append(Uncertain(path, place, max(float(column.std()), least(mechanism, path))))
                columns.append(column)
    correlation = np.atleast_2d(np.corrcoef(columns)) if columns else np.zeros((0, 0))
    others = [path for path in (*DELAYS, STIFFNESS) if path not in {one.path for one in found}]
    found += [Uncertain(path, None, least(mechanism, path)) for path in others]
    whole = np.eye(len(found))
    whole[: len(columns), : len(columns)] = correlation
    return found, whole


def least(mechanism: Mechanism, path: str) -> float:
    """The standard deviation that a number has at least."""
    if path in DELAYS:
        return CLOCK
    return CALIBRATION * float(np.ravel(value_at(mechanism, path))[0]) if path == STIFFNESS else 0.0


def _stepped(value: Any, entry: tuple[int, ...] | None, step: float) -> Any:
    """A number, or a list all of which or one entry of which has moved."""
    table = np.array(value, float)
    if entry is not None and table.ndim:
        table[entry] += step
    elif table.ndim and np.ptp(table) > 0.0:
        table *= 1.0 + step / table.flat[0]  # as draws scale a list
    else:
        table += step
    return table.tolist()
