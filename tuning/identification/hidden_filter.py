"""Check for a filter of the force sensor that the mechanism file does not state.

A filter of order 2 or 4 resembles a lag with a longer delay. The fit of a lag can therefore absorb it. The
damping is then wrong, because only the onset of contact distinguishes damping from delay.

The check fits Butterworth filters of both orders in place of the lag (see `filter_grid`). The errors of e and
e - e* then have mixtures of normal distributions: around 0 if the file is right, or around the change from
the file to a filter on the grid. The weights are the likelihoods of the fits, times the prior probabilities
of the filters. The effect of the check is the increase of the errors' bounds by the mixtures.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import optimize, special

from jaxhil.mechanism.structs import Mechanism
from tuning.identification.contact_fit import ContactFit
from tuning.identification.filter_grid import FilterFit, find_scale, fit_filter, has_free_delay
from tuning.identification.uncertainty_effect import (
    EFFECT_PROBABILITY,
    SIMULATOR_PREFIX,
    UncertaintyEffect,
    compute_change_effects,
)
from tuning.identification.validation import CheckResult

HIDDEN_ORDERS = 2, 4  # orders of the Butterworth filters that the check fits
MAX_LIKELIHOOD_DROP = 6.0  # largest increase of chi-squared with a filter that explains the logs as well
PRIOR_FILTER_PROBABILITY = 0.1  # prior probability of each order; data sheets usually state such a filter
# bound of an effect, in standard deviations
BOUND_SIGMAS = float(special.ndtri(0.5 + 0.5 * EFFECT_PROBABILITY))
MAX_STIFFNESS_CHANGE = 0.3  # maximum relative change of the stiffness of an entry that the logs determine
MIN_EFFECT = 1e-3  # smallest effect on e or e - e* that the check reports


def check_hidden_filter(
    contact: ContactFit, mechanism: Mechanism, effect: UncertaintyEffect
) -> list[CheckResult]:
    """Check that filters of order 2 and 4 that fit as closely as the file give the same e and e - e*.

    Args:
        contact: Contact model of the file.
        mechanism: The file.
        effect: Effect of the parameters' uncertainty on e and on e - e*.

    Returns:
        A list with one check; empty if no parameter was identified, or if the file states a filter.
    """
    if not effect.parts or contact.readings.low_pass is not None or contact.degrees_of_freedom <= 0:
        return []
    lag, *filters = (fit_filter(contact, mechanism, order) for order in (1, *HIDDEN_ORDERS))
    file = min(lag.misfit, _compute_misfit(contact))
    scale = find_scale(min(file, *(fit.misfit for fit in filters)), contact.degrees_of_freedom)
    gains = [(file - fit.misfit) / scale for fit in filters]
    weights, changes = [np.log([1.0 - PRIOR_FILTER_PROBABILITY * len(filters)])], [np.zeros((2, 1))]
    file_std = np.array(effect[:2])[:, None] / BOUND_SIGMAS
    stds = [file_std]
    # The grid covers the errors of delay and damping if the delay is uncertain.
    motion = float(np.linalg.norm([p for key, p in effect.parts.items() if key.startswith(SIMULATOR_PREFIX)]))
    grid_std = np.minimum(motion / BOUND_SIGMAS, file_std) if has_free_delay(mechanism) else file_std
    for fit, gain in zip(filters, gains, strict=True):
        if gain > -MAX_LIKELIHOOD_DROP:
            log_weights = [point.log_prior - 0.5 * point.misfit / scale for point in fit.grid]
            weights.append(np.log(PRIOR_FILTER_PROBABILITY) + 0.5 * gain + special.log_softmax(log_weights))
            changes.append(_compute_changes(contact, mechanism, fit, lag))
            stds.append(np.repeat(grid_std, len(fit.grid), axis=1))
    probabilities = special.softmax(np.concatenate(weights))
    increases = [
        max(_find_bound(probabilities, change, std) - bound, 0.0)
        for change, std, bound in zip(np.hstack(changes), np.hstack(stds), effect[:2], strict=True)
    ]
    return [_describe(filters, gains, *increases)]


def _describe(
    filters: list[FilterFit], gains: list[float], on_restitution: float, on_error: float
) -> CheckResult:
    """Return the check with the filter that explains the logs best.

    `gains` states the decrease of chi-squared by each filter.
    """
    best = int(np.argmax(gains))
    comparison = f"{abs(gains[best]):.3g} {'smaller' if gains[best] > 0.0 else 'larger'}"
    cutoff = f"order {filters[best].order} and {filters[best].cutoff:.3g} Hz"
    finding = f"chi-squared is {comparison} with a filter of {cutoff}"
    is_present = max(on_restitution, on_error) > MIN_EFFECT
    if is_present:
        quality = "better" if gains[best] > MAX_LIKELIHOOD_DROP else "as well"
        finding += f", which explains the logs {quality}; state rig.force_sensor.filter as in its data sheet"
    return CheckResult(
        "filter of the force sensor",
        finding,
        is_present,
        on_restitution,
        on_error=on_error,
        gain=max(gains[best], 0.0),
    )


def _compute_changes(contact: ContactFit, mechanism: Mechanism, fit: FilterFit, lag: FilterFit) -> np.ndarray:
    """Return the changes of e and of e - e* from the file to each fit on the grid, shape (2, fits).

    Entries of the contact lists that the logs hardly determine are ignored: those whose stiffness in the fit
    of a lag differs from the file.
    """
    delay, _, file = contact.posterior.best
    entries, stated = contact.readings.entries, file.coefficients[:-1]

    def split(coefficients: np.ndarray) -> np.ndarray:
        return coefficients.reshape(*coefficients.shape[:-1], len(entries), -1)

    stiffness, refitted = split(stated)[:, 0], split(lag.best.coefficients)[:, 0]
    is_determined = np.abs(refitted - stiffness) <= MAX_STIFFNESS_CHANGE * np.abs(stiffness)
    differences = split(np.array([point.coefficients for point in fit.grid]) - stated)
    table = {
        entry: differences[:, i] for i, entry in enumerate(entries) if is_determined[i] or len(entries) == 1
    }
    added = np.array([point.age for point in fit.grid]) - delay - mechanism.rig.force_sensor.time_constant
    return np.array(compute_change_effects(mechanism, table, added))


def _compute_misfit(contact: ContactFit) -> float:
    """Return chi-squared of the file, as that of the fits: with the deviation of the bias from its prior."""
    (delay, plane, fit), prior = contact.posterior.best, contact.readings.bias
    deviation = 0.0 if prior is None else (fit.coefficients[-1] - prior[0]) / prior[1]
    residual = contact.readings.force - contact.problem.force(delay, plane, fit.coefficients)
    whitened = contact.problem.whiten(residual) / contact.readings.std
    return float(np.sum(whitened[contact.readings.counts] ** 2) + deviation**2)


def _find_bound(probabilities: np.ndarray, changes: np.ndarray, stds: np.ndarray) -> float:
    """Return the bound that the magnitude of an error exceeds with a probability of 1 %.

    Args:
        probabilities: Probability of each model.
        changes: Magnitude of the file's mean error if this model is true.
        stds: Standard deviation of the error if this model is true.
    """
    stds = np.maximum(stds, 1e-12)

    def excess(limit: float) -> float:
        outside = special.ndtr((changes - limit) / stds) + special.ndtr((-changes - limit) / stds)
        return float(probabilities @ outside) - (1.0 - EFFECT_PROBABILITY)

    root: Any = optimize.brentq(excess, 0.0, float(np.max(changes + 10.0 * stds)))
    return root
