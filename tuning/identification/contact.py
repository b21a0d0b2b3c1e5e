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

from tuning.identification import two_clocks, undamped
from tuning.identification.contact_laws import Law, kelvin_voigt
from tuning.identification.contact_problem import LONGEST, Problem
from tuning.identification.contact_profile import Posterior, profile
from tuning.identification.force_readings import Readings
from tuning.identification.law_choice import Judged, judge, quick
from tuning.identification.motion import Motion
from tuning.identification.noise import Noise
from tuning.identification.press import known_bias
from tuning.identification.rational import Model
from tuning.identification.records import Run, Timing
from tuning.identification.sensor_lag import LIKELY, Lag, sensor_lag, with_lag
from tuning.identification.two_clocks import Drift

SETTLING = 0.5  # s, settling time of a motion simulator
PIECE = 1.0  # s, length of the segments of a long run
TIME_CONSTANTS = 10.0  # time constants after which earlier commands have no effect
FIRST_ROWS, STEADY = 5, 0.01  # rows between speeds, and their largest relative change in uniform motion
TOLD = 1e-3  # relative standard deviation of a specified dead zone
SURFACE_STD = 5e-5  # m; standard deviation of a surface position that nothing specifies, about 0
BEYOND = 4.0  # standard deviations beyond the dead zone, above which a reading is used
ROUGH = 21, 5  # delays and planes of a coarse grid, for fits that only serve comparisons
UNKNOWN_NOISE = 0.01  # noise over the largest force, if it is unknown
LEAST_NOISE = 1e-6  # least noise over the largest force, for simulated logs with rounding errors alone
SURE = 3.0  # standard deviations above 0 that show a dead zone
UNEXPLAINED = 1.3  # chi-squared per degree of freedom above which the intervals are widened


def pieces(run: Run, period: float) -> list[Run]:
    """Divide a long run into segments of one second, so that all lanes have a similar length.

    Each segment starts earlier with rows that are not used, during which the motion simulator settles.
    """
    settling, length = round(SETTLING / period), round(PIECE / period)
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


def after_gaps(runs: Sequence[Run], model: Model, period: float) -> list[Run]:
    """Mark the first rows of runs after a gap in mid-contact as unused, because their past commands are lost.

    The lost commands affect the motion for ten of its time constants plus all delays. A run that begins in
    uniform motion is taken to have moved uniformly before, so all its rows are used.
    """
    slowest = max((-1.0 / pole.real for pole in np.roots(model.fraction[1])), default=0.0)
    settling = int(np.ceil((TIME_CONSTANTS * slowest + max(model.delay, 0.0) + LONGEST) / period))
    result, ends = [], {}
    for run in runs:
        lost = ends.get(run.source, run.tick[0]) + 1 < run.tick[0]
        ends[run.source] = int(run.tick[-1])
        if lost and not _uniform(run.position_desired):
            run = replace(run, valid=run.valid & (np.arange(len(run.tick)) >= settling))
        result.append(run)
    return result


def _uniform(position: np.ndarray) -> bool:
    """Return whether the first rows move without acceleration."""
    first, second = np.diff(position[: 2 * FIRST_ROWS + 1 : FIRST_ROWS])
    return bool(abs(second - first) <= STEADY * abs(first))


@dataclass(frozen=True)
class ContactFit:
    """Contact fitted to runs in contact, with the motion given."""

    law: Law
    judged: tuple[Judged, ...]  # all laws tried, the chosen one first; empty if the law was specified
    problem: Problem
    posterior: Posterior
    freedom: int  # degrees of freedom: readings minus parameters
    noise_error: float  # relative standard error of the noise level that weights the residuals
    dead_zone: bool  # whether the sensor has a dead zone, which then lowers "bias"
    drift: Drift | None = None  # drift of a separate force clock; the delay then includes a constant
    has_specified_surface: bool = False  # whether the surface was an option, neither fitted nor assumed
    resampled: str = ""  # summary of the bootstrap in words, if there was one

    @property
    def readings(self) -> Readings:
        return self.problem.readings

    @property
    def left(self) -> float:
        """Return chi-squared per degree of freedom."""
        return self.posterior.best[2].misfit / self.freedom

    def draws(self) -> np.ndarray:
        """Return draws of the posterior, wider if the law leaves more than noise, (draws, names)."""
        values = self.posterior.draws
        if self.left <= UNEXPLAINED or self.resampled:
            return values
        return values.mean(axis=0) + (values - values.mean(axis=0)) * np.sqrt(self.left)


