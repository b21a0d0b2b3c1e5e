"""Comparison of logs with a mechanism file, without estimating any parameter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxhil.errors import InputError
from jaxhil.mechanism.file import to_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from tuning.identification import clock_drift, free_motion, mechanism_models, validation
from tuning.identification import contact_fit as contacts
from tuning.identification.contact_fit import ContactFit
from tuning.identification.contact_frequency import compute_force_lag, estimate_contact_frequency
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import Posterior
from tuning.identification.contact_regression import CoefficientFit
from tuning.identification.contact_runs import exclude_rows_after_gaps, split_long_run
from tuning.identification.cut_zone import estimate_bias_before_contact, estimate_subtracted_bias
from tuning.identification.dead_zone_check import (
    check_cut_dead_zone,
    check_zeros_at_rest,
    check_zone_sampling,
)
from tuning.identification.drifting_noise import estimate_force_noise
from tuning.identification.edge_check import check_contact_edges, check_force_smoothing
from tuning.identification.force_readings import ForceReadings
from tuning.identification.free_motion import FreeMotion
from tuning.identification.hidden_filter import check_hidden_filter
from tuning.identification.motion import MotionResponse
from tuning.identification.motion_in_contact import check_motion_in_contact
from tuning.identification.noise import NoiseEstimate
from tuning.identification.rational import MotionModel
from tuning.identification.records import Campaign, LoggedRun
from tuning.identification.result import (
    PRESS_EXPERIMENT,
    UNCERTAINTY_CHECK,
    Identification,
    suggest_experiment,
)
from tuning.identification.uncertainty_effect import UncertaintyEffect, compute_uncertainty_effect
from tuning.identification.unmodelled_effects import check_modelled_effects

MIN_DELAY_STD = 2e-5  # minimum standard deviation of a delay [s]


def check_against_mechanism(
    campaign: Campaign, mechanism: Mechanism, limit: float = 0.01, fitted: FreeMotion | None = None
) -> Identification:
    """Check whether a mechanism agrees with the logs of a rig, without estimating any parameter.

    The force noise comes from runs at rest or in free motion or, without such runs, from the mechanism.

    Args:
        campaign: The logs.
        mechanism: Mechanism that the logs are compared with.
        limit: Largest allowed effect of all defects on the restitution e, and on its error e - e*.
        fitted: Motion simulator that was fitted, with any order, to the free runs; or None. Without this fit,
            a wrong command hold or latency stays hidden if a wrong delay in the mechanism cancels it.

    Returns:
        An identification that contains checks and a verdict, but no estimates.

    Raises:
        InputError: If the logs have neither free motion nor contact, or the contact law cannot be compared
            with logs.
    """
    clock_drift.reject_separate_clocks(campaign.timing)
    model = mechanism_models.make_motion_model(mechanism)
    free = [run for run in campaign.runs if run.kind == "free"]
    mass, period = campaign.equivalent_mass, campaign.timing.control_period
    touches = [run for run in campaign.runs if run.kind in ("contact", "press", "tap")]
    touches = exclude_rows_after_gaps(touches, model, period) if touches else []
    touching = [segment for run in touches for segment in split_long_run(run, period)]
    motion = free_motion.compare_free_motion(free, campaign.timing, model)
    contact = None
    if touching:
        contact = _make_contact_fit(touching, model, campaign, mechanism)
    elif motion is None:
        raise InputError("logs: found neither free motion nor contact, expected runs of either kind")
    frequency = estimate_contact_frequency(contact, mass)
    lines = check_modelled_effects(mechanism)
    if motion is not None:
        structures = mechanism_models.list_structures(mechanism)
        fitted = fitted or free_motion.fit_free_motion(free, campaign.timing, None, structures)
        assert fitted is not None
        motion = replace(motion, other_hold_gain=max(motion.other_hold_gain, fitted.other_hold_gain))
        lines += [
            *validation.check_motion_model(motion, frequency),
            validation.check_delay_sign(fitted, frequency),
        ]
    if contact is not None:
        lag = compute_force_lag(contact, model, frequency)
        flags = np.ones(len(touching), bool)
        lines += validation.check_contact_model(contact, touching, mass, frequency, lag, flags)
        lines += check_motion_in_contact(contact, touching, frequency)
        lines += check_cut_dead_zone(contact, touching) or check_zeros_at_rest(
            contact, mechanism, campaign.runs
        )
        lines += check_zone_sampling(mechanism)
    effect = compute_uncertainty_effect(mechanism)
    if contact is not None and not _has_uncertain_dead_zone(mechanism):
        lines += check_contact_edges(contact, touching, effect)
    if contact is not None:
        lines += check_force_smoothing(
            _estimate_force_noise(campaign.runs, mechanism), effect, frequency, period
        )
        lines += check_hidden_filter(contact, mechanism, effect)
    lines += check_file_uncertainty(effect, any(run.kind == "press" for run in campaign.runs))
    return Identification(
        estimates=(),
        draws=np.zeros((0, 0)),
        combinations=(),
        confounded=(),
        lines=tuple(lines),
        mechanism=to_plain_data(mechanism),
        limit=limit,
        motion=motion,
        contact=contact,
    )


def _has_uncertain_dead_zone(mechanism: Mechanism) -> bool:
    """Return whether the standard deviation of a dead zone, or of the hidden bias, exceeds that of a reading.

    The readings at the onset and release of contact are then unpredictable.
    """
    stated = (mechanism.uncertainty.get(f"rig.force_sensor.{key}") for key in ("dead_zone", "bias"))
    std = max((entry.std or 0.0) if entry else 0.0 for entry in stated)
    return mechanism.rig.force_sensor.dead_zone > 0.0 and std > mechanism.rig.force_sensor.noise_std


def check_file_uncertainty(effect: UncertaintyEffect, pressed: bool) -> list[validation.CheckResult]:
    """Check how much the parameters' uncertainty in a mechanism file affects the restitution.

    Args:
        effect: Effect of the uncertainty on e and on e - e*.
        pressed: Whether the logs contain a press run.

    Returns:
        A list with one check, which recommends a further experiment; empty if no parameter was identified.
    """
    if not effect.parts:
        return []
    largest = sorted(effect.parts, key=lambda key: -effect.parts[key])[:2]
    finding = f"{' and '.join(largest)} above all"
    if len(largest) == 2:
        advice = suggest_experiment(*largest)
        if pressed and advice == PRESS_EXPERIMENT:
            advice = "a longer or stronger press run with a multisine to 45 Hz"
        finding += f"; {advice} would determine them better"
    return [
        validation.CheckResult(UNCERTAINTY_CHECK, finding, True, effect.restitution, on_error=effect.error)
    ]


def _make_contact_fit(
    runs: Sequence[LoggedRun], model: MotionModel, campaign: Campaign, mechanism: Mechanism
) -> ContactFit:
    """Return the mechanism's contact model as a `ContactFit`, which the checks require."""
    rig, contact, period = mechanism.rig, mechanism.contact, campaign.timing.control_period
    law = mechanism_models.make_regression_law(contact)
    delay = rig.force_sensor.delay - rig.position_sensor.delay
    plane = rig.contact_plane
    lag = rig.force_sensor.time_constant if rig.force_sensor.filter is None else None
    motion = MotionResponse(model, runs, campaign.timing, max(MAX_FORCE_DELAY, delay) + period)
    noise = _estimate_force_noise(campaign.runs, mechanism)
    has_dead_zone = rig.force_sensor.dead_zone > 0.0
    std = float(np.hypot(rig.force_sensor.noise_std, rig.force_sensor.quantum / np.sqrt(12.0)))
    whitening = (1.0,)
    if noise is not None and not noise.silent:
        std, whitening = float(np.hypot(noise.innovation, noise.quantum / np.sqrt(12.0))), noise.filter
    if has_dead_zone or not std:
        whitening = (1.0,)
    readings = ForceReadings.of(runs, std or 1.0, whitening, std if has_dead_zone else 0.0)
    step = 0.0 if noise is None else noise.bias_step
    readings = replace(readings, low_pass=rig.force_sensor.filter, bias_step=step)
    coefficients = [
        coefficient
        for entry in readings.entries
        for coefficient in mechanism_models.get_regression_coefficients(contact, entry)
    ]
    is_cut = rig.force_sensor.dead_zone_kind == "cut"
    readings = replace(readings, zone=rig.force_sensor.dead_zone if is_cut else 0.0)
    subtracts = has_dead_zone and not is_cut
    if is_cut and has_dead_zone:
        readings = replace(readings, bias=estimate_bias_before_contact(runs, rig.force_sensor.dead_zone))
    if subtracts:
        entry = mechanism.uncertainty.get("rig.force_sensor.dead_zone")
        zone_std = (entry.std or 0.0) if entry else 0.0
        bias = estimate_subtracted_bias(runs, rig.force_sensor.dead_zone, zone_std)
        readings = replace(readings, bias=bias)
    coefficients.append(rig.force_sensor.bias - (rig.force_sensor.dead_zone if subtracts else 0.0))
    values = np.array(coefficients)
    if not std:
        std = _estimate_row_noise(ContactProblem(motion, readings, law, plane, lag), delay, plane, values)
        readings = replace(readings, std=std)
    if has_dead_zone:
        predicted = ContactProblem(motion, readings, law, plane, lag).force(delay, plane, values)
        least = readings.zone + contacts.DEAD_ZONE_MARGIN * std
        readings = replace(readings, counts=readings.counts & (predicted > least))
    problem = ContactProblem(motion, readings, law, plane, lag)
    inner = CoefficientFit(values, np.zeros((len(values), len(values))), 0.0, 0.0, 0.0, 0.0)
    delays, planes = _draw_delay_and_surface(mechanism)
    # `motion` is available only up to the longest delay in the search range of fits.
    delays = np.clip(delays, problem.min_delay, max(MAX_FORCE_DELAY, delay))
    posterior = Posterior(
        ["delay", "plane", *problem.names],
        np.column_stack([delays, planes, np.tile(values, (validation.CONTACT_STATE_DRAWS, 1))]),
        np.array([delay]),
        np.zeros(1),
        (delay, plane, inner),
    )
    error = 0.0 if noise is None or noise.silent else noise.std_std / max(noise.std, 1e-300)
    return ContactFit(law, (), problem, posterior, len(problem.used_rows), error, has_dead_zone)


