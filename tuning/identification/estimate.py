"""Identification of a campaign in four stages: rest, free motion, contact, validation.

Each stage uses the results of the previous ones; without runs for a stage, the prior's values are used. The
logs cannot determine the hold, the latency, the row convention, the mass, or the split of the motion's delay
between the motion and the position sensor. These are taken as specified.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from jaxhil.errors import InputError
from jaxhil.mechanism.file import from_builtins
from jaxhil.mechanism.structs import Mechanism
from tuning.identification import contact as contacts
from tuning.identification import free_motion, knowledge, known, parameters, validation
from tuning.identification.bootstrap import bootstrap
from tuning.identification.check import check as check_file
from tuning.identification.check import uncertainty
from tuning.identification.contact import ContactFit
from tuning.identification.contact_profile import DRAWS
from tuning.identification.estimates import combinations, estimates, unit_of
from tuning.identification.free_motion import FreeMotion
from tuning.identification.identified import mechanism_of, off_bound
from tuning.identification.mechanism_file import to_toml
from tuning.identification.noise import Noise, at_rest
from tuning.identification.notes import no_dead_zone, notes_on
from tuning.identification.options import FIRST, Options, check
from tuning.identification.order import VAGUE
from tuning.identification.parameters import SIMULATOR
from tuning.identification.rational import Model
from tuning.identification.records import Campaign, Run
from tuning.identification.result import Identification, confounded
from tuning.identification.uncertain_effect import uncertain_effect

SHORTEST_REST = 200  # rows at rest that an estimate of the noise needs
USUAL_FREQUENCY = 3.0  # Hz, contact frequency that is assumed if the logs have no contact
TOUCHING = ("contact", "press", "tap")
STAGES = 3  # free motion, contact, validation; a bootstrap adds one for each chunk of its fits
Say = Callable[[str], None]  # receives the name of each stage when it begins
FORCE_DELAY, DEAD_ZONE = "rig.force_sensor.delay", "rig.force_sensor.dead_zone"
STIFFNESS, POSITION_DELAY = "contact.stiffness.", "rig.position_sensor.delay"
CLEAR = 2.0  # standard deviations between 0 and a force delay that would else be negative


def _silent(text: str) -> None:
    pass


def identify(
    campaign: Campaign, prior: Mechanism | None = None, options: Options | None = None, say: Say = _silent
) -> Identification:
    """Identify the rig and the mechanism from the runs of a campaign.

    Args:
        campaign: Runs and their timing.
        prior: Mechanism with the values that the logs do not determine, or None.
        options: Options of the caller.
        say: Function that receives the name of each stage (at most `STAGES`) and bootstrap chunk.

    Returns:
        Estimates, draws, checks and the mechanism, or a bad verdict if a required value is unknown.

    Raises:
        InputError: If the options are invalid.
    """
    options = options or Options()
    check(options, prior)
    runs = {kind: [run for run in campaign.runs if run.kind == kind] for kind in ("rest", "free", *TOUCHING)}
    force, position = _noise(runs)
    say("fitting the motion simulator")
    motion = free_motion.estimate(runs["free"], campaign.timing, options.order)
    model = _told_model(prior) if motion is None else motion.model
    dead_zone = options.fixed.get(DEAD_ZONE, 0.0 if prior is None else prior.rig.force_sensor.dead_zone)
    touching = [] if model is None else _touching(campaign, model)
    contact, left_out = _contact(touching, model, campaign, force, dead_zone, options, say)
    frequency = _frequency(contact, campaign.equivalent_mass)
    apart = None if contact is None else contact.drift
    share = _position_delay(motion, None if apart else contact, prior, options)
    draws = _draws(motion, contact, model, frequency, share, options.seed)
    first = FIRST if apart is None else (*FIRST, FORCE_DELAY)
    draws, later, denied = _conditioned(draws, first, frequency, prior, options)
    fixed = {**_told_first(first, share, prior, options), **later}
    draws, vague = _without_vague(draws)
    used = contact if any(key.startswith(STIFFNESS) for key in (*draws, *fixed)) else None
    numbers = estimates(draws, motion, used, force, position, fixed)
    missing = _missing(prior, model, used, apart is not None and FORCE_DELAY not in fixed)
    mechanism = None if missing else mechanism_of(campaign, prior, model, used, numbers, draws, options)
    mechanism, lines = _checked(mechanism, campaign, motion, contact, model, touching, options)
    table = np.array(list(draws.values())).T if draws else np.zeros((DRAWS, 0))
    return Identification(
        estimates=numbers,
        draws=table,
        combinations=combinations(draws | {k: np.full(DRAWS, v) for k, v in later.items()}, used),
        confounded=confounded(list(draws), table),
        lines=(*lines, *left_out),
        mechanism=mechanism,
        limit=options.limit,
        notes=(
            *notes_on(motion, contact, used, force, vague),
            *no_dead_zone(contact, dead_zone),
            *(*_moved(fixed, options), *_at_bounds(draws), *denied),
        ),
        missing=missing,
        motion=motion,
        contact=contact,
        force_noise=force,
        position_noise=position,
    )


def _touching(campaign: Campaign, model: Model) -> list[Run]:
    """Return the runs in contact, divided into segments of similar length."""
    period = campaign.timing.control_period
    runs = contacts.after_gaps([run for run in campaign.runs if run.kind in TOUCHING], model, period)
    return [segment for run in runs for segment in contacts.pieces(run, period)]


def _frequency(contact: ContactFit | None, mass: float) -> float:
    """Return the contact frequency [Hz]."""
    return USUAL_FREQUENCY if contact is None else contacts.frequency(contact, mass)


def _conditioned(
    draws: dict[str, np.ndarray],
    first: Sequence[str],
    frequency: float,
    prior: Mechanism | None,
    options: Options,
) -> tuple[dict[str, np.ndarray], dict[str, float], list[str]]:
    """Condition the draws on the prior and on the fixed parameters that are not in `first`.

    Returns:
        The draws of the other parameters, these fixed parameters by key, and notes on contradictions.
    """
    if options.bayes and prior is not None:
        draws = knowledge.with_prior(draws, prior, frequency, options.seed)
    later = {key: value for key, value in options.fixed.items() if key not in first}
    later = knowledge.spread_out(later, list(draws))
    draws, denied = knowledge.with_told(draws, later)
    return draws, later, denied


def _without_vague(draws_by_key: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """Drop the entries of the contact lists whose stiffness is hardly determined.

    Returns:
        The remaining draws, without any contact key if no entry is determined; and the vague stiffness keys.
    """
    keys = [key for key in draws_by_key if key.startswith(STIFFNESS)]
    vague = [key for key in keys if draws_by_key[key].std() > VAGUE * abs(draws_by_key[key].mean())]
    entries = {key.split(".")[2] for key in vague}
    if entries == {key.split(".")[2] for key in keys}:
        return {
            key: draws for key, draws in draws_by_key.items() if vague == [] or key.startswith(SIMULATOR)
        }, vague
    # The remaining entries determine a damping that all entries share.
    shared = sum(key.startswith("contact.damping.") for key in draws_by_key) == 1
    lists = (STIFFNESS,) if shared else (STIFFNESS, "contact.damping.")
    dropped = tuple(f"{name}{entry}" for name in lists for entry in entries)
    left = {
        k: v
        for k, v in draws_by_key.items()
        if not any(k == key or k.startswith(f"{key}.") for key in dropped)
    }
    return left, vague


def _missing(
    prior: Mechanism | None, model: Model | None, contact: ContactFit | None, untold: bool
) -> tuple[str, ...]:
    """Return the parameters that neither the logs nor the prior determine, each with the run that would.

    `untold` says that the force delay is one of them.
    """
    missing = ["rig.simulator (a run of kind free would)"] if model is None else []
    if prior is None and untold:
        missing.append(f"{FORCE_DELAY} (--fix would: of two clocks nobody knows the constant)")
    if prior is None and contact is None:
        missing.append("contact.stiffness (a run of kind contact or press would)")
    return tuple(missing)


def _told_model(prior: Mechanism | None) -> Model | None:
    return None if prior is None else known.motion_model(prior)


def _noise(runs: Mapping[str, Sequence[Run]]) -> tuple[Noise | None, Noise | None]:
    """Return the noise of the force and position sensors at rest.

    The noise of the force sensor comes from free motion if no run is at rest.
    """
    force = position = None
    for run in (*runs["rest"], *runs["free"]):
        if run.valid.sum() < SHORTEST_REST:
            continue
        if force is None and run.force_measured is not None:
            force = at_rest(_whole(run.force_measured, run.valid))
        if position is None and run.kind == "rest":
            position = at_rest(_whole(run.position_measured - run.position_desired[0], run.valid))
    return force, position


def _whole(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return values[valid & np.isfinite(values)]


def _contact(
    runs: list[Run],
    model: Model | None,
    campaign: Campaign,
    force: Noise | None,
    dead_zone: float,
    options: Options,
    say: Say,
) -> tuple[ContactFit | None, list[validation.Line]]:
    """Fit all contacts, and check a fit to most of them on those left out; None without contacts."""
    if model is None or not runs:
        return None, []
    plane = options.fixed.get("rig.contact_plane")
    say(f"fitting the contact to {len(runs)} touches")
    fit = contacts.estimate(runs, model, campaign.timing, force, options.law, plane, options.seed, dead_zone)
    if options.bootstrap:
        say(f"fitting {options.bootstrap} times to contacts drawn again")
        fit = bootstrap(fit, options.bootstrap, options.seed, options.scheduler, options.kept, say)
    say("judging the fit by touches left out of it")
    left_out = held_out(runs, options.hold_out)
    if not left_out.any():
        return fit, []
    partial_fit = contacts.without(fit, left_out, options.seed)
    return fit, validation.of_touches_left_out(partial_fit, runs, campaign.equivalent_mass, left_out)


def _checked(
    mechanism: dict[str, Any] | None,
    campaign: Campaign,
    motion: FreeMotion | None,
    contact: ContactFit | None,
    model: Model | None,
    touching: list[Run],
    options: Options,
) -> tuple[dict[str, Any] | None, list[validation.Line]]:
    """Return the mechanism, or None if its file is invalid, and the checks of that file or of the fits."""
    written, refused = _written(mechanism)
    lines = _of_file(campaign, written, motion if options.order is None else None)
    if lines is None:
        lines = [*refused, *_of_fits(motion, contact, model, touching, campaign.equivalent_mass, written)]
    return None if refused else mechanism, lines


def _written(mechanism: dict[str, Any] | None) -> tuple[Mechanism | None, list[validation.Line]]:
    """Return the mechanism as its file would contain it, or that file's error as a line of the verdict."""
    if mechanism is None:
        return None, []
    try:
        return from_builtins(tomllib.loads(to_toml(mechanism)), "identified mechanism"), []
    except InputError as error:
        return None, [validation.Line("mechanism file", str(error), True, 1.0)]


