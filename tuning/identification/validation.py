"""Whether the model explains the rig, each defect by what it can do to a contact's restitution.

With thousands of readings every model is rejected by some test. So a line states how large the effect on the
restitution e can be, and the test says only whether the defect is there at all. The effects are first order
and in closed form: a phase error phi of the motion at the contact's frequency w is a delay of phi/w, and a
delay tau changes e by (pi/2) w tau; a force r that the law does not explain changes the rebound by
-(integral of r v dt)/(M v_0 e), the balance of momentum and energy over one touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special, stats

from tuning.identification.contact import ContactFit
from tuning.identification.contact_problem import LONGEST
from tuning.identification.free_motion import FreeMotion
from tuning.identification.law_choice import misfits
from tuning.identification.records import Run
from tuning.identification.two_clocks import differences, slope

OTHER_HOLD = 2.0  # gain of the information criterion from which the other hold explains more
RARE = 1e-3  # probability under which a defect is taken to be there
HARMONICS = 4.0  # of the contact's frequency: up to there the motion decides what a contact does
CERTAIN_DRAWS = 40  # of the posterior, under all of which a row is in contact or under none
AT_THE_END = 0.93  # of the longest force delay that is looked for
FEW_TOUCHES = 5  # of which one would show a small reading
MOSTLY = 0.8  # share of a run's readings that are not 0, beyond which no dead zone hides the others
CUT = 0.01  # probability of such readings below which a dead zone is taken to cut
SEEN = 3.0  # standard deviations of the noise; readings as small occur where no dead zone cuts
NEIGHBOURS = 5  # lines over which the motion's misfit is averaged


@dataclass(frozen=True)
class Line:
    """One check."""

    name: str
    finding: str  # what was found, in words and numbers
    there: bool  # whether the defect is more than chance
    effect: float  # on e, if it is there
    where: str = ""  # frequency, file and time, or entry where it is worst
    on_error: float | None = None  # effect on e - e*, where it is not that on e
    counts: bool = True  # whether the verdict adds it up

    @property
    def counted(self) -> float:
        """Effect on e that the verdict adds up."""
        return self.effect if self.there and self.counts else 0.0

    @property
    def counted_error(self) -> float:
        """Effect on e - e* that the verdict adds up."""
        effect = self.effect if self.on_error is None else self.on_error
        return effect if self.there and self.counts else 0.0


def of_motion(motion: FreeMotion, frequency: float) -> list[Line]:
    """Checks of the motion simulator's model; `frequency` of contacts [Hz]."""
    lines = [_misfit(motion, frequency), _gain(motion), _hold(motion, frequency)]
    return [*lines, *_distortion(motion)]


def _misfit(motion: FreeMotion, frequency: float) -> Line:
    error, noise = motion.misfit()
    order = np.argsort(motion.lines.frequency)
    at, error, noise = motion.lines.frequency[order], error[order], noise[order]
    width = min(NEIGHBOURS, len(at))
    kernel = np.ones(width) / width
    smooth = np.abs(np.convolve(error, kernel, "valid"))
    chance = np.sqrt(np.convolve(noise**2, kernel, "valid") / width)
    beyond = np.sqrt(np.maximum(smooth**2 - chance**2, 0.0))
    middle = np.convolve(at, kernel, "valid")
    near = middle <= max(HARMONICS * frequency, middle[0])
    worst = int(np.argmax(beyond * near))
    freedom = max(motion.fit.freedom, 1)
    probability = stats.chi2.sf(motion.left * freedom, freedom)
    return Line(
        "motion model",
        f"leaves {motion.left:.3g} times the noise's power, {beyond[worst]:.2g} of the motion near contacts",
        bool(probability < RARE),
        float(np.pi / 2.0 * beyond[worst]),
        f"{middle[worst]:.3g} Hz",
    )


def _gain(motion: FreeMotion) -> Line:
    gain, std = motion.gain
    return Line(
        "scale of the measured position",
        f"{gain:.5f} +- {std:.2g} of the desired one",
        bool(abs(gain - 1.0) > max(4.0 * std, 0.005)),
        abs(gain - 1.0),
    )


def _hold(motion: FreeMotion, frequency: float) -> Line:
    other = "linear" if motion.lines.hold == "zoh" else "zoh"
    half = 0.5 * motion.lines.period
    return Line(
        "command hold",
        f"the information criterion is {abs(motion.other_hold):.3g} "
        f"{'less' if motion.other_hold > 0 else 'more'} with {other}",
        motion.other_hold > OTHER_HOLD,
        float(np.pi**2 * frequency * half),
    )


def sign_of_delay(motion: FreeMotion, frequency: float) -> Line:
    """Check that a fitted delay of the motion is not negative."""
    delay, std = motion.model.delay, float(np.sqrt(motion.covariance[-1, -1]))
    return Line(
        "sign of the motion's delay",
        f"{1e3 * delay:.4f} +- {1e3 * std:.2g} ms: negative where latency, hold or row are told wrongly",
        delay < -4.0 * std - 1e-6,
        float(np.pi**2 * frequency * abs(delay)),
    )


