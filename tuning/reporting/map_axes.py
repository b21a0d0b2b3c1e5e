"""The two axes of a stability map: keys of the mechanism file, or gains, from one end to the other.

The entries of a list scale together, and its first one says how far; `contact.stiffness[1]` is one entry.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, shown
from jaxhil.laws.simulation_base import Compensator
from jaxhil.mechanism.conversion import close_match, dotted
from jaxhil.mechanism.file import from_builtins, to_builtins
from jaxhil.mechanism.overrides import KeyProblem, parse_key
from jaxhil.mechanism.structs import Mechanism, numeric_keys, value_at
from jaxhil.mechanism.uncertainty import dimensions, extremes, quantiles
from jaxhil.simulation.gain_file import bounds_of
from jaxhil.simulation.plausibility import check_run
from tuning.sweeps.columns import unit_of

GAINS = "gains."
NOMINAL_SHARES = 0.3, 3.0  # of the nominal value, where nothing else says how far an axis goes
NORMAL_ENDS = 0.001, 0.999  # probabilities at which the axis of a normal distribution ends
LOGARITHMIC = 5.0  # from this ratio of its ends on
ALLOWED = "PATH or PATH=LOW:HIGH, such as contact.stiffness=5e4:5e5"


class MapAxis(NamedTuple):
    """What varies along an axis."""

    key: str  # as asked for: a dotted path, with indices into lists, or gains.NAME
    path: str  # the key's, without indices; "" for a gain
    entry: tuple[int, ...]  # of a list, where one is meant
    unit: str  # SI
    nominal: float  # of the mechanism, or of the gains; of a list that of its first entry
    low: float
    high: float

    @property
    def logarithmic(self) -> bool:
        return self.low > 0 and self.high > LOGARITHMIC * self.low

    def values(self, points: int) -> np.ndarray:
        """So many values from one end to the other, (points,)."""
        return (np.geomspace if self.logarithmic else np.linspace)(self.low, self.high, points)


def parse_axis(
    name: str, text: Any, mechanism: Mechanism, law: Compensator, gains: Mapping[str, float]
) -> MapAxis:
    """The axis that PATH or PATH=LOW:HIGH asks for. Raises `InputError` that calls it `name`."""
    if not isinstance(text, str):
        raise InputError(f"{name}: found {shown(text)}, allowed {ALLOWED}")
    key, given, ends = text.partition("=")
    key = key.strip()
    axis = (_gain if key.startswith(GAINS) else _key)(name, key, mechanism, law, gains)
    if given:
        axis = axis._replace(**dict(zip(("low", "high"), _ends(name, key, ends), strict=True)))
    if not axis.low < axis.high:
        found = f"{axis.nominal:g} as its value, and nothing that says how far it goes"
        raise InputError(f"{name} {key}: found {found}, allowed {key}=LOW:HIGH")
    return axis


def draws(mechanism: Mechanism, axes: Sequence[MapAxis], values: np.ndarray) -> dict[str, np.ndarray]:
    """Values (lanes, axes) of the axes as draws of the mechanism's keys; those of gains are not in them."""
    drawn: dict[str, np.ndarray] = {}
    for place, axis in enumerate(axes):
        if not axis.path:
            continue
        nominal = np.asarray(value_at(mechanism, axis.path), float)
        table = drawn.setdefault(axis.path, np.repeat(nominal[None], len(values), axis=0))
        part = (slice(None), *axis.entry)
        column = values[:, place].reshape(-1, *[1] * (table[part].ndim - 1))
        table[part] = table[part] * (column / axis.nominal) if nominal.ndim and axis.nominal else column
    return drawn


def check_axes(mechanism: Mechanism, axes: Sequence[MapAxis]) -> None:
    """At all four corners of the map there is a mechanism that can be run. Raises `InputError`."""
    if axes[0].key == axes[1].key:
        raise InputError(f"y: found {axes[1].key}, allowed another key than that of x")
    raw = to_builtins(mechanism)
    for name in ("uncertainty", "correlation"):
        raw.pop(name, None)
    for first in (axes[0].low, axes[0].high):
        for second in (axes[1].low, axes[1].high):
            drawn = draws(mechanism, axes, np.array([[first, second]]))
            changes = {path: value[0].tolist() for path, value in drawn.items()}
            corner = from_builtins(raw, mechanism.name, changes)  # pyright: ignore[reportArgumentType]
            check_run(corner)


def _gain(name: str, key: str, mechanism: Mechanism, law: Compensator, gains: Mapping[str, float]) -> MapAxis:
    known = {gain.name: gain for gain in law.gains}
    gain = known.get(key.removeprefix(GAINS))
    if gain is None:
        allowed = ", ".join(GAINS + one for one in known) or f"no gain: {law.name} has none"
        hint = close_match(key.removeprefix(GAINS), known)
        raise InputError(f"{name}: found {shown(key)}, allowed {allowed}{hint}")
    low, high, _ = bounds_of(gain, mechanism)
    return MapAxis(key, "", (), gain.unit, gains[gain.name], low, high)


def _key(name: str, key: str, mechanism: Mechanism, law: Compensator, gains: Mapping[str, float]) -> MapAxis:
    try:
        parts = parse_key(key)
    except KeyProblem:
        raise InputError(f"{name}: found {shown(key)}, allowed {ALLOWED}") from None
    entry = tuple(part for part in parts if isinstance(part, int))
    path = dotted(parts[: len(parts) - len(entry)])
    known = [one for one in numeric_keys() if not one.startswith("uncertainty")]
    if path not in known:
        raise InputError(f"{name}: found {shown(key)}, allowed a real number{close_match(path, known)}")
    value = value_at(mechanism, path)
    shape = np.shape(value)
    if len(entry) > len(shape) or any(index >= size for index, size in zip(entry, shape, strict=False)):
        raise InputError(f"{name} {key}: found a value of the shape {shape}, allowed indices into it")
    if value is None or value == []:
        raise InputError(
            f"{name} {key}: found no value of it in {mechanism.name}, allowed a key that has one"
        )
    nominal = float(np.asarray(value, float)[entry].flat[0])
    low, high = _reach(mechanism, path, entry, nominal)
    return MapAxis(
        key, path, entry, unit_of(mechanism, path) or numeric_keys()[path].unit, nominal, low, high
    )


def _reach(mechanism: Mechanism, path: str, entry: tuple[int, ...], nominal: float) -> tuple[float, float]:
    """From where to where a key goes: what is drawn of it, else shares of the nominal value within what is
    allowed; twice the same where there is no such range."""
    known = mechanism.uncertainty.get(path)
    if known is not None:
        if known.distribution == "normal":
            points = np.repeat(np.array(NORMAL_ENDS)[:, None], sum(dimensions(mechanism).values()), axis=1)
            ends = quantiles(mechanism, points)[path]
        else:
            ends = extremes(mechanism)[path]
        low, high = sorted(float(np.asarray(end)[entry].flat[0]) for end in ends)
        return low, high
    if not np.isfinite(nominal) or nominal == 0:
        return nominal, nominal
    low, high = sorted(share * nominal for share in NOMINAL_SHARES)
    allowed = numeric_keys()[path]
    return (low if allowed.allows(low) else nominal), (high if allowed.allows(high) else allowed.high)


def _ends(name: str, key: str, text: str) -> tuple[float, float]:
    try:
        low, high = (float(end) for end in text.split(":"))
    except ValueError:
        low = high = 0.0
    if not (low < high and np.isfinite(low) and np.isfinite(high)):
        raise InputError(f"{name} {key}: found {shown(text)}, allowed LOW:HIGH, two numbers, LOW < HIGH")
    return low, high
