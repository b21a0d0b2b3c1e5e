"""Fit of the contact model to runs in contact: contact law, coefficients, surface position and force delay.

A dead zone of the force sensor hides small forces. A reading is therefore used only if its predicted force is
well above the dead zone. In such readings, the measured force is smaller than the predicted force by the dead
zone. A surface that is further away reduces the force like a dead zone. The fit can distinguish the two only
if the dead zone is known: the user specifies it, or it is estimated from a noise at rest that exceeds it. If
neither the dead zone nor the surface position is known, the surface position is assumed to be 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxhil.mechanism.structs import ForceSensor
from tuning.identification import clock_drift, damping_average
from tuning.identification.clock_drift import ClockDrift
from tuning.identification.contact_laws import Law, kelvin_voigt
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import Posterior, compute_posterior
from tuning.identification.cut_zone import (
    estimate_bias_before_contact,
    estimate_subtracted_bias,
    find_largest_size,
)
from tuning.identification.deep_contact import summarise_deep_lanes
from tuning.identification.force_readings import ForceReadings
from tuning.identification.hidden_noise import HiddenNoise
from tuning.identification.law_choice import EvaluatedLaw, choose_contact_law, search_coarsely
from tuning.identification.motion import MotionResponse
from tuning.identification.noise import MIN_ZERO_SHARE, NoiseEstimate
from tuning.identification.press_bias import find_bias_prior
from tuning.identification.rational import MotionModel
from tuning.identification.records import CampaignTiming, LoggedRun
from tuning.identification.sensor_lag import (
    PRIOR_LAG_PROBABILITY,
    SensorLag,
    compute_posterior_at_lag,
    estimate_sensor_lag,
)
from tuning.identification.stated_filter import estimate_stated_filter

SPECIFIED_DEAD_ZONE_STD = 1e-3  # relative standard deviation of a specified dead zone
UNKNOWN_SURFACE_STD = 5e-5  # standard deviation of a surface position that is assumed to be 0 [m]
DEAD_ZONE_MARGIN = 4.0  # minimum distance of a used force above the dead zone, in standard deviations
COARSE_GRID_SIZE = 21, 5  # numbers of delays and of surface positions in the grid of bootstrap and test fits
ASSUMED_NOISE_SHARE = 0.01  # standard deviation of unknown noise, relative to the largest force
MIN_NOISE_SHARE = 1e-6  # minimum noise as a share of the largest force; simulated logs may be noise-free
MIN_DEAD_ZONE_SIGMAS = 3.0  # minimum size of a significant dead zone, in standard deviations
MAX_REDUCED_CHI_SQUARE = 1.3  # chi-squared per degree of freedom above which the intervals are widened


@dataclass(frozen=True)
class ContactFit:
    """Contact law fitted to runs in contact, with the posterior of its parameters."""

    law: Law
    # all fitted laws, the chosen law first; empty if the law was specified
    evaluated: tuple[EvaluatedLaw, ...]
    problem: ContactProblem
    posterior: Posterior
    degrees_of_freedom: int  # degrees of freedom: number of readings minus number of parameters
    noise_error: float  # relative standard error of the noise level that weights the residuals
    # whether the sensor has a dead zone; the parameter "bias" is then the bias minus the dead zone
    dead_zone: bool
    hidden_noise: HiddenNoise | None = None  # noise, bias and dead zone at rest, if a dead zone hides them
    drift: ClockDrift | None = None  # drift of a separate force clock, whose offset is part of the delay
    has_specified_surface: bool = False  # whether the user specified the surface position
    resampled: str = ""  # summary of the bootstrap in words; empty without a bootstrap
    # change of each posterior draw by the uncertainty of the motion simulator, shape (draws, parameters)
    motion_shifts: np.ndarray | float = 0.0

    @property
    def readings(self) -> ForceReadings:
        return self.problem.readings

    @property
    def reduced_chi_square(self) -> float:
        """Return chi-squared per degree of freedom."""
        return self.posterior.best[2].misfit / self.degrees_of_freedom

    def draws(self) -> np.ndarray:
        """Return draws of the parameters, shape (draws, parameters), with all uncertainties.

        They include the uncertainty of the motion simulator, and are wider than the posterior if the
        residuals exceed the noise.
        """
        values = self.posterior.draws
        if self.reduced_chi_square > MAX_REDUCED_CHI_SQUARE and not self.resampled:
            values = values.mean(axis=0) + (values - values.mean(axis=0)) * np.sqrt(self.reduced_chi_square)
        values = np.asarray(values + self.motion_shifts)
        positive = [2 + i for i in self.problem.damping_indices]
        values[:, positive] = np.maximum(values[:, positive], 0.0)
        return values


def fit_contact(
    runs: Sequence[LoggedRun],
    model: MotionModel,
    timing: CampaignTiming,
    noise: NoiseEstimate | None,
    law: Law | str | None = None,
    plane: float | None = None,
    seed: int = 0,
    sensor: ForceSensor | None = None,
) -> ContactFit:
    """Fit a contact law, the surface position and the force delay to all runs in contact together.

    Args:
        runs: Runs in contact.
        model: Model of the motion simulator.
        timing: Timing of commands and readings.
        noise: Noise of the force sensor at rest, or None if it is unknown.
        law: Contact law; or the name of a law, to fit its shape parameters, too; or None to choose a law.
        plane: Position of the surface [m], or None to estimate it.
        seed: Seed of the random numbers.
        sensor: Specified force sensor, or None. Its filter is ignored if a dead zone hides the noise. Its
            dead zone is ignored if readings at rest do not show a dead zone.
    """
    sensor = sensor or ForceSensor()
    drift = _estimate_clock_drift(runs, model, timing, noise, law, plane) if timing.two_clocks else None
    motion = MotionResponse(
        model, runs, timing, MAX_FORCE_DELAY + timing.control_period, drift and drift.delays
    )
    plane_option = plane
    readings, plane = _prepare_readings(runs, motion, noise, plane, sensor)
    noise_is_hidden = noise is not None and noise.silent
    evaluated: tuple[EvaluatedLaw, ...] = ()
    near = None
    if law is None or isinstance(law, str):
        evaluated = tuple(choose_contact_law(motion, readings, plane, None if law is None else (law,)))
        law, near = evaluated[0].law, (evaluated[0].delay, evaluated[0].plane)
    laws = (law, kelvin_voigt()) if evaluated and law.pulls else (law,)
    problem, posterior = _fit_laws(motion, readings, laws, plane, near, seed)
    law = problem.law
    is_estimated = noise is not None and noise.hidden is not None
    is_visible = not (readings.zone or is_estimated or _has_dead_zone(posterior))
    if noise_is_hidden and is_visible and not _is_silent_outside(runs, problem, posterior):
        # Without a dead zone, readings of 0 at rest hide the noise: estimate it from the contacts.
        return fit_contact(runs, model, timing, None, law, plane_option, seed, sensor)
    if noise_is_hidden and readings.bias is None and plane_option is None:
        # The surface position is only an assumption, so readings near onset and release must not determine
        # delay and damping.
        readings = _drop_readings_near_edges(problem, posterior)
        problem, posterior = _fit_laws(motion, readings, (law,), plane, None, seed)
        posterior = _add_surface_uncertainty(posterior, seed)
    degrees_of_freedom = len(problem.used_rows) - len(posterior.names)
    error = 0.0 if noise is None or noise_is_hidden else noise.std_std / max(noise.std, 1e-300)
    is_specified = plane_option is not None
    return ContactFit(
        law,
        evaluated,
        problem,
        posterior,
        degrees_of_freedom,
        error,
        bool(noise_is_hidden),
        None if noise is None else noise.hidden,
        drift,
        is_specified,
    )


def _prepare_readings(
    runs: Sequence[LoggedRun],
    motion: MotionResponse,
    noise: NoiseEstimate | None,
    plane: float | None,
    sensor: ForceSensor,
) -> tuple[ForceReadings, float | None]:
    """Return the readings (with noise and prior of the bias), and the surface position [m] for the fit.

    The surface position is None if the fit must estimate it.
    """
    prior, noise_is_hidden = None, noise is not None and noise.silent
    zone = sensor.dead_zone
    cut = find_largest_size(runs) if noise_is_hidden and zone and sensor.dead_zone_kind == "cut" else 0.0
    if noise is not None and noise_is_hidden and noise.hidden is not None:
        missing_force, std = noise.hidden.missing_force
        prior = -missing_force, std
    if noise_is_hidden and zone and not cut:
        prior = estimate_subtracted_bias(runs, zone, SPECIFIED_DEAD_ZONE_STD * zone)
    low_pass = None if noise_is_hidden else sensor.filter
    if noise is None or noise_is_hidden or noise.std == 0.0:
        readings = ForceReadings.of(runs, 1.0, threshold=1.0 if noise_is_hidden else 0.0)
        subtracted = zone if noise_is_hidden and not cut else 0.0
        readings = replace(readings, low_pass=low_pass, zone=cut, subtracted=subtracted)
        if cut:
            readings = replace(readings, bias=estimate_bias_before_contact(runs, cut))
            return _estimate_noise_from_contact(motion, readings, plane, 0.0), plane
        usual = 0.0 if noise_is_hidden and plane is None else plane
        readings = _estimate_noise_from_contact(motion, readings, usual, 0.0 if noise is None else noise.std)
        plane = plane if prior else usual
    else:
        readings = replace(_make_readings(runs, noise), low_pass=low_pass)
    # If there is a dead zone, the parameter "bias" is the bias minus the dead zone.
    bias = prior if noise_is_hidden else find_bias_prior(runs, motion, noise, plane)
    return replace(readings, bias=bias), plane


def _fit_laws(
    motion: MotionResponse,
    readings: ForceReadings,
    laws: Sequence[Law],
    plane: float | None,
    near: tuple[float, float] | None,
    seed: int,
) -> tuple[ContactProblem, Posterior]:
    """Fit the candidate laws; average the best posterior over models with and without damping.

    Args:
        motion: Motion of the mechanism in all runs.
        readings: Force readings.
        laws: Candidate laws.
        plane: Position of the surface [m], or None to estimate it.
        near: Approximate delay [s] and surface position [m], or None.
        seed: Seed of the random numbers.

    Returns:
        The contact problem of the chosen law and the posterior.
    """
    # An unmodelled sensor lag looks like a contact that pulls, so each law is fitted together with a lag.
    fits = [(_fit_law(motion, readings, law, plane, near, seed), law) for law in laws]
    (problem, posterior, lag, evidence), law = max(reversed(fits), key=lambda fit: fit[0][3])
    if lag is not None:
        problem, posterior = problem.changed(law, lag.value), lag.posterior

    def without_damping(law: Law) -> tuple[Posterior, float]:
        _, alone, lagging, evidence = _fit_law(motion, readings, law, plane, near, seed)
        return alone if lagging is None else lagging.posterior, evidence

    posterior = damping_average.average_over_damping(problem, posterior, evidence, without_damping)
    return ContactProblem(motion, readings, law, plane, problem.time_constant), posterior


def _drop_readings_near_edges(problem: ContactProblem, posterior: Posterior) -> ForceReadings:
    """Exclude the readings at depths below twice the standard deviation of the assumed surface position."""
    position, _ = problem.motion.at(posterior.best[0])
    readings = problem.readings
    return replace(
        readings, counts=readings.counts & (position - posterior.best[1] > 2.0 * UNKNOWN_SURFACE_STD)
    )


def _add_surface_uncertainty(posterior: Posterior, seed: int) -> Posterior:
    """Add the uncertainty of an assumed surface position to the posterior.

    A surface that is further away reduces the force like a dead zone does. The readings determine only the
    sum of both effects.
    """
    names, draws = posterior.names, posterior.draws.copy()
    # The first coefficient of every law is its stiffness at the surface.
    slope = draws[:, names.index("plane") + 1]
    missing_force = -draws[:, names.index("bias")]
    surface = UNKNOWN_SURFACE_STD * np.random.default_rng(seed).standard_normal(len(draws))
    # The dead zone must not become negative.
    surface = np.minimum(surface, missing_force / slope)
    draws[:, names.index("plane")] += surface
    draws[:, names.index("bias")] += slope * surface
    return replace(posterior, draws=draws)


def _fit_law(
    motion: MotionResponse,
    readings: ForceReadings,
    law: Law,
    plane: float | None,
    near: tuple[float, float] | None,
    seed: int,
) -> tuple[ContactProblem, Posterior, SensorLag | None, float]:
    """Fit one law with the prior's filter or, without a filter, with and without a sensor lag."""
    problem = summarise_deep_lanes(ContactProblem(motion, readings, law, plane), near)
    if readings.time_constant:
        lag = estimate_stated_filter(problem, near, seed)
        return problem, lag.posterior, lag, lag.evidence
    posterior = compute_posterior(problem, seed, near)
    lag = estimate_sensor_lag(problem, posterior, seed)
    return (
        problem,
        posterior,
        lag,
        posterior.evidence + np.log(1.0 - PRIOR_LAG_PROBABILITY) if lag is None else lag.evidence,
    )


