"""From a campaign to an identification: rest, free motion, contact, validation, in that order.

Each stage takes what the one before it found; a stage without runs takes the prior's numbers. What the logs
cannot tell is taken as told: the hold, the latency, the way rows are written, the mass, and how the motion's
delay is shared with the position sensor's.
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
from tuning.identification.options import FIRST, Options, check
from tuning.identification.order import VAGUE
from tuning.identification.parameters import SIMULATOR
from tuning.identification.rational import Model
from tuning.identification.records import Campaign, Run
from tuning.identification.result import Identification, confounded
from tuning.identification.uncertain_effect import uncertain_effect

SHORTEST_REST = 200  # rows from which a run at rest says what a sensor's noise is
USUAL_FREQUENCY = 3.0  # Hz, of contacts, where none was made
TOUCHING = ("contact", "press", "tap")
STAGES = 3  # free motion, contact, validation; with a bootstrap one more for each piece of its fits
Say = Callable[[str], None]  # told what begins
FORCE_DELAY, DEAD_ZONE = "rig.force_sensor.delay", "rig.force_sensor.dead_zone"
STIFFNESS, POSITION_DELAY = "contact.stiffness.", "rig.position_sensor.delay"
CLEAR = 2.0  # standard deviations by which a force delay is taken to be above 0


def _silent(text: str) -> None:
    pass


def identify(
    campaign: Campaign, prior: Mechanism | None = None, options: Options | None = None, say: Say = _silent
) -> Identification:
    """What the runs of a campaign say of the rig and the mechanism.

    `prior` gives what the logs do not tell. Where neither does for a number that a mechanism file must have,
    there is no mechanism and the verdict is bad. `say` is called with what begins, in words, `STAGES` times
    at most, once more for each piece of a bootstrap. Raises `InputError` for options that cannot be."""
    options = options or Options()
    check(options, prior)
    runs = {kind: [run for run in campaign.runs if run.kind == kind] for kind in ("rest", "free", *TOUCHING)}
    period, mass = campaign.timing.control_period, campaign.equivalent_mass
    force, position = _noise(runs)
    say("fitting the motion simulator")
    motion = free_motion.estimate(runs["free"], campaign.timing, options.order)
    model = _told_model(prior) if motion is None else motion.model
    contact, touching, left_out, frequency = None, [], [], USUAL_FREQUENCY
    dead_zone = options.fixed.get(DEAD_ZONE, 0.0 if prior is None else prior.rig.force_sensor.dead_zone)
    whole = [run for run in campaign.runs if run.kind in TOUCHING]
    if whole and model is not None:
        whole = contacts.after_gaps(whole, model, period)
        touching = [piece for run in whole for piece in contacts.pieces(run, period)]
        contact, left_out = _contact(touching, model, campaign, force, dead_zone, options, say)
        frequency = contacts.frequency(contact, mass)
    apart = None if contact is None else contact.drift
    share = _position_delay(motion, None if apart else contact, prior, options)
    found = _draws(motion, contact, model, frequency, share, options.seed)
    first = FIRST
    if apart is not None:
        # What a constant between two clocks adds to it, no log shows.
        del found[FORCE_DELAY]
        first = (*FIRST, FORCE_DELAY)
    if options.bayes and prior is not None:
        found = knowledge.with_prior(found, prior, frequency, options.seed)
    later = {key: value for key, value in options.fixed.items() if key not in first}
    later = knowledge.spread_out(later, list(found))
    found, denied = knowledge.with_told(found, later)
    fixed = {**_told_first(first, share, prior, options), **later}
    told = {key: np.full(DRAWS, value) for key, value in later.items()}
    found, vague = _without_vague(found)
    told_contact = contact if any(key.startswith(STIFFNESS) for key in (*found, *fixed)) else None
    numbers = estimates(found, motion, told_contact, force, position, fixed)
    untold = apart is not None and FORCE_DELAY not in fixed
    mechanism, missing = None, _missing(prior, model, told_contact, untold)
    if not missing:
        mechanism = mechanism_of(campaign, prior, model, told_contact, numbers, found, options)
    written, refused = _written(mechanism)
    lines = _of_file(campaign, written, motion if options.order is None else None)
    if lines is None:
        lines = [*refused, *_of_fits(motion, contact, model, touching, mass)]
        if written is not None:
            lines += uncertainty(uncertain_effect(written), any(run.kind == "press" for run in whole))
    keys = list(found)
    table = np.array([found[key] for key in keys]).T if keys else np.zeros((DRAWS, 0))
    return Identification(
        estimates=numbers,
        draws=table,
        combinations=combinations(found | told, told_contact),
        confounded=confounded(keys, table),
        lines=(*lines, *left_out),
        mechanism=None if refused else mechanism,
        limit=options.limit,
        notes=(
            *_notes(motion, contact, told_contact, force, vague),
            *_no_dead_zone(contact, dead_zone),
            *_moved(fixed, options),
            *_at_bounds(found),
            *denied,
        ),
        missing=missing,
        motion=motion,
        contact=contact,
        force_noise=force,
        position_noise=position,
    )


def _without_vague(found: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], list[str]]:
    """The draws without entries of the contact lists whose stiffness is hardly told, and its keys; where no
    entry is told, without the contact."""
    keys = [key for key in found if key.startswith(STIFFNESS)]
    vague = [key for key in keys if found[key].std() > VAGUE * abs(found[key].mean())]
    entries = {key.split(".")[2] for key in vague}
    if entries == {key.split(".")[2] for key in keys}:
        return {key: draws for key, draws in found.items() if vague == [] or key.startswith(SIMULATOR)}, vague
    # A damping that all entries share is told by the others.
    shared = sum(key.startswith("contact.damping.") for key in found) == 1
    lists = (STIFFNESS,) if shared else (STIFFNESS, "contact.damping.")
    gone = tuple(f"{name}{entry}" for name in lists for entry in entries)
    left = {k: v for k, v in found.items() if not any(k == one or k.startswith(f"{one}.") for one in gone)}
    return left, vague


def _missing(
    prior: Mechanism | None, model: Model | None, contact: ContactFit | None, untold: bool
) -> tuple[str, ...]:
    """What neither the logs nor the prior tell, and the run that would; `untold`: the force delay."""
    missing = ["rig.simulator (a run of kind free would)"] if model is None else []
    if prior is None and untold:
        missing.append(f"{FORCE_DELAY} (--fix would: of two clocks nobody knows the constant)")
    if prior is None and contact is None:
        missing.append("contact.stiffness (a run of kind contact or press would)")
    return tuple(missing)


def _told_model(prior: Mechanism | None) -> Model | None:
    return None if prior is None else known.motion_model(prior)


def _noise(runs: Mapping[str, Sequence[Run]]) -> tuple[Noise | None, Noise | None]:
    """Of the force and position sensors at rest; the force sensor's in free motion where it never rested."""
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
    model: Model,
    campaign: Campaign,
    force: Noise | None,
    dead_zone: float,
    options: Options,
    say: Say,
) -> tuple[ContactFit, list[validation.Line]]:
    """The fit to all touches, and how one to most of them explains the others."""
    plane = options.fixed.get("rig.contact_plane")
    say(f"fitting the contact to {len(runs)} touches")
    fit = contacts.estimate(runs, model, campaign.timing, force, options.law, plane, options.seed, dead_zone)
    if options.bootstrap:
        say(f"fitting {options.bootstrap} times to contacts drawn again")
        fit = bootstrap(fit, options.bootstrap, options.seed, options.scheduler, options.kept, say)
    say("judging the fit by touches left out of it")
    held = held_out(runs, options.hold_out)
    if not held.any():
        return fit, []
    others = contacts.without(fit, held, options.seed)
    return fit, validation.of_touches_left_out(others, runs, campaign.equivalent_mass, held)


