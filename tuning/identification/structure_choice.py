"""Choice of the motion simulator's model structure: the smallest one that explains the measured spectra.

The Bayesian information criterion (Schwarz 1978) compares the candidates. If even the best candidate has a
chi-squared per degree of freedom above 1, the noise variance is multiplied by this value for all candidates.
Without this factor, structures with additional poles would be chosen because they fit nonlinear friction. A
candidate is excluded if a smaller structure is equivalent: if a zero cancels a pole, or if the spectra hardly
determine a parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from tuning.identification.rational import (
    STRUCTURES,
    SimulatorStructure,
    SpectralLines,
    SpectrumFit,
    fit_structure,
)

POLE_ZERO_TOLERANCE = 0.05  # maximum distance of a zero that cancels a pole, divided by the pole's magnitude
MAX_RELATIVE_STD = 0.3  # maximum relative standard deviation of a parameter that the spectra determine
NOISE_P_VALUE = 0.01  # minimum p-value of a residual that noise explains; no larger structure is then fitted
NEGATIVE_DELAY_SIGMAS = 3.0  # minimum distance of a significantly negative delay from 0, in std
# Maximum difference of an acceptable structure's criterion from the best value; the smallest acceptable
# structure is chosen.
MAX_CRITERION_DEFICIT = 2.0


@dataclass(frozen=True)
class StructureCandidate:
    """Fit of one model structure, with its information criterion and, if it is excluded, the reason."""

    fit: SpectrumFit
    criterion: float  # Bayesian information criterion
    fault: str  # reason to exclude the structure; empty if there is none


def choose_structure(
    lines: SpectralLines,
    order: int | None = None,
    highest: int | None = None,
    structures: Sequence[SimulatorStructure] = STRUCTURES,
) -> tuple[StructureCandidate, list[StructureCandidate]]:
    """Fit model structures of the motion simulator and choose the smallest one that explains the spectra.

    Args:
        lines: Measured spectra.
        order: Order of the structures to fit, or None for all orders.
        highest: Highest order to fit if `order` is None; None for no limit.
        structures: Structures to choose from.

    Returns:
        The chosen candidate, and all candidates.
    """
    fits = []
    for structure in structures:
        if structure.order == order or (order is None and (highest is None or structure.order <= highest)):
            fits.append(fit_structure(structure, lines))
            if (
                not find_fault(fits[-1])
                and stats.chi2.sf(fits[-1].chi2, fits[-1].degrees_of_freedom) > NOISE_P_VALUE
            ):
                break
    inflation = max(1.0, min(result.chi2 / max(result.degrees_of_freedom, 1) for result in fits))
    candidates = [
        StructureCandidate(result, compute_criterion(result, inflation), find_fault(result, inflation))
        for result in fits
    ]
    usable = [candidate for candidate in candidates if not candidate.fault] or candidates
    best = min(candidate.criterion for candidate in usable)
    return next(
        candidate for candidate in usable if candidate.criterion <= best + MAX_CRITERION_DEFICIT
    ), candidates


def compute_residual_ratio(candidates: list[StructureCandidate]) -> float:
    """Return the smallest chi-squared per degree of freedom of all candidates, but at least 1."""
    return max(
        1.0, min(candidate.fit.chi2 / max(candidate.fit.degrees_of_freedom, 1) for candidate in candidates)
    )


def compute_criterion(fit: SpectrumFit, inflation: float) -> float:
    """Return the Bayesian information criterion of a fit; `inflation` is a factor on the noise variance."""
    return fit.chi2 / inflation + fit.model.structure.size * float(np.log(2 * len(fit.residual)))


def find_fault(fit: SpectrumFit, inflation: float = 1.0) -> str:
    """Return the reason to exclude the structure of a fit, or an empty string if there is none.

    `inflation` is the factor on the noise variance.
    """
    numerator, denominator = fit.model.fraction
    poles, zeros = np.roots(denominator), np.roots(numerator)
    for zero in zeros:
        if np.any(np.abs(poles - zero) < POLE_ZERO_TOLERANCE * np.abs(poles)):
            return "a zero cancels a pole"
    relative = fit.std * np.sqrt(inflation)
    if fit.model.delay < -NEGATIVE_DELAY_SIGMAS * relative[-1] and fit.model.structure.order:
        return "its delay is negative"
    for name, std, value in zip(fit.model.names, relative, fit.model.parameters, strict=True):
        # The standard deviation of a logarithm is relative. Only coefficients of zeros are not logarithms.
        share = std / abs(value) if name.startswith("zero") else 0.0 if name == "delay" else std
        if not share < MAX_RELATIVE_STD:
            return f"{name} is not determined"
    return ""
