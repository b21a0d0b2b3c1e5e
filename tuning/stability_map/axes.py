"""Axes of a stability map: keys of the mechanism file, or gains, with a range of values.

If the value of a key is a list, all entries are scaled by the same factor, and the axis shows the first
entry. A key with an index, such as `contact.stiffness[1]`, varies only this entry.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, format_value
from jaxhil.laws.simulation_base import Compensator
from jaxhil.laws.six_axis_base import SixAxisCompensator
from jaxhil.mechanism.conversion import format_key_path, suggest_names
from jaxhil.mechanism.file import AnyMechanism, any_from_plain_data, to_plain_data
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.overrides import KeyProblem, parse_key
from jaxhil.mechanism.six_axes import SixAxisMechanism, numeric_keys_of
from jaxhil.mechanism.uncertainty import compute_quantiles, count_dimensions, draw_extremes
from jaxhil.simulation.gain_file import resolve_gain_bounds
from jaxhil.simulation.plausibility import check_run
from tuning.sweeps.columns import find_key_unit

GAIN_PREFIX = "gains."
DEFAULT_RANGE_FACTORS = 0.3, 3.0  # axis' ends for a key without uncertainty, divided by its nominal value
NORMAL_RANGE_PROBABILITIES = 0.001, 0.999  # probabilities of the quantiles at the axis' ends
MIN_LOGARITHMIC_RATIO = 5.0  # smallest ratio of the axis' ends for a logarithmic scale
AnyCompensator = Compensator | SixAxisCompensator
AXIS_FORMAT = "PATH or PATH=LOW:HIGH, such as contact.stiffness=5e4:5e5"


class MapAxis(NamedTuple):
    """Axis of a stability map: a key of the mechanism file or a gain, with a range of values."""

    key: str  # dotted path as the user typed it, with indices into lists, or gains.NAME
    path: str  # path of the key without indices; "" for a gain
    entry: tuple[int, ...]  # indices of one entry of a list; () if the whole value varies
    unit: str  # SI unit of the values
    nominal: float  # nominal value (of the first entry, if the value is a list)
    low: float  # lower end of the range
    high: float  # upper end of the range

    @property
    def logarithmic(self) -> bool:
        """Return whether successive values on the axis have equal ratios instead of equal differences."""
        return self.low > 0 and self.high > MIN_LOGARITHMIC_RATIO * self.low

    def values(self, points: int) -> np.ndarray:
        """Return `points` values from the lower to the upper end of the axis, (points,)."""
        return (np.geomspace if self.logarithmic else np.linspace)(self.low, self.high, points)


def parse_axis(
    name: str, text: Any, mechanism: AnyMechanism, law: AnyCompensator, gains: Mapping[str, float]
) -> MapAxis:
    """Convert the text PATH or PATH=LOW:HIGH to an axis.

    Raise `InputError` for a wrong text; the message begins with `name`, the name of the argument.
    """
    if not isinstance(text, str):
        raise InputError(f"{name}: found {format_value(text)}, expected {AXIS_FORMAT}")
    key, separator, ends = text.partition("=")
    key = key.strip()
    axis = (_gain_axis if key.startswith(GAIN_PREFIX) else _key_axis)(name, key, mechanism, law, gains)
    if separator:
        axis = axis._replace(**dict(zip(("low", "high"), _parse_range(name, key, ends), strict=True)))
    if not axis.low < axis.high:
        problem = f"the nominal value {axis.nominal:g}, from which no default range follows"
        raise InputError(f"{name} {key}: found {problem}, expected {key}=LOW:HIGH")
    return axis


def mechanism_draws(
    mechanism: AnyMechanism, axes: Sequence[MapAxis], values: np.ndarray
) -> dict[str, np.ndarray]:
    """Convert points of a map, (lanes, axes), to values by key of the mechanism file, each (lanes, ...).

    Axes of gains are ignored.
    """
    drawn: dict[str, np.ndarray] = {}
    for index, axis in enumerate(axes):
        if not axis.path:
            continue
        nominal = np.asarray(value_at(mechanism, axis.path), float)
        table = drawn.setdefault(axis.path, np.repeat(nominal[None], len(values), axis=0))
        selected = (slice(None), *axis.entry)
        column = values[:, index].reshape(-1, *[1] * (table[selected].ndim - 1))
        is_scaled = nominal.ndim and axis.nominal
        table[selected] = table[selected] * (column / axis.nominal) if is_scaled else column
    return drawn


def check_axes(mechanism: AnyMechanism, axes: Sequence[MapAxis]) -> None:
    """Raise `InputError` if both axes have the same key, or if a corner of the map cannot be simulated."""
    if axes[0].key == axes[1].key:
        raise InputError(f"y: found {axes[1].key}, expected a key that differs from the key of x")
    raw = to_plain_data(mechanism)
    for name in ("uncertainty", "correlation"):
        raw.pop(name, None)
    for first in (axes[0].low, axes[0].high):
        for second in (axes[1].low, axes[1].high):
            drawn = mechanism_draws(mechanism, axes, np.array([[first, second]]))
            changes = {path: value[0].tolist() for path, value in drawn.items()}
            _check_corner(any_from_plain_data(raw, mechanism.name, changes))


def _check_corner(mechanism: AnyMechanism) -> None:
    """Raise `InputError` if the mechanism at a corner of the map cannot be simulated."""
    if not isinstance(mechanism, SixAxisMechanism):
        check_run(mechanism)
        return
    from jaxhil.sixdof.building import build_scenarios
    from jaxhil.sixdof.plausibility import check_scenario

    check_scenario(mechanism, build_scenarios(mechanism))


def _gain_axis(
    name: str, key: str, mechanism: AnyMechanism, law: AnyCompensator, gains: Mapping[str, float]
) -> MapAxis:
    """Return the axis of a gain, by default between its bounds; raise `InputError` for an unknown gain."""
    gain_by_name = {gain.name: gain for gain in law.gains}
    gain = gain_by_name.get(key.removeprefix(GAIN_PREFIX))
    if gain is None:
        allowed = ", ".join(GAIN_PREFIX + name for name in gain_by_name) or f"no gain: {law.name} has none"
        hint = suggest_names(key.removeprefix(GAIN_PREFIX), gain_by_name)
        raise InputError(f"{name}: found {format_value(key)}, expected {allowed}{hint}")
    low, high, _ = resolve_gain_bounds(gain, mechanism)
    return MapAxis(key, "", (), gain.unit, gains[gain.name], low, high)


def _key_axis(
    name: str, key: str, mechanism: AnyMechanism, law: AnyCompensator, gains: Mapping[str, float]
) -> MapAxis:
    """Return the axis of a key with its default range; raise `InputError` if the key cannot be an axis."""
    try:
        parts = parse_key(key)
    except KeyProblem:
        raise InputError(f"{name}: found {format_value(key)}, expected {AXIS_FORMAT}") from None
    entry = tuple(part for part in parts if isinstance(part, int))
    path = format_key_path(parts[: len(parts) - len(entry)])
    paths = [name for name in numeric_keys_of(mechanism) if not name.startswith("uncertainty")]
    if path not in paths:
        raise InputError(
            f"{name}: found {format_value(key)}, expected the key of a number{suggest_names(path, paths)}"
        )
    value = value_at(mechanism, path)
    shape = np.shape(value)
    if len(entry) > len(shape) or any(index >= size for index, size in zip(entry, shape, strict=False)):
        raise InputError(f"{name} {key}: found the shape {shape}, expected indices within this shape")
    if value is None or value == []:
        raise InputError(f"{name} {key}: found no value in {mechanism.name}, expected a key that has a value")
    nominal = float(np.asarray(value, float)[entry].flat[0])
    low, high = _default_range(mechanism, path, entry, nominal)
    return MapAxis(key, path, entry, find_key_unit(mechanism, path), nominal, low, high)


def _default_range(
    mechanism: AnyMechanism, path: str, entry: tuple[int, ...], nominal: float
) -> tuple[float, float]:
    """Return the default range of a key.

    This is the range of the key's uncertainty. Without uncertainty it is `DEFAULT_RANGE_FACTORS` times the
    nominal value, clipped to the allowed values. If the nominal value is 0 or infinite, both ends equal the
    nominal value.
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
    low, high = sorted(factor * nominal for factor in DEFAULT_RANGE_FACTORS)
    allowed = numeric_keys_of(mechanism)[path]
    return (low if allowed.allows(low) else nominal), (high if allowed.allows(high) else allowed.high)


def _parse_range(name: str, key: str, text: str) -> tuple[float, float]:
    """Parse a text LOW:HIGH to two numbers; raise `InputError` unless they are finite and LOW < HIGH."""
    try:
        low, high = (float(end) for end in text.split(":"))
    except ValueError:
        low = high = 0.0
    if not (low < high and np.isfinite(low) and np.isfinite(high)):
        raise InputError(
            f"{name} {key}: found {format_value(text)}, expected two numbers LOW:HIGH with LOW < HIGH"
        )
    return low, high