def estimate(
    runs: Sequence[Run],
    model: Model,
    timing: Timing,
    noise: Noise | None,
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
    apart = _drift(runs, model, timing, noise, law, plane) if timing.two_clocks else None
    motion = Motion(model, runs, timing, LONGEST + timing.control_period, apart and apart.late)
    plane_option = plane
    readings, plane = _prepared(runs, motion, noise, plane, dead_zone)
    hidden = noise is not None and noise.silent
    judged: tuple[Judged, ...] = ()
    near = None
    if law is None or isinstance(law, str):
        judged = tuple(judge(motion, readings, plane, None if law is None else (law,)))
        law, near = judged[0].law, (judged[0].delay, judged[0].plane)
    laws = (law, kelvin_voigt()) if judged and law.pulls else (law,)
    problem, posterior = _solution(motion, readings, laws, plane, near, hidden, seed)
    law = problem.law
    if hidden and not _hides(posterior):
        # Zeros at rest without a dead zone are not readings of a noisy sensor: estimate the noise.
        return estimate(runs, model, timing, None, law, plane_option, seed)
    if hidden and readings.bias is None and plane_option is None:
        # What the edges of contact tell of delay and damping holds for the surface that is assumed.
        readings = _clear_of_edges(problem, posterior)
        problem, posterior = _solution(motion, readings, (law,), plane, None, hidden, seed)
        posterior = _with_unknown_surface(posterior, seed)
    freedom = len(problem.kept) - len(posterior.names)
    error = 0.0 if noise is None or hidden else noise.std_std / max(noise.std, 1e-300)
    is_specified = plane_option is not None
    return ContactFit(law, judged, problem, posterior, freedom, error, bool(hidden), apart, is_specified)


def _prepared(
    runs: Sequence[Run], motion: Motion, noise: Noise | None, plane: float | None, dead_zone: float
) -> tuple[Readings, float | None]:
    """Return the readings with noise level and prior bias, and the surface [m], or None if it is fitted."""
    prior, hidden = None, noise is not None and noise.silent
    if noise is not None and hidden:
        prior = (dead_zone, TOLD * dead_zone) if dead_zone else noise.dead_zone
    if noise is None or hidden:
        readings = Readings.of(runs, 1.0, threshold=1.0 if hidden else 0.0)
        usual = 0.0 if hidden and plane is None else plane
        readings = _noise_from_contact(motion, readings, usual, 0.0 if noise is None else noise.std)
        plane = plane if prior else usual
    else:
        readings = _readings(runs, noise)
    # With a dead zone the bias only stands for the force that it removes.
    bias = known_bias(runs, motion, noise, plane) if not hidden else prior and (-prior[0], prior[1])
    return replace(readings, bias=bias), plane


def _solution(
    motion: Motion,
    readings: Readings,
    laws: Sequence[Law],
    plane: float | None,
    near: tuple[float, float] | None,
    hidden: bool,
    seed: int,
) -> tuple[Problem, Posterior]:
    """Return the fit of the likeliest of the laws, averaged over a sensor lag and contact without damping."""
    # A sensor lag that a law does not model looks like a contact that pulls: two laws are compared.
    fits = [(_fitted(motion, readings, law, plane, near, hidden, seed), law) for law in laws]
    (problem, posterior, lag, evidence), law = max(reversed(fits), key=lambda fit: fit[0][3])
    if lag is not None:
        problem = Problem(motion, readings, law, plane, lag.value)
        posterior = lag.posterior

    def without_damping(law: Law) -> tuple[Posterior, float]:
        _, alone, lagging, evidence = _fitted(motion, readings, law, plane, near, hidden, seed)
        return alone if lagging is None else lagging.posterior, evidence

    return problem, undamped.averaged(problem, posterior, evidence, without_damping)


def _clear_of_edges(problem: Problem, posterior: Posterior) -> Readings:
    """Return the readings that are in contact wherever the surface is, to two standard deviations."""
    position, _ = problem.motion.at(posterior.best[0])
    readings = problem.readings
    return replace(readings, counts=readings.counts & (position - posterior.best[1] > 2.0 * SURFACE_STD))


def _with_unknown_surface(posterior: Posterior, seed: int) -> Posterior:
    """Return the posterior with the uncertainty of a surface that nothing specifies, and of the dead zone.

    A spring that begins later lacks as much force as a dead zone removes.
    """
    names, draws = posterior.names, posterior.draws.copy()
    slope = draws[
        :, names.index("plane") + 1
    ]  # the first coefficient of every law is its slope at the surface
    lacking = -draws[:, names.index("bias")]
    surface = SURFACE_STD * np.random.default_rng(seed).standard_normal(len(draws))
    # The dead zone is not below 0.
    surface = np.maximum(surface, -lacking / slope)
    draws[:, names.index("plane")] += surface
    draws[:, names.index("bias")] -= slope * surface
    return replace(posterior, draws=draws)


def _fitted(
    motion: Motion,
    readings: Readings,
    law: Law,
    plane: float | None,
    near: tuple[float, float] | None,
    hidden: bool,
    seed: int,
) -> tuple[Problem, Posterior, Lag | None, float]:
    """Fit one law, with a sensor lag unless a dead zone hides the onset; return the log evidence last."""
    problem = Problem(motion, readings, law, plane)
    posterior = profile(problem, seed, near)
    lag = None if hidden else sensor_lag(problem, posterior, seed)
    return problem, posterior, lag, posterior.evidence + np.log(1.0 - LIKELY) if lag is None else lag.evidence


def _readings(runs: Sequence[Run], noise: Noise) -> Readings:
    return Readings.of(runs, float(np.hypot(noise.innovation, noise.quantum / np.sqrt(12.0))), noise.filter)


def _drift(
    runs: Sequence[Run], model: Model, timing: Timing, noise: Noise | None, law: Law | str | None, plane
) -> Drift:
    """Return the drift of the force clock; if the noise is unknown, it is a share of the largest force."""
    if noise is None or noise.silent:
        readings = Readings.of(runs, 1.0)
        readings = replace(readings, std=UNKNOWN_NOISE * float(np.abs(readings.force).max()))
    else:
        readings = _readings(runs, noise)
    return two_clocks.drift(runs, model, timing, readings, law, plane)


def _hides(posterior: Posterior) -> bool:
    """Return whether the readings lack so much force that there is a dead zone."""
    lacking = -posterior.draws[:, posterior.names.index("bias")]
    return bool(lacking.mean() > SURE * lacking.std())


def _noise_from_contact(motion: Motion, readings: Readings, plane: float | None, at_rest: float) -> Readings:
    """Estimate the noise from the residuals of a fit; with a dead zone, from the readings well beyond it.

    `at_rest` is the noise that reaches beyond the dead zone at rest [N], or 0.
    """
    counts = readings.counts
    if readings.threshold:
        counts = counts & (readings.force != 0.0) & (np.abs(readings.force) > BEYOND * at_rest)
    peak = np.abs(readings.force[counts]).max()
    result = replace(
        readings, counts=counts, std=0.01 * peak, threshold=0.02 * peak * (readings.threshold > 0)
    )
    for _ in range(3):
        problem = Problem(motion, result, kelvin_voigt(), plane)
        delay, at, misfit = quick(problem)
        std = result.std * np.sqrt(max(misfit, 0.0) / max(len(problem.kept) - 5, 1))
        std = max(std, LEAST_NOISE * peak)
        counts = readings.counts
        if readings.threshold:
            predicted = problem.force(delay, at, problem.at(delay, at).coefficients)
            counts = counts & (predicted > BEYOND * std)
        result = replace(
            result, counts=counts, std=float(std), threshold=float(std) if readings.threshold else 0.0
        )
    return result


def frequency(contact: ContactFit, mass: float) -> float:
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


def lag(contact: ContactFit, model: Model, frequency: float) -> float:
    """Return the delay of the force's phase behind the command at a frequency [Hz], in s."""
    angle = float(np.angle(model.response(np.array([2j * np.pi * frequency]))[0]))
    return contact.posterior.best[0] - angle / (2.0 * np.pi * frequency)


def without(fit: ContactFit, held: np.ndarray, seed: int = 0) -> ContactFit:
    """Fit the same law to the contacts outside `held`; the result keeps the readings of all contacts."""
    readings, problem = fit.readings, fit.problem
    taught = replace(readings, counts=readings.counts & ~held)
    taught = Problem(problem.motion, taught, fit.law, problem.plane, problem.time_constant)
    freedom = len(taught.kept) - len(fit.posterior.names)
    delay, plane, inner = fit.posterior.best
    if taught.time_constant:
        best = quick(taught, (delay, plane, inner.misfit), 2)
        posterior = with_lag(taught, best, fit.posterior, seed)
    else:
        posterior = profile(taught, seed, (delay, plane), ROUGH)
    return replace(fit, posterior=posterior, freedom=freedom)
