"""The contact from runs in contact: law, stiffness, damping, plane, and the force sensor's delay.

Where a dead zone hides small forces, only rows count whose predicted force is well beyond it; what the
readings lack there is the dead zone. Unless noise at rest reaches beyond it, or it is told, the plane has to
be told, since a spring that begins later lacks as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tuning.identification import two_clocks, undamped
from tuning.identification.contact_laws import Law, kelvin_voigt
from tuning.identification.contact_problem import LONGEST, Problem, Readings
from tuning.identification.contact_profile import Posterior, profile
from tuning.identification.law_choice import Judged, judge, quick
from tuning.identification.motion import Motion
from tuning.identification.noise import Noise
from tuning.identification.press import known_bias
from tuning.identification.rational import Model
from tuning.identification.records import Run, Timing
from tuning.identification.sensor_lag import LIKELY, Lag, sensor_lag, with_lag
from tuning.identification.two_clocks import Drift

SETTLING = 0.5  # s, of a motion simulator
PIECE = 1.0  # s
TIME_CONSTANTS = 10.0  # after which what was commanded before is over
FIRST_ROWS, STEADY = 5, 0.01  # rows over which, and share by which, the speed of uniform motion may change
TOLD = 1e-3  # of a dead zone that was told, to which it is known
BEYOND = 4.0  # standard deviations beyond the dead zone from which a reading counts
ROUGH = 21, 5  # delays and planes of the grid for the fit that is only judged
UNKNOWN_NOISE = 0.01  # of the largest force, where nothing tells it
LEAST_NOISE = 1e-6  # of the largest force: below it a log without noise differs by rounding alone
SURE = 3.0  # standard deviations from which a dead zone is there
UNEXPLAINED = 1.3  # chi-squared per degree of freedom above which intervals are widened by it


def pieces(run: Run, period: float) -> list[Run]:
    """A long run in pieces of a second, so that no lane is much longer than the others.

    Each begins in the run before it, with rows that do not count while the motion simulator settles."""
    settling, length = round(SETTLING / period), round(PIECE / period)
    if len(run.tick) <= settling + 2 * length:
        return [run]
    found = []
    for begin in range(settling, len(run.tick), length):
        part = slice(begin - settling, min(begin + length, len(run.tick)))
        names = ("tick", "position_desired", "position_measured", "force_measured", "velocity_desired",
                 "force_command", "contact_index", "force_late")  # fmt: skip
        cut = {name: None if getattr(run, name) is None else getattr(run, name)[part] for name in names}
        valid = run.valid[part].copy()
        valid[:settling] = False
        found.append(replace(run, valid=valid, **cut))
    return found


def after_gaps(runs: Sequence[Run], model: Model, period: float) -> list[Run]:
    """Runs whose first rows do not count where the log lost rows in mid-contact, commands and all.

    What was commanded there is in the motion until ten of its time constants and all delays later. A run that
    begins in uniform motion was so before."""
    slowest = max((-1.0 / pole.real for pole in np.roots(model.fraction[1])), default=0.0)
    settling = int(np.ceil((TIME_CONSTANTS * slowest + max(model.delay, 0.0) + LONGEST) / period))
    found, ends = [], {}
    for run in runs:
        lost = ends.get(run.source, run.tick[0]) + 1 < run.tick[0]
        ends[run.source] = int(run.tick[-1])
        if lost and not _uniform(run.position_desired):
            run = replace(run, valid=run.valid & (np.arange(len(run.tick)) >= settling))
        found.append(run)
    return found


def _uniform(position: np.ndarray) -> bool:
    """Whether the first rows are those of a motion that nothing accelerates."""
    first, second = np.diff(position[: 2 * FIRST_ROWS + 1 : FIRST_ROWS])
    return bool(abs(second - first) <= STEADY * abs(first))


@dataclass(frozen=True)
class ContactFit:
    """What runs in contact say, the motion given."""

    law: Law
    judged: tuple[Judged, ...]  # all laws tried, the one taken first; empty where it was told
    problem: Problem
    posterior: Posterior
    freedom: int  # readings less parameters
    noise_error: float  # relative standard deviation of the noise that residuals are weighed by
    dead_zone: bool  # whether readings are those of a dead zone: "bias" is then less by it
    drift: Drift | None = None  # of a clock of the forces' own; the delay is then that and a constant
    lag_share: float = 0.0  # posterior probability of a sensor's lag that is part of the delay
    resampled: str = ""  # what fits to other contacts say of the draws, in words, where they were asked for

    @property
    def readings(self) -> Readings:
        return self.problem.readings

    @property
    def left(self) -> float:
        """Chi-squared per degree of freedom."""
        return self.posterior.best[2].misfit / self.freedom

    def draws(self) -> np.ndarray:
        """Draws of the posterior; spread out where the law leaves more than noise."""
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
    """From runs with contact together; `noise` is the force sensor's at rest, where it is known.

    A law as a string is the name of one whose shape is searched; None lets the touches choose. `dead_zone`
    [N] is one that was told: it counts where readings at rest show one.
    """
    apart = _drift(runs, model, timing, noise, law, plane) if timing.two_clocks else None
    motion = Motion(model, runs, timing, LONGEST + timing.control_period, apart and apart.late)
    told = plane
    hidden = noise is not None and noise.silent
    known = None
    if noise is not None and hidden:
        known = (dead_zone, TOLD * dead_zone) if dead_zone else noise.dead_zone
    if noise is None or hidden:
        readings = Readings.of(runs, 1.0, threshold=1.0 if hidden else 0.0)
        usual = 0.0 if hidden and plane is None else plane
        readings = _noise_from_contact(motion, readings, usual, 0.0 if noise is None else noise.std)
        plane = plane if known else usual
    else:
        readings = _readings(runs, noise)
    # Under a dead zone there is no bias but what it takes.
    bias = known_bias(runs, motion, noise, plane) if not hidden else known and (-known[0], known[1])
    readings = replace(readings, bias=bias)
    judged: tuple[Judged, ...] = ()
    near = None
    if law is None or isinstance(law, str):
        judged = tuple(judge(motion, readings, plane, None if law is None else (law,)))
        law, near = judged[0].law, (judged[0].delay, judged[0].plane)
    problem, posterior, lag, evidence = _fitted(motion, readings, law, plane, near, hidden, seed)
    if judged and law.pulls:
        # Without a lag in the laws, one of the sensor looks like a contact that pulls.
        pushing = kelvin_voigt()
        other = _fitted(motion, readings, pushing, plane, near, hidden, seed)
        if other[3] >= evidence:
            law, (problem, posterior, lag, evidence) = pushing, other
    if lag is not None:
        problem = Problem(motion, readings, law, plane, lag.value)
        posterior = lag.posterior

    def without_damping(law: Law) -> tuple[Posterior, float]:
        _, alone, lagging, evidence = _fitted(motion, readings, law, plane, near, hidden, seed)
        return alone if lagging is None else lagging.posterior, evidence

    posterior = undamped.averaged(problem, posterior, evidence, without_damping)
    averaged = lag.share if lag is not None and not lag.value else 0.0
    if hidden and not _hides(posterior):
        # A channel that is 0 out of contact is no sensor's.
        return estimate(runs, model, timing, None, law, told, seed)
    freedom = len(problem.kept) - len(posterior.names)
    error = 0.0 if noise is None or hidden else noise.std_std / max(noise.std, 1e-300)
    return ContactFit(law, judged, problem, posterior, freedom, error, bool(hidden), apart, averaged)


def _fitted(
    motion: Motion,
    readings: Readings,
    law: Law,
    plane: float | None,
    near: tuple[float, float] | None,
    hidden: bool,
    seed: int,
) -> tuple[Problem, Posterior, Lag | None, float]:
    """Fit one law, with a lag of the sensor if no dead zone hides the onset; the last is the evidence."""
    problem = Problem(motion, readings, law, plane)
    posterior = profile(problem, seed, near)
    lag = None if hidden else sensor_lag(problem, posterior, seed)
    return problem, posterior, lag, posterior.evidence + np.log(1.0 - LIKELY) if lag is None else lag.evidence


def _readings(runs: Sequence[Run], noise: Noise) -> Readings:
    return Readings.of(runs, float(np.hypot(noise.innovation, noise.quantum / np.sqrt(12.0))), noise.filter)


def _drift(
    runs: Sequence[Run], model: Model, timing: Timing, noise: Noise | None, law: Law | str | None, plane
) -> Drift:
    """Of the forces' clock; where no rest tells the noise, forces count by a share of the largest."""
    if noise is None or noise.silent:
        readings = Readings.of(runs, 1.0)
        readings = replace(readings, std=UNKNOWN_NOISE * float(np.abs(readings.force).max()))
    else:
        readings = _readings(runs, noise)
    return two_clocks.drift(runs, model, timing, readings, law, plane)


