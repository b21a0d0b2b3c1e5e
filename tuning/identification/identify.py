"""Identification of a rig and its mechanism in four stages: rest, free motion, contact, validation.

Each stage uses the results of the previous stages. If the campaign has no runs for a stage, the prior's
values are used. The user must specify what the logs cannot determine: the command hold, the command latency,
the row convention (which ticks the command and the readings in a row belong to), the mass, and the position
sensor's delay, because the logs determine only its sum with the delay of the motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec
import numpy as np

from jaxhil.mechanism.structs import ForceSensor, Mechanism
from tuning.identification import conditioning, free_motion, mechanism_models, parameters, validation
from tuning.identification import contact_fit as contacts
from tuning.identification.bootstrap import bootstrap
from tuning.identification.contact_fit import ContactFit
from tuning.identification.contact_frequency import estimate_contact_frequency
from tuning.identification.contact_profile import POSTERIOR_DRAWS
from tuning.identification.contact_runs import exclude_rows_after_gaps, split_long_run
from tuning.identification.drifting_noise import estimate_force_noise
from tuning.identification.estimates import estimate_combinations, get_unit, make_estimates
from tuning.identification.free_motion import FreeMotion
from tuning.identification.identified_mechanism import compute_bound_excess, make_mechanism
from tuning.identification.motion_uncertainty import add_motion_uncertainty
from tuning.identification.noise import NoiseEstimate, estimate_noise, recognise_noise_free_readings
from tuning.identification.notes import collect_notes, note_absent_dead_zone
from tuning.identification.options import KEYS_FIXED_BEFORE_FIT, IdentificationOptions, check_options
from tuning.identification.parameters import SIMULATOR_PREFIX
from tuning.identification.rational import MotionModel
from tuning.identification.records import CONTACT_KINDS, Campaign, LoggedRun
from tuning.identification.result import Identification, find_confounded_pairs
from tuning.identification.result_checks import check_result
from tuning.identification.structure_choice import MAX_RELATIVE_STD

MIN_REST_ROWS = 200  # minimum number of rows at rest for an estimate of the noise
STAGE_COUNT = 3  # number of progress messages without a bootstrap, which adds one per chunk of fits
ReportProgress = Callable[[str], None]  # receives the name of each stage when it begins
FORCE_DELAY_KEY, DEAD_ZONE_KEY = "rig.force_sensor.delay", "rig.force_sensor.dead_zone"
STIFFNESS_PREFIX, POSITION_DELAY_KEY = "contact.stiffness.", "rig.position_sensor.delay"
MIN_DELAY_SIGMAS = 2.0  # a negative force delay is increased to this number of standard deviations above 0


def _ignore_progress(text: str) -> None:
    pass


def identify(
    campaign: Campaign,
    prior: Mechanism | None = None,
    options: IdentificationOptions | None = None,
    say: ReportProgress = _ignore_progress,
) -> Identification:
    """Identify the rig and the mechanism from the runs of a campaign.

    Args:
        campaign: Runs and their timing.
        prior: Mechanism with the values that the logs do not determine, or None.
        options: Options of the identification, or None for the defaults.
        say: Function that receives a progress message at each stage and after each chunk of bootstrap fits.

    Returns:
        Estimates, posterior draws, checks and the mechanism. If a required value is unknown, there is no
        mechanism and the verdict is bad.

    Raises:
        InputError: If the options are invalid.
    """
    options = options or IdentificationOptions()
    check_options(options, prior)
    runs = {
        kind: [run for run in campaign.runs if run.kind == kind] for kind in ("rest", "free", *CONTACT_KINDS)
    }
    sensor = _specify_sensor(prior, options)
    force, position = _estimate_sensor_noise(runs, campaign.timing.control_period, sensor)
    say("fitting the motion simulator")
    structures = mechanism_models.list_structures(prior if options.order is None else None)
    motion = free_motion.fit_free_motion(runs["free"], campaign.timing, options.order, structures)
    model = _make_prior_model(prior) if motion is None else motion.model
    touching = [] if model is None else _select_runs_in_contact(campaign, model)
    if force is not None and not sensor.dead_zone:
        force = recognise_noise_free_readings(force, [run.valid_forces for run in touching])
    contact, left_out = _fit_and_check_contact(touching, model, campaign, force, sensor, options, say)
    contact, deviations = add_motion_uncertainty(contact, touching, motion, campaign.timing, options.seed)
    frequency = estimate_contact_frequency(contact, campaign.equivalent_mass)
    clock_drift = None if contact is None else contact.drift
    share = _choose_position_delay(motion, None if clock_drift else contact, prior, options)
    draws = _draw_parameters(motion, contact, deviations, frequency, share)
    used_keys = KEYS_FIXED_BEFORE_FIT if clock_drift is None else (*KEYS_FIXED_BEFORE_FIT, FORCE_DELAY_KEY)
    draws, conditioned, contradictions = _condition_draws(draws, used_keys, frequency, prior, options)
    fixed = {**_select_fixed_before_fit(used_keys, share, prior, options), **conditioned}
    draws, vague = _drop_undetermined_entries(draws)
    used = contact if any(key.startswith(STIFFNESS_PREFIX) for key in (*draws, *fixed)) else None
    numbers = make_estimates(draws, motion, used, force, position, fixed)
    missing = _list_missing_parameters(
        prior, model, used, clock_drift is not None and FORCE_DELAY_KEY not in fixed
    )
    mechanism = None if missing else make_mechanism(campaign, prior, model, used, numbers, draws, options)
    mechanism, lines = check_result(mechanism, campaign, motion, contact, model, touching, frequency, options)
    table = np.array(list(draws.values())).T if draws else np.zeros((POSTERIOR_DRAWS, 0))
    return Identification(
        estimates=numbers,
        draws=table,
        combinations=estimate_combinations(
            draws | {k: np.full(POSTERIOR_DRAWS, v) for k, v in conditioned.items()}, used
        ),
        confounded=find_confounded_pairs(list(draws), table),
        lines=(*lines, *left_out),
        mechanism=mechanism,
        limit=options.limit,
        notes=(
            *collect_notes(motion, contact, used, force, vague),
            *note_absent_dead_zone(contact, sensor.dead_zone),
            *(*_note_shifted_delay(fixed, options), *_note_clipped_values(draws), *contradictions),
        ),
        missing=missing,
        motion=motion,
        contact=contact,
        force_noise=force,
        position_noise=position,
    )


def _specify_sensor(prior: Mechanism | None, options: IdentificationOptions) -> ForceSensor:
    """Return the prior's force sensor, with the dead zone that the user fixed, if any."""
    sensor = ForceSensor() if prior is None else prior.rig.force_sensor
    return msgspec.structs.replace(sensor, dead_zone=options.fixed.get(DEAD_ZONE_KEY, sensor.dead_zone))


