"""Checks of the model against the logs; each defect is measured by its effect on a contact's restitution.

With thousands of readings some test rejects every model. Therefore each line states how large the effect on
the restitution e can be, and the test only decides whether the defect is present. The effects are of first
order and in closed form. A phase error phi of the motion at the contact frequency w is a delay of phi/w, and
a delay tau changes e by (pi/2) w tau. An unexplained force r changes the rebound by -(integral of r v dt)/(M
v_0 e), from the balance of momentum and energy over one contact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special, stats

from tuning.identification.clock_drift import estimate_residual_delays, fit_weighted_slope
from tuning.identification.contact_fit import ContactFit
from tuning.identification.contact_problem import MAX_FORCE_DELAY
from tuning.identification.free_motion import FreeMotion
from tuning.identification.law_choice import compute_contact_misfits
from tuning.identification.records import LoggedRun

MIN_HOLD_CRITERION_GAIN = 2.0  # gain of the information criterion that shows a wrong hold
DEFECT_P_VALUE = 1e-3  # p-value below which a defect is present
MAX_FREQUENCY_RATIO = 4.0  # multiple of the contact frequency, up to which the motion affects a contact
CONTACT_STATE_DRAWS = 40  # posterior draws that must agree on whether a row is in contact
MAX_DELAY_SHARE = 0.93  # share of the longest force delay in the search
MIN_CONTACTS_FOR_DEAD_ZONE = 5  # contacts that a check of small readings needs
MAX_NONZERO_SHARE = 0.8  # share of readings other than 0, above which there is no dead zone
CUTTING_DEAD_ZONE_P_VALUE = 0.01  # p-value below which a dead zone without offset is present
MIN_SMALL_READING_SIGMAS = 3.0  # standard deviations of the noise; smaller readings exclude such a dead zone
MISFIT_SMOOTHING_LINES = 5  # lines over which the motion's misfit is averaged


@dataclass(frozen=True)
class CheckResult:
    """Result of one check."""

    name: str
    finding: str  # result in words and numbers
    there: bool  # whether the defect exceeds chance
    effect: float  # effect on e if the defect is present
    where: str = ""  # worst frequency, or file and time
    on_error: float | None = None  # effect on e - e* if it differs from that on e
    counts: bool = True  # whether the verdict includes it

    @property
    def counted(self) -> float:
        """Return the effect on e in the sum of the verdict."""
        return self.effect if self.there and self.counts else 0.0

    @property
    def counted_error(self) -> float:
        """Return the effect on e - e* in the sum of the verdict."""
        effect = self.effect if self.on_error is None else self.on_error
        return effect if self.there and self.counts else 0.0


def check_motion_model(motion: FreeMotion, frequency: float) -> list[CheckResult]:
    """Check the model of the motion simulator at a contact frequency [Hz]."""
    lines = [
        _check_motion_misfit(motion, frequency),
        _check_position_gain(motion),
        _check_command_hold(motion, frequency),
    ]
    return [*lines, *_check_distortion(motion)]


def _check_motion_misfit(motion: FreeMotion, frequency: float) -> CheckResult:
    error, noise = motion.misfit()
    order = np.argsort(motion.lines.frequency)
    at, error, noise = motion.lines.frequency[order], error[order], noise[order]
    width = min(MISFIT_SMOOTHING_LINES, len(at))
    kernel = np.ones(width) / width
    smooth = np.abs(np.convolve(error, kernel, "valid"))
    chance = np.sqrt(np.convolve(noise**2, kernel, "valid") / width)
    beyond = np.sqrt(np.maximum(smooth**2 - chance**2, 0.0))
    middle = np.convolve(at, kernel, "valid")
    near = middle <= max(MAX_FREQUENCY_RATIO * frequency, middle[0])
    worst = int(np.argmax(beyond * near))
    freedom = max(motion.fit.freedom, 1)
    probability = stats.chi2.sf(motion.left * freedom, freedom)
    return CheckResult(
        "motion model",
        f"leaves {motion.left:.3g} times the noise's power, {beyond[worst]:.2g} of the motion near contacts",
        bool(probability < DEFECT_P_VALUE),
        float(np.pi / 2.0 * beyond[worst]),
        f"{middle[worst]:.3g} Hz",
    )


def _check_position_gain(motion: FreeMotion) -> CheckResult:
    gain, std = motion.gain
    return CheckResult(
        "scale of the measured position",
        f"{gain:.5f} +- {std:.2g} of the desired one",
        bool(abs(gain - 1.0) > max(4.0 * std, 0.005)),
        abs(gain - 1.0),
    )


def _check_command_hold(motion: FreeMotion, frequency: float) -> CheckResult:
    other_hold = "linear" if motion.lines.hold == "zoh" else "zoh"
    half = 0.5 * motion.lines.period
    return CheckResult(
        "command hold",
        f"the information criterion is {abs(motion.other_hold_gain):.3g} "
        f"{'less' if motion.other_hold_gain > 0 else 'more'} with {other_hold}",
        motion.other_hold_gain > MIN_HOLD_CRITERION_GAIN,
        float(np.pi**2 * frequency * half),
    )


def check_delay_sign(motion: FreeMotion, frequency: float) -> CheckResult:
    """Check that a fitted delay of the motion is not negative."""
    delay, std = motion.model.delay, float(np.sqrt(motion.covariance[-1, -1]))
    return CheckResult(
        "sign of the motion's delay",
        f"{1e3 * delay:.4f} +- {1e3 * std:.2g} ms: negative where latency, hold or row are told wrongly",
        delay < -4.0 * std - 1e-6,
        float(np.pi**2 * frequency * abs(delay)),
    )


def _check_distortion(motion: FreeMotion) -> list[CheckResult]:
    lines = []
    for parity, name in ((0, "odd"), (1, "even")):
        levels = [level for run in motion.spectra if (level := (run.odd, run.even)[parity]) is not None]
        if levels:
            excess = max(run.excess[parity] for run in motion.spectra)
            lines.append(
                CheckResult(
                    f"{name} nonlinearity of the motion",
                    f"{-20 * np.log10(max(levels)):.0f} dB below the motion, {excess:.2g} times the noise",
                    excess > 2.0,
                    float(np.pi / 2.0 * max(levels)),
                )
            )
    return lines


def check_contact_model(
    contact: ContactFit, runs: list[LoggedRun], mass: float, frequency: float, lag: float, held: np.ndarray
) -> list[CheckResult]:
    """Check the contact model on the contacts flagged in `held`."""
    lines = [
        _check_law_residual(contact, runs, held),
        *_check_delay_in_search_range(contact),
        *_check_cutting_dead_zone(contact, runs),
    ]
    if contact.drift is None:
        errors, stds = estimate_restitution_errors(contact, runs, mass)
        usable = held & np.isfinite(errors)
        if usable.any():
            lines.append(_check_restitution(contact, runs, errors, stds, usable))
    return [*lines, *_check_trends(contact, len(runs), frequency, lag)]


def check_held_out_contacts(
    contact: ContactFit, runs: list[LoggedRun], mass: float, held: np.ndarray
) -> list[CheckResult]:
    """Check the fit on the contacts flagged in `held`, which it did not use.

    The verdict excludes these lines, because the written file uses all contacts.
    """
    left = _check_law_residual(contact, runs, held)
    lines = [replace(left, name="contact law, touches not fitted", counts=False)]
    errors, stds = estimate_restitution_errors(contact, runs, mass)
    usable = held & np.isfinite(errors)
    if contact.drift is None and usable.any():
        line = _check_restitution(contact, runs, errors, stds, usable)
        lines.append(replace(line, name="restitution of touches not fitted", counts=False))
    return lines


def _check_law_residual(contact: ContactFit, runs: list[LoggedRun], chosen: np.ndarray) -> CheckResult:
    delay, plane, inner = contact.posterior.best
    readings = contact.readings
    readings = replace(readings, counts=readings.counts & flag_certain_rows(contact))
    misfit = compute_contact_misfits(contact.problem, readings, delay, plane, inner.coefficients)[chosen]
    count = np.maximum(readings.counts.sum(axis=0)[chosen], 1)
    ratio = float(misfit.sum() / count.sum())
    # The effect on e is at most the rms error of the force over its rms.
    force = np.where(readings.counts, readings.force, 0.0)[:, chosen]
    beyond = max(ratio - 1.0, 0.0) * readings.std**2 * count.sum() / max(float(np.sum(force**2)), 1e-300)
    return CheckResult(
        "contact law",
        f"leaves {ratio:.3g} times the noise's power",
        bool(
            special.ndtr(-(ratio - 1.0) / np.hypot(np.sqrt(2.0 / count.sum()), 2.0 * contact.noise_error))
            < DEFECT_P_VALUE
        ),
        float(np.sqrt(beyond)),
        _locate_worst(contact, runs, chosen, misfit / count),
    )


def flag_certain_rows(contact: ContactFit) -> np.ndarray:
    """Return the rows whose contact state is the same for all delays and surfaces within their uncertainty.

    The force of damped contact jumps at the onset; a row on its other side carries no information on the law.
    """
    count = len(contact.problem.names)
    flags = [
        contact.problem.touching(draw[0], draw[1], draw[2 : 2 + count])
        for draw in contact.posterior.draws[:CONTACT_STATE_DRAWS]
    ]
    return np.all(flags, axis=0) | ~np.any(flags, axis=0)


def check_stiffness_sign(contact: ContactFit) -> CheckResult:
    """Check that no stiffness is negative."""
    names = contact.posterior.names
    values = [
        contact.posterior.mean[i] for i, name in enumerate(names) if name.startswith(("stiffness", "slope"))
    ]
    return CheckResult(
        "sign of the force",
        f"least stiffness {min(values):.4g}: negative where the force's sign is told wrongly",
        min(values) <= 0.0,
        1.0,
    )


def _check_delay_in_search_range(contact: ContactFit) -> list[CheckResult]:
    """Return a failed check if the delay is at the upper end of the search."""
    delay = contact.posterior.mean[0]
    if delay < MAX_DELAY_SHARE * MAX_FORCE_DELAY:
        return []
    finding = f"{1e3 * delay:.4g} ms, the longest that was looked for"
    return [CheckResult("force delay", finding, True, 1.0)]


def _check_cutting_dead_zone(contact: ContactFit, runs: list[LoggedRun]) -> list[CheckResult]:
    """Check that the readings of contacts that are 0 out of contact begin and end near 0.

    If no reading is small, a dead zone suppresses small forces and passes the others unchanged. The dead zone
    of mechanism files differs: it is subtracted from every force.
    """
    smallest, steps, peaks = [], [], []
    for lane, run in enumerate(runs):
        force = np.abs(contact.readings.force[: len(run.tick), lane])
        (felt,) = np.nonzero(force)
        if run.kind == "contact" and len(felt) > 1 and len(felt) < MAX_NONZERO_SHARE * len(force):
            smallest.append(force[felt].min())
            steps.append(abs(force[felt[-1]] - force[felt[-2]]))
            peaks.append(force.max())
    if len(smallest) < MIN_CONTACTS_FOR_DEAD_ZONE:
        return []
    least, std = min(smallest), contact.readings.std
    quantum = np.diff(np.unique(contact.readings.force)).min(initial=np.inf)
    # The last reading of a smooth release is uniform between 0 and the last step.
    probability = np.prod(np.maximum(1.0 - least / (np.array(steps) + 2.0 * std + 1e-300), 0.0))
    if least <= max(MIN_SMALL_READING_SIGMAS * std, 2.5 * quantum) or probability > CUTTING_DEAD_ZONE_P_VALUE:
        return []
    finding = f"no reading lies between 0 and {least:.2g} N, as behind a dead zone that cuts"
    return [CheckResult("dead zone of the force sensor", finding, True, float(least / np.median(peaks)))]


def estimate_restitution_errors(
    contact: ContactFit, runs: list[LoggedRun], mass: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the change of e by the unexplained force in each contact, and its standard deviation by noise.

    Both are NaN if the numerical model was not a free body, did not rebound, or the log is incomplete.
    """
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
        # Only the low frequencies of coloured noise add up.
        slow = readings.std / abs(float(np.sum(readings.whitening)))
        stds[lane] = slow * period * float(np.sqrt(np.sum((speed * touching) ** 2))) / scale / before
    return errors, stds