def _written(mechanism: dict[str, Any] | None) -> tuple[Mechanism | None, list[validation.Line]]:
    """Return the mechanism as its file has it; or what is wrong with it, as the lines of a verdict."""
    if mechanism is None:
        return None, []
    try:
        return from_builtins(tomllib.loads(to_toml(mechanism)), "identified mechanism"), []
    except InputError as error:
        return None, [validation.Line("mechanism file", str(error), True, 1.0)]


def _of_file(
    campaign: Campaign, written: Mechanism | None, motion: FreeMotion | None
) -> list[validation.Line] | None:
    """Check the mechanism as it is written, as `identify --check` would.

    `motion`: fitted, of any order. Returns None where no file is written, or none can be checked."""
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
) -> list[validation.Line]:
    """Check the fits themselves, where there is no file to check."""
    frequency = USUAL_FREQUENCY if contact is None else contacts.frequency(contact, mass)
    lines = []
    if motion is not None:
        lines = [*validation.of_motion(motion, frequency), validation.sign_of_delay(motion, frequency)]
    if contact is not None and model is not None:
        lag = contacts.lag(contact, model, frequency)
        every = np.ones(len(touching), bool)
        lines += [
            validation.sign_of_force(contact),
            *validation.of_contact(contact, touching, mass, frequency, lag, every),
        ]
    return lines


def _at_bounds(found: Mapping[str, np.ndarray]) -> list[str]:
    """Name the numbers whose values in the file are 0 since the logs say that they are below."""
    notes = []
    for key, draws in found.items():
        if off_bound(key, draws) > 0.0:
            told = f"the logs say {draws.mean():.4g} +- {draws.std():.2g}, {unit_of(key)}"
            notes.append(f"{key}: {told}: the file has its least value, 0, and the difference as uncertainty")
    return notes