def _hides(posterior: Posterior) -> bool:
    """Whether readings lack so much that there is a dead zone."""
    lacking = -posterior.draws[:, posterior.names.index("bias")]
    return bool(lacking.mean() > SURE * lacking.std())


def _noise_from_contact(motion: Motion, readings: Readings, plane: float | None, at_rest: float) -> Readings:
    """The noise is what the laws leave; under a dead zone, of the readings well beyond it.

    `at_rest`: noise that reaches beyond the dead zone at rest [N]; 0 where none does."""
    counts = readings.counts
    if readings.threshold:
        counts = counts & (readings.force != 0.0) & (np.abs(readings.force) > BEYOND * at_rest)
    peak = np.abs(readings.force[counts]).max()
    found = replace(
        readings, counts=counts, std=0.01 * peak, threshold=0.02 * peak * (readings.threshold > 0)
    )
    for _ in range(3):
        problem = Problem(motion, found, kelvin_voigt(), plane)
        delay, at, misfit = quick(problem)
        std = found.std * np.sqrt(max(misfit, 0.0) / max(len(problem.kept) - 5, 1))
        std = max(std, LEAST_NOISE * peak)
        counts = readings.counts
        if readings.threshold:
            predicted = problem.force(delay, at, problem.at(delay, at).coefficients)
            counts = counts & (predicted > BEYOND * std)
        found = replace(
            found, counts=counts, std=float(std), threshold=float(std) if readings.threshold else 0.0
        )
    return found