def _estimate_force_noise(runs: Sequence[LoggedRun], mechanism: Mechanism) -> NoiseEstimate | None:
    """Return the force sensor's noise from the first long run at rest or, without one, in free motion.

    Returns None if no run has 200 readings.
    """
    walk = mechanism.rig.force_sensor.bias_random_walk
    for kind in ("rest", "free"):
        for run in runs:
            if run.kind == kind and run.force_measured is not None:
                if len(run.valid_forces) >= 200:
                    return estimate_force_noise(run.valid_forces, mechanism.rig.control_period, walk)
    return None


def _estimate_row_noise(problem: ContactProblem, delay: float, plane: float, values: np.ndarray) -> float:
    """Estimate the noise of the force readings [N] from the differences of successive residuals."""
    residual = problem.readings.force - problem.force(delay, plane, values)
    steps = np.diff(residual, axis=0)[problem.readings.counts[1:] & problem.readings.counts[:-1]]
    peak = float(np.abs(problem.readings.force).max())
    return max(1.4826 * float(np.median(np.abs(steps))) / np.sqrt(2.0), contacts.MIN_NOISE_SHARE * peak, 1e-9)


def _draw_delay_and_surface(mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray]:
    """Draw the force delay and the surface position [m] from the mechanism's uncertainty.

    The force delay [s] is relative to the delay of the position sensor.
    """
    count, rig = validation.CONTACT_STATE_DRAWS, mechanism.rig
    drawn = draw(mechanism, count, 0)

    def of(key: str, nominal: float) -> np.ndarray:
        return drawn.get(key, np.full(count, nominal))

    delay = of("rig.force_sensor.delay", rig.force_sensor.delay)
    delay = delay - of("rig.position_sensor.delay", rig.position_sensor.delay)
    clock = MIN_DELAY_STD * np.random.default_rng(0).standard_normal(count)
    return delay + clock, of("rig.contact_plane", rig.contact_plane)
