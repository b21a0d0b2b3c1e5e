"""Reader of one-axis gain files: returns checked values or raises a `GainFileError` with one line.

The reader first checks the form (`gain_document`), then the content (compensator, gains, units, bounds,
control period). A digest does not prevent edits, because anyone can recompute it. Therefore gains must be
within the bounds in the file and in the code (`bounds`), and limits within the bounds in the code.
"""

from collections.abc import Mapping
from math import inf
from typing import Any, NamedTuple

from jaxhil.rig.bounds import DISTANCES
from jaxhil.rig.errors import GainFileError, format_value, make_gain_file_error, printable
from jaxhil.rig.gain_document import (
    SCHEMA,
    check_form,
    check_within,
    digest,
    read_control_period,
    read_entry,
    read_gain_document,
    read_gains,
    read_limits,
    read_number,
    read_object,
)
from jaxhil.rig.limits import LIMITS, NO_LIMITS, complete_limits
from jaxhil.rig.registry import COMPENSATORS, GainSpecification

RETIRED_COMPENSATORS = ("retrospective_reference", "retrospective_delay_bank")  # replaced by `impulse_ledger`
NO_FURTHER_GAINS: Mapping[str, Mapping[str, GainSpecification]] = {}


class GainFile(NamedTuple):
    """Checked content of a gain file, as far as the controller needs it."""

    compensator: str  # name of the compensator
    gains: Mapping[str, float]  # gains by name, in SI units
    control_period: float  # control period [s]
    clearance: float  # clearance of a two-sided contact [m]; infinite for a one-sided contact
    limits: Mapping[str, float] = NO_LIMITS  # limits by name, in SI units


def check_gain_document(
    document: Mapping[str, Any],
    source: str = "gain document",
    others: Mapping[str, Mapping[str, GainSpecification]] = NO_FURTHER_GAINS,
    axes: tuple[int, ...] = (1,),
) -> GainFile:
    """Check a gain document and return the values that the controller needs.

    Args:
        document: content of a gain file.
        source: name of the document in error messages.
        others: gain specifications of compensators that can only be simulated, by compensator name. These
            specifications take precedence over the specifications of registered compensators.
        axes: accepted numbers of axes.

    Raises:
        GainFileError: if the document is invalid.
    """
    check_form(document, source)
    number = document.get("axes", 1)
    if number not in axes:
        allowed = f"{' or '.join(map(str, axes))}: `Controller6` runs gains of six axes"
        raise make_gain_file_error(source, "axes", format_value(number), allowed)
    name = read_entry(document, "compensator", source, "")
    if name in RETIRED_COMPENSATORS:
        message = f"compensator: found {format_value(name)}, expected 'impulse_ledger', which replaces it"
        raise GainFileError(printable(f"{source}: {message}"))
    specifications = {**{law: compensator.gains for law, compensator in COMPENSATORS.items()}, **others}
    if not isinstance(name, str) or name not in specifications:
        raise make_gain_file_error(
            source, "compensator", format_value(name), f"one of {', '.join(specifications)}"
        )
    gains = read_gains(document, name, specifications[name], source)
    period = read_control_period(document, source)
    mechanism = read_object(document, "mechanism", source, "")
    contact = read_object(mechanism, "contact", source, "mechanism.") if number == 1 else {}
    clearance = inf
    if "clearance" in contact:
        clearance = read_number(contact["clearance"], "mechanism.contact.clearance", source)
        check_within(clearance, *DISTANCES, "mechanism.contact.clearance", source)
    limits = NO_LIMITS if number != 1 else read_limits(document, source, LIMITS, complete_limits)
    return GainFile(name, gains, period, clearance, limits)


__all__ = ["SCHEMA", "GainFile", "check_gain_document", "digest", "read_gain_document"]