def _of_file(
    campaign: Campaign, written: Mechanism | None, motion: FreeMotion | None
) -> list[validation.Line] | None:
    """Check the written mechanism, as `identify --check` does.

    `motion` is fitted with any order. Returns None if no file is written or the file cannot be checked.
    """
    if written is None or campaign.timing.two_clocks:
        return None
    if not any(run.kind in (*TOUCHING, "free") for run in campaign.runs):
        return None
    try:
        return list(check_file(campaign, written, fitted=motion).lines)
    except InputError:
        return None


def _of_fits(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    model: Model | None,
    touching: list[Run],
    mass: float,
    written: Mechanism | None,
) -> list[validation.Line]:
    """Check the fits themselves, if there is no file that can be checked."""
    frequency, lines = _frequency(contact, mass), []
    if motion is not None:
        lines = [*validation.of_motion(motion, frequency), validation.sign_of_delay(motion, frequency)]
    if contact is not None and model is not None:
        lag = contacts.lag(contact, model, frequency)
        all_touches = np.ones(len(touching), bool)
        lines += [
            validation.sign_of_force(contact),
            *validation.of_contact(contact, touching, mass, frequency, lag, all_touches),
        ]
    if written is not None:
        lines += uncertainty(uncertain_effect(written), any(run.kind == "press" for run in touching))
    return lines


