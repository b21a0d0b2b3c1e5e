"""Reading a gain file: the gains of a compensator, with the mechanism and the rig that they were tuned for.

First the checks that the rig makes too (`jaxhil.rig.gain_file`), then those that need the mechanism and
the registry of compensators. A file is refused as a whole, in one line that says what is wrong.
"""

import os
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, NamedTuple

from jaxhil.errors import InputError, one_line, shown
from jaxhil.laws.compensators import COMPENSATORS, SIX_AXES, compensator_of
from jaxhil.laws.simulation_base import Compensator, Gain
from jaxhil.mechanism.conversion import close_match
from jaxhil.mechanism.file import AnyMechanism, any_from_builtins, from_builtins
from jaxhil.rig import GainFileError
from jaxhil.rig.gain_file import check_gain_document, read_gain_document
from jaxhil.rig.registry import COMPENSATORS as RUNTIME_COMPENSATORS
from jaxhil.rig.registry import GainSpecification

ROUNDING = 1e-9  # by which a bound worked out elsewhere may differ


class LoadedGains(NamedTuple):
    """A checked gain file."""

    document: dict[str, Any]  # its whole content
    compensator: str
    gains: dict[str, float]  # by name, in SI units
    mechanism: Any  # that the gains were tuned for, a `Mechanism`; a `SixAxisMechanism` where that may be


def load_gain_file(path: str | os.PathLike[str], any_axes: bool = False) -> LoadedGains:
    """The gain file at `path`, checked as a whole; of one axis, unless `any_axes` will do.

    Raises `InputError`, one line, for whatever is wrong."""
    source = one_line(os.fspath(path))
    try:
        document = read_gain_document(path)
    except GainFileError as error:
        raise InputError(str(error)) from None
    return check_document(document, source, any_axes)


def check_document(
    document: dict[str, Any], source: str = "gain document", any_axes: bool = False
) -> LoadedGains:
    """The content of a gain file, checked as a whole; errors call it `source`; of one axis, unless `any_axes`
    will do. Raises `InputError`."""
    try:
        on_the_rig = check_gain_document(document, source, _simulated_only(), (1, 6) if any_axes else (1,))
    except GainFileError as error:
        raise InputError(str(error)) from None
    for key, (fits, allowed) in _REQUIRED.items():
        if key not in document:
            raise _refusal(source, key, "nothing", "this key is required")
        if not fits(document[key]):
            raise _refusal(source, key, shown(document[key]), allowed)
    read = any_from_builtins if document.get("axes") == 6 else from_builtins
    mechanism = read(document["mechanism"], f"{source}: mechanism")
    law = look_up(on_the_rig.compensator, source).gains
    check_names(on_the_rig.gains, law, f"{source}: gains")
    for gain in law:
        _check_entry(gain, document["gains"][gain.name], mechanism, source)
    return LoadedGains(document, on_the_rig.compensator, dict(on_the_rig.gains), mechanism)


def look_up(compensator: object, source: str) -> Compensator:
    """The compensator of that name, built in or registered. Raises `InputError` that begins with `source`."""
    if not isinstance(compensator, str) or compensator not in {**COMPENSATORS, **SIX_AXES}:
        hint = close_match(compensator, COMPENSATORS) if isinstance(compensator, str) else ""
        allowed = f"one of {', '.join(COMPENSATORS)}{hint}"
        raise _refusal(source, "compensator", shown(compensator), allowed)
    return compensator_of(compensator)


def check_names(gains: Mapping[str, Any], law: tuple[Gain, ...], source: str) -> None:
    """`gains` are those of the law, all of them and no other. Raises `InputError`."""
    names = [gain.name for gain in law]
    if set(gains) != set(names):
        wrong = sorted(set(gains) ^ set(names))[0]
        found = "an extra gain" if wrong in gains else "nothing"
        raise _refusal(source, one_line(str(wrong), 60), found, ", ".join(names) or "no gains")


def bounds_of(gain: Gain, mechanism: Any) -> tuple[float, float, float]:
    """Lower and upper bound of a gain for a mechanism, and by how much rounding may miss them."""
    lower, upper = float(gain.lower(mechanism)), float(gain.upper(mechanism))
    return lower, upper, ROUNDING * max(abs(lower), abs(upper))


def _simulated_only() -> dict[str, dict[str, GainSpecification]]:
    """The gains of compensators that were registered without a runtime class, or are of six axes alone."""
    return {
        name: {gain.name: GainSpecification(gain.unit) for gain in law.gains}
        for name, law in {**COMPENSATORS, **SIX_AXES}.items()
        if name not in RUNTIME_COMPENSATORS
    }


def _check_entry(gain: Gain, entry: Mapping[str, Any], mechanism: AnyMechanism, source: str) -> None:
    key = f"gains.{gain.name}"
    if entry["unit"] != gain.unit:
        raise _refusal(source, f"{key}.unit", shown(entry["unit"]), f"'{gain.unit}'")
    lower, upper, margin = bounds_of(gain, mechanism)
    for bound in ("lower", "upper"):
        if not lower - margin <= entry[bound] <= upper + margin:
            allowed = f"{lower:.12g} to {upper:.12g} for this mechanism"
            raise _refusal(source, f"{key}.{bound}", shown(entry[bound]), allowed)


def _refusal(source: str, key: str, found: str, allowed: str) -> InputError:
    where = f"{source}: {key}" if source else key
    return InputError(f"{where}: found {found}, allowed {allowed}")


def _is_date(value: object) -> bool:
    try:
        return isinstance(value, str) and datetime.fromisoformat(value).tzinfo is not None
    except ValueError:
        return False


def _is_envelope(value: object) -> bool:
    return isinstance(value, Mapping) and all(
        isinstance(span, Mapping) and {"low", "high", "unit"} <= span.keys() for span in value.values()
    )


def _is_object(value: object) -> bool:
    return isinstance(value, Mapping)


def _is_table_of_texts(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(text, str) for text in value.values())


# Of each further key of a gain file: whether its value will do, and what is allowed.
_REQUIRED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "mechanism_sha256": (
        lambda value: isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) is not None,
        "64 hexadecimal digits",
    ),
    "envelope": (_is_envelope, "an object of {low, high, unit} objects"),
    "figures": (_is_object, "an object"),
    "seed": (
        lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= 0,
        "an integer >= 0",
    ),
    "versions": (_is_table_of_texts, "an object of texts"),
    "created": (_is_date, "a date and time with time zone, as 2030-01-31T12:00:00+00:00"),
    "timings": (_is_object, "an object"),
}