def _distortion(motion: FreeMotion) -> list[Line]:
    lines = []
    for parity, name in ((0, "odd"), (1, "even")):
        levels = [level for one in motion.spectra if (level := (one.odd, one.even)[parity]) is not None]
        if levels:
            excess = max(one.excess[parity] for one in motion.spectra)
            lines.append(
                Line(
                    f"{name} nonlinearity of the motion",
                    f"{-20 * np.log10(max(levels)):.0f} dB below the motion, {excess:.2g} times the noise",
                    excess > 2.0,
                    float(np.pi / 2.0 * max(levels)),
                )
            )
    return lines


def of_contact(
    contact: ContactFit, runs: list[Run], mass: float, frequency: float, lag: float, held: np.ndarray
) -> list[Line]:
    """Checks of the contact's model on the touches `held`, a flag each."""
    lines = [_left(contact, runs, held), *_at_the_end(contact), *_dead_zone(contact, runs)]
    if contact.drift is None:
        errors, stds = restitution_errors(contact, runs, mass)
        usable = held & np.isfinite(errors)
        if usable.any():
            lines.append(_restitution(contact, runs, errors, stds, usable))
    return [*lines, *_trends(contact, len(runs), frequency, lag)]


def of_touches_left_out(contact: ContactFit, runs: list[Run], mass: float, held: np.ndarray) -> list[Line]:
    """Check on the touches `held` what a fit to the others leaves of them; the verdict does not count it.

    The verdict is that of the file written, whose numbers are those of all touches."""
    left = _left(contact, runs, held)
    lines = [replace(left, name="contact law, touches not fitted", counts=False)]
    errors, stds = restitution_errors(contact, runs, mass)
    usable = held & np.isfinite(errors)
    if contact.drift is None and usable.any():
        line = _restitution(contact, runs, errors, stds, usable)
        lines.append(replace(line, name="restitution of touches not fitted", counts=False))
    return lines


def _left(contact: ContactFit, runs: list[Run], held: np.ndarray) -> Line:
    delay, plane, inner = contact.posterior.best
    readings = contact.readings
    readings = replace(readings, counts=readings.counts & certain_rows(contact))
    every = misfits(contact.problem, readings, delay, plane, inner.coefficients)[held]
    count = np.maximum(readings.counts.sum(axis=0)[held], 1)
    ratio = float(every.sum() / count.sum())
    # The force's rms error over the touch, as a share of its rms, is at most what it can do to e.
    force = np.where(readings.counts, readings.force, 0.0)[:, held]
    beyond = max(ratio - 1.0, 0.0) * readings.std**2 * count.sum() / max(float(np.sum(force**2)), 1e-300)
    return Line(
        "contact law",
        f"leaves {ratio:.3g} times the noise's power",
        bool(
            special.ndtr(-(ratio - 1.0) / np.hypot(np.sqrt(2.0 / count.sum()), 2.0 * contact.noise_error))
            < RARE
        ),
        float(np.sqrt(beyond)),
        _place(contact, runs, held, every / count),
    )


def certain_rows(contact: ContactFit) -> np.ndarray:
    """Rows that are in contact, or out of it, whatever the delay and the plane are within their uncertainty:
    damped contact begins with a jump, and a row on its other side says nothing of the law."""
    count = len(contact.problem.names)
    flags = [
        contact.problem.touching(draw[0], draw[1], draw[2 : 2 + count])
        for draw in contact.posterior.draws[:CERTAIN_DRAWS]
    ]
    return np.all(flags, axis=0) | ~np.any(flags, axis=0)


def sign_of_force(contact: ContactFit) -> Line:
    """Check that no stiffness is negative."""
    names = contact.posterior.names
    values = [
        contact.posterior.mean[i] for i, name in enumerate(names) if name.startswith(("stiffness", "slope"))
    ]
    return Line(
        "sign of the force",
        f"least stiffness {min(values):.4g}: negative where the force's sign is told wrongly",
        min(values) <= 0.0,
        1.0,
    )


def _at_the_end(contact: ContactFit) -> list[Line]:
    """A delay at the end of those that were looked at is none."""
    delay = contact.posterior.mean[0]
    if delay < AT_THE_END * LONGEST:
        return []
    found = f"{1e3 * delay:.4g} ms, the longest that was looked for"
    return [Line("force delay", found, True, 1.0)]


