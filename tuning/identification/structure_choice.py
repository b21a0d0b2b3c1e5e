"""Choice of the motion simulator's order: the smallest one that explains the lines.

The Bayesian information criterion (Schwarz 1978) compares the candidates. If even the best candidate leaves
more than the noise (chi-squared per degree of freedom above 1), this excess inflates the noise for all
candidates, so that poles do not explain nonlinear friction. Excluded are candidates with a pole on a zero, or
with a parameter that the lines hardly determine, since a smaller one is equivalent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from tuning.identification.rational import STRUCTURES, SpectralLines, SpectrumFit, fit_structure

POLE_ZERO_TOLERANCE = 0.05  # a pole and a zero nearer than this, relative to the pole, cancel
MAX_RELATIVE_STD = 0.3  # relative standard deviation, above which a parameter is not determined
NOISE_P_VALUE = 0.01  # p-value above which the residual is noise and larger candidates are not fitted
NEGATIVE_DELAY_SIGMAS = 3.0  # standard deviations below 0 that make a delay negative
MAX_CRITERION_DEFICIT = (
    2.0  # distance of the criterion to its best value, within which the smallest candidate wins
)


@dataclass(frozen=True)
class StructureCandidate:
    """Fit of one structure and its evaluation."""

    fit: SpectrumFit
    criterion: float  # Bayesian information criterion
    fault: str  # reason for its exclusion, or empty


def choose_structure(
    lines: SpectralLines, order: int | None = None, highest: int | None = None
) -> tuple[StructureCandidate, list[StructureCandidate]]:
    """Return the chosen candidate and all candidates: those of one `order`, or those up to the `highest`."""
    fits = []
    for structure in STRUCTURES:
        if structure.order == order or (order is None and (highest is None or structure.order <= highest)):
            fits.append(fit_structure(structure, lines))
            if not find_fault(fits[-1]) and stats.chi2.sf(fits[-1].chi2, fits[-1].freedom) > NOISE_P_VALUE:
                break
    inflation = max(1.0, min(result.chi2 / max(result.freedom, 1) for result in fits))
    candidates = [
        StructureCandidate(result, compute_criterion(result, inflation), find_fault(result, inflation))
        for result in fits
    ]
    sound = [candidate for candidate in candidates if not candidate.fault] or candidates
    best = min(candidate.criterion for candidate in sound)
    return next(
        candidate for candidate in sound if candidate.criterion <= best + MAX_CRITERION_DEFICIT
    ), candidates


def compute_residual_ratio(candidates: list[StructureCandidate]) -> float:
    """Return the residual power of the best candidate over the noise power, at least 1."""
    return max(1.0, min(candidate.fit.chi2 / max(candidate.fit.freedom, 1) for candidate in candidates))


def compute_criterion(one: SpectrumFit, inflation: float) -> float:
    """Return the Bayesian information criterion for a noise power `inflation` times that of the lines."""
    return one.chi2 / inflation + one.model.structure.size * float(np.log(2 * len(one.residual)))


def find_fault(one: SpectrumFit, inflation: float = 1.0) -> str:
    """Return the reason why a smaller structure is equivalent to the fit, or an empty string."""
    numerator, denominator = one.model.fraction
    poles, zeros = np.roots(denominator), np.roots(numerator)
    for zero in zeros:
        if np.any(np.abs(poles - zero) < POLE_ZERO_TOLERANCE * np.abs(poles)):
            return "a zero cancels a pole"
    relative = one.std * np.sqrt(inflation)
    if one.model.delay < -NEGATIVE_DELAY_SIGMAS * relative[-1] and one.model.structure.order:
        return "its delay is negative"
    for name, std, value in zip(one.model.names, relative, one.model.parameters, strict=True):
        # The standard deviation of a logarithm is already relative; that of a zero's coefficient is not.
        share = std / abs(value) if name.startswith("zero") else 0.0 if name == "delay" else std
        if not share < MAX_RELATIVE_STD:
            return f"{name} is not determined"
    return ""
