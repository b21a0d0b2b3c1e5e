"""Rules of a mechanism file that join several keys.

Each rule raises a `KeyProblem` that names the key to change. Types and single ranges are checked
before, in `jaxhil.mechanism.conversion`. A key that the chosen law or model does not use is refused where
it says anything: who wrote it means something by it. What a law from elsewhere uses, only that law knows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from jaxhil.errors import shown
from jaxhil.mechanism.conversion import KeyProblem, close_match, computable
from jaxhil.mechanism.correlation import check_correlation
from jaxhil.mechanism.structs import (
    BUILT_IN_LAWS,
    Contact,
    Mechanism,
    Simulator,
    Uncertainty,
    is_computable,
    numeric_keys,
    value_at,
)

__all__ = ["KEYS_OF_MODELS", "LAWS_OF_KEYS", "UNDAMPED", "check", "is_hurwitz"]

# Keys of each model of the motion simulator.
KEYS_OF_MODELS = {
    "ideal": (),
    "first_order": ("time_constant",),
    "second_order": ("natural_frequency", "damping_ratio"),
    "third_order": ("coefficients",),
    "transfer_function": ("numerator", "denominator"),
}
_OF_SOME_MODEL = sorted({key for keys in KEYS_OF_MODELS.values() for key in keys})
# Keys of some contact laws alone; all others are at their defaults in a contact that states none of them.
LAWS_OF_KEYS = {
    "tension": ("kelvin_voigt",),
    "exponent": ("hunt_crossley", "depth_damped"),
    "depths": ("piecewise_linear",),
    "reference_depth": ("hardening", "depth_damped"),
    "unloading_ratio": ("elastoplastic",),
    "preload": ("preloaded",),
    "friction": ("preloaded",),
}
# Laws without damping, and what they dissipate by.
UNDAMPED = {"elastoplastic": "yielding", "preloaded": "friction"}
_PLAIN = Contact(law="linear", stiffness=[1.0])
_Span = tuple[np.ndarray, np.ndarray]
_FIXED = ("rig.simulator.numerator", "rig.simulator.denominator")


def check(mechanism: Mechanism) -> None:
    """Every rule in turn; raises `KeyProblem` for the first one broken."""
    _check_texts(mechanism)
    _check_bodies(mechanism)
    _check_contact(mechanism.contact)
    _check_keys_of_laws(mechanism)
    _check_simulator(mechanism.rig.simulator)
    _check_hold(mechanism)
    spans = {
        path: _check_uncertainty(mechanism, path, uncertainty)
        for path, uncertainty in mechanism.uncertainty.items()
    }
    check_correlation(mechanism)
    _check_gap(mechanism, spans)


def is_hurwitz(polynomial: Sequence[float]) -> bool:
    """Whether all roots of a real polynomial (descending powers) have negative real parts.

    Routh's array in exact rational arithmetic: true when its first column has one sign throughout
    (Routh 1877; Gantmacher, The Theory of Matrices, vol. 2, ch. XV). A zero there is not stable.
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


def _check_texts(mechanism: Mechanism) -> None:
    if not mechanism.name.isprintable():
        raise KeyProblem(("name",), shown(mechanism.name), "printable characters")
    if not mechanism.source.replace("\n", "").replace("\t", "").isprintable():
        raise KeyProblem(("source",), shown(mechanism.source), "printable characters and new lines")


def _check_bodies(mechanism: Mechanism) -> None:
    bodies = mechanism.bodies
    either = "either equivalent_mass, or both chaser_mass and target_mass"
    both = bodies.chaser_mass is not None and bodies.target_mass is not None
    one = bodies.chaser_mass is not None or bodies.target_mass is not None
    if bodies.equivalent_mass is not None and one:
        raise KeyProblem(("bodies", "equivalent_mass"), "a body's mass beside it", either)
    if bodies.equivalent_mass is None and not both:
        missing = "target_mass" if bodies.chaser_mass is not None else "chaser_mass"
        key = missing if one else "equivalent_mass"
        raise KeyProblem(("bodies", key), "nothing", either)
    if not 0.0 < bodies.mass < math.inf:
        allowed = "masses whose equivalent mass is a finite number > 0"
        raise KeyProblem(("bodies",), shown(bodies.mass), allowed)


def _check_contact(contact: Contact) -> None:
    nested = contact.law == "piecewise_linear"
    if nested and not contact.depths:
        allowed = "a list of at least one depth (law piecewise_linear needs it)"
        raise KeyProblem(("contact", "depths"), "no entries", allowed)
    for i, (depth, deeper) in enumerate(zip(contact.depths, contact.depths[1:], strict=False)):
        if deeper <= depth:
            allowed = f"a depth > the one before, {depth:g}"
            raise KeyProblem(("contact", "depths", i + 1), shown(deeper), allowed)
    for i, entry in enumerate(contact.stiffness):
        path = ("contact", "stiffness", i)
        if nested:
            length = len(contact.depths) + 1
            allowed = f"a list of {length} slopes, one more than depths (law piecewise_linear)"
            if not isinstance(entry, list) or len(entry) != length:
                raise KeyProblem(path, shown(entry), allowed)
        elif isinstance(entry, list):
            raise KeyProblem(path, shown(entry), f"a number > 0 (law {contact.law})")


