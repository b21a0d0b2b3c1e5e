"""Reading and checking of gain files.

A gain file contains the gains of a compensator, and the mechanism for which the gains were tuned. The rig's
controller checks a file without the simulation (`jaxhil.rig.gain_file`). This module repeats these checks and
adds checks that need the mechanism and the registered compensators. A file with any error is rejected with a
one-line message.
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
from jaxhil.rig.six_axes import SIX_AXIS_COMPENSATORS as RUNTIME_SIX_AXIS_COMPENSATORS
from jaxhil.rig.six_axes.gain_file import check_six_axis_document

# relative tolerance of bounds, which other machines may round differently [1]
BOUND_TOLERANCE = 1e-9


class LoadedGains(NamedTuple):
    """Content of a valid gain file.

    Attributes:
        document: All keys of the file.
        compensator: Name of the compensator.
        gains: Gains by name [SI units].
        mechanism: Mechanism for which the gains were tuned: `Mechanism` or `SixAxisMechanism`.
    """

    document: dict[str, Any]
    compensator: str
    gains: dict[str, float]
    mechanism: Any


def load_gain_file(path: str | os.PathLike[str], any_axes: bool = False) -> LoadedGains:
    """Read and check the gain file at `path`. Accept a file for six axes only if `any_axes` is true.

    Raise `InputError` if the file cannot be read or is invalid.
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
    """Check the content of a gain file. Accept a file for six axes only if `any_axes` is true.

    Raise `InputError` if the content is invalid; `source` names the file in the message.
    """
    axes = 6 if isinstance(document, dict) and document.get("axes") == 6 else 1
    try:
        checked = check_gain_document(
            document, source, _gains_without_runtime(axes), (1, 6) if any_axes else (1,)
        )
        if axes == 6 and checked.compensator in RUNTIME_SIX_AXIS_COMPENSATORS:
            check_six_axis_document(document, source)
    except GainFileError as error:
        raise InputError(str(error)) from None
    for key, (fits, allowed) in _REQUIRED_KEYS.items():
        if key not in document:
            raise _make_error(source, key, "nothing", allowed)
        if not fits(document[key]):
            raise _make_error(source, key, format_value(document[key]), allowed)
    read = any_from_plain_data if axes == 6 else from_plain_data
    mechanism = read(document["mechanism"], f"{source}: mechanism")
    law = find_compensator(checked.compensator, source, axes).gains
    check_gain_names(checked.gains, law, f"{source}: gains")
    for gain in law:
        _check_entry(gain, document["gains"][gain.name], mechanism, source)
    return LoadedGains(document, checked.compensator, dict(checked.gains), mechanism)


def find_compensator(compensator: object, source: str, axes: int = 1) -> Compensator | SixAxisCompensator:
    """Return the compensator with the name `compensator` for rigs with `axes` axes.

    Raise `InputError` if there is none; the message begins with `source`.
    """
    table = SIX_AXIS_COMPENSATORS if axes == 6 else COMPENSATORS
    if not isinstance(compensator, str) or compensator not in table:
        hint = suggest_names(compensator, table) if isinstance(compensator, str) else ""
        allowed = f"one of {', '.join(table)}{hint}"
        raise _make_error(source, "compensator", format_value(compensator), allowed)
    return table[compensator]


def check_gain_names(gains: Mapping[str, Any], law: tuple[Gain, ...], source: str) -> None:
    """Raise `InputError` unless the names of `gains` are exactly the names of a compensator's gains."""
    names = [gain.name for gain in law]
    if set(gains) != set(names):
        wrong = sorted(set(gains) ^ set(names))[0]
        found = "an extra gain" if wrong in gains else "nothing"
        raise _make_error(source, to_one_line(str(wrong), 60), found, ", ".join(names) or "no gains")


def resolve_gain_bounds(gain: Gain, mechanism: Any) -> tuple[float, float, float]:
    """Return lower bound, upper bound and rounding tolerance of a gain for a mechanism [unit of the gain]."""
    lower, upper = float(gain.lower(mechanism)), float(gain.upper(mechanism))
    return lower, upper, BOUND_TOLERANCE * max(abs(lower), abs(upper))


def _gains_without_runtime(axes: int) -> dict[str, dict[str, GainSpecification]]:
    """Return the gain specifications of the compensators that run in the simulation only, by name."""
    return {
        name: {gain.name: GainSpecification(gain.unit) for gain in law.gains}
        for name, law in (SIX_AXIS_COMPENSATORS if axes == 6 else COMPENSATORS).items()
        if axes == 6 or name not in RUNTIME_COMPENSATORS
    }


def _check_entry(gain: Gain, entry: Mapping[str, Any], mechanism: AnyMechanism, source: str) -> None:
    """Raise `InputError` if a gain file gives a gain another unit than the compensator, or wider bounds."""
    key = f"gains.{gain.name}"
    if entry["unit"] != gain.unit:
        raise _make_error(source, f"{key}.unit", format_value(entry["unit"]), f"'{gain.unit}'")
    lower, upper, margin = resolve_gain_bounds(gain, mechanism)
    for bound in ("lower", "upper"):
        if not lower - margin <= entry[bound] <= upper + margin:
            allowed = f"{lower:.12g} to {upper:.12g} for this mechanism"
            raise _make_error(source, f"{key}.{bound}", format_value(entry[bound]), allowed)


def _make_error(source: str, key: str, found: str, allowed: str) -> InputError:
    """Return the error with the message "source: key: found ..., expected ..."."""
    where = f"{source}: {key}" if source else key
    return InputError(f"{where}: found {found}, expected {allowed}")


def _is_date(value: object) -> bool:
    try:
        return isinstance(value, str) and datetime.fromisoformat(value).tzinfo is not None
    except ValueError:
        return False


def _is_envelope(value: object) -> bool:
    """Return whether a value is a JSON object whose values are objects with the keys low, high, unit."""
    return isinstance(value, Mapping) and all(
        isinstance(span, Mapping) and {"low", "high", "unit"} <= span.keys() for span in value.values()
    )


def _is_object(value: object) -> bool:
    return isinstance(value, Mapping)


def _is_table_of_texts(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(text, str) for text in value.values())


# Keys of a gain file that only this module checks: function that returns whether a value is valid, and
# description of valid values.
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
