"""Checks of the model against the logs; every defect is expressed as its effect on the restitution.

With thousands of readings, a significance test rejects every model. Therefore, each check estimates how much
the defect changes the restitution e. The significance test only decides whether the defect is present. The
effects are first-order formulas. A phase error phi of the motion at the contact frequency w is a delay of
phi/w, and a delay tau changes e by (pi/2) w tau. An unexplained force r changes the rebound speed by
-(integral of r v dt)/(M v_0 e), according to the balance of momentum and energy during the contact.
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

MIN_HOLD_CRITERION_GAIN = 2.0  # minimum decrease of the information criterion that shows a wrong command hold
DEFECT_P_VALUE = 1e-3  # maximum p-value of a significant defect
MAX_FREQUENCY_RATIO = 4.0  # highest evaluated frequency, divided by the contact frequency
CONTACT_STATE_DRAWS = 40  # number of posterior draws that must agree whether a row is in contact
MAX_DELAY_SHARE = 0.93  # maximum force delay that passes the check, as a share of the longest delay searched
MISFIT_SMOOTHING_LINES = 5  # number of adjacent frequency lines whose misfit is averaged


@dataclass(frozen=True)
class CheckResult:
    """Result of checking the model or the logs for one kind of defect.

    Attributes:
        name: Name of the check.
        finding: Result in words and numbers.
        is_significant: Whether the defect is statistically significant.
        effect: Effect of the defect on the restitution e.
        where: Place of the largest error: the frequency, or the log file and the time of the contact.
        on_error: Effect of the defect on the error e - e* (e*: ideal contact), or None if it equals `effect`.
        is_in_verdict: Whether the verdict includes this check.
        gain: Decrease of chi-squared with another model than the file's; 0 if the check fits no other model.
    """

    name: str
    finding: str
    is_significant: bool
    effect: float
    where: str = ""
    on_error: float | None = None
    is_in_verdict: bool = True
    gain: float = 0.0

    @property
    def effect_in_verdict(self) -> float:
        """Return the effect on e for the verdict: 0 if the defect is absent or not in the verdict."""
        return self.effect if self.is_significant and self.is_in_verdict else 0.0

    @property
    def error_in_verdict(self) -> float:
        """Return the effect of this defect on e - e* that counts for the verdict.

        The effect is 0 if the defect is not significant, or if the verdict ignores this defect.
        """
        effect = self.effect if self.on_error is None else self.on_error
        return effect if self.is_significant and self.is_in_verdict else 0.0


def check_motion_model(motion: FreeMotion, frequency: float) -> list[CheckResult]:
    """Check the model of the motion simulator for defects that affect contacts with this frequency [Hz]."""
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
    excess = np.sqrt(np.maximum(smooth**2 - chance**2, 0.0))
    middle = np.convolve(at, kernel, "valid")
    near = middle <= max(MAX_FREQUENCY_RATIO * frequency, middle[0])
    worst = int(np.argmax(excess * near))
    degrees_of_freedom = max(motion.fit.degrees_of_freedom, 1)
    probability = stats.chi2.sf(motion.reduced_chi_square * degrees_of_freedom, degrees_of_freedom)
    return CheckResult(
        "motion model",
        f"leaves {motion.reduced_chi_square:.3g} times the noise's power, "
        f"{excess[worst]:.2g} of the motion near contacts",
        bool(probability < DEFECT_P_VALUE),
        float(np.pi / 2.0 * excess[worst]),
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
        gain=max(motion.other_hold_gain, 0.0),
    )


def check_delay_sign(motion: FreeMotion, frequency: float) -> CheckResult:
    """Check that the fitted delay of the motion is not negative."""
    delay, std = motion.model.delay, float(np.sqrt(motion.covariance[-1, -1]))
    return CheckResult(
        "sign of the motion's delay",
        f"{1e3 * delay:.4f} +- {1e3 * std:.2g} ms: negative if the specified latency, hold or row is wrong",
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
    contact: ContactFit, runs: list[LoggedRun], mass: float, frequency: float, lag: float, flags: np.ndarray
) -> list[CheckResult]:
    """Check a contact model against the contacts that `flags` selects, and for drift over all contacts.

    Args:
        contact: Contact model.
        runs: Runs in contact.
        mass: Equivalent mass of the numerical model [kg].
        frequency: Contact frequency [Hz].
        lag: Phase delay from the command to the force reading [s].
        flags: Whether to compare each run.
    """
    lines = [
        _check_law_residual(contact, runs, flags),
        *_check_delay_in_search_range(contact),
    ]
    if contact.drift is None:
        errors, stds = estimate_restitution_errors(contact, runs, mass)
        usable = flags & np.isfinite(errors)
        if usable.any():
            lines.append(_check_restitution(contact, runs, errors, stds, usable))
    return [*lines, *_check_trends(contact, len(runs), frequency, lag)]


def check_held_out_contacts(
    contact: ContactFit, runs: list[LoggedRun], mass: float, held_out: np.ndarray
) -> list[CheckResult]:
    """Compare a fit with the contacts that the fit did not use; `held_out` flags these contacts.

    The verdict ignores these checks, because the mechanism file comes from a second fit that uses all
    contacts.
    """
    residual_check = _check_law_residual(contact, runs, held_out)
    lines = [replace(residual_check, name="contact law, touches not fitted", is_in_verdict=False)]
    errors, stds = estimate_restitution_errors(contact, runs, mass)
    usable = held_out & np.isfinite(errors)
    if contact.drift is None and usable.any():
        line = _check_restitution(contact, runs, errors, stds, usable)
        lines.append(replace(line, name="restitution of touches not fitted", is_in_verdict=False))
    return lines


def _check_law_residual(contact: ContactFit, runs: list[LoggedRun], chosen: np.ndarray) -> CheckResult:
    delay, plane, coefficient_fit = contact.posterior.best
    readings = contact.readings
    readings = replace(readings, counts=readings.counts & flag_certain_rows(contact))
    misfit = compute_contact_misfits(contact.problem, readings, delay, plane, coefficient_fit.coefficients)[
        chosen
    ]
    count = np.maximum(readings.counts.sum(axis=0)[chosen], 1)
    ratio = float(misfit.sum() / count.sum())
    # The effect on e is at most the ratio of the force's rms error to the rms force.
    force = np.where(readings.counts, readings.force, 0.0)[:, chosen]
    excess = max(ratio - 1.0, 0.0) * readings.std**2 * count.sum() / max(float(np.sum(force**2)), 1e-300)
    return CheckResult(
        "contact law",
        f"leaves {ratio:.3g} times the noise's power",
        bool(
            special.ndtr(-(ratio - 1.0) / np.hypot(np.sqrt(2.0 / count.sum()), 2.0 * contact.noise_error))
            < DEFECT_P_VALUE
        ),
        float(np.sqrt(excess)),
        _locate_worst(contact, runs, chosen, misfit / count),
    )


def flag_certain_rows(contact: ContactFit) -> np.ndarray:
    """Return which rows are certainly in contact or certainly out of contact, shape (rows, contacts).

    A row is certain if it is in contact for all posterior draws of delay and surface position, or for none.
    In uncertain rows, residuals do not show an error of the law, because the force jumps at the onset.
    """
    count = len(contact.problem.names)
    # Delays that include a lag may exceed the longest delay of the search.
    flags = [
        contact.problem.touching(min(draw[0], MAX_FORCE_DELAY), draw[1], draw[2 : 2 + count])
        for draw in contact.posterior.draws[:CONTACT_STATE_DRAWS]
    ]
    return np.all(flags, axis=0) | ~np.any(flags, axis=0)


def check_stiffness_sign(contact: ContactFit) -> CheckResult:
    """Check that no fitted stiffness is negative."""
    names = contact.posterior.names
    values = [
        contact.posterior.mean[i] for i, name in enumerate(names) if name.startswith(("stiffness", "slope"))
    ]
    return CheckResult(
        "sign of the force",
        f"smallest stiffness {min(values):.4g}: negative if the specified sign of the force is wrong",
        min(values) <= 0.0,
        1.0,
    )


def _check_delay_in_search_range(contact: ContactFit) -> list[CheckResult]:
    """Return a failed check if the fitted force delay is at the upper end of the search range."""
    delay = contact.posterior.mean[0]
    if delay < MAX_DELAY_SHARE * MAX_FORCE_DELAY:
        return []
    end = f"{1e3 * MAX_FORCE_DELAY:g} ms"
    finding = (
        f"{1e3 * delay:.4g} ms: at the upper end of the search range, {end}: is a column of the log late?"
    )
    return [CheckResult("force delay", finding, True, 1.0)]


def estimate_restitution_errors(
    contact: ContactFit, runs: list[LoggedRun], mass: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return how much the force residuals change e in each contact, and the change's standard deviation.

    The standard deviation comes from the noise of the force. Both values are NaN if the numerical model is
    not a free body or does not rebound, or if the log of the contact is incomplete.
    """
    delay, plane, coefficient_fit = contact.posterior.best
    predicted = contact.problem.force(delay, plane, coefficient_fit.coefficients)
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
        if not touching.any():
            # All readings lie within a dead zone.
            continue
        residual = (readings.force[:rows, lane] - predicted[:rows, lane]) * touching
        scale = mass * before * abs(after / before)
        errors[lane] = -float(np.sum(residual * speed)) * period / scale / before
        weights = speed * touching
        if readings.bias_step:
            # A step of the bias changes all later readings.
            later = readings.bias_step * np.cumsum(weights[::-1])
            std = float(np.sqrt(np.sum((readings.std * weights) ** 2) + np.sum(later**2)))
        else:
            # Only the low-frequency part of coloured noise affects the impulse.
            slow = readings.std / abs(float(np.sum(readings.whitening)))
            std = slow * float(np.sqrt(np.sum(weights**2)))
        stds[lane] = std * period / scale / before
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
    """Return the log file and the time of the run with the largest of `values` among the chosen runs."""
    run = runs[int(np.flatnonzero(chosen)[np.argmax(values)])]
    first = run.tick[int(np.argmax(run.valid))]
    return f"{run.source} from {run.begin + first * contact.problem.motion.period:.1f} s on"