def _make_readings(runs: Sequence[LoggedRun], noise: NoiseEstimate) -> ForceReadings:
    std = float(np.hypot(noise.innovation, noise.quantum / np.sqrt(12.0)))
    return replace(ForceReadings.of(runs, std, noise.filter), bias_step=noise.bias_step)


def _estimate_clock_drift(
    runs: Sequence[LoggedRun],
    model: MotionModel,
    timing: CampaignTiming,
    noise: NoiseEstimate | None,
    law: Law | str | None,
    plane,
) -> ClockDrift:
    """Estimate the drift of the force clock; if the noise is unknown, assume a share of the largest force."""
    if noise is None or noise.silent or noise.std == 0.0:
        readings = ForceReadings.of(runs, 1.0)
        readings = replace(readings, std=ASSUMED_NOISE_SHARE * float(np.abs(readings.force).max()))
    else:
        readings = _make_readings(runs, noise)
    return clock_drift.estimate_clock_drift(runs, model, timing, readings, law, plane)


def _has_dead_zone(posterior: Posterior) -> bool:
    """Return whether a dead zone makes the measured force significantly smaller than predicted."""
    missing_force = -posterior.draws[:, posterior.names.index("bias")]
    return bool(missing_force.mean() > MIN_DEAD_ZONE_SIGMAS * missing_force.std())


