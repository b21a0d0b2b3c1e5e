"""From a campaign to an identification: rest, free motion, contact, validation, in that order.

Each stage takes what the one before it found; a stage without runs takes the prior's numbers. What the logs
cannot tell is taken as told: the hold, the latency, the way rows are written, the mass, and how the motion's
delay is shared with the position sensor's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxhil.errors import InputError, shown
from jaxhil.mechanism.file import to_builtins
from jaxhil.mechanism.structs import Mechanism, numeric_keys
from tuning.identification import contact as contacts
from tuning.identification import free_motion, knowledge, known, parameters, validation
from tuning.identification.contact import ContactFit
from tuning.identification.contact_profile import DRAWS
from tuning.identification.free_motion import FreeMotion
from tuning.identification.law_choice import NAMES
from tuning.identification.mechanism_file import put, uncertainty_tables
from tuning.identification.noise import Noise, at_rest
from tuning.identification.order import VAGUE
from tuning.identification.parameters import SIMULATOR
from tuning.identification.rational import STRUCTURES, Model
from tuning.identification.records import Campaign, Run
from tuning.identification.result import Estimate, Identification, confounded

SHORTEST_REST = 200  # rows from which a run at rest says what a sensor's noise is
USUAL_FREQUENCY = 3.0  # Hz, of contacts, where none was made
TOUCHING = ("contact", "press", "tap")
STAGES = 3  # free motion, contact, validation
Say = Callable[[str], None]  # told what begins


@dataclass(frozen=True)
class Options:
    """What the caller knows or wants."""

    order: int | None = None  # of the motion simulator; None lets the lines choose
    law: str | None = None  # of the contact; None lets the touches choose
    fixed: Mapping[str, Any] = field(default_factory=dict)  # by key, a list's too: told, not estimated
    bayes: bool = False  # whether the prior's normal marginals are evidence beside the logs
    hold_out: float = 0.2  # share of the touches that judge the fit to the others
    limit: float = 0.01  # on the restitution, of all that the model does not explain
    calibration: float = 0.001  # relative uncertainty of the force sensor's scale
    clock: float = 2e-5  # s, uncertainty of a delay that no log shows
    seed: int = 0


FIRST = ("rig.contact_plane", "rig.position_sensor.delay")  # told before anything is fitted


def _silent(text: str) -> None:
    pass


def identify(
    campaign: Campaign, prior: Mechanism | None = None, options: Options | None = None, say: Say = _silent
) -> Identification:
    """What the runs of a campaign say of the rig and the mechanism.

    `prior` gives what the logs do not tell. Where neither does for a number that a mechanism file must have,
    there is no mechanism and the verdict is bad. `say` is called with what begins, in words, `STAGES` times
    at most. Raises `InputError` for options that cannot be."""
    options = options or Options()
    _check(options, prior)
    runs = {kind: [run for run in campaign.runs if run.kind == kind] for kind in ("rest", "free", *TOUCHING)}
    period, mass = campaign.timing.control_period, campaign.equivalent_mass
    force, position = _noise(runs)
    say("fitting the motion simulator")
    motion = free_motion.estimate(runs["free"], campaign.timing, options.order)
    model = _told_model(prior) if motion is None else motion.model
    contact, lines, frequency = None, [], USUAL_FREQUENCY
    whole = [run for run in campaign.runs if run.kind in TOUCHING]
    if whole and model is not None:
        whole = contacts.after_gaps(whole, model, period)
        touching = [piece for run in whole for piece in contacts.pieces(run, period)]
        contact, lines = _contact(touching, model, campaign, force, options, say)
        frequency = contacts.frequency(contact, mass)
    if motion is not None:
        lines = [*validation.of_motion(motion, frequency), *lines]
    found = _draws(motion, contact, model, frequency, options)
    if options.bayes and prior is not None:
        found = knowledge.with_prior(found, prior, frequency, options.seed)
    later = {key: value for key, value in options.fixed.items() if key not in FIRST}
    later = knowledge.spread_out(later, list(found))
    found, denied = knowledge.with_told(found, later)
    fixed = {**{key: options.fixed[key] for key in FIRST if key in options.fixed}, **later}
    told = {key: np.full(DRAWS, value) for key, value in later.items()}
    vague = [key for key, draws in found.items() if key.startswith("contact.stiffness") and _vague(draws)]
    told_contact = None if vague else contact
    if vague:
        found = {key: draws for key, draws in found.items() if key.startswith(SIMULATOR)}
    estimates = _estimates(found, motion, told_contact, force, position, fixed)
    mechanism, missing = None, _missing(prior, model, told_contact)
    if not missing:
        mechanism = _mechanism(campaign, prior, model, told_contact, estimates, found, options)
    keys = list(found)
    table = np.array([found[key] for key in keys]).T if keys else np.zeros((DRAWS, 0))
    return Identification(
        estimates=estimates,
        draws=table,
        combinations=_combinations(found | told, told_contact),
        confounded=confounded(keys, table),
        lines=tuple(lines),
        mechanism=mechanism,
        limit=options.limit,
        notes=(*_notes(motion, contact, force, vague), *denied),
        missing=missing,
        motion=motion,
        contact=contact,
        force_noise=force,
        position_noise=position,
    )


def _vague(draws: np.ndarray) -> bool:
    return bool(draws.std() > VAGUE * abs(draws.mean()))


def _missing(prior: Mechanism | None, model: Model | None, contact: ContactFit | None) -> tuple[str, ...]:
    """What neither the logs nor the prior tell, and the run that would."""
    missing = ["rig.simulator (a run of kind free would)"] if model is None else []
    if prior is None and contact is None:
        missing.append("contact.stiffness (a run of kind contact or press would)")
    return tuple(missing)


def _check(options: Options, prior: Mechanism | None) -> None:
    for key in FIRST:
        if not isinstance(options.fixed.get(key, 0.0), (int, float)):
            raise InputError(f"fix: {key}: found {shown(options.fixed[key])}, allowed a number")
    if options.bayes and prior is None:
        raise InputError("bayes: found no prior, allowed a mechanism with [uncertainty]")
    if options.law is not None and options.law not in NAMES:
        raise InputError(f"law: found {shown(options.law)}, allowed {', '.join(NAMES)}")
    orders = sorted({one.order for one in STRUCTURES})
    if options.order is not None and options.order not in orders:
        raise InputError(f"order: found {options.order}, allowed {', '.join(map(str, orders))}")


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
    options: Options,
    say: Say,
) -> tuple[ContactFit, list[validation.Line]]:
    """The fit to all touches, and how one to most of them explains the others."""
    plane = options.fixed.get("rig.contact_plane")
    say(f"fitting the contact to {len(runs)} touches")
    fit = contacts.estimate(runs, model, campaign.timing, force, options.law, plane, options.seed)
    say("judging the fit by touches left out of it")
    held = held_out(runs, options.hold_out)
    judged = fit if not held.any() else contacts.without(fit, held, options.seed)
    frequency = contacts.frequency(fit, campaign.equivalent_mass)
    s = np.array([2j * np.pi * frequency])
    lag = -float(np.angle(model.response(s)[0])) / (2.0 * np.pi * frequency) + fit.posterior.best[0]
    judging = held if held.any() else np.ones(len(runs), bool)
    return fit, validation.of_contact(judged, runs, campaign.equivalent_mass, frequency, lag, judging)


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
    options: Options,
) -> dict[str, np.ndarray]:
    """Draws of every number by its key, in the key's unit."""
    found, lag = {}, np.zeros(DRAWS)
    if motion is not None and model is not None:
        rng = np.random.default_rng([options.seed, 1])
        found, lag = parameters.simulator_draws(model, motion.covariance, frequency, DRAWS, rng)
    if contact is not None:
        # An error of the motion's lag is one of the force delay, the other way round.
        found |= parameters.contact_draws(contact)
        found["rig.force_sensor.delay"] = found["rig.force_sensor.delay"] - lag
    shared = options.fixed.get("rig.position_sensor.delay", 0.0)
    if shared and motion is not None:
        found["rig.simulator.delay"] = found["rig.simulator.delay"] - shared
    if shared and contact is not None:
        found["rig.force_sensor.delay"] = found["rig.force_sensor.delay"] + shared
    return found