def _check_trends(contact: ContactFit, touches: int, frequency: float, lag: float) -> list[CheckResult]:
    """Check that the scale and the delay of the force do not drift from the first to the last contact."""
    delay, plane, coefficient_fit = contact.posterior.best
    problem, std = contact.problem, contact.readings.std
    readings = problem.force(delay, plane, coefficient_fit.coefficients), contact.readings.force
    # A reading that the fit does not use must not affect others.
    predicted, force = (np.where(contact.readings.counts, problem.whiten(values), 0.0) for values in readings)
    power = np.sum(predicted**2, axis=0)
    used = power > 100.0 * std**2
    if used.sum() < 4:
        return []
    number = np.flatnonzero(used) / max(touches - 1, 1)
    share = np.sum(predicted * force, axis=0)[used] / power[used]
    scale_drift, scale_drift_std = fit_weighted_slope(share, power[used] / std**2, number)
    delay_changes, variance = estimate_residual_delays(problem, delay, plane, coefficient_fit.coefficients)
    delay_drift, delay_drift_std = fit_weighted_slope(delay_changes[used], 1.0 / variance[used], number)
    angle = 2.0 * np.pi * frequency
    first = "from the first touch to the last"
    return [
        CheckResult(
            "drift from touch to touch",
            f"force {100 * scale_drift:+.2g} +- {100 * scale_drift_std:.2g} % {first}",
            _is_significant(scale_drift, scale_drift_std),
            float(np.pi / 4.0 * angle * lag * abs(scale_drift)),
        ),
        CheckResult(
            "drift of the force delay",
            f"{1e3 * delay_drift:+.2g} +- {1e3 * delay_drift_std:.2g} ms {first}",
            _is_significant(delay_drift, delay_drift_std),
            float(np.pi / 4.0 * angle * abs(delay_drift)),
        ),
    ]


def _is_significant(value: float, std: float) -> bool:
    return bool(2.0 * special.ndtr(-abs(value) / std) < DEFECT_P_VALUE)