def _check_keys_of_laws(mechanism: Mechanism) -> None:
    contact = mechanism.contact
    for key, laws in LAWS_OF_KEYS.items():
        path, value, default = f"contact.{key}", getattr(contact, key), getattr(_PLAIN, key)
        if contact.law in laws and value is None:
            allowed = f"{numeric_keys()[path]} (law {contact.law} needs it)"
            raise KeyProblem(("contact", key), "nothing", allowed)
        if contact.law not in laws and contact.law in BUILT_IN_LAWS:
            only = f"only for law {' or '.join(laws)}"
            if value != default:
                raise KeyProblem(("contact", key), shown(value), f"nothing ({only})")
            if path in mechanism.uncertainty and value not in (None, []):
                raise KeyProblem(("uncertainty", path), f"a key {only}", "keys that the law uses")
    if contact.law in UNDAMPED and _is_damped(mechanism):
        damping = shown(contact.damping) if any(contact.damping) else "an uncertain damping"
        allowed = f"0 (law {contact.law} dissipates by {UNDAMPED[contact.law]})"
        raise KeyProblem(("contact", "damping"), damping, allowed)


def _is_damped(mechanism: Mechanism, *, by: str = "damping") -> bool:
    """Whether the contact has damping, or what else is named, or may have some where it is drawn."""
    uncertain = mechanism.uncertainty.get(f"contact.{by}")
    some = np.any(getattr(mechanism.contact, by))
    return bool(some) or (uncertain is not None and uncertain.factor is None)


def _check_simulator(simulator: Simulator) -> None:
    path = ("rig", "simulator")
    for key in KEYS_OF_MODELS[simulator.model]:
        if getattr(simulator, key) is None:
            lists = ("coefficients", "numerator", "denominator")
            allowed = "a list of numbers" if key in lists else "a number > 0"
            raise KeyProblem((*path, key), "nothing", f"{allowed} ({simulator.model} needs it)")
    for key in _OF_SOME_MODEL:
        value = getattr(simulator, key)
        if value is not None and key not in KEYS_OF_MODELS[simulator.model]:
            allowed = f"nothing ({simulator.model} does not use it: unset it)"
            raise KeyProblem((*path, key), shown(value), allowed)
    if simulator.model == "first_order" and simulator.time_constant == 0.0:
        raise KeyProblem((*path, "time_constant"), "0.0", "a number > 0 (first_order), or ideal")
    if simulator.model == "third_order" and simulator.coefficients is not None:
        if not is_hurwitz([*reversed(simulator.coefficients), 1.0]):
            allowed = "a stable motion simulator: a1 a2 > a3"
            raise KeyProblem((*path, "coefficients"), shown(simulator.coefficients), allowed)
    if simulator.model == "transfer_function":
        _check_transfer_function(simulator.numerator or [], simulator.denominator or [])


def _check_transfer_function(numerator: list[float], denominator: list[float]) -> None:
    path = ("rig", "simulator")
    if len(numerator) >= len(denominator):
        found = f"degree {len(numerator) - 1} over degree {len(denominator) - 1}"
        allowed = "a strictly proper transfer function: a degree below the denominator's"
        raise KeyProblem((*path, "numerator"), found, allowed)
    if not is_hurwitz(denominator):
        allowed = "a stable motion simulator: every pole in the open left half plane"
        raise KeyProblem((*path, "denominator"), shown(denominator), allowed)
    if not abs(Fraction(numerator[-1]) - Fraction(denominator[-1])) <= (
        Fraction(1, 10**9) * abs(Fraction(denominator[-1]))
    ):
        found = f"last coefficients {numerator[-1]:g} and {denominator[-1]:g}"
        raise KeyProblem((*path, "numerator"), found, "equal ones, so that G(0) = 1")


def _check_hold(mechanism: Mechanism) -> None:
    # The ideal simulator jumps between ticks and rests otherwise: damping would see no velocity.
    rig, contact = mechanism.rig, mechanism.contact
    damped = _is_damped(mechanism) or _is_damped(mechanism, by="friction")
    if rig.simulator.model == "ideal" and rig.command_hold == "zoh" and damped and contact.law != "linear":
        allowed = '"linear" for an ideal simulator with contact damping (or another model)'
        raise KeyProblem(("rig", "command_hold"), shown(rig.command_hold), allowed)


