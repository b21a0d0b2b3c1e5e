"""Validation rules for the table ``[uncertainty]``, and smallest and largest draws of its keys."""

from __future__ import annotations

import math

import numpy as np

from jaxhil.errors import format_value
from jaxhil.mechanism.conversion import KeyProblem, add_magnitude_limits, suggest_names
from jaxhil.mechanism.number_ranges import Range, is_computable, value_at
from jaxhil.mechanism.six_axes import AnyMechanism, numeric_keys_of
from jaxhil.mechanism.structs import Uncertainty

__all__ = ["Span", "check_uncertainty"]

Span = tuple[np.ndarray, np.ndarray]  # smallest and largest draw of each entry of a key's value
POLYNOMIALS = ("rig.simulator.numerator", "rig.simulator.denominator")  # keys that cannot be uncertain


def check_uncertainty(mechanism: AnyMechanism, path: str) -> Span:
    """Check the distribution of an uncertain key; return the smallest and largest draw of each entry.

    Raise `KeyProblem` if the distribution, or a value that it can draw, is invalid.
    """
    uncertainty = mechanism.uncertainty[path]
    where = ("uncertainty", path)
    ranges = numeric_keys_of(mechanism)
    key_ranges = {key: allowed for key, allowed in ranges.items() if key not in POLYNOMIALS}
    if path not in key_ranges:
        expected = f"the dotted path of a numeric key{suggest_names(path, key_ranges)}"
        if path in POLYNOMIALS:
            expected += " other than a polynomial, because G(0) = 1 is fixed"
        raise KeyProblem(where, "a key that cannot be uncertain", expected)
    value = value_at(mechanism, path)
    if value is None or value == [] or np.all(np.isinf(value)):
        expected = f"a key with a value: set {path}, or unset its uncertainty"
        raise KeyProblem(where, f"{format_value(value)} as its value", expected)
    nominal = np.asarray(value, dtype=float)
    low, high = _compute_span(where, path, uncertainty, nominal, key_ranges[path])
    ends = [float(end) for end in np.concatenate((low.ravel(), high.ravel()))]
    if uncertainty.distribution != "normal":
        disallowed = [end for end in ends if not (key_ranges[path].allows(end) and math.isfinite(end))]
        if disallowed:
            raise KeyProblem(where, f"a draw of {disallowed[0]:g}", str(key_ranges[path]))
        extreme = [end for end in ends if not is_computable(end)]
        if extreme:
            raise KeyProblem(where, f"a draw of {extreme[0]:g}", add_magnitude_limits(key_ranges[path]))
    if path.endswith(".depths") and uncertainty.independent and np.any(high[:-1] >= low[1:]):
        raise KeyProblem((*where, "independent"), "true", "false (draws may reverse the depths' order)")
    if path == "rig.simulator.coefficients" and mechanism.rig.simulator.model == "third_order":
        largest = high[2] if uncertainty.independent else low[2]
        if not low[0] * low[1] > largest:
            expected = "a stable motion simulator for all draws: a1 a2 > a3"
            raise KeyProblem(where, "draws that make the motion simulator unstable", expected)
    return low, high


def _compute_span(
    where: tuple[str, str], path: str, uncertainty: Uncertainty, nominal: np.ndarray, allowed: Range
) -> Span:
    """Return the smallest and largest draw of each entry. Raise `KeyProblem` for an invalid distribution."""
    kind = uncertainty.distribution
    keys = {k for k in ("low", "high", "factor", "std") if getattr(uncertainty, k) is not None}
    choices = [{"std"}] if kind == "normal" else [{"factor"}, {"low", "high"}]
    if keys not in choices:
        found = " and ".join(sorted(keys)) or "no range"
        needed = "std" if kind == "normal" else "either factor, or both low and high"
        raise KeyProblem(where, found, f"{needed} for {kind}")
    is_unscaled = uncertainty.independent or np.all(nominal == nominal.flat[0])
    if not is_unscaled and nominal.flat[0] == 0.0 and uncertainty.factor is None:
        raise KeyProblem(
            where,
            f"a list {path} that begins with 0, which no common factor can scale",
            "`factor`, or independent = true",
        )
    if kind == "normal":
        return np.full_like(nominal, allowed.low), np.full_like(nominal, allowed.high)
    bounds = uncertainty.factor or [uncertainty.low or 0.0, uncertainty.high or 0.0]
    key = "factor" if uncertainty.factor else "low"
    if not bounds[0] < bounds[1]:
        raise KeyProblem((*where, key), format_value(bounds), "low < high")
    if kind == "loguniform" and not bounds[0] > 0.0:
        raise KeyProblem((*where, key), format_value(bounds[0]), "a number > 0 for loguniform")
    # A bound that overflows becomes infinite, and the caller rejects the infinite bound.
    with np.errstate(over="ignore"):
        if uncertainty.factor:
            ends = [nominal * bound for bound in bounds]
        elif is_unscaled:
            ends = [np.full_like(nominal, bound) for bound in bounds]
        else:
            ends = [nominal * (bound / nominal.flat[0]) for bound in bounds]
    return np.minimum(*ends), np.maximum(*ends)
