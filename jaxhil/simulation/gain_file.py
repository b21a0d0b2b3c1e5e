"""Reading of gain files: a compensator's gains, and the mechanism and rig for which they were tuned.

The first checks are those that the rig also makes (`jaxhil.rig.gain_file`). Further checks need the mechanism
and the registry of compensators. An invalid file is rejected as a whole, with a one-line message.
"""

import os
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, NamedTuple

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.laws.compensators import COMPENSATORS, SIX_AXIS_COMPENSATORS
from jaxhil.laws.simulation_base import Compensator, Gain
from jaxhil.laws.six_axis_base import SixAxisCompensator
from jaxhil.mechanism.conversion import suggest_names
from jaxhil.mechanism.file import AnyMechanism, any_from_plain_data, from_plain_data
from jaxhil.rig import GainFileError
from jaxhil.rig.gain_file import check_gain_document, read_gain_document
from jaxhil.rig.registry import COMPENSATORS as RUNTIME_COMPENSATORS
from jaxhil.rig.registry import GainSpecification

BOUND_TOLERANCE = 1e-9  # relative tolerance of bounds computed on another machine


class LoadedGains(NamedTuple):
    """Checked gain file."""

    document: dict[str, Any]  # whole content of the file
    compensator: str  # name
    gains: dict[str, float]  # by name, in SI units
    mechanism: Any  # for which the gains were tuned; a `Mechanism`, or a `SixAxisMechanism` if allowed


def load_gain_file(path: str | os.PathLike[str], any_axes: bool = False) -> LoadedGains:
    """Read and check the gain file at `path`; it must be of one axis unless `any_axes` is set.

    Raise `InputError` if anything is wrong.
    """
    source = to_one_line(os.fspath(path))
    try:
        document = read_gain_document(path)
    except GainFileError as error:
        raise InputError(str(error)) from None
    return check_document(document, source, any_axes)


def check_document(
    document: dict[str, Any], source: str = "gain document", any_axes: bool = False
) -> LoadedGains:
    """Check the content of a gain file; it must be of one axis unless `any_axes` is set.

    Raise `InputError`, which calls the document `source`.
    """
    axes = 6 if document.get("axes") == 6 else 1
    try:
        on_the_rig = check_gain_document(
            document, source, _gains_without_runtime(axes), (1, 6) if any_axes else (1,)
        )
    except GainFileError as error:
        raise InputError(str(error)) from None
    for key, (fits, allowed) in _REQUIRED_KEYS.items():
        if key not in document:
            raise _make_error(source, key, "nothing", "this key is required")
        if not fits(document[key]):
            raise _make_error(source, key, format_value(document[key]), allowed)
    read = any_from_plain_data if axes == 6 else from_plain_data
    mechanism = read(document["mechanism"], f"{source}: mechanism")
    law = find_compensator(on_the_rig.compensator, source, axes).gains
    check_gain_names(on_the_rig.gains, law, f"{source}: gains")
    for gain in law:
        _check_entry(gain, document["gains"][gain.name], mechanism, source)
    return LoadedGains(document, on_the_rig.compensator, dict(on_the_rig.gains), mechanism)


def find_compensator(compensator: object, source: str, axes: int = 1) -> Compensator | SixAxisCompensator:
    """Return the compensator with that name for a number of axes.

    Raise `InputError` that begins with `source` if there is none.
    """
    table = SIX_AXIS_COMPENSATORS if axes == 6 else COMPENSATORS
    if not isinstance(compensator, str) or compensator not in table:
        hint = suggest_names(compensator, table) if isinstance(compensator, str) else ""
        allowed = f"one of {', '.join(table)}{hint}"
        raise _make_error(source, "compensator", format_value(compensator), allowed)
    return table[compensator]


def check_gain_names(gains: Mapping[str, Any], law: tuple[Gain, ...], source: str) -> None:
    """Raise `InputError` unless `gains` are exactly the gains of the law."""
    names = [gain.name for gain in law]
    if set(gains) != set(names):
        wrong = sorted(set(gains) ^ set(names))[0]
        found = "an extra gain" if wrong in gains else "nothing"
        raise _make_error(source, to_one_line(str(wrong), 60), found, ", ".join(names) or "no gains")


def resolve_gain_bounds(gain: Gain, mechanism: Any) -> tuple[float, float, float]:
    """Return a gain's lower and upper bound for a mechanism, and their tolerance for rounding."""
    lower, upper = float(gain.lower(mechanism)), float(gain.upper(mechanism))
    return lower, upper, BOUND_TOLERANCE * max(abs(lower), abs(upper))


def _gains_without_runtime(axes: int) -> dict[str, dict[str, GainSpecification]]:
    """Return the gains of compensators without a runtime class for so many axes, by compensator."""
    return {
        name: {gain.name: GainSpecification(gain.unit) for gain in law.gains}
        for name, law in (SIX_AXIS_COMPENSATORS if axes == 6 else COMPENSATORS).items()
        if axes == 6 or name not in RUNTIME_COMPENSATORS
    }


def _check_entry(gain: Gain, entry: Mapping[str, Any], mechanism: AnyMechanism, source: str) -> None:
    """Raise `InputError` if a gain's unit or bounds in the file differ from the law's."""
    key = f"gains.{gain.name}"
    if entry["unit"] != gain.unit:
        raise _make_error(source, f"{key}.unit", format_value(entry["unit"]), f"'{gain.unit}'")
    lower, upper, margin = resolve_gain_bounds(gain, mechanism)
    for bound in ("lower", "upper"):
        if not lower - margin <= entry[bound] <= upper + margin:
            allowed = f"{lower:.12g} to {upper:.12g} for this mechanism"
            raise _make_error(source, f"{key}.{bound}", format_value(entry[bound]), allowed)


def _make_error(source: str, key: str, found: str, allowed: str) -> InputError:
    """Return the error for a key."""
    where = f"{source}: {key}" if source else key
    return InputError(f"{where}: found {found}, expected {allowed}")


def _is_date(value: object) -> bool:
    """Return whether a value is an ISO date and time with time zone."""
    try:
        return isinstance(value, str) and datetime.fromisoformat(value).tzinfo is not None
    except ValueError:
        return False


def _is_envelope(value: object) -> bool:
    """Return whether a value is an object of {low, high, unit} objects."""
    return isinstance(value, Mapping) and all(
        isinstance(span, Mapping) and {"low", "high", "unit"} <= span.keys() for span in value.values()
    )


def _is_object(value: object) -> bool:
    """Return whether a value is an object."""
    return isinstance(value, Mapping)


def _is_table_of_texts(value: object) -> bool:
    """Return whether a value is an object of texts."""
    return isinstance(value, Mapping) and all(isinstance(text, str) for text in value.values())


# For each further key of a gain file: the check of its value, and a description of the allowed values.
_REQUIRED_KEYS: dict[str, tuple[Callable[[Any], bool], str]] = {
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