def _estimates(found, motion, contact, force, position, fixed) -> tuple[Estimate, ...]:
    """Estimates of what has draws, then of what the sensors say at rest and of what was told."""
    estimates = [_of_draws(key, values) for key, values in found.items()]
    others = []
    if force is not None and not force.silent:
        others.append(_plain("rig.force_sensor.noise_std", force.std, force.std_std))
        others.append(_plain("rig.force_sensor.bias", force.mean, force.mean_std))
    elif contact is not None:
        std = contact.readings.std
        others.append(_plain("rig.force_sensor.noise_std", std, std / np.sqrt(2.0 * contact.freedom)))
    if force is not None and force.quantum:
        others.append(_plain("rig.force_sensor.quantum", force.quantum, 0.0))
    if position is not None:
        others.append(_plain("rig.position_sensor.noise_std", position.std, position.std_std))
        if position.quantum:
            others.append(_plain("rig.position_sensor.quantum", position.quantum, 0.0))
    elif motion is not None:
        count = sum(len(one.frequency) for one in motion.spectra)
        std = motion.noise_std
        others.append(_plain("rig.position_sensor.noise_std", std, std / np.sqrt(2.0 * max(count, 1))))
    others += [
        Estimate(key, value, 0.0, value, value, unit_of(key), told=True) for key, value in fixed.items()
    ]
    return (*estimates, *others)