def frequency(contact: ContactFit, mass: float) -> float:
    """Of the stiffest contact [Hz]: that of the mass on the secant stiffness at the greatest depth."""
    delay, plane, inner = contact.posterior.best
    position, _ = contact.problem.motion.at(delay)
    depth = np.where(contact.readings.counts, position - plane, 0.0)
    force = np.where(contact.readings.counts, contact.problem.force(delay, plane, inner.coefficients), 0.0)
    deepest, lanes = np.argmax(depth, axis=0), np.arange(depth.shape[1])
    peak = force[deepest, lanes]
    # Of a touch that hardly pressed the quotient says nothing.
    secant = np.where(peak > 0.2 * peak.max(), peak / np.maximum(depth[deepest, lanes], 1e-9), 0.0)
    return float(np.sqrt(max(secant.max(), 1e-9) / mass) / (2.0 * np.pi))


def lag(contact: ContactFit, model: Model, frequency: float) -> float:
    """Return the delay of the force's phase behind the command at a frequency [Hz], in s."""
    angle = float(np.angle(model.response(np.array([2j * np.pi * frequency]))[0]))
    return contact.posterior.best[0] - angle / (2.0 * np.pi * frequency)


def without(fit: ContactFit, held: np.ndarray, seed: int = 0) -> ContactFit:
    """The same law fitted to the touches that are not `held`; its readings are still those of all."""
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