def _select_runs_in_contact(campaign: Campaign, model: MotionModel) -> list[LoggedRun]:
    """Return the runs in contact; long runs are divided into segments."""
    period = campaign.timing.control_period
    runs = exclude_rows_after_gaps([run for run in campaign.runs if run.kind in CONTACT_KINDS], model, period)
    return [segment for run in runs for segment in split_long_run(run, period)]


def _condition_draws(
    draws: dict[str, np.ndarray],
    used_keys: Sequence[str],
    frequency: float,
    prior: Mechanism | None,
    options: IdentificationOptions,
) -> tuple[dict[str, np.ndarray], dict[str, float], list[str]]:
    """Condition the draws on the prior, and on the fixed parameters that the fits have not used yet.

    Args:
        draws: Posterior draws by key.
        used_keys: Keys of the fixed parameters whose values the fits have already used.
        frequency: Contact frequency [Hz].
        prior: Prior mechanism, or None.
        options: Options of the identification.

    Returns:
        The draws of the parameters that are not fixed; the values (by key) on which the draws were
        conditioned; and notes on fixed values that contradict the logs.
    """
    if options.bayes and prior is not None:
        draws = conditioning.condition_on_prior(draws, prior, frequency, options.seed)
    fixed = {key: value for key, value in options.fixed.items() if key not in used_keys}
    fixed = conditioning.split_lists(fixed, list(draws))
    draws, contradictions = conditioning.condition_on_fixed(draws, fixed)
    return draws, fixed, contradictions


