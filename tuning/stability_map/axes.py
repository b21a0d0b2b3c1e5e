"""Axes of a stability map: keys of the mechanism file, or gains, with a range of values.

The entries of a list are scaled together, and the range is that of the first; `contact.stiffness[1]` is one
entry.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, format_value
from jaxhil.laws.simulation_base import Compensator
from jaxhil.mechanism.conversion import format_key_path, suggest_names
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from jaxhil.mechanism.overrides import KeyProblem, parse_key
from jaxhil.mechanism.structs import Mechanism, numeric_keys, value_at
from jaxhil.mechanism.uncertainty import compute_quantiles, count_dimensions, draw_extremes
from jaxhil.simulation.gain_file import resolve_gain_bounds
from jaxhil.simulation.plausibility import check_run
from tuning.sweeps.columns import find_key_unit

GAIN_PREFIX = "gains."
DEFAULT_RANGE_FACTORS = 0.3, 3.0  # default range of an axis, over the nominal value
NORMAL_RANGE_PROBABILITIES = 0.001, 0.999  # probabilities at which the axis of a normal distribution ends
MIN_LOGARITHMIC_RATIO = 5.0  # ratio of its ends above which an axis is logarithmic
AXIS_FORMAT = "PATH or PATH=LOW:HIGH, such as contact.stiffness=5e4:5e5"


class MapAxis(NamedTuple):
    """Axis of a map."""

    key: str  # dotted path as given, with indices into lists, or gains.NAME
    path: str  # path of the key without indices; "" for a gain
    entry: tuple[int, ...]  # indices of an entry of a list; () for the whole value
    unit: str  # SI
    nominal: float  # nominal value; for a list that of its first entry
    low: float  # lower end of the range
    high: float  # upper end of the range

    @property
    def logarithmic(self) -> bool:
        """Return whether the values have equal ratios instead of equal differences."""
        return self.low > 0 and self.high > MIN_LOGARITHMIC_RATIO * self.low

    def values(self, points: int) -> np.ndarray:
        """Return `points` values from the lower to the upper end, (points,)."""
        return (np.geomspace if self.logarithmic else np.linspace)(self.low, self.high, points)


def parse_axis(
    name: str, text: Any, mechanism: Mechanism, law: Compensator, gains: Mapping[str, float]
) -> MapAxis:
    """Return the axis for a text PATH or PATH=LOW:HIGH.

    Raise `InputError`, with `name` as the name of the argument.
    """
    if not isinstance(text, str):
        raise InputError(f"{name}: found {format_value(text)}, expected {AXIS_FORMAT}")
    key, separator, ends = text.partition("=")
    key = key.strip()
    axis = (_gain_axis if key.startswith(GAIN_PREFIX) else _key_axis)(name, key, mechanism, law, gains)
    if separator:
        axis = axis._replace(**dict(zip(("low", "high"), _parse_range(name, key, ends), strict=True)))
    if not axis.low < axis.high:
        found = f"{axis.nominal:g} as its value, and nothing that says how far it goes"
        raise InputError(f"{name} {key}: found {found}, expected {key}=LOW:HIGH")
    return axis


def mechanism_draws(
    mechanism: Mechanism, axes: Sequence[MapAxis], values: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the points `values` (lanes, axes) as draws of the mechanism's keys, without those of gains."""
    drawn: dict[str, np.ndarray] = {}
    for index, axis in enumerate(axes):
        if not axis.path:
            continue
        nominal = np.asarray(value_at(mechanism, axis.path), float)
        table = drawn.setdefault(axis.path, np.repeat(nominal[None], len(values), axis=0))
        part = (slice(None), *axis.entry)
        column = values[:, index].reshape(-1, *[1] * (table[part].ndim - 1))
        table[part] = table[part] * (column / axis.nominal) if nominal.ndim and axis.nominal else column
    return drawn