def _at_bounds(draws_by_key: Mapping[str, np.ndarray]) -> list[str]:
    """Return a note for each parameter that is 0 in the file because the logs indicate a negative value."""
    notes = []
    for key, draws in draws_by_key.items():
        if off_bound(key, draws) > 0.0:
            interval = f"the logs say {draws.mean():.4g} +- {draws.std():.2g}, {unit_of(key)}"
            notes.append(
                f"{key}: {interval}: the file has its least value, 0, and the difference as uncertainty"
            )
    return notes


def held_out(runs: Sequence[Run], share: float) -> np.ndarray:
    """Return a flag for each run that is left out of a fit: a `share` of the contacts of each speed.

    At least one contact of each speed is left out if there are three or more.
    """
    flags = np.zeros(len(runs), bool)
    speeds = [round(1e4 * (run.speed or 0.0)) if run.kind == "contact" else -1 for run in runs]
    for speed in set(speeds) - {-1}:
        members = [i for i, speed_of_run in enumerate(speeds) if speed_of_run == speed]
        count = max(1, round(share * len(members))) if share > 0.0 and len(members) >= 3 else 0
        # At regular intervals, so that contacts of every entry of the lists remain in the fit.
        for i in members[1 :: max(1, len(members) // max(count, 1))][:count]:
            flags[i] = True
    return flags


def _draws(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    model: Model | None,
    frequency: float,
    share: float,
    seed: int,
) -> dict[str, np.ndarray]:
    """Return draws of every parameter by its key, in the key's unit.

    `share` [s] is the part of the delays that belongs to the position sensor.
    """
    result, lag = {}, np.zeros(DRAWS)
    if motion is not None and model is not None:
        rng = np.random.default_rng([seed, 1])
        result, lag = parameters.simulator_draws(model, motion.covariance, frequency, DRAWS, rng)
    if contact is not None:
        # The force delay is relative to the motion, so an error of the motion's lag enters with a minus.
        result |= parameters.contact_draws(contact)
        result[FORCE_DELAY] = result[FORCE_DELAY] - lag
    if motion is not None:
        result["rig.simulator.delay"] = result["rig.simulator.delay"] - share
    if contact is not None:
        result[FORCE_DELAY] = result[FORCE_DELAY] + share
        if contact.drift is not None:
            # No log shows the constant between two clocks, which adds to the force delay.
            del result[FORCE_DELAY]
    return result


def _told_first(
    keys: Sequence[str], share: float, prior: Mechanism | None, options: Options
) -> dict[str, float]:
    """Return the fixed parameters, and the position sensor's delay if it differs from the prior."""
    first = {key: options.fixed[key] for key in keys if key in options.fixed}
    if share != (0.0 if prior is None else prior.rig.position_sensor.delay):
        first[POSITION_DELAY] = share
    return first


def _position_delay(
    motion: FreeMotion | None, contact: ContactFit | None, prior: Mechanism | None, options: Options
) -> float:
    """Return the position sensor's delay [s]; it is raised if the force delay would be negative."""
    if POSITION_DELAY in options.fixed:
        return options.fixed[POSITION_DELAY]
    specified = 0.0 if prior is None else prior.rig.position_sensor.delay
    if motion is None or contact is None:
        return specified
    delay = contact.posterior.draws[:, 0]
    return specified if delay.mean() + specified >= 0.0 else float(CLEAR * delay.std() - delay.mean())


def _moved(fixed: Mapping[str, float], options: Options) -> list[str]:
    """Return a note if an unspecified part of the motion's delay was assigned to the position sensor."""
    if POSITION_DELAY not in fixed or POSITION_DELAY in options.fixed:
        return []
    share = f"{1e3 * fixed[POSITION_DELAY]:.3g} ms of the motion's delay were taken as its"
    return [f"the position sensor lags more than the force sensor: {share}"]