def _dead_zone(contact: ContactFit, runs: list[Run]) -> list[Line]:
    """Check that readings of touches that are 0 out of contact begin and end near 0.

    Where none is small, a dead zone cuts small forces and leaves the others as they are; that of mechanism
    files takes its size from every force."""
    smallest, steps, peaks = [], [], []
    for lane, run in enumerate(runs):
        force = np.abs(contact.readings.force[: len(run.tick), lane])
        (felt,) = np.nonzero(force)
        if run.kind == "contact" and len(felt) > 1 and len(felt) < MOSTLY * len(force):
            smallest.append(force[felt].min())
            steps.append(abs(force[felt[-1]] - force[felt[-2]]))
            peaks.append(force.max())
    if len(smallest) < FEW_TOUCHES:
        return []
    least, std = min(smallest), contact.readings.std
    quantum = np.diff(np.unique(contact.readings.force)).min(initial=np.inf)
    # The last reading of a touch that ends smoothly lies anywhere between 0 and the last step.
    likely = np.prod(np.maximum(1.0 - least / (np.array(steps) + 2.0 * std + 1e-300), 0.0))
    if least <= max(SEEN * std, 2.5 * quantum) or likely > CUT:
        return []
    found = f"no reading lies between 0 and {least:.2g} N, as behind a dead zone that cuts"
    return [Line("dead zone of the force sensor", found, True, float(least / np.median(peaks)))]


def restitution_errors(contact: ContactFit, runs: list[Run], mass: float) -> tuple[np.ndarray, np.ndarray]:
    """By how much the force that the law does not explain changes e of each touch, and the noise's part.

    NaN where the numerical model was not a free body, or did not rebound, or the log has not all of it."""
    delay, plane, inner = contact.posterior.best
    predicted = contact.problem.force(delay, plane, inner.coefficients)
    readings, period = contact.readings, contact.problem.motion.period
    errors, stds = np.full(len(runs), np.nan), np.full(len(runs), np.nan)
    for lane, run in enumerate(runs):
        if run.kind != "contact":
            continue
        rows = len(run.tick)
        speed = (
            np.gradient(run.position_desired, period)
            if run.velocity_desired is None
            else run.velocity_desired
        )
        counts = readings.counts[:rows, lane]
        before, after = float(speed[0]), float(speed[-1])
        if before <= 0.0 or after >= 0.0 or not run.valid[0] or run.position_desired[-1] > plane:
            continue
        touching = counts & (run.position_desired > plane - abs(before) * 0.02)
        left = (readings.force[:rows, lane] - predicted[:rows, lane]) * touching
        scale = mass * before * abs(after / before)
        errors[lane] = -float(np.sum(left * speed)) * period / scale / before
        # Coloured noise adds up by what it holds at low frequencies.
        slow = readings.std / abs(float(np.sum(readings.whitening)))
        stds[lane] = slow * period * float(np.sqrt(np.sum((speed * touching) ** 2))) / scale / before
    return errors, stds


def _restitution(
    contact: ContactFit, runs: list[Run], errors: np.ndarray, stds: np.ndarray, usable: np.ndarray
) -> Line:
    z, errors = errors[usable] / stds[usable], errors[usable]
    mean = float(errors.mean())
    return Line(
        "restitution of touches",
        f"off by {mean:+.2g} on the mean, rms z {np.sqrt(np.mean(z**2)):.2f}",
        bool(stats.chi2.sf(float(np.sum(z**2)), len(z)) < RARE),
        float(np.sqrt(np.mean(errors**2))),
        _place(contact, runs, usable, np.abs(z)),
    )


def _place(contact: ContactFit, runs: list[Run], chosen: np.ndarray, values: np.ndarray) -> str:
    """Return file and time of the run with the largest of values, one for each chosen run."""
    run = runs[int(np.flatnonzero(chosen)[np.argmax(values)])]
    first = run.tick[int(np.argmax(run.valid))]
    return f"{run.source} from {run.begin + first * contact.problem.motion.period:.1f} s on"


def _trends(contact: ContactFit, touches: int, frequency: float, lag: float) -> list[Line]:
    """Whether the force over the law's, or its delay, grows or falls from touch to touch."""
    delay, plane, inner = contact.posterior.best
    problem, std = contact.problem, contact.readings.std
    predicted = np.where(contact.readings.counts, problem.force(delay, plane, inner.coefficients), 0.0)
    force = np.where(contact.readings.counts, contact.readings.force, 0.0)
    predicted, force = (problem.whiten(value) for value in (predicted, force))
    power = np.sum(predicted**2, axis=0)
    used = power > 100.0 * std**2
    if used.sum() < 4:
        return []
    number = np.flatnonzero(used) / max(touches - 1, 1)
    share = np.sum(predicted * force, axis=0)[used] / power[used]
    grown, grown_std = slope(share, power[used] / std**2, number)
    off, variance = differences(problem, delay, plane, inner.coefficients)
    later, later_std = slope(off[used], 1.0 / variance[used], number)
    angle = 2.0 * np.pi * frequency
    first = "from the first touch to the last"
    return [
        Line(
            "drift from touch to touch",
            f"force {100 * grown:+.2g} +- {100 * grown_std:.2g} % {first}",
            _is_there(grown, grown_std),
            float(np.pi / 4.0 * angle * lag * abs(grown)),
        ),
        Line(
            "drift of the force delay",
            f"{1e3 * later:+.2g} +- {1e3 * later_std:.2g} ms {first}",
            _is_there(later, later_std),
            float(np.pi / 4.0 * angle * abs(later)),
        ),
    ]


def _is_there(value: float, std: float) -> bool:
    return bool(2.0 * special.ndtr(-abs(value) / std) < RARE)