def _check_restitution(
    contact: ContactFit, runs: list[LoggedRun], errors: np.ndarray, stds: np.ndarray, usable: np.ndarray
) -> CheckResult:
    z, errors = errors[usable] / stds[usable], errors[usable]
    mean = float(errors.mean())
    return CheckResult(
        "restitution of touches",
        f"off by {mean:+.2g} on the mean, rms z {np.sqrt(np.mean(z**2)):.2f}",
        bool(stats.chi2.sf(float(np.sum(z**2)), len(z)) < DEFECT_P_VALUE),
        float(np.sqrt(np.mean(errors**2))),
        _locate_worst(contact, runs, usable, np.abs(z)),
    )


def _locate_worst(contact: ContactFit, runs: list[LoggedRun], chosen: np.ndarray, values: np.ndarray) -> str:
    """Return file and time of the run with the largest of the values, which are those of the chosen runs."""
    run = runs[int(np.flatnonzero(chosen)[np.argmax(values)])]
    first = run.tick[int(np.argmax(run.valid))]
    return f"{run.source} from {run.begin + first * contact.problem.motion.period:.1f} s on"


def _check_trends(contact: ContactFit, touches: int, frequency: float, lag: float) -> list[CheckResult]:
    """Check that neither the scale of the force nor its delay changes from contact to contact."""
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
    grown, grown_std = fit_weighted_slope(share, power[used] / std**2, number)
    delay_changes, variance = estimate_residual_delays(problem, delay, plane, inner.coefficients)
    later, later_std = fit_weighted_slope(delay_changes[used], 1.0 / variance[used], number)
    angle = 2.0 * np.pi * frequency
    first = "from the first touch to the last"
    return [
        CheckResult(
            "drift from touch to touch",
            f"force {100 * grown:+.2g} +- {100 * grown_std:.2g} % {first}",
            _is_significant(grown, grown_std),
            float(np.pi / 4.0 * angle * lag * abs(grown)),
        ),
        CheckResult(
            "drift of the force delay",
            f"{1e3 * later:+.2g} +- {1e3 * later_std:.2g} ms {first}",
            _is_significant(later, later_std),
            float(np.pi / 4.0 * angle * abs(later)),
        ),
    ]


def _is_significant(value: float, std: float) -> bool:
    return bool(2.0 * special.ndtr(-abs(value) / std) < DEFECT_P_VALUE)
