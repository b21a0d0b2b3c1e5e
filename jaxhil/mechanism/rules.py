"""Validation rules that involve several keys of a mechanism file.

Each rule raises a `KeyProblem` that names the key to change. `jaxhil.mechanism.conversion` has checked the
types and ranges of single keys before. A key with a value is rejected if the chosen law or model does not use
the key, because the value would have no effect. A user-registered law that lists no keys may use any key.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
from msgspec.structs import replace

from jaxhil.contact.keys import ContactKey
from jaxhil.contact.laws import CONTACT_KEYS, ContactLaw, find_contact_law, laws_with_key
from jaxhil.errors import format_value
from jaxhil.mechanism.conversion import KeyPath, KeyProblem, describe_allowed_at, run_checks
from jaxhil.mechanism.correlation import check_correlation
from jaxhil.mechanism.structs import DAMPING_RATIO_LAWS, Contact, Mechanism, Simulator, Uncertainty
from jaxhil.mechanism.timing_rules import build_extreme_function, check_jitter, check_missed_ticks
from jaxhil.mechanism.uncertainty_rules import Span, check_uncertainty

__all__ = [
    "KEYS_OF_MODELS",
    "check_contact_law",
    "check_mechanism_rules",
    "check_simulator_model",
    "check_texts",
    "format_allowed_velocity_limit",
    "is_damped",
    "is_hurwitz",
    "resolve_damping_ratio",
]

# Keys that each model of the motion simulator requires.
KEYS_OF_MODELS = {
    "ideal": (),
    "first_order": ("time_constant",),
    "second_order": ("natural_frequency", "damping_ratio"),
    "third_order": ("coefficients",),
    "transfer_function": ("numerator", "denominator"),
    "moving_average": ("window",),
}
_ALL_MODEL_KEYS = sorted({key for keys in KEYS_OF_MODELS.values() for key in keys})


def check_mechanism_rules(mechanism: Mechanism) -> None:
    """Check all rules for a one-axis mechanism. Raise `KeyProblem` for all rules that are violated."""
    contact, uncertainty = mechanism.contact, mechanism.uncertainty
    spans: dict[str, Span] = {}
    run_checks(
        [
            lambda: check_texts(mechanism),
            lambda: _check_damping_ratio(contact),
            lambda: _check_bodies(mechanism),
            lambda: check_contact_law(("contact",), contact, uncertainty, CONTACT_KEYS.values()),
            lambda: check_simulator_model(mechanism.rig.simulator, uncertainty),
            lambda: check_sensor_filter(mechanism.rig.force_sensor, uncertainty),
        ]
    )
    run_checks(
        [
            lambda: _check_hold(mechanism),
            *(
                lambda path=path: spans.update({path: check_uncertainty(mechanism, path)})
                for path in uncertainty
            ),
        ]
    )
    check_correlation(mechanism)
    run_checks(
        [
            lambda: _check_velocity_limit(mechanism, spans),
            lambda: _check_gap(mechanism, spans),
            lambda: check_jitter(mechanism, spans),
            lambda: check_missed_ticks(mechanism, spans),
        ]
    )


def resolve_damping_ratio(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism with `contact.damping` computed from its key `contact.damping_ratio`.

    If the key is missing, return the mechanism unchanged. Do the same if no damping can be computed;
    `check_mechanism_rules` then reports the problem.
    """
    contact, bodies = mechanism.contact, mechanism.bodies
    if contact.damping_ratio is None:
        return mechanism
    try:
        _check_damping_ratio(contact)
        _check_bodies(mechanism)
        damping = [
            2.0 * ratio * math.sqrt(stiffness * bodies.mass)
            for ratio, stiffness in _repeat_last(contact.damping_ratio, contact.stiffness)
        ]
    except (KeyProblem, TypeError):
        return mechanism
    return replace(mechanism, contact=replace(contact, damping=damping, damping_ratio=None))


def _check_damping_ratio(contact: Contact) -> None:
    """Raise `KeyProblem` if the contact law has no damping ratio, or if `damping` is also specified."""
    path = ("contact", "damping_ratio")
    if contact.damping_ratio is None:
        return
    found = format_value(contact.damping_ratio)
    if contact.law not in DAMPING_RATIO_LAWS:
        raise KeyProblem(path, found, f"nothing (only for law {' or '.join(DAMPING_RATIO_LAWS)})")
    if any(contact.damping):
        raise KeyProblem(path, f"{found} and damping", "either damping or damping_ratio")


