"""Choice of a compensator's gains: literature values, named setting, dict, or gain file."""

import math
import os
from collections.abc import Mapping
from typing import Any

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.laws.compensators import axes_of, literature_gains
from jaxhil.laws.simulation_base import Compensator
from jaxhil.laws.six_axis_base import SixAxisCompensator
from jaxhil.mechanism.conversion import suggest_names
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.gain_file import LoadedGains, find_compensator, load_gain_file, resolve_gain_bounds


def choose_gains(mechanism: AnyMechanism, compensator: object, gains: object) -> tuple[str, dict[str, float]]:
    """Return the name of the compensator and its gains by name [SI units].

    Args:
        mechanism: Mechanism that the compensator will control.
        compensator: Name of the compensator. With a gain file, "none" selects the compensator of the file.
        gains: One of the following. None: all gains have the values that the literature recommends. Name of
            a setting of the compensator: the gains of this setting. Dict: values of some gains; the others
            have the values of the literature. Path of a gain file: the gains of this file. A text is a path
            if it has a separator or a suffix, or if it names an existing file.

    Raises:
        InputError: The compensator, the setting or a gain is unknown; a value is out of its bounds; or the
            gain file is invalid, or is for a different compensator, control period or number of axes.
    """
    law = find_compensator(compensator, "", axes_of(mechanism))
    if gains is None:
        return law.name, literature_gains(mechanism, law.name)
    if isinstance(gains, Mapping):
        return law.name, _complete_gains(mechanism, law, gains)
    if isinstance(gains, str) and gains in law.settings:
        return law.name, literature_gains(mechanism, law.name, gains)
    if isinstance(gains, os.PathLike) or (isinstance(gains, str) and _is_path(gains)):
        return _read_gains(mechanism, law, gains)
    settings = ", ".join(map(repr, law.settings)) or f"no setting's name ({law.name} has none)"
    hint = suggest_names(gains, law.settings) if isinstance(gains, str) else ""
    allowed = f"None, a dict of gains, a gain file's path or {settings}{hint}"
    raise InputError(f"gains: found {format_value(gains)}, expected {allowed}")


def check_fit(mechanism: AnyMechanism, loaded: LoadedGains, label: str) -> None:
    """Raise `InputError` if the gains of a file are not usable with a mechanism.

    The control periods must be equal, because gains act once per control period. All gains must lie within
    their bounds for this mechanism, because a bound may be the length of a delay line.
    """
    period, tuned = mechanism.rig.control_period, loaded.mechanism.rig.control_period
    if period != tuned:
        raise InputError(f"{label}: control_period: found {tuned:g} s, expected the mechanism's {period:g} s")
    for gain in find_compensator(loaded.compensator, label, axes_of(mechanism)).gains:
        value = loaded.gains[gain.name]
        lower, upper, margin = resolve_gain_bounds(gain, mechanism)
        if not lower - margin <= value <= upper + margin:
            raise InputError(
                f"{label}: gains.{gain.name}: found {value:.6g}, expected {lower:.6g} to {upper:.6g} "
                f"{gain.unit} for this mechanism"
            )


def _is_path(text: str) -> bool:
    """Return whether a text is a path: it has a separator or a suffix, or it names an existing file."""
    if os.sep in text or os.path.splitext(text)[1]:
        return True
    try:
        return os.path.exists(text)
    except ValueError:
        return True


def _complete_gains(
    mechanism: AnyMechanism, law: Compensator | SixAxisCompensator, choice: Mapping[Any, Any]
) -> dict[str, float]:
    """Return the gains from the dict `choice`, completed with the literature's values for missing gains."""
    gains = literature_gains(mechanism, law.name)
    specifications = {gain.name: gain for gain in law.gains}
    for name, value in choice.items():
        if name not in specifications:
            hint = suggest_names(name, specifications) if isinstance(name, str) else ""
            allowed = (", ".join(specifications) or f"none: {law.name} has no gains") + hint
            raise InputError(f"gains: found {format_value(name)}, expected {allowed}")
        lower, upper, margin = resolve_gain_bounds(specifications[name], mechanism)
        number = _to_float(value)
        if not lower - margin <= number <= upper + margin:
            allowed = f"{lower:.6g} to {upper:.6g} {specifications[name].unit} for this mechanism"
            raise InputError(f"gains.{name}: found {format_value(value)}, expected {allowed}")
        gains[name] = min(max(number, lower), upper)
    return gains


def _to_float(value: Any) -> float:
    """Convert a number of Python, NumPy or JAX to a float; return NaN for any other object."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def _read_gains(
    mechanism: AnyMechanism, law: Compensator | SixAxisCompensator, path: str | os.PathLike[str]
) -> tuple[str, dict[str, float]]:
    """Return the compensator and the gains of a gain file; raise `InputError` if they are not usable."""
    label = to_one_line(os.fsdecode(path)) or "''"
    loaded = load_gain_file(os.fsdecode(path), any_axes=True)
    if isinstance(loaded.mechanism, Mechanism) != isinstance(mechanism, Mechanism):
        found, allowed = (f"gains for {_describe_axes(item)}" for item in (loaded.mechanism, mechanism))
        raise InputError(f"{label}: axes: found {found}, expected {allowed}")
    if law.name not in ("none", loaded.compensator):
        found = f"compensator: found {law.name}, expected {loaded.compensator}"
        raise InputError(f"{found}, because {label} contains gains for it")
    check_fit(mechanism, loaded, label)
    return loaded.compensator, loaded.gains


def _describe_axes(mechanism: AnyMechanism) -> str:
    return "one axis" if isinstance(mechanism, Mechanism) else "six axes"