def _of_draws(key: str, values: np.ndarray) -> Estimate:
    low, high = np.quantile(values, (0.025, 0.975))
    return Estimate(
        key, float(values.mean()), float(values.std(ddof=1)), float(low), float(high), unit_of(key)
    )


def _plain(key: str, value: float, std: float) -> Estimate:
    return Estimate(key, value, std, value - 1.96 * std, value + 1.96 * std, unit_of(key))


def unit_of(key: str) -> str:
    """SI unit of a key, the number of a list's entry behind it or not."""
    parts = key.split(".")
    while parts[-1].isdigit():
        parts.pop()
    return numeric_keys()[".".join(parts)].unit


def _combinations(found: Mapping[str, np.ndarray], contact: ContactFit | None) -> tuple[Estimate, ...]:
    """What the logs tell better than its parts: delays together, damping less stiffness times delay."""
    combined = []
    motion, force = (found.get(key) for key in ("rig.simulator.delay", "rig.force_sensor.delay"))
    lag = found.get("rig.force_sensor.time_constant")
    if force is not None and lag is not None:
        force = force + lag
        combined.append(replace(_of_draws("rig.force_sensor.delay", force), key="delay and lag of force"))
    if motion is not None and force is not None:
        combined.append(
            replace(_of_draws("rig.force_sensor.delay", motion + force), key="delay of motion and force")
        )
    damping, stiffness = found.get("contact.damping.0"), found.get("contact.stiffness.0")
    if force is not None and contact is not None and contact.law.name == "kelvin_voigt":
        assert damping is not None and stiffness is not None
        apparent = replace(_of_draws("contact.damping", damping - stiffness * force), key="apparent damping")
        combined.append(apparent)
    return tuple(combined)