def _repeat_last(*lists: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Combine lists to a list of tuples, as `zip` does; shorter lists repeat their last entry."""
    length = max(map(len, lists))
    return [tuple(entries[min(i, len(entries) - 1)] for entries in lists) for i in range(length)]


def is_hurwitz(polynomial: Sequence[float]) -> bool:
    """Return whether all roots of a real polynomial (descending powers) have negative real parts.

    This is true if and only if all entries in the first column of the Routh array are nonzero and have the
    same sign (Routh 1877; Gantmacher, The Theory of Matrices, vol. 2, ch. XV). The array is computed in exact
    rational arithmetic.
    """
    coefficients = [Fraction(value) for value in polynomial]
    if coefficients[0] < 0:
        coefficients = [-value for value in coefficients]
    upper, lower = coefficients[0::2], coefficients[1::2]
    while lower:
        if upper[0] <= 0 or lower[0] <= 0:
            return False
        ratio = upper[0] / lower[0]
        below = [*lower[1:], Fraction(0)]
        upper, lower = lower, [a - ratio * b for a, b in zip(upper[1:], below, strict=False)]
    return upper[0] > 0


def check_texts(mechanism: Any) -> None:
    """Raise `KeyProblem` unless the keys `name` and `source` are printable texts."""
    if not mechanism.name.isprintable():
        raise KeyProblem(("name",), format_value(mechanism.name), "printable characters")
    if not mechanism.source.replace("\n", "").replace("\t", "").isprintable():
        raise KeyProblem(("source",), format_value(mechanism.source), "printable characters and new lines")


def _check_bodies(mechanism: Mechanism) -> None:
    """Raise `KeyProblem` unless the bodies have either an equivalent mass or two masses."""
    bodies = mechanism.bodies
    either = "either equivalent_mass, or both chaser_mass and target_mass"
    has_both = bodies.chaser_mass is not None and bodies.target_mass is not None
    has_any = bodies.chaser_mass is not None or bodies.target_mass is not None
    if bodies.equivalent_mass is not None and has_any:
        raise KeyProblem(("bodies", "equivalent_mass"), "a body's mass as well", either)
    if bodies.equivalent_mass is None and not has_both:
        missing = "target_mass" if bodies.chaser_mass is not None else "chaser_mass"
        key = missing if has_any else "equivalent_mass"
        raise KeyProblem(("bodies", key), "nothing", either)
    if not 0.0 < bodies.mass < math.inf:
        expected = "masses whose equivalent mass is a finite number > 0"
        raise KeyProblem(("bodies",), format_value(bodies.mass), expected)


def check_contact_law(
    path: KeyPath, contact: Any, uncertainties: Mapping[str, Uncertainty], keys: Collection[ContactKey]
) -> None:
    """Raise `KeyProblem` unless a contact has the keys that its contact law requires.

    Args:
        path: path of the contact's table.
        contact: the contact's struct.
        uncertainties: the file's table `[uncertainty]`.
        keys: keys that only some laws have, with their names in the file's schema.
    """
    law = find_contact_law(contact.law)
    _check_depths(path, law, contact.depths)
    is_list = isinstance(contact, Contact)  # A one-axis file has one entry for each successive contact.
    for i, entry in enumerate(contact.stiffness if is_list else [contact.stiffness]):
        where = (*path, "stiffness", *[i] * is_list)
        if law.is_segmented and not (isinstance(entry, list) and len(entry) == len(contact.depths) + 1):
            expected = f"a list of {len(contact.depths) + 1} slopes, one more than depths (law {law.name})"
            raise KeyProblem(where, format_value(entry), expected)
        if isinstance(entry, list) and not law.is_segmented:
            raise KeyProblem(where, format_value(entry), f"a number > 0 N/m (law {law.name})")
    run_checks([lambda key=key: _check_law_key(path, law, contact, uncertainties, key) for key in keys])
    if law.dissipation_process and is_damped(path, contact, uncertainties):
        damping = format_value(contact.damping) if np.any(contact.damping) else "an uncertain damping"
        raise KeyProblem(
            (*path, "damping"), damping, f"0 (law {law.name} dissipates by {law.dissipation_process})"
        )


def _check_depths(path: KeyPath, law: ContactLaw, depths: Sequence[float]) -> None:
    """Raise `KeyProblem` unless a segmented law has depths, in increasing order."""
    if law.is_segmented and not depths:
        expected = f"a list of at least one depth (law {law.name} needs it)"
        raise KeyProblem((*path, "depths"), "no entries", expected)
    for i, (depth, deeper) in enumerate(pairwise(depths)):
        if deeper <= depth:
            raise KeyProblem(
                (*path, "depths", i + 1), format_value(deeper), f"a depth > the depth before, {depth:g} m"
            )


def _check_law_key(
    path: KeyPath, law: ContactLaw, contact: Any, uncertain: Collection[str], key: ContactKey
) -> None:
    """Raise `KeyProblem` if a contact lacks a `key` that its law uses, or has an unused `key`."""
    value, laws = getattr(contact, key.name), laws_with_key(key)
    if law.name in laws and value is None:
        expected = f"{describe_allowed_at(type(contact), key.name)} (law {law.name} needs it)"
        raise KeyProblem((*path, key.name), "nothing", expected)
    if law.keys is not None and law.name not in laws:
        only = f"only for law {' or '.join(laws)}"
        if value != key.default:
            raise KeyProblem((*path, key.name), format_value(value), f"nothing ({only})")
        dotted = ".".join((*map(str, path), key.name))
        if dotted in uncertain and value not in (None, []):
            raise KeyProblem(("uncertainty", dotted), f"a key {only}", "keys that the law uses")


def is_damped(
    path: KeyPath, contact: Any, uncertainties: Mapping[str, Uncertainty], key: str = "damping"
) -> bool:
    """Return whether the contact's value of `key` is nonzero, or can be nonzero in a random draw."""
    uncertain = uncertainties.get(".".join((*map(str, path), key)))
    return bool(np.any(getattr(contact, key))) or (uncertain is not None and uncertain.factor is None)


def check_simulator_model(simulator: Any, uncertain: Collection[str]) -> None:
    """Raise `KeyProblem` unless the motion simulator is stable and has exactly the keys of its model."""
    path = ("rig", "simulator")
    run_checks([lambda key=key: _check_model_key(simulator, uncertain, key) for key in _ALL_MODEL_KEYS])
    if simulator.model == "first_order" and not np.all(simulator.time_constant):
        raise KeyProblem((*path, "time_constant"), "0.0", 'a number > 0, or model = "ideal"')
    if simulator.model == "third_order" and simulator.coefficients is not None:
        if not is_hurwitz([*reversed(simulator.coefficients), 1.0]):
            expected = "a stable motion simulator: a1 a2 > a3"
            raise KeyProblem((*path, "coefficients"), format_value(simulator.coefficients), expected)
    if simulator.model == "transfer_function":
        _check_transfer_function(simulator.numerator or [], simulator.denominator or [])


def _check_model_key(simulator: Any, uncertain: Collection[str], key: str) -> None:
    """Raise `KeyProblem` if a motion simulator lacks a `key` that its model uses, or has an unused `key`."""
    path, value = ("rig", "simulator", key), getattr(simulator, key)
    is_used = key in KEYS_OF_MODELS[simulator.model]
    if is_used and value is None:
        expected = f"{describe_allowed_at(type(simulator), key)} ({simulator.model} needs it)"
        raise KeyProblem(path, "nothing", expected)
    if not is_used and value is not None:
        also = ", also in [uncertainty]" if ".".join(path) in uncertain else ""
        expected = f"nothing ({simulator.model} does not use it: unset it{also})"
        raise KeyProblem(path, format_value(value), expected)


def check_sensor_filter(sensor: Any, uncertain: Collection[str]) -> None:
    """Raise `KeyProblem` if a force sensor has both a filter and a time constant."""
    path = ("rig", "force_sensor", "time_constant")
    if sensor.filter is None:
        return
    expected = "nothing (rig.force_sensor.filter replaces the lag)"
    if sensor.time_constant != 0.0:
        raise KeyProblem(path, format_value(sensor.time_constant), expected)
    if ".".join(path) in uncertain:
        raise KeyProblem(("uncertainty", ".".join(path)), "a time constant", expected)


def _check_transfer_function(numerator: list[float], denominator: list[float]) -> None:
    """Raise `KeyProblem` unless G(s) is strictly proper and stable, with G(0) = 1."""
    path = ("rig", "simulator")
    if len(numerator) >= len(denominator):
        found = f"degree {len(numerator) - 1}, and degree {len(denominator) - 1} of the denominator"
        expected = "a lower degree than the denominator (a strictly proper transfer function)"
        raise KeyProblem((*path, "numerator"), found, expected)
    if not is_hurwitz(denominator):
        expected = "a stable motion simulator: every pole in the open left half plane"
        raise KeyProblem((*path, "denominator"), format_value(denominator), expected)
    if not abs(Fraction(numerator[-1]) - Fraction(denominator[-1])) <= (
        Fraction(1, 10**9) * abs(Fraction(denominator[-1]))
    ):
        found = f"last coefficients {numerator[-1]:g} and {denominator[-1]:g}"
        raise KeyProblem((*path, "numerator"), found, "equal last coefficients, so that G(0) = 1")


def _check_hold(mechanism: Mechanism) -> None:
    """Raise `KeyProblem` for contact damping or friction if an ideal simulator has a zero-order hold."""
    # Such a simulator jumps at the ticks, where its velocity is not defined.
    rig, contact = mechanism.rig, mechanism.contact
    law, arguments = find_contact_law(contact.law), (("contact",), contact, mechanism.uncertainty)
    dissipates = (law.is_damped and is_damped(*arguments)) or is_damped(*arguments, "friction")
    if rig.simulator.model == "ideal" and rig.command_hold == "zoh" and dissipates:
        expected = '"linear", because the model ideal with "zoh" does not support contact damping'
        raise KeyProblem(("rig", "command_hold"), format_value(rig.command_hold), expected)


def _check_velocity_limit(mechanism: Mechanism, spans: Mapping[str, Span]) -> None:
    """Raise `KeyProblem` unless the velocity limit of the drives is at least the approach speed."""
    # Drives that are slower than the approach have no steady state from which a run could start.
    extreme, path = build_extreme_function(mechanism, spans), "rig.simulator.velocity_limit"
    fastest, limit = float(extreme("approach.velocity", 1)), float(extreme(path, 0))
    if limit < fastest:
        raise KeyProblem(tuple(path.split(".")), format_value(limit), format_allowed_velocity_limit(fastest))


def format_allowed_velocity_limit(approach: float) -> str:
    """Describe the allowed velocity limits for an `approach` speed [m/s], for a message."""
    return f"a number >= {approach:g} m/s, the approach speed: slower drives cannot follow the approach"


def _check_gap(mechanism: Mechanism, spans: Mapping[str, Span]) -> None:
    """Raise `KeyProblem` unless the approach starts in the gap (clearance) between the two surfaces."""
    # The model starts at min(plane, 0) - v (0.02 s + phase T). The hardware lags behind the model by
    # the motion simulator's delay and lag, and by the command latency.
    extreme = build_extreme_function(mechanism, spans)
    clearance = float(extreme("contact.clearance", 0))
    period = extreme("rig.control_period", 1)
    delay = extreme("rig.simulator.delay", 1) + mechanism.rig.command_latency * period
    delay += max(_greatest_lag(mechanism.rig.simulator, extreme), 0.0)
    start = float(extreme("approach.velocity", 1) * (0.02 + period + delay))
    if clearance <= start:
        expected = f"a clearance > {start:g} m, the distance of the start from the surface"
        expected += " (v (0.02 s + T + delay and lag of the motion simulator))"
        raise KeyProblem(("contact", "clearance"), format_value(clearance), expected)
    limit = clearance - start
    for plane in (float(extreme("rig.contact_plane", end)) for end in (0, 1)):
        if not abs(plane) < limit:
            expected = f"a number > {-limit:g} and < {limit:g} m, the clearance minus the start's distance"
            raise KeyProblem(("rig", "contact_plane"), format_value(plane), expected)


def _greatest_lag(simulator: Simulator, extreme: Callable[[str, int], Any]) -> float:
    """Return the largest lag -G'(0) [s] of the motion simulator's transfer function G, without its delay."""
    path = "rig.simulator."
    if simulator.model == "first_order":
        return extreme(path + "time_constant", 1)
    if simulator.model == "second_order":
        return extreme(path + "damping_ratio", 1) / (math.pi * extreme(path + "natural_frequency", 0))
    if simulator.model == "third_order":
        return extreme(path + "coefficients", 1)[0]
    if simulator.model == "transfer_function":
        *_, slope, value = simulator.denominator or []
        *_, lead, gain = 0.0, *(simulator.numerator or [])
        return slope / value - lead / gain
    if simulator.model == "moving_average":
        return extreme(path + "window", 1) / 2
    return 0.0
