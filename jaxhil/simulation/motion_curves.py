"""Nominal run tick by tick, and the ideal contacts, for plots."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactLaw, ContactParameters, compute_two_sided_force, find_contact_law
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation import cached_programs
from jaxhil.simulation.free_flight import APPROACH_TIME
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.recording import LaneRecord, prepare_recording, record_lanes
from jaxhil.simulation.scenario import Scenario, build_scenarios

INTEGRATION_STEPS = 8000  # steps of the ideal contact's integration
STORED_POINTS = 800  # number of stored points

NamedCompensators = Mapping[str, tuple[str, Mapping[str, float]]]  # compensator and gains by name


class Curve(NamedTuple):
    """Motion over time."""

    velocity: float  # approach velocity [m/s]
    time: np.ndarray  # [s]
    force: np.ndarray  # force on the numerical model [N]
    position: np.ndarray  # position of the numerical model [m]
    force_measured: np.ndarray | None  # [N]; None for the ideal contact
    position_measured: np.ndarray | None  # [m]; None for the ideal contact


class RunMotion(NamedTuple):
    """One run of the schedule: a contact or, with two surfaces, all contacts.

    Time 0 is the first touch, extrapolated by uniform motion.
    """

    name: str  # name of the run
    surfaces: tuple[float, ...]  # positions of the mechanism's surfaces [m]
    curves: dict[str, Curve]  # curves by name; "in space" is the ideal contact


def compute_nominal_motion(mechanism: Mechanism, laws: NamedCompensators, seed: int = 0) -> list[RunMotion]:
    """Return the pieces of the nominal run under each of the `laws`.

    The ideal contacts have the approach velocities of the last law's run.
    """
    runs: dict[str, list[Curve]] = {}
    lanes = list(_scenarios_by_compensator(mechanism, laws, seed))
    for names, loaded, scenarios in lanes:
        runs |= _compute_run_curves(loaded, scenarios, names)
    return _build_run_motions(mechanism, lanes[0][-1], {name: runs[name] for name in laws})


def compute_scenario_motion(loaded: LoadedGains, scenarios: Scenario, name: str = "rig") -> list[RunMotion]:
    """Return the pieces of one scenario's run, a batch of one lane; plots call it `name`."""
    return _build_run_motions(loaded.mechanism, scenarios, _compute_run_curves(loaded, scenarios, [name]))


def prepare_motion(mechanism: Mechanism, laws: NamedCompensators) -> None:
    """Compile the programs of `compute_nominal_motion` for these laws."""
    for _, loaded, scenarios in _scenarios_by_compensator(mechanism, laws, 0):
        prepare_recording(loaded, scenarios)


def _scenarios_by_compensator(
    mechanism: Mechanism, laws: NamedCompensators, seed: int
) -> Iterator[tuple[list[str], LoadedGains, Scenario]]:
    """Yield for each compensator the names of its gains and the nominal scenario, a lane per name."""
    for compensator in dict.fromkeys(compensator for compensator, _ in laws.values()):
        gains_by_name = {name: gains for name, (law, gains) in laws.items() if law == compensator}
        phase = np.full(len(gains_by_name), mechanism.approach.phase)
        scenarios = build_scenarios(mechanism, {"approach.phase": phase}, seed)
        sets = list(gains_by_name.values())
        lanes: Any = {name: np.array([gains[name] for gains in sets]) for name in sets[0]}
        yield list(gains_by_name), LoadedGains({}, compensator, lanes, mechanism), scenarios


def _compute_run_curves(loaded: LoadedGains, scenarios: Scenario, names: list[str]) -> dict[str, list[Curve]]:
    """Return the curves of a lane for each name; the lanes differ only in their gains."""
    _, recorded = record_lanes(loaded, scenarios)
    return {name: _split_runs(lane, scenarios) for name, lane in zip(names, recorded, strict=True)}


