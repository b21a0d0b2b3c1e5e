"""Size of a cut dead zone of a force sensor, and the bias that a dead zone of any kind hides.

A sensor with a cut dead zone reads 0 if the force with bias and noise is smaller than the zone, and does not
change larger forces. No reading is therefore between 0 and the size of the zone. The smallest reading is an
upper bound of the size. Readings of 0 at a predicted force give lower bounds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuning.identification.contact_problem import ContactProblem
from tuning.identification.contact_profile import POSTERIOR_DRAWS, Posterior
from tuning.identification.hidden_noise import compute_log_probability_of_zero, estimate_hidden_bias
from tuning.identification.noise import detect_quantum
from tuning.identification.records import LoggedRun

ZONE_GRID_SIZE = 400  # number of zone sizes that are tried, from 0 to the smallest reading
PARAMETER_DRAWS = 40  # number of posterior draws of the contact for which the size is drawn
ASSUMED_BIAS_SHARE = 0.2  # standard deviation of a bias that a dead zone hides, divided by the zone
MIN_LOUD_SHARE = 0.1  # share of the peak force that shows a contact


def find_largest_size(runs: Sequence[LoggedRun]) -> float:
    """Return the largest possible size [N] of a cut dead zone: the smallest magnitude of a nonzero reading.

    If the readings are rounded, half a rounding step is added. The result is 0 if all readings are 0.
    """
    readings = np.concatenate([run.valid_forces for run in runs])
    sizes = np.abs(readings[readings != 0.0])
    return float(sizes.min()) + 0.5 * detect_quantum(readings) if len(sizes) else 0.0


def estimate_bias_before_contact(
    runs: Sequence[LoggedRun], zone: float, is_subtracted: bool = False
) -> tuple[float, float]:
    """Estimate the bias of the readings before contact although a dead zone replaces most of them by 0.

    The noise is assumed to be normally distributed.

    Args:
        runs: Runs that begin before contact.
        zone: Size of the zone [N].
        is_subtracted: Whether the sensor subtracts the zone from larger forces.

    Returns:
        Mean and standard deviation of the bias [N]; assumed values if too few readings exceed the zone.
    """
    before = np.concatenate([take_readings_before_contact(run) for run in runs])
    estimate = estimate_hidden_bias(before, zone, is_subtracted, detect_quantum(before))
    return (0.0, ASSUMED_BIAS_SHARE * zone) if estimate is None else estimate


def estimate_subtracted_bias(runs: Sequence[LoggedRun], zone: float, zone_std: float) -> tuple[float, float]:
    """Estimate the bias that a continuous dead zone hides, minus the zone: the readings in contact show it.

    Args:
        runs: Runs that begin before contact.
        zone: Size of the zone [N].
        zone_std: Standard deviation of the size [N].

    Returns:
        Mean and standard deviation [N].
    """
    bias, std = estimate_bias_before_contact(runs, zone, True)
    return bias - zone, float(np.hypot(std, zone_std))


def take_readings_before_contact(run: LoggedRun) -> np.ndarray:
    """Return the first half of the readings that precede the first large force."""
    force = run.valid_forces
    if not len(force):
        return force
    loud = np.abs(force) > MIN_LOUD_SHARE * np.abs(force).max(initial=0.0)
    return force[: int(np.argmax(loud)) // 2]


def draw_zone(problem: ContactProblem, posterior: Posterior, seed: int = 0) -> np.ndarray:
    """Draw the size of a cut dead zone [N] from its posterior; the prior is uniform up to the largest size.

    Args:
        problem: Contact problem, in which the zone has its largest possible size.
        posterior: Posterior of the contact parameters.
        seed: Seed of the random numbers.
    """
    readings, count = problem.readings, len(problem.names)
    sizes = readings.zone * (np.arange(ZONE_GRID_SIZE) + 1.0) / ZONE_GRID_SIZE
    heights = []
    is_zero = readings.is_valid & (readings.force == 0.0)
    for draw in posterior.draws[:PARAMETER_DRAWS]:
        predicted = problem.force(draw[0], draw[1], draw[2 : 2 + count])[is_zero]
        # Forces far inside the zone do not bound its size.
        predicted = predicted[predicted > 0.0]
        heights.append(
            [compute_log_probability_of_zero(predicted, readings.std, size).sum() for size in sizes]
        )
    # The readings of 0 also select the draws of the contact that agree with them.
    share = np.cumsum(np.exp(np.array(heights) - np.max(heights)).sum(axis=0))
    uniform = np.random.default_rng([seed, 5]).uniform(size=POSTERIOR_DRAWS)
    return np.interp(uniform, np.append(0.0, share / share[-1]), np.append(0.0, sizes))