def _drop_undetermined_entries(
    draws_by_key: dict[str, np.ndarray],
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Drop the entries of the lists in `[contact]` whose stiffness the logs hardly determine.

    Returns:
        The remaining draws, and the keys of the dropped stiffnesses. If the logs determine no entry, all
        draws of the contact are dropped.
    """
    keys = [key for key in draws_by_key if key.startswith(STIFFNESS_PREFIX)]
    vague = [
        key for key in keys if draws_by_key[key].std() > MAX_RELATIVE_STD * abs(draws_by_key[key].mean())
    ]
    entries = {key.split(".")[2] for key in vague}
    if entries == {key.split(".")[2] for key in keys}:
        return {
            key: draws
            for key, draws in draws_by_key.items()
            if vague == [] or key.startswith(SIMULATOR_PREFIX)
        }, vague
    # If one damping is common to all entries, the entries that were not excluded are enough to determine it.
    shared = sum(key.startswith("contact.damping.") for key in draws_by_key) == 1
    lists = (STIFFNESS_PREFIX,) if shared else (STIFFNESS_PREFIX, "contact.damping.")
    dropped = tuple(f"{name}{entry}" for name in lists for entry in entries)
    remaining = {
        k: v
        for k, v in draws_by_key.items()
        if not any(k == key or k.startswith(f"{key}.") for key in dropped)
    }
    return remaining, vague


def _list_missing_parameters(
    prior: Mechanism | None, model: MotionModel | None, contact: ContactFit | None, delay_is_unknown: bool
) -> tuple[str, ...]:
    """Return the parameters that neither the logs nor the prior determine, each with advice in words.

    `delay_is_unknown` is True if the logs do not determine the force delay and the user did not fix it.
    """
    missing = ["rig.simulator (add a run of kind free)"] if model is None else []
    if prior is None and delay_is_unknown:
        missing.append(f"{FORCE_DELAY_KEY} (specify it with --fix: the offset of the two clocks is unknown)")
    if prior is None and contact is None:
        missing.append("contact.stiffness (add a run of kind contact or press)")
    return tuple(missing)


def _make_prior_model(prior: Mechanism | None) -> MotionModel | None:
    return None if prior is None else mechanism_models.make_motion_model(prior)


def _estimate_sensor_noise(
    runs: Mapping[str, Sequence[LoggedRun]], period: float, sensor: ForceSensor
) -> tuple[NoiseEstimate | None, NoiseEstimate | None]:
    """Return the noise of force sensor and position sensor at rest; each may be None.

    Without a run at rest, the noise of the force sensor is estimated from free motion.
    """
    force = position = None
    for run in (*runs["rest"], *runs["free"]):
        if run.valid.sum() < MIN_REST_ROWS:
            continue
        if force is None and run.force_measured is not None:
            force = estimate_force_noise(run.valid_forces, period, sensor.bias_random_walk)
        if position is None and run.kind == "rest":
            position = estimate_noise(
                _select_finite(run.position_measured - run.position_desired[0], run.valid)
            )
    return force, position


def _select_finite(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return values[valid & np.isfinite(values)]


def _fit_and_check_contact(
    runs: list[LoggedRun],
    model: MotionModel | None,
    campaign: Campaign,
    force: NoiseEstimate | None,
    sensor: ForceSensor,
    options: IdentificationOptions,
    say: ReportProgress,
) -> tuple[ContactFit | None, list[validation.CheckResult]]:
    """Fit the contact law to all contacts; check a second fit on contacts that the second fit did not use.

    Returns:
        The fit to all contacts, or None if there are no contacts; and the checks of the second fit.
    """
    if model is None or not runs:
        return None, []
    plane = options.fixed.get("rig.contact_plane")
    say(f"fitting the contact to {len(runs)} runs")
    fit = contacts.fit_contact(runs, model, campaign.timing, force, options.law, plane, options.seed, sensor)
    if options.bootstrap:
        say(f"fitting {options.bootstrap} bootstrap samples of the contacts")
        fit = bootstrap(fit, options.bootstrap, options.seed, options.scheduler, options.checkpoints, say)
    say("evaluating a fit on contacts that it does not use")
    left_out = select_held_out_contacts(runs, options.hold_out)
    if not left_out.any():
        return fit, []
    partial_fit = contacts.refit_without(fit, left_out, options.seed)
    return fit, validation.check_held_out_contacts(partial_fit, runs, campaign.equivalent_mass, left_out)


def _note_clipped_values(draws_by_key: Mapping[str, np.ndarray]) -> list[str]:
    """Return a note for each parameter that is 0 in the mechanism file because its estimate is negative."""
    notes = []
    for key, draws in draws_by_key.items():
        if compute_bound_excess(key, draws) > 0.0:
            notes.append(
                f"{key}: logs give {draws.mean():.2g} {get_unit(key)}, standard deviation {draws.std():.2g}; "
                "the file has 0, the lowest value allowed, with an uncertainty that includes the difference"
            )
    return notes


def select_held_out_contacts(runs: Sequence[LoggedRun], share: float) -> np.ndarray:
    """Select contacts that a test fit omits: about the fraction `share` of those at each approach speed.

    If there are at least three contacts at a speed, at least one of them is selected.

    Returns:
        One flag per run, True if the run is selected.
    """
    flags = np.zeros(len(runs), bool)
    speeds = [round(1e4 * (run.speed or 0.0)) if run.kind == "contact" else -1 for run in runs]
    for speed in set(speeds) - {-1}:
        members = [i for i, speed_of_run in enumerate(speeds) if speed_of_run == speed]
        count = max(1, round(share * len(members))) if share > 0.0 and len(members) >= 3 else 0
        # Contacts are selected at regular intervals, so that the fit keeps contacts of every list entry.
        for i in members[1 :: max(1, len(members) // max(count, 1))][:count]:
            flags[i] = True
    return flags


def _draw_parameters(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    deviations: np.ndarray | None,
    frequency: float,
    share: float,
) -> dict[str, np.ndarray]:
    """Return posterior draws of all parameters by key, in SI units.

    Args:
        motion: Fit of the motion simulator, or None.
        contact: Fit of the contact, or None.
        deviations: Deviations of the draws from the parameters of the motion simulator, or None.
        frequency: Contact frequency [Hz].
        share: Delay of the position sensor [s], moved from the fitted motion delay to the force delay.
    """
    result = {}
    if motion is not None and deviations is not None:
        result = parameters.draw_simulator_parameters(motion.model, deviations, frequency)
        result["rig.simulator.delay"] = result["rig.simulator.delay"] - share
    if contact is not None:
        result |= parameters.convert_contact_draws(contact)
        result[FORCE_DELAY_KEY] = result[FORCE_DELAY_KEY] + share
        if contact.drift is not None:
            # The unknown offset between two clocks adds to the force delay, so the logs do not determine it.
            del result[FORCE_DELAY_KEY]
    return result


def _select_fixed_before_fit(
    keys: Sequence[str], share: float, prior: Mechanism | None, options: IdentificationOptions
) -> dict[str, float]:
    """Return the user's fixed values of `keys`; add the position sensor's delay if it is not the prior's."""
    fixed = {key: options.fixed[key] for key in keys if key in options.fixed}
    if share != (0.0 if prior is None else prior.rig.position_sensor.delay):
        fixed[POSITION_DELAY_KEY] = share
    return fixed


def _choose_position_delay(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    prior: Mechanism | None,
    options: IdentificationOptions,
) -> float:
    """Return the position sensor's delay [s]: as specified, or larger to avoid a negative force delay."""
    if POSITION_DELAY_KEY in options.fixed:
        return options.fixed[POSITION_DELAY_KEY]
    specified = 0.0 if prior is None else prior.rig.position_sensor.delay
    if motion is None or contact is None:
        return specified
    delay = contact.draws()[:, 0]
    # The mean of an uncertain delay may be negative by chance, hence the margin.
    mean, margin = float(delay.mean()), MIN_DELAY_SIGMAS * float(delay.std())
    return specified if mean + specified >= -margin else margin - mean


def _note_shifted_delay(fixed: Mapping[str, float], options: IdentificationOptions) -> list[str]:
    """Return a note if the position sensor's delay was increased (see `_choose_position_delay`)."""
    if POSITION_DELAY_KEY not in fixed or POSITION_DELAY_KEY in options.fixed:
        return []
    share = f"{1e3 * fixed[POSITION_DELAY_KEY]:.3g} ms of the motion's delay"
    return [
        f"the position sensor lags more than the force sensor: {share} are attributed to the position sensor"
    ]
