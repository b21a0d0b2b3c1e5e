"""The gains that a caller asks for: the literature's, a setting's, some of his own, or a gain file's."""

import math
import os
from collections.abc import Mapping
from typing import Any

from jaxhil.errors import InputError, one_line, shown
from jaxhil.laws.compensators import literature_gains
from jaxhil.laws.simulation_base import Compensator
from jaxhil.mechanism.conversion import close_match
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.gain_file import LoadedGains, bounds_of, load_gain_file, look_up


def choose_gains(mechanism: AnyMechanism, compensator: object, gains: object) -> tuple[str, dict[str, float]]:
    """The compensator's name and its gains [SI units] for a mechanism.

    `gains` is None (the literature's), the name of a setting of the compensator, a dict of some gains (the
    others are the literature's), or a gain file's path. With a file, "none" stands for its compensator. A
    text that is no setting's name is a path if it has a separator or an ending, or if there is such a file.

    Raises `InputError` for an unknown compensator, setting or gain, for a value out of its bounds, and for a
    gain file that cannot be used or does not fit compensator, control period or bounds.
    """
    law = look_up(compensator, "")
    if gains is None:
        return law.name, literature_gains(mechanism, law.name)
    if isinstance(gains, Mapping):
        return law.name, _partial(mechanism, law, gains)
    if isinstance(gains, str) and gains in law.settings:
        return law.name, literature_gains(mechanism, law.name, gains)
    if isinstance(gains, os.PathLike) or (isinstance(gains, str) and _is_path(gains)):
        return _from_file(mechanism, law, gains)
    settings = ", ".join(map(repr, law.settings)) or f"no setting's name ({law.name} has none)"
    hint = close_match(gains, law.settings) if isinstance(gains, str) else ""
    allowed = f"None, a dict of gains, a gain file's path or {settings}{hint}"
    raise InputError(f"gains: found {shown(gains)}, allowed {allowed}")


def check_fit(mechanism: AnyMechanism, loaded: LoadedGains, label: str) -> None:
    """The gains of a file fit a mechanism: they act per control period, and a bound of theirs may be the
    length of a delay line. Raises `InputError`."""
    period, tuned = mechanism.rig.control_period, loaded.mechanism.rig.control_period
    if period != tuned:
        raise InputError(f"{label}: control_period: found {tuned:g} s, allowed {period:g} s of the mechanism")
    for gain in look_up(loaded.compensator, label).gains:
        value = loaded.gains[gain.name]
        lower, upper, margin = bounds_of(gain, mechanism)
        if not lower - margin <= value <= upper + margin:
            raise InputError(
                f"{label}: gains.{gain.name}: found {value:.6g}, allowed {lower:.6g} to {upper:.6g} "
                f"{gain.unit} for this mechanism"
            )


def _is_path(text: str) -> bool:
    if os.sep in text or os.path.splitext(text)[1]:
        return True
    try:
        return os.path.exists(text)
    except ValueError:
        return True


def _partial(mechanism: AnyMechanism, law: Compensator, given: Mapping[Any, Any]) -> dict[str, float]:
    gains = literature_gains(mechanism, law.name)
    known = {gain.name: gain for gain in law.gains}
    for name, value in given.items():
        if name not in known:
            hint = close_match(name, known) if isinstance(name, str) else ""
            allowed = (", ".join(known) or f"none: {law.name} has no gains") + hint
            raise InputError(f"gains: found {shown(name)}, allowed {allowed}")
        lower, upper, margin = bounds_of(known[name], mechanism)
        number = _number(value)
        if not lower - margin <= number <= upper + margin:
            allowed = f"{lower:.6g} to {upper:.6g} {known[name].unit} for this mechanism"
            raise InputError(f"gains.{name}: found {shown(value)}, allowed {allowed}")
        gains[name] = min(max(number, lower), upper)
    return gains


def _number(value: Any) -> float:
    """A number of Python, NumPy or jax; NaN for anything else."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def _from_file(
    mechanism: AnyMechanism, law: Compensator, path: str | os.PathLike[str]
) -> tuple[str, dict[str, float]]:
    label = one_line(os.fsdecode(path)) or "''"
    loaded = load_gain_file(os.fsdecode(path), any_axes=True)
    if isinstance(loaded.mechanism, Mechanism) != isinstance(mechanism, Mechanism):
        found, allowed = f"gains of {_axes(loaded.mechanism)}", f"of {_axes(mechanism)}"
        raise InputError(f"{label}: axes: found {found}, allowed {allowed}")
    if law.name not in ("none", loaded.compensator):
        found = f"compensator: found {law.name}, allowed {loaded.compensator}"
        raise InputError(f"{found}, which {label} is for")
    check_fit(mechanism, loaded, label)
    return loaded.compensator, loaded.gains


def _axes(mechanism: AnyMechanism) -> str:
    return "one axis" if isinstance(mechanism, Mechanism) else "six axes"