def _is_silent_outside(runs: Sequence[LoggedRun], problem: ContactProblem, posterior: Posterior) -> bool:
    """Return whether most readings before and after the contacts are exactly 0, which shows a dead zone.

    A fit alone may not reveal a dead zone, because a wrong surface position can have the same effect on the
    force as the dead zone.
    """
    delay, plane, _ = posterior.best
    position, _ = problem.motion.at(delay)
    readings = [
        run.force_measured[run.valid & (position[: len(run.tick), lane] < plane - 3.0 * UNKNOWN_SURFACE_STD)]
        for lane, run in enumerate(runs)
        if run.force_measured is not None
    ]
    outside = np.concatenate(readings)
    return bool(len(outside) and np.mean(outside == 0.0) > MIN_ZERO_SHARE)


def _estimate_noise_from_contact(
    motion: MotionResponse, readings: ForceReadings, plane: float | None, at_rest: float
) -> ForceReadings:
    """Estimate the noise of the force readings from the residuals of a Kelvin-Voigt fit.

    If there is a dead zone, only readings of forces well above the dead zone are used.

    Args:
        motion: Motion of the mechanism in all runs.
        readings: Force readings.
        plane: Position of the surface [m], or None to estimate it.
        at_rest: Noise at rest [N]; 0 if it is unknown or a dead zone hides it.

    Returns:
        The readings, with the estimated noise and with flags (`counts`) of the readings that fits use.
    """
    counts = readings.counts
    if readings.threshold:
        least = max(DEAD_ZONE_MARGIN * at_rest, 2.0 * readings.zone)
        counts = counts & (readings.force != 0.0) & (np.abs(readings.force) > least)
    peak = np.abs(readings.force[counts]).max()
    result = replace(
        readings, counts=counts, std=0.01 * peak, threshold=0.02 * peak * (readings.threshold > 0)
    )
    for _ in range(3):
        problem = ContactProblem(motion, result, kelvin_voigt(), plane)
        delay, at, misfit = search_coarsely(problem)
        std = result.std * np.sqrt(max(misfit, 0.0) / max(len(problem.used_rows) - 5, 1))
        std = max(std, MIN_NOISE_SHARE * peak)
        counts = readings.counts
        if readings.threshold:
            predicted = problem.force(delay, at, problem.at(delay, at).coefficients)
            counts = counts & (predicted > readings.zone + DEAD_ZONE_MARGIN * std)
        result = replace(
            result, counts=counts, std=float(std), threshold=float(std) if readings.threshold else 0.0
        )
    return result


def refit_without(fit: ContactFit, held_out: np.ndarray, seed: int = 0) -> ContactFit:
    """Fit the same law again, without the contacts that `held_out` flags.

    The result keeps the readings of all contacts, so that checks can compare the fit with the omitted ones.
    """
    readings, problem = fit.readings, fit.problem
    rest = replace(readings, counts=readings.counts & ~held_out)
    rest = ContactProblem(problem.motion, rest, fit.law, problem.plane, problem.time_constant)
    degrees_of_freedom = len(rest.used_rows) - len(fit.posterior.names)
    delay, plane, inner = fit.posterior.best
    rest = summarise_deep_lanes(rest, (delay, plane))
    if rest.time_constant:
        best = search_coarsely(rest, (delay, plane, inner.misfit), 2)
        delay_std = float(fit.posterior.draws[:, 0].std())
        posterior = compute_posterior_at_lag(rest, best, delay_std, seed)
    else:
        posterior = compute_posterior(rest, seed, (delay, plane), COARSE_GRID_SIZE)
    return replace(fit, posterior=posterior, degrees_of_freedom=degrees_of_freedom)