def _check_gap(mechanism: Mechanism, spans: Mapping[str, _Span]) -> None:
    # The approach starts at x_d = min(plane, 0) - v (0.02 s + phase T) with x_a behind by the motion
    # simulator's delay and lag and the command's latency, and has to lie inside the gap. An unbounded
    # distribution reaches every value, so that only the nominal one can be judged.
    def extreme(path: str, end: int) -> Any:
        uncertainty = mechanism.uncertainty.get(path)
        drawn = uncertainty is not None and uncertainty.distribution != "normal"
        return spans[path][end] if drawn else value_at(mechanism, path)

    clearance = float(extreme("contact.clearance", 0))
    period = extreme("rig.control_period", 1)
    behind = extreme("rig.simulator.delay", 1) + mechanism.rig.command_latency * period
    behind += max(_greatest_lag(mechanism.rig.simulator, extreme), 0.0)
    start = float(extreme("approach.velocity", 1) * (0.02 + period + behind))
    if clearance <= start:
        allowed = f"a clearance > {start:g}, v (0.02 s + T + the motion simulator's delay and lag): "
        raise KeyProblem(("contact", "clearance"), shown(clearance), allowed + "the start lies within it")
    most = clearance - start
    for plane in (float(extreme("rig.contact_plane", end)) for end in (0, 1)):
        if not abs(plane) < most:
            allowed = f"a number > {-most:g} and < {most:g}, the clearance less what the start needs"
            raise KeyProblem(("rig", "contact_plane"), shown(plane), allowed)


def _greatest_lag(simulator: Simulator, extreme: Callable[[str, int], Any]) -> float:
    """By how much [s] a motion simulator follows a uniform motion late, its delay apart: -G'(0)."""
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
    return 0.0


def _check_uncertainty(mechanism: Mechanism, path: str, uncertainty: Uncertainty) -> _Span:
    where = ("uncertainty", path)
    known = {key: allowed for key, allowed in numeric_keys().items() if key not in _FIXED}
    if path not in known:
        allowed = f"the dotted path of a numeric key{close_match(path, known)}"
        if path in _FIXED:
            allowed += " other than a polynomial, which fixes G(0) = 1"
        raise KeyProblem(where, "no such uncertain key", allowed)
    value = value_at(mechanism, path)
    if value is None or value == [] or value == math.inf:
        allowed = f"a key with a value: set {path}, or unset its uncertainty"
        raise KeyProblem(where, f"{shown(value)} as its value", allowed)
    nominal = np.asarray(value, dtype=float)
    low, high = _span(where, path, uncertainty, nominal)
    ends = [float(end) for end in np.concatenate((low.ravel(), high.ravel()))]
    if uncertainty.distribution != "normal":
        outside = [end for end in ends if not (known[path].allows(end) and math.isfinite(end))]
        if outside:
            raise KeyProblem(where, f"values as far as {outside[0]:g}", str(known[path]))
        beyond = [end for end in ends if not is_computable(end)]
        if beyond:
            raise KeyProblem(where, f"values as far as {beyond[0]:g}", computable(known[path]))
    if path == "contact.depths" and uncertainty.independent and np.any(high[:-1] >= low[1:]):
        raise KeyProblem((*where, "independent"), "true", "false, or depths that keep their order")
    if path == "rig.simulator.coefficients" and mechanism.rig.simulator.model == "third_order":
        largest = high[2] if uncertainty.independent else low[2]
        if not low[0] * low[1] > largest:
            allowed = "a stable motion simulator throughout: a1 a2 > a3"
            raise KeyProblem(where, "values for which it is not stable", allowed)
    return low, high


def _span(where: tuple[str, str], path: str, uncertainty: Uncertainty, nominal: np.ndarray) -> _Span:
    """Least and greatest value of each entry when drawn; `KeyProblem` for a wrong distribution."""
    kind = uncertainty.distribution
    given = {k for k in ("low", "high", "factor", "std") if getattr(uncertainty, k) is not None}
    wanted = [{"std"}] if kind == "normal" else [{"factor"}, {"low", "high"}]
    if given not in wanted:
        found = " and ".join(sorted(given)) or "no range"
        allowed = "std" if kind == "normal" else "either factor, or both low and high"
        raise KeyProblem(where, found, f"{allowed} for {kind}")
    single = uncertainty.independent or np.all(nominal == nominal.flat[0])
    if not single and nominal.flat[0] == 0.0 and uncertainty.factor is None:
        raise KeyProblem(where, f"0 as the first entry of {path}", "a factor, or independent = true")
    if kind == "normal":
        allowed = numeric_keys()[path]
        return np.full_like(nominal, allowed.low), np.full_like(nominal, allowed.high)
    bounds = uncertainty.factor or [uncertainty.low or 0.0, uncertainty.high or 0.0]
    key = "factor" if uncertainty.factor else "low"
    if not bounds[0] < bounds[1]:
        raise KeyProblem((*where, key), shown(bounds), "low < high")
    if kind == "loguniform" and not bounds[0] > 0.0:
        raise KeyProblem((*where, key), shown(bounds[0]), "a number > 0 for loguniform")
    # An end that overflows is infinite, and refused as such.
    with np.errstate(over="ignore"):
        if uncertainty.factor:
            ends = [nominal * bound for bound in bounds]
        elif single:
            ends = [np.full_like(nominal, bound) for bound in bounds]
        else:
            ends = [nominal * (bound / nominal.flat[0]) for bound in bounds]
    return np.minimum(*ends), np.maximum(*ends)