def held_out(runs: Sequence[Run], share: float) -> np.ndarray:
    """A flag for each run: of each speed `share` of the touches, one at least where there are three."""
    flags = np.zeros(len(runs), bool)
    speeds = [round(1e4 * (run.speed or 0.0)) if run.kind == "contact" else -1 for run in runs]
    for speed in set(speeds) - {-1}:
        members = [i for i, one in enumerate(speeds) if one == speed]
        count = max(1, round(share * len(members))) if share > 0.0 and len(members) >= 3 else 0
        # Every so many, so that a list's entries are all left to fit to.
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
    """Draws of every number by its key, in the key's unit; `share`: of the delays, the position sensor's."""
    found, lag = {}, np.zeros(DRAWS)
    if motion is not None and model is not None:
        rng = np.random.default_rng([seed, 1])
        found, lag = parameters.simulator_draws(model, motion.covariance, frequency, DRAWS, rng)
    if contact is not None:
        # An error of the motion's lag is one of the force delay, the other way round.
        found |= parameters.contact_draws(contact)
        found[FORCE_DELAY] = found[FORCE_DELAY] - lag
    if motion is not None:
        found["rig.simulator.delay"] = found["rig.simulator.delay"] - share
    if contact is not None:
        found[FORCE_DELAY] = found[FORCE_DELAY] + share
    return found


def _told_first(
    keys: Sequence[str], share: float, prior: Mechanism | None, options: Options
) -> dict[str, float]:
    """What was told before anything was fitted, and the position sensor's delay if it is not the prior's."""
    first = {key: options.fixed[key] for key in keys if key in options.fixed}
    if share != (0.0 if prior is None else prior.rig.position_sensor.delay):
        first[POSITION_DELAY] = share
    return first


def _position_delay(
    motion: FreeMotion | None, contact: ContactFit | None, prior: Mechanism | None, options: Options
) -> float:
    """Of the position sensor [s]: as told, else 0; more where the force delay would be negative."""
    if POSITION_DELAY in options.fixed:
        return options.fixed[POSITION_DELAY]
    told = 0.0 if prior is None else prior.rig.position_sensor.delay
    if motion is None or contact is None:
        return told
    delay = contact.posterior.draws[:, 0]
    return told if delay.mean() + told >= 0.0 else float(CLEAR * delay.std() - delay.mean())


def _moved(fixed: Mapping[str, float], options: Options) -> list[str]:
    """That some of the delays were taken as the position sensor's, though nobody said so."""
    if POSITION_DELAY not in fixed or POSITION_DELAY in options.fixed:
        return []
    share = f"{1e3 * fixed[POSITION_DELAY]:.3g} ms of the motion's delay were taken as its"
    return [f"the position sensor lags more than the force sensor: {share}"]


def _notes(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    told: ContactFit | None,
    force: Noise | None,
    vague: Sequence[str],
) -> list[str]:
    notes = []
    if vague:
        taken = "the contact is the prior's" if told is None else "taken as the entry before it"
        notes.append(
            f"{', '.join(vague)}: known to {100 * VAGUE:.0f} % at best: {taken}; "
            "more touches or deeper ones would tell it"
        )
    if motion is None:
        notes.append("no free motion: the motion simulator is the prior's")
    if contact is None:
        notes.append("no contact: the contact and the force delay are the prior's")
    elif contact.drift is not None:
        rate, std = 1e6 * contact.drift.rate, 1e6 * contact.drift.std
        gains = f"the forces' clock gains {rate:.3g} +- {std:.2g} ppm on the drives'"
        notes.append(f"{gains}; a constant between them and {FORCE_DELAY} are one number: it is as told")
    if contact is not None and not contact.problem.rate_like:
        notes.append(
            f"law {contact.law.name}: without damping, as asked for; a damping b with a force delay longer "
            "by b over the stiffness may explain the logs as well"
        )
    if contact is not None and contact.resampled:
        notes.append(contact.resampled)
    if force is not None and force.drift:
        notes.append(f"the force drifts at rest, by {force.drift:.3g} N from the first row to the last")
    if force is not None and force.pole > 0.5:
        notes.append(f"the force's noise is coloured (pole {force.pole:.2f}); tuning weighs it as white")
    if contact is not None and (entries := contact.readings.entries) != tuple(range(len(entries))):
        notes.append(f"of the contact lists only entries {', '.join(map(str, entries))} were met")
    if contact is not None and contact.dead_zone and contact.problem.plane is not None:
        notes.append("the force has a dead zone: the contact plane was taken as told")
    return notes


def _no_dead_zone(contact: ContactFit | None, told: float) -> list[str]:
    """Say that the readings have no dead zone though one was told."""
    if contact is None or contact.dead_zone or not told:
        return []
    return [f"{DEAD_ZONE}: {told:g} N were told, but readings at rest show none: taken as none"]