def check_axes(mechanism: Mechanism, axes: Sequence[MapAxis]) -> None:
    """Raise `InputError` unless the keys differ and the mechanisms at all four corners can be simulated."""
    if axes[0].key == axes[1].key:
        raise InputError(f"y: found {axes[1].key}, expected another key than that of x")
    raw = to_plain_data(mechanism)
    for name in ("uncertainty", "correlation"):
        raw.pop(name, None)
    for first in (axes[0].low, axes[0].high):
        for second in (axes[1].low, axes[1].high):
            drawn = mechanism_draws(mechanism, axes, np.array([[first, second]]))
            changes = {path: value[0].tolist() for path, value in drawn.items()}
            corner = from_plain_data(raw, mechanism.name, changes)  # pyright: ignore[reportArgumentType]
            check_run(corner)


def _gain_axis(
    name: str, key: str, mechanism: Mechanism, law: Compensator, gains: Mapping[str, float]
) -> MapAxis:
    """Return the axis of a gain, with its bounds as the range."""
    gain_by_name = {gain.name: gain for gain in law.gains}
    gain = gain_by_name.get(key.removeprefix(GAIN_PREFIX))
    if gain is None:
        allowed = ", ".join(GAIN_PREFIX + name for name in gain_by_name) or f"no gain: {law.name} has none"
        hint = suggest_names(key.removeprefix(GAIN_PREFIX), gain_by_name)
        raise InputError(f"{name}: found {format_value(key)}, expected {allowed}{hint}")
    low, high, _ = resolve_gain_bounds(gain, mechanism)
    return MapAxis(key, "", (), gain.unit, gains[gain.name], low, high)


def _key_axis(
    name: str, key: str, mechanism: Mechanism, law: Compensator, gains: Mapping[str, float]
) -> MapAxis:
    """Return the axis of a key of the mechanism file, with its default range."""
    try:
        parts = parse_key(key)
    except KeyProblem:
        raise InputError(f"{name}: found {format_value(key)}, expected {AXIS_FORMAT}") from None
    entry = tuple(part for part in parts if isinstance(part, int))
    path = format_key_path(parts[: len(parts) - len(entry)])
    paths = [name for name in numeric_keys() if not name.startswith("uncertainty")]
    if path not in paths:
        raise InputError(
            f"{name}: found {format_value(key)}, expected a real number{suggest_names(path, paths)}"
        )
    value = value_at(mechanism, path)
    shape = np.shape(value)
    if len(entry) > len(shape) or any(index >= size for index, size in zip(entry, shape, strict=False)):
        raise InputError(f"{name} {key}: found a value of the shape {shape}, expected indices into it")
    if value is None or value == []:
        raise InputError(
            f"{name} {key}: found no value of it in {mechanism.name}, expected a key that has one"
        )
    nominal = float(np.asarray(value, float)[entry].flat[0])
    low, high = _default_range(mechanism, path, entry, nominal)
    return MapAxis(key, path, entry, find_key_unit(mechanism, path), nominal, low, high)


def _default_range(
    mechanism: Mechanism, path: str, entry: tuple[int, ...], nominal: float
) -> tuple[float, float]:
    """Return the default range of a key.

    It is the range of the key's uncertainty, or shares of the nominal value within the allowed values; if
    there is no such range, both ends are the nominal value.
    """
    uncertain = mechanism.uncertainty.get(path)
    if uncertain is not None:
        if uncertain.distribution == "normal":
            points = np.repeat(
                np.array(NORMAL_RANGE_PROBABILITIES)[:, None],
                sum(count_dimensions(mechanism).values()),
                axis=1,
            )
            ends = compute_quantiles(mechanism, points)[path]
        else:
            ends = draw_extremes(mechanism)[path]
        low, high = sorted(float(np.asarray(end)[entry].flat[0]) for end in ends)
        return low, high
    if not np.isfinite(nominal) or nominal == 0:
        return nominal, nominal
    low, high = sorted(share * nominal for share in DEFAULT_RANGE_FACTORS)
    allowed = numeric_keys()[path]
    return (low if allowed.allows(low) else nominal), (high if allowed.allows(high) else allowed.high)


def _parse_range(name: str, key: str, text: str) -> tuple[float, float]:
    """Return the two numbers of LOW:HIGH. Raise `InputError`."""
    try:
        low, high = (float(end) for end in text.split(":"))
    except ValueError:
        low = high = 0.0
    if not (low < high and np.isfinite(low) and np.isfinite(high)):
        raise InputError(
            f"{name} {key}: found {format_value(text)}, expected LOW:HIGH, two numbers, LOW < HIGH"
        )
    return low, high
