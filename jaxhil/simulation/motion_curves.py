"""Curves of force and position against time for plots: runs on the rig, and the ideal contacts."""

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
from jaxhil.simulation.recording import LaneRecord, record_lanes
from jaxhil.simulation.scenario import Scenario, build_scenarios

INTEGRATION_STEPS = 8000  # number of steps in the integration of the ideal contact
STORED_POINTS = 800  # number of points of a curve of the ideal contact

# Compensator and its gains, by name of the curve.
NamedCompensators = Mapping[str, tuple[str, Mapping[str, float]]]


class Curve(NamedTuple):
    """Force and position against time, on the rig or in the ideal contact."""

    velocity: float  # approach velocity [m/s]
    time: np.ndarray  # time since the numerical model's first touch [s]
    force: np.ndarray  # force on the numerical model [N]
    position: np.ndarray  # position of the numerical model [m]
    force_measured: np.ndarray | None  # reading of the force sensor [N]; None for the ideal contact
    position_measured: np.ndarray | None  # reading of the position sensor [m]; None for the ideal contact


class RunMotion(NamedTuple):
    """Curves of one run: a single contact or, with two surfaces, all contacts.

    The time 0 is the first touch. The time of the first touch is extrapolated from the start of the run,
    assuming uniform motion.
    """

    name: str  # name of the run, for the title of its panel
    surfaces: tuple[float, ...]  # positions of the mechanism's surfaces [m]
    curves: dict[str, Curve]  # curves by name; "ideal" is the ideal contact


def compute_nominal_motion(mechanism: Mechanism, laws: NamedCompensators, seed: int = 0) -> list[RunMotion]:
    """Simulate the nominal contacts with each of the compensators; return the curves of each run.

    The ideal contacts have the approach velocities of the last compensator's run.
    """
    runs: dict[str, list[Curve]] = {}
    lanes = list(_scenarios_by_compensator(mechanism, laws, seed))
    for names, loaded, scenarios in lanes:
        runs |= _compute_run_curves(loaded, scenarios, names)
    return _build_run_motions(mechanism, lanes[0][-1], {name: runs[name] for name in laws})


def compute_scenario_motion(loaded: LoadedGains, scenarios: Scenario) -> list[RunMotion]:
    """Simulate one scenario; return the curves of each run."""
    return _build_run_motions(loaded.mechanism, scenarios, _compute_run_curves(loaded, scenarios, ["rig"]))


def _scenarios_by_compensator(
    mechanism: Mechanism, laws: NamedCompensators, seed: int
) -> Iterator[tuple[list[str], LoadedGains, Scenario]]:
    """Yield, for each compensator, the names of its curves in the plot, and gains and nominal scenarios.

    Gains and scenarios have one lane for each curve.
    """
    for compensator in dict.fromkeys(compensator for compensator, _ in laws.values()):
        gains_by_name = {name: gains for name, (law, gains) in laws.items() if law == compensator}
        phase = np.full(len(gains_by_name), mechanism.approach.phase)
        scenarios = build_scenarios(mechanism, {"approach.phase": phase}, seed)
        sets = list(gains_by_name.values())
        lanes: Any = {name: np.array([gains[name] for gains in sets]) for name in sets[0]}
        yield list(gains_by_name), LoadedGains({}, compensator, lanes, mechanism), scenarios


def _compute_run_curves(loaded: LoadedGains, scenarios: Scenario, names: list[str]) -> dict[str, list[Curve]]:
    """Simulate the scenarios; return the curves of each lane's runs by the name of the lane."""
    _, recorded = record_lanes(loaded, scenarios)
    return {name: _split_runs(lane, scenarios) for name, lane in zip(names, recorded, strict=True)}


def _build_run_motions(
    mechanism: Mechanism, scenarios: Scenario, runs: dict[str, list[Curve]]
) -> list[RunMotion]:
    """Combine the curves of each run with the curve of the ideal contact.

    The last entry of `runs` determines the approach velocities of the ideal contacts.
    """
    leading = list(runs.values())[-1]
    clearance = float(scenarios.clearance[0])
    two = bool(np.isfinite(clearance))
    surfaces = (0.0, -clearance) if two else (0.0,)
    motions = []
    for number, ideal in enumerate(_ideal_curves(mechanism, scenarios, leading)):
        curves = {name: run[number] for name, run in runs.items() if number < len(run)}
        name = f"{mechanism.approach.contacts} contacts" if two else f"contact {number + 1}"
        motions.append(RunMotion(name, surfaces, {"ideal": ideal, **curves}))
    return motions


def _split_runs(lane: LaneRecord, scenarios: Scenario) -> list[Curve]:
    """Divide the record of a lane into runs and return the curve of each run."""
    signals = lane.signals
    begins = np.flatnonzero(signals.age == 0)
    ends = np.append(begins[1:], len(signals.age))
    period = float(scenarios.control_period[0])
    curves = []
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
        curves.append(curve)
    return curves


def _ideal_curves(mechanism: Mechanism, scenarios: Scenario, curves: list[Curve]) -> list[Curve]:
    """Return the curve of the ideal contact for each curve of the rig, from 0.02 s before the first touch."""
    velocity = np.array([curve.velocity for curve in curves])
    step = (np.array([curve.time[-1] for curve in curves]) + APPROACH_TIME) / INTEGRATION_STEPS
    forces, positions = cached_programs.run_cached(
        _integrate_ideal_contacts,
        find_contact_law(mechanism.contact.law).simulation_law,
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
    """Integrate M x'' = -F of the ideal contacts by semi-implicit Euler; return force [N] and position [m].

    Args:
        law: Contact law.
        contacts: Parameters of the contact law for each contact.
        clearance: Distance between two surfaces [m]; infinite for one surface.
        mass: Equivalent mass M [kg].
        firsts: Index of each run's first contact. When a contact ends, the parameters of the next one apply.
        velocities: Approach velocity of each run [m/s].
        steps: Integration step of each run [s], much shorter than a control period.
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