def _mechanism(
    campaign: Campaign,
    prior: Mechanism | None,
    model: Model | None,
    contact: ContactFit | None,
    estimates: Sequence[Estimate],
    found: Mapping[str, np.ndarray],
    options: Options,
) -> dict[str, Any]:
    """As a mechanism file has it: what was found over what the prior says."""
    timing = campaign.timing
    document: dict[str, Any] = {"schema": "jaxhil/mechanism/1", "name": "identified"}
    document |= {} if prior is None else to_builtins(prior)
    speeds = [run.speed for run in campaign.runs if run.speed]
    values = {one.key: one.value for one in estimates}
    document["source"] = _source(campaign)
    document["bodies"] = {"equivalent_mass": campaign.equivalent_mass}
    document.setdefault("approach", {"velocity": float(np.median(speeds)) if speeds else 0.005})
    if contact is not None:
        document["contact"] = parameters.contact_section(contact.law, values)
        if prior is None:
            document["approach"]["contacts"] = len(document["contact"]["stiffness"])
    else:
        for key, value in values.items():
            if key.startswith("contact."):
                put(document, key, value)
    rig = dict(document.get("rig", {}))
    rig |= {
        "control_period": timing.control_period,
        "command_latency": timing.command_latency,
        "command_hold": timing.command_hold,
    }
    simulator = {key[len(SIMULATOR) :]: one for key, one in values.items() if key.startswith(SIMULATOR)}
    if simulator and model is not None:
        before = rig.get("simulator", {})
        simulator = {
            **{k: v for k, v in before.items() if k.endswith("_limit")},
            **parameters.simulator_section(model),
            "delay": before.get("delay", 0.0),
            **simulator,
        }
        rig["simulator"] = {**simulator, "delay": max(simulator["delay"], 0.0)}
    for section in ("force_sensor", "position_sensor"):
        told = {**rig.get(section, {})}
        prefix = f"rig.{section}."
        told |= {key[len(prefix) :]: value for key, value in values.items() if key.startswith(prefix)}
        rig[section] = {**told, "delay": max(told.get("delay", 0.0), 0.0)}
    if "rig.contact_plane" in values:
        rig["contact_plane"] = values["rig.contact_plane"]
    document["rig"] = rig
    if found:
        document.pop("correlation", None)
    document |= _uncertainty(document, found, options)
    return document


def _uncertainty(document, found: Mapping[str, np.ndarray], options: Options) -> dict[str, Any]:
    """The prior's for what was not found, and what was found, with its correlation."""
    if not found:
        return {}
    keys = list(found)
    floors = np.array([
        options.clock if key.endswith(".delay")
        else options.calibration * abs(float(found[key].mean())) if key.startswith("contact.stiffness")
        else 0.0
        for key in keys
    ])  # fmt: skip
    tables = uncertainty_tables(keys, np.array([found[key] for key in keys]).T, floors)
    kept = {
        key: value
        for key, value in document.get("uncertainty", {}).items()
        if not key.startswith(tuple(name.rsplit(".", 1)[0] + "." for name in tables["uncertainty"]))
    }
    return {**tables, "uncertainty": {**kept, **tables["uncertainty"]}}


def _source(campaign: Campaign) -> str:
    files = ", ".join(f"{name} (SHA-256 {digest[:12]})" for name, digest in campaign.sources.items())
    return f"identified from {files or 'a campaign in memory'}"[:9_000]


def _notes(
    motion: FreeMotion | None, contact: ContactFit | None, force: Noise | None, vague: Sequence[str]
) -> list[str]:
    notes = []
    if vague:
        notes.append(
            f"{', '.join(vague)}: known to {100 * VAGUE:.0f} % at best: the contact is the prior's; "
            "more touches or deeper ones would tell it"
        )
    if motion is None:
        notes.append("no free motion: the motion simulator is the prior's")
    if contact is None:
        notes.append("no contact: the contact and the force delay are the prior's")
    if force is not None and force.pole > 0.5:
        notes.append(f"the force's noise is coloured (pole {force.pole:.2f}); tuning weighs it as white")
    if contact is not None and (entries := contact.readings.entries) != tuple(range(len(entries))):
        notes.append(f"of the contact lists only entries {', '.join(map(str, entries))} were met")
    if contact is not None and contact.dead_zone:
        notes.append("the force has a dead zone: the contact plane was taken as told")
    return notes