def _build_run_motions(
    mechanism: Mechanism, scenarios: Scenario, runs: dict[str, list[Curve]]
) -> list[RunMotion]:
    """Return the pieces of runs, with the ideal contacts for the last run."""
    leading = list(runs.values())[-1]
    clearance = float(scenarios.clearance[0])
    two = bool(np.isfinite(clearance))
    surfaces = (0.0, -clearance) if two else (0.0,)
    pieces = []
    for number, ideal in enumerate(_ideal_curves(mechanism, scenarios, leading)):
        curves = {name: run[number] for name, run in runs.items() if number < len(run)}
        name = f"{mechanism.approach.contacts} contacts" if two else f"contact {number + 1}"
        pieces.append(RunMotion(name, surfaces, {"in space": ideal, **curves}))
    return pieces


def _split_runs(lane: LaneRecord, scenarios: Scenario) -> list[Curve]:
    """Return the curves of a lane's runs."""
    signals = lane.signals
    begins = np.flatnonzero(signals.age == 0)
    ends = np.append(begins[1:], len(signals.age))
    period = float(scenarios.control_period[0])
    pieces = []
    for begin, end in zip(begins, ends, strict=True):
        touch = -float(signals.position_desired[begin] / signals.velocity_desired[begin])
        part = slice(begin, end)
        curve = Curve(
            float(signals.velocity_desired[begin]),
            np.arange(end - begin) * period - touch,
            np.asarray(lane.command[part]),
            np.asarray(signals.position_desired[part]),
            np.asarray(signals.force_measured[part]),
            np.asarray(signals.position_measured[part]),
        )
        pieces.append(curve)
    return pieces


def _ideal_curves(mechanism: Mechanism, scenarios: Scenario, curves: list[Curve]) -> list[Curve]:
    """Return the ideal motion from 0.02 s before each contact's touch to the end of the contact's curve."""
    velocity = np.array([curve.velocity for curve in curves])
    step = (np.array([curve.time[-1] for curve in curves]) + APPROACH_TIME) / INTEGRATION_STEPS
    forces, positions = cached_programs.run_cached(
        _integrate_ideal_contacts,
        find_contact_law(mechanism.contact.law).simulated,
        jax.tree.map(lambda leaf: leaf[..., 0], scenarios.contact),
        scenarios.clearance[0],
        scenarios.equivalent_mass[0],
        np.arange(len(curves)),
        velocity,
        step,
    )
    stored = slice(None, None, INTEGRATION_STEPS // STORED_POINTS)
    times = -APPROACH_TIME + step[:, None] * np.arange(INTEGRATION_STEPS)[None]
    motions = zip(times, np.asarray(forces), np.asarray(positions), strict=True)
    return [
        Curve(curve.velocity, time[stored], force[stored], position[stored], None, None)
        for curve, (time, force, position) in zip(curves, motions, strict=True)
    ]


def _integrate_ideal_contacts(
    law: ContactLaw,
    contacts: ContactParameters,
    clearance: Array,
    mass: Array,
    firsts: Int[Array, "runs"],
    velocities: Float[Array, "runs"],
    steps: Float[Array, "runs"],
) -> tuple[Float[Array, "runs steps"], Float[Array, "runs steps"]]:
    """Return force [N] and position [m] of M x'' = -F by semi-implicit Euler with very small steps.

    Runs begin with the contacts `firsts`. The parameters of the next contact apply after a contact has ended.
    """
    last = contacts.damping.shape[0] - 1

    def integrate(first, velocity, step):
        def advance(carry, _):
            position, speed, index, touched, state = carry
            parameters = jax.tree.map(lambda leaf: leaf[jnp.minimum(index, last)], contacts)
            force, state = compute_two_sided_force(law, parameters, state, position, speed, clearance)
            touching = (position > 0) | (position < -clearance)
            index = jnp.where(touched & ~touching, index + 1, index)
            speed = speed - step * force / mass
            return (position + step * speed, speed, index, touching, state), (force, position)

        start = (-velocity * APPROACH_TIME, velocity, first, jnp.array(False), law.init(velocity))
        return lax.scan(advance, start, None, length=INTEGRATION_STEPS)[1]

    return jax.vmap(integrate)(firsts, velocities, steps)
