"""Which order a motion simulator has: the smallest one that explains the lines.

Candidates are compared by the Bayesian information criterion (Schwarz 1978). Where even the best one leaves
more than the noise (chi-squared per degree of freedom above 1), all are weighed by what it leaves: nonlinear
friction is not to be explained by poles. A candidate with a pole on top of a zero, or with a parameter that
the lines hardly determine, says the same as a smaller one and is out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from tuning.identification.rational import STRUCTURES, Fit, Lines, fit

CLOSE = 0.05  # a pole and a zero nearer than this, relative to the pole, cancel
VAGUE = 0.3  # relative standard deviation of a parameter that is not determined
EXPLAINED = 0.01  # probability from which what is left is noise: larger candidates are not looked at
SURE = 3.0  # standard deviations by which a delay is negative
ENOUGH = 2.0  # of the criterion: the smallest candidate within this of the best wins


@dataclass(frozen=True)
class Candidate:
    """One structure's fit and what is said of it."""

    fit: Fit
    criterion: float  # Bayesian information criterion
    fault: str  # why it is out, or empty


def choose(
    lines: Lines, order: int | None = None, highest: int | None = None
) -> tuple[Candidate, list[Candidate]]:
    """The structure to use and all candidates: those of one `order` alone, or up to the `highest`."""
    fits = []
    for structure in STRUCTURES:
        if structure.order == order or (order is None and (highest is None or structure.order <= highest)):
            fits.append(fit(structure, lines))
            if not fault(fits[-1]) and stats.chi2.sf(fits[-1].chi2, fits[-1].freedom) > EXPLAINED:
                break
    inflation = max(1.0, min(one.chi2 / max(one.freedom, 1) for one in fits))
    candidates = [Candidate(one, criterion(one, inflation), fault(one, inflation)) for one in fits]
    sound = [one for one in candidates if not one.fault] or candidates
    best = min(one.criterion for one in sound)
    return next(one for one in sound if one.criterion <= best + ENOUGH), candidates


def left(candidates: list[Candidate]) -> float:
    """What the best of the candidates leaves, over the noise; 1 at least."""
    return max(1.0, min(one.fit.chi2 / max(one.fit.freedom, 1) for one in candidates))


def criterion(one: Fit, inflation: float) -> float:
    """The Bayesian information criterion, of noise whose power is `inflation` times what the lines state."""
    return one.chi2 / inflation + one.model.structure.size * float(np.log(2 * len(one.residual)))


def fault(one: Fit, inflation: float = 1.0) -> str:
    """Why a fit says less than its number of parameters, or an empty string."""
    numerator, denominator = one.model.fraction
    poles, zeros = np.roots(denominator), np.roots(numerator)
    for zero in zeros:
        if np.any(np.abs(poles - zero) < CLOSE * np.abs(poles)):
            return "a zero cancels a pole"
    relative = one.std * np.sqrt(inflation)
    if one.model.delay < -SURE * relative[-1] and one.model.structure.order:
        return "its delay is negative"
    for name, std, value in zip(one.model.names, relative, one.model.parameters, strict=True):
        # Logarithms have relative standard deviations; a zero's coefficients and the delay do not.
        share = std / abs(value) if name.startswith("zero") else 0.0 if name == "delay" else std
        if not share < VAGUE:
            return f"{name} is not determined"
    return ""
