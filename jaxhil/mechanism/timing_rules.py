"""Validation rules for jitter and missed ticks in files with one axis and with six axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from jaxhil.contact.laws import find_contact_law
from jaxhil.errors import format_value
from jaxhil.mechanism.conversion import KeyProblem
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.six_axes import AnyMechanism, SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty_rules import Span

__all__ = ["build_extreme_function", "check_jitter", "check_missed_ticks", "check_six_axis_jitter"]

JITTER, MISSED_TICKS = "rig.force_sensor.jitter", "rig.missed_tick_probability"


def check_jitter(mechanism: Mechanism, spans: Mapping[str, Span]) -> None:
    """Raise `KeyProblem` if a one-axis mechanism does not support the jitter of its force sensor's delay."""
    law, has_clearance = mechanism.contact.law, math.isfinite(mechanism.contact.clearance)
    reasons = {f"the contact law {law}": find_contact_law(law).has_memory, "a clearance": has_clearance}
    _check_jitter(mechanism, spans, reasons)


def check_missed_ticks(mechanism: Mechanism, spans: Mapping[str, Span]) -> None:
    """Raise `KeyProblem` if a mechanism with a clearance (gap between two surfaces) can miss ticks."""
    if _is_used(mechanism, MISSED_TICKS) and math.isfinite(mechanism.contact.clearance):
        largest = build_extreme_function(mechanism, spans)(MISSED_TICKS, 1)
        _reject(MISSED_TICKS, largest, "0, because missed ticks are not supported with a clearance")


def check_six_axis_jitter(mechanism: SixAxisMechanism, spans: Mapping[str, Span]) -> None:
    """Raise `KeyProblem` if a six-axis mechanism does not support the jitter of its force sensor's delay."""
    laws = [contact.law for contact in mechanism.contact.values()]
    frictions = [contact.friction for contact in mechanism.contact.values()]
    reasons = {
        **{f"the contact law {law}": find_contact_law(law).has_memory for law in laws},
        "bristle friction": any(friction and friction.law == "bristle" for friction in frictions),
        "a latch": bool(mechanism.latch),
    }
    _check_jitter(mechanism, spans, reasons)


def build_extreme_function(mechanism: AnyMechanism, spans: Mapping[str, Span]) -> Callable[[str, int], Any]:
    """Return a function `extreme(path, end)` that returns a key's smallest or largest possible draw.

    `end` is 0 for the smallest draw and 1 for the largest. For a key that is not uncertain, or whose
    normal distribution may have no bounds, `extreme` returns the nominal value.
    """

    def extreme(path: str, end: int) -> Any:
        uncertainty = mechanism.uncertainty.get(path)
        is_bounded = uncertainty is not None and uncertainty.distribution != "normal"
        return spans[path][end] if is_bounded else value_at(mechanism, path)

    return extreme


def _check_jitter(mechanism: AnyMechanism, spans: Mapping[str, Span], reasons: Mapping[str, bool]) -> None:
    """Raise `KeyProblem` if a mechanism does not support the jitter of its force sensor's delay.

    Args:
        mechanism: the mechanism.
        spans: smallest and largest draws of the uncertain keys.
        reasons: properties besides lag and filter that exclude jitter, and whether the mechanism has them.
    """
    extreme = build_extreme_function(mechanism, spans)
    if not _is_used(mechanism, JITTER):
        return
    largest, shortest = extreme(JITTER, 1), extreme("rig.force_sensor.delay", 0)
    if not largest <= shortest:
        _reject(JITTER, largest, f"at most {shortest:g} s, the smallest rig.force_sensor.delay")
    reasons = {
        "a time_constant": _is_used(mechanism, "rig.force_sensor.time_constant"),
        "a filter": mechanism.rig.force_sensor.filter is not None,
        **reasons,
    }
    for reason in (reason for reason, is_true in reasons.items() if is_true):
        _reject(JITTER, largest, f"0, because jitter is not supported with {reason}")


def _reject(path: str, found: float, expected: str) -> None:
    raise KeyProblem(tuple(path.split(".")), format_value(found), expected)


def _is_used(mechanism: AnyMechanism, path: str) -> bool:
    """Return whether the number at `path` is nonzero or uncertain, so that the effect exists."""
    return bool(value_at(mechanism, path)) or path in mechanism.uncertainty
