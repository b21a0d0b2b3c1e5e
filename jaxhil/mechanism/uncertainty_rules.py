"""Rules of ``[uncertainty]``: what each entry may say of its key, and how far its draws reach."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from jaxhil.errors import shown
from jaxhil.mechanism.conversion import KeyProblem, close_match, computable
from jaxhil.mechanism.structs import Range, Uncertainty, is_computable, value_at

__all__ = ["Span", "check_uncertainty"]

Span = tuple[np.ndarray, np.ndarray]


def check_uncertainty(mechanism: Any, path: str, ranges: Mapping[str, Range], fixed: Collection[str]) -> Span:
    """Least and greatest value of each entry of an uncertain key when drawn.

    `ranges` are the allowed values of every numeric key, `fixed` the polynomials, which cannot be uncertain.
    Raises `KeyProblem`.
    """
    uncertainty = mechanism.uncertainty[path]
    where = ("uncertainty", path)
    known = {key: allowed for key, allowed in ranges.items() if key not in fixed}
    if path not in known:
        allowed = f"the dotted path of a numeric key{close_match(path, known)}"
        if path in fixed:
            allowed += " other than a polynomial, which fixes G(0) = 1"
        raise KeyProblem(where, "no such uncertain key", allowed)
    value = value_at(mechanism, path)
    if value is None or value == [] or np.all(np.isinf(value)):
        allowed = f"a key with a value: set {path}, or unset its uncertainty"
        raise KeyProblem(where, f"{shown(value)} as its value", allowed)
    nominal = np.asarray(value, dtype=float)
    low, high = _span(where, path, uncertainty, nominal, known[path])
    ends = [float(end) for end in np.concatenate((low.ravel(), high.ravel()))]
    if uncertainty.distribution != "normal":
        outside = [end for end in ends if not (known[path].allows(end) and math.isfinite(end))]
        if outside:
            raise KeyProblem(where, f"values as far as {outside[0]:g}", str(known[path]))
        beyond = [end for end in ends if not is_computable(end)]
        if beyond:
            raise KeyProblem(where, f"values as far as {beyond[0]:g}", computable(known[path]))
    return low, high


def _span(
    where: tuple[str, str], path: str, uncertainty: Uncertainty, nominal: np.ndarray, allowed: Range
) -> Span:
    """Least and greatest value of each entry when drawn; `KeyProblem` for a wrong distribution."""
    kind = uncertainty.distribution
    given = {k for k in ("low", "high", "factor", "std") if getattr(uncertainty, k) is not None}
    wanted = [{"std"}] if kind == "normal" else [{"factor"}, {"low", "high"}]
    if given not in wanted:
        found = " and ".join(sorted(given)) or "no range"
        needed = "std" if kind == "normal" else "either factor, or both low and high"
        raise KeyProblem(where, found, f"{needed} for {kind}")
    single = uncertainty.independent or np.all(nominal == nominal.flat[0])
    if not single and nominal.flat[0] == 0.0 and uncertainty.factor is None:
        raise KeyProblem(where, f"0 as the first entry of {path}", "a factor, or independent = true")
    if kind == "normal":
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
