"""Estimation of the contact from runs in contact: law, coefficients, surface position and force delay.

A dead zone hides small forces, so only rows with a predicted force well beyond it are used; the force that
these readings lack is the dead zone. A dead zone and a shift of the surface reduce the force in the same way.
The surface must therefore be specified (else it is taken as 0) unless the dead zone is specified or noise at
rest reaches beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tuning.identification import clock_drift, damping_average
from tuning.identification.clock_drift import ClockDrift
from tuning.identification.contact_laws import Law, kelvin_voigt
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import Posterior, compute_posterior
from tuning.identification.deep_contact import summarized
from tuning.identification.force_readings import ForceReadings
from tuning.identification.law_choice import EvaluatedLaw, choose_contact_law, search_coarsely
from tuning.identification.motion import MotionResponse
from tuning.identification.noise import SensorNoise
from tuning.identification.press_bias import find_bias_prior
from tuning.identification.rational import MotionModel
from tuning.identification.records import CampaignTiming, LoggedRun
from tuning.identification.sensor_lag import (
    PRIOR_LAG_PROBABILITY,
    SensorLag,
    compute_posterior_at_lag,
    estimate_sensor_lag,
)

SETTLING_TIME = 0.5  # s, settling time of a motion simulator
SEGMENT_LENGTH = 1.0  # s, length of the segments of a long run
MEMORY_TIME_CONSTANTS = 10.0  # time constants after which earlier commands have no effect
SPEED_ROWS, MAX_SPEED_CHANGE = (
    5,
    0.01,
)  # rows between speeds, and their largest relative change in uniform motion
SPECIFIED_DEAD_ZONE_STD = 1e-3  # relative standard deviation of a specified dead zone
UNKNOWN_SURFACE_STD = 5e-5  # m; standard deviation of a surface position that nothing specifies, about 0
DEAD_ZONE_MARGIN = 4.0  # standard deviations beyond the dead zone, above which a reading is used
COARSE_GRID_SIZE = 21, 5  # delays and planes of a coarse grid, for fits that only serve comparisons
ASSUMED_NOISE_SHARE = 0.01  # noise over the largest force, if it is unknown
MIN_NOISE_SHARE = 1e-6  # least noise over the largest force, for simulated logs with rounding errors alone
MIN_DEAD_ZONE_SIGMAS = 3.0  # standard deviations above 0 that show a dead zone
MAX_REDUCED_CHI_SQUARE = 1.3  # chi-squared per degree of freedom above which the intervals are widened


def split_long_run(run: LoggedRun, period: float) -> list[LoggedRun]:
    """Divide a long run into segments of one second, so that all lanes have a similar length.

    Each segment starts earlier with rows that are not used, during which the motion simulator settles.
    """
    settling, length = round(SETTLING_TIME / period), round(SEGMENT_LENGTH / period)
    if len(run.tick) <= settling + 2 * length:
        return [run]
    segments = []
    for begin in range(settling, len(run.tick), length):
        part = slice(begin - settling, min(begin + length, len(run.tick)))
        names = ("tick", "position_desired", "position_measured", "force_measured", "velocity_desired",
                 "force_command", "contact_index", "force_late")  # fmt: skip
        cut = {name: None if getattr(run, name) is None else getattr(run, name)[part] for name in names}
        valid = run.valid[part].copy()
        valid[:settling] = False
        segments.append(replace(run, valid=valid, **cut))
    return segments


def exclude_rows_after_gaps(runs: Sequence[LoggedRun], model: MotionModel, period: float) -> list[LoggedRun]:
    """Mark the first rows of runs after a gap in mid-contact as unused, because their past commands are lost.

    The lost commands affect the motion for ten of its time constants plus all delays. A run that begins in
    uniform motion is taken to have moved uniformly before, so all its rows are used.
    """
    slowest = max((-1.0 / pole.real for pole in np.roots(model.fraction[1])), default=0.0)
    settling = int(
        np.ceil((MEMORY_TIME_CONSTANTS * slowest + max(model.delay, 0.0) + MAX_FORCE_DELAY) / period)
    )
    result, ends = [], {}
    for run in runs:
        lost = ends.get(run.source, run.tick[0]) + 1 < run.tick[0]
        ends[run.source] = int(run.tick[-1])
        if lost and not _is_uniform_motion(run.position_desired):
            run = replace(run, valid=run.valid & (np.arange(len(run.tick)) >= settling))
        result.append(run)
    return result


def _is_uniform_motion(position: np.ndarray) -> bool:
    """Return whether the first rows move without acceleration."""
    first, second = np.diff(position[: 2 * SPEED_ROWS + 1 : SPEED_ROWS])
    return bool(abs(second - first) <= MAX_SPEED_CHANGE * abs(first))


@dataclass(frozen=True)
class ContactFit:
    """Contact fitted to runs in contact, with the motion given."""

    law: Law
    judged: tuple[EvaluatedLaw, ...]  # all laws tried, the chosen one first; empty if the law was specified
    problem: ContactProblem
    posterior: Posterior
    freedom: int  # degrees of freedom: readings minus parameters
    noise_error: float  # relative standard error of the noise level that weights the residuals
    dead_zone: bool  # whether the sensor has a dead zone, which then lowers "bias"
    drift: ClockDrift | None = None  # drift of a separate force clock; the delay then includes a constant
    has_specified_surface: bool = False  # whether the surface was an option, neither fitted nor assumed
    resampled: str = ""  # summary of the bootstrap in words, if there was one

    @property
    def readings(self) -> ForceReadings:
        return self.problem.readings

    @property
    def left(self) -> float:
        """Return chi-squared per degree of freedom."""
        return self.posterior.best[2].misfit / self.freedom

    def draws(self) -> np.ndarray:
        """Return draws of the posterior, wider if the law leaves more than noise, (draws, names)."""
        values = self.posterior.draws
        if self.left <= MAX_REDUCED_CHI_SQUARE or self.resampled:
            return values
        return values.mean(axis=0) + (values - values.mean(axis=0)) * np.sqrt(self.left)


def fit_contact(
    runs: Sequence[LoggedRun],
    model: MotionModel,
    timing: CampaignTiming,
    noise: SensorNoise | None,
    law: Law | str | None = None,
    plane: float | None = None,
    seed: int = 0,
    dead_zone: float = 0.0,
) -> ContactFit:
    """Fit the contact to all runs in contact together.

    Args:
        runs: Runs in contact.
        model: Motion simulator.
        timing: Timing of commands and readings.
        noise: Noise of the force sensor at rest, if it is known.
        law: A law; the name of a law whose shape is searched; or None to choose among all laws.
        plane: Position of the surface [m], if it is specified.
        seed: Seed of the random numbers.
        dead_zone: Specified dead zone [N], used if readings at rest show one.
    """
    apart = _estimate_clock_drift(runs, model, timing, noise, law, plane) if timing.two_clocks else None
    motion = MotionResponse(
        model, runs, timing, MAX_FORCE_DELAY + timing.control_period, apart and apart.late
    )
    plane_option = plane
    readings, plane = _prepare_readings(runs, motion, noise, plane, dead_zone)
    hidden = noise is not None and noise.silent
    judged: tuple[EvaluatedLaw, ...] = ()
    near = None
    if law is None or isinstance(law, str):
        judged = tuple(choose_contact_law(motion, readings, plane, None if law is None else (law,)))
        law, near = judged[0].law, (judged[0].delay, judged[0].plane)
    laws = (law, kelvin_voigt()) if judged and law.pulls else (law,)
    problem, posterior = _fit_laws(motion, readings, laws, plane, near, hidden, seed)
    law = problem.law
    if hidden and not _has_dead_zone(posterior):
        # Zeros at rest without a dead zone are not readings of a noisy sensor: estimate the noise.
        return fit_contact(runs, model, timing, None, law, plane_option, seed)
    if hidden and readings.bias is None and plane_option is None:
        # What the edges of contact tell of delay and damping holds for the surface that is assumed.
        readings = _drop_readings_near_edges(problem, posterior)
        problem, posterior = _fit_laws(motion, readings, (law,), plane, None, hidden, seed)
        posterior = _add_surface_uncertainty(posterior, seed)
    freedom = len(problem.kept) - len(posterior.names)
    error = 0.0 if noise is None or hidden else noise.std_std / max(noise.std, 1e-300)
    is_specified = plane_option is not None
    return ContactFit(law, judged, problem, posterior, freedom, error, bool(hidden), apart, is_specified)


def _prepare_readings(
    runs: Sequence[LoggedRun],
    motion: MotionResponse,
    noise: SensorNoise | None,
    plane: float | None,
    dead_zone: float,
) -> tuple[ForceReadings, float | None]:
    """Return the readings with noise level and prior bias, and the surface [m], or None if it is fitted."""
    prior, hidden = None, noise is not None and noise.silent
    if noise is not None and hidden:
        prior = (dead_zone, SPECIFIED_DEAD_ZONE_STD * dead_zone) if dead_zone else noise.dead_zone
    if noise is None or hidden:
        readings = ForceReadings.of(runs, 1.0, threshold=1.0 if hidden else 0.0)
        usual = 0.0 if hidden and plane is None else plane
        readings = _estimate_noise_from_contact(motion, readings, usual, 0.0 if noise is None else noise.std)
        plane = plane if prior else usual
    else:
        readings = _make_readings(runs, noise)
    # With a dead zone the bias only stands for the force that it removes.
    bias = find_bias_prior(runs, motion, noise, plane) if not hidden else prior and (-prior[0], prior[1])
    return replace(readings, bias=bias), plane


def _fit_laws(
    motion: MotionResponse,
    readings: ForceReadings,
    laws: Sequence[Law],
    plane: float | None,
    near: tuple[float, float] | None,
    hidden: bool,
    seed: int,
) -> tuple[ContactProblem, Posterior]:
    """Return the fit of the likeliest of the laws, averaged over a sensor lag and contact without damping."""
    # A sensor lag that a law does not model looks like a contact that pulls: two laws are compared.
    fits = [(_fit_law(motion, readings, law, plane, near, hidden, seed), law) for law in laws]
    (problem, posterior, lag, evidence), law = max(reversed(fits), key=lambda fit: fit[0][3])
    if lag is not None:
        problem, posterior = problem.changed(law, lag.value), lag.posterior

    def without_damping(law: Law) -> tuple[Posterior, float]:
        _, alone, lagging, evidence = _fit_law(motion, readings, law, plane, near, hidden, seed)
        return alone if lagging is None else lagging.posterior, evidence

    posterior = damping_average.average_over_damping(problem, posterior, evidence, without_damping)
    return ContactProblem(motion, readings, law, plane, problem.time_constant), posterior


def _drop_readings_near_edges(problem: ContactProblem, posterior: Posterior) -> ForceReadings:
    """Return the readings that are in contact wherever the surface is, to two standard deviations."""
    position, _ = problem.motion.at(posterior.best[0])
    readings = problem.readings
    return replace(
        readings, counts=readings.counts & (position - posterior.best[1] > 2.0 * UNKNOWN_SURFACE_STD)
    )


def _add_surface_uncertainty(posterior: Posterior, seed: int) -> Posterior:
    """Return the posterior with the uncertainty of a surface that nothing specifies, and of the dead zone.

    A spring that begins later lacks as much force as a dead zone removes.
    """
    names, draws = posterior.names, posterior.draws.copy()
    slope = draws[
        :, names.index("plane") + 1
    ]  # the first coefficient of every law is its slope at the surface
    lacking = -draws[:, names.index("bias")]
    surface = UNKNOWN_SURFACE_STD * np.random.default_rng(seed).standard_normal(len(draws))
    # The dead zone is not below 0.
    surface = np.maximum(surface, -lacking / slope)
    draws[:, names.index("plane")] += surface
    draws[:, names.index("bias")] -= slope * surface
    return replace(posterior, draws=draws)


def _fit_law(
    motion: MotionResponse,
    readings: ForceReadings,
    law: Law,
    plane: float | None,
    near: tuple[float, float] | None,
    hidden: bool,
    seed: int,
) -> tuple[ContactProblem, Posterior, SensorLag | None, float]:
    """Fit one law, with a sensor lag unless a dead zone hides the onset; return the log evidence last."""
    problem = summarized(ContactProblem(motion, readings, law, plane), near)
    posterior = compute_posterior(problem, seed, near)
    lag = None if hidden else estimate_sensor_lag(problem, posterior, seed)
    return (
        problem,
        posterior,
        lag,
        posterior.evidence + np.log(1.0 - PRIOR_LAG_PROBABILITY) if lag is None else lag.evidence,
    )


def _make_readings(runs: Sequence[LoggedRun], noise: SensorNoise) -> ForceReadings:
    return ForceReadings.of(
        runs, float(np.hypot(noise.innovation, noise.quantum / np.sqrt(12.0))), noise.filter
    )


def _estimate_clock_drift(
    runs: Sequence[LoggedRun],
    model: MotionModel,
    timing: CampaignTiming,
    noise: SensorNoise | None,
    law: Law | str | None,
    plane,
) -> ClockDrift:
    """Return the drift of the force clock; if the noise is unknown, it is a share of the largest force."""
    if noise is None or noise.silent:
        readings = ForceReadings.of(runs, 1.0)
        readings = replace(readings, std=ASSUMED_NOISE_SHARE * float(np.abs(readings.force).max()))
    else:
        readings = _make_readings(runs, noise)
    return clock_drift.estimate_clock_drift(runs, model, timing, readings, law, plane)


def _has_dead_zone(posterior: Posterior) -> bool:
    """Return whether the readings lack so much force that there is a dead zone."""
    lacking = -posterior.draws[:, posterior.names.index("bias")]
    return bool(lacking.mean() > MIN_DEAD_ZONE_SIGMAS * lacking.std())


def _estimate_noise_from_contact(
    motion: MotionResponse, readings: ForceReadings, plane: float | None, at_rest: float
) -> ForceReadings:
    """Estimate the noise from the residuals of a fit; with a dead zone, from the readings well beyond it.

    `at_rest` is the noise that reaches beyond the dead zone at rest [N], or 0.
    """
    counts = readings.counts
    if readings.threshold:
        counts = counts & (readings.force != 0.0) & (np.abs(readings.force) > DEAD_ZONE_MARGIN * at_rest)
    peak = np.abs(readings.force[counts]).max()
    result = replace(
        readings, counts=counts, std=0.01 * peak, threshold=0.02 * peak * (readings.threshold > 0)
    )
    for _ in range(3):
        problem = ContactProblem(motion, result, kelvin_voigt(), plane)
        delay, at, misfit = search_coarsely(problem)
        std = result.std * np.sqrt(max(misfit, 0.0) / max(len(problem.kept) - 5, 1))
        std = max(std, MIN_NOISE_SHARE * peak)
        counts = readings.counts
        if readings.threshold:
            predicted = problem.force(delay, at, problem.at(delay, at).coefficients)
            counts = counts & (predicted > DEAD_ZONE_MARGIN * std)
        result = replace(
            result, counts=counts, std=float(std), threshold=float(std) if readings.threshold else 0.0
        )
    return result


def estimate_contact_frequency(contact: ContactFit, mass: float) -> float:
    """Return the frequency [Hz] of the mass on the stiffest contact, by the secant at the greatest depth."""
    delay, plane, inner = contact.posterior.best
    position, _ = contact.problem.motion.at(delay)
    depth = np.where(contact.readings.counts, position - plane, 0.0)
    force = np.where(contact.readings.counts, contact.problem.force(delay, plane, inner.coefficients), 0.0)
    deepest, lanes = np.argmax(depth, axis=0), np.arange(depth.shape[1])
    peak = force[deepest, lanes]
    # The secant of a very light contact is mostly noise.
    secant = np.where(peak > 0.2 * peak.max(), peak / np.maximum(depth[deepest, lanes], 1e-9), 0.0)
    return float(np.sqrt(max(secant.max(), 1e-9) / mass) / (2.0 * np.pi))


def compute_force_lag(contact: ContactFit, model: MotionModel, frequency: float) -> float:
    """Return the delay of the force's phase behind the command at a frequency [Hz], in s."""
    angle = float(np.angle(model.response(np.array([2j * np.pi * frequency]))[0]))
    return contact.posterior.best[0] - angle / (2.0 * np.pi * frequency)


def refit_without(fit: ContactFit, held: np.ndarray, seed: int = 0) -> ContactFit:
    """Fit the same law to the contacts outside `held`; the result keeps the readings of all contacts."""
    readings, problem = fit.readings, fit.problem
    taught = replace(readings, counts=readings.counts & ~held)
    taught = ContactProblem(problem.motion, taught, fit.law, problem.plane, problem.time_constant)
    freedom = len(taught.kept) - len(fit.posterior.names)
    delay, plane, inner = fit.posterior.best
    taught = summarized(taught, (delay, plane))
    if taught.time_constant:
        best = search_coarsely(taught, (delay, plane, inner.misfit), 2)
        posterior = compute_posterior_at_lag(taught, best, fit.posterior, seed)
    else:
        posterior = compute_posterior(taught, seed, (delay, plane), COARSE_GRID_SIZE)
    return replace(fit, posterior=posterior, freedom=freedom)
