"""Posterior of the contact parameters if the force sensor has a first-order lag.

The lag smooths the jump of the force at the onset of damped contact. The likelihood therefore has no steps,
unlike in `contact_profile`. At each force delay, linear least squares give a normal distribution of the
surface position and the coefficients.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from tuning.identification.contact_problem import ContactProblem
from tuning.identification.contact_profile import MAX_SURFACE_STD, POSTERIOR_DRAWS, Posterior
from tuning.identification.normal_draws import factorise_covariance
from tuning.identification.surface_search import find_best_surface

MAX_REDRAWS = 50  # maximum number of repetitions of draws with a negative damping coefficient


def compute_posterior_near(problem: ContactProblem, delays: np.ndarray, plane: float, seed: int) -> Posterior:
    """Compute the posterior on a grid of force delays, from an approximate surface position.

    Args:
        problem: Contact problem with the lag of the sensor.
        delays: Evenly spaced force delays [s].
        plane: Approximate surface position [m].
        seed: Seed of the random numbers.
    """
    step, free = delays[1] - delays[0], problem.plane is None
    surfaces, fits, deviations, changes, heights = [], [], [], [], []
    for delay in delays:
        surface, fit, gain = find_best_surface(problem, float(delay), plane)
        deviation = min(1.0 / np.sqrt(max(fit.curvature, 1e-300)), MAX_SURFACE_STD) if free else 0.0
        change = np.zeros(len(fit.coefficients)) if fit.by_plane is None else fit.by_plane
        mean = fit.coefficients + change * (surface - fit.plane)
        spread = np.sqrt(np.diag(fit.covariance) + (change * deviation) ** 2)
        allowed = sum(special.log_ndtr(mean[i] / spread[i]) for i in problem.damping_indices)
        volume = 0.5 * np.linalg.slogdet(fit.covariance)[1] + np.log(np.sqrt(2.0 * np.pi) * deviation or 1.0)
        heights.append(gain - 0.5 * fit.misfit + volume + allowed)
        for values, value in ((surfaces, surface), (fits, fit), (deviations, deviation), (changes, change)):
            values.append(value)
    total: Any = special.logsumexp(heights)
    weights = np.exp(np.array(heights) - total)
    rng = np.random.default_rng(seed)
    # Systematic resampling reduces the variance of the draws.
    picked = np.searchsorted(
        np.cumsum(weights), (np.arange(POSTERIOR_DRAWS) + rng.uniform(size=POSTERIOR_DRAWS)) / POSTERIOR_DRAWS
    )
    picked = np.minimum(picked, len(delays) - 1)
    means = np.array([fit.coefficients for fit in fits]) + np.array(changes) * (
        np.array(surfaces) - [fit.plane for fit in fits]
    ).reshape(-1, 1)
    moved = np.maximum(delays[picked] + rng.uniform(-0.5, 0.5, POSTERIOR_DRAWS) * step, problem.min_delay)
    at = np.column_stack([np.interp(moved, delays, values) for values in (surfaces, *means.T)])
    factors = factorise_covariance(np.array([fit.covariance for fit in fits]))
    off, values, left = np.empty(POSTERIOR_DRAWS), at[:, 1:].copy(), np.arange(POSTERIOR_DRAWS)
    for _ in range(MAX_REDRAWS):
        cell, noise = picked[left], rng.standard_normal((len(left), means.shape[1] + 1))
        off[left] = np.array(deviations)[cell] * noise[:, 0]
        along = off[left, None] * np.array(changes)[cell]
        values[left] = at[left, 1:] + along + np.einsum("nij,nj->ni", factors[cell], noise[:, 1:])
        left = np.flatnonzero(np.any(values[:, problem.damping_indices] < 0.0, axis=1))
        if not len(left):
            break
    values[:, problem.damping_indices] = np.maximum(values[:, problem.damping_indices], 0.0)
    best = int(np.argmax(heights))
    return Posterior(
        ["delay", "plane", *problem.names],
        rng.permutation(np.column_stack([moved, at[:, 0] + off, values])),
        delays,
        np.array(heights) - max(heights),
        (float(delays[best]), surfaces[best], problem.at(float(delays[best]), surfaces[best])),
        float(total + np.log(step)),
    )
