"""The nominal run tick by tick, and the same contacts in space: what plots are drawn from."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactLaw, ContactParameters, contact_law, two_sided
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation import kept_programs
from jaxhil.simulation.free_flight import APPROACH
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.recording import Lane, prepare_recording, record_lanes
from jaxhil.simulation.scenario import Scenario, build_scenarios

STEPS = 8000  # of the integration in space
POINTS = 800  # of them kept

Laws = Mapping[str, tuple[str, Mapping[str, float]]]  # by name, a compensator and its gains


class Curve(NamedTuple):
    """A motion over time."""

    velocity: float  # at which it entered [m/s]
    time: np.ndarray  # [s]
    force: np.ndarray  # on the numerical model [N]
    position: np.ndarray  # of the numerical model [m]
    force_measured: np.ndarray | None  # [N]; None in space
    position_measured: np.ndarray | None  # [m]; None in space


class Piece(NamedTuple):
    """One run of the schedule: a contact, or with two surfaces all of them. Time 0 is the first touch of
    uniform motion."""

    name: str  # of the run
    surfaces: tuple[float, ...]  # positions of the mechanism's surfaces [m]
    curves: dict[str, Curve]  # by name, "in space" among them


def nominal_motion(mechanism: Mechanism, laws: Laws, seed: int = 0) -> list[Piece]:
    """The pieces of the nominal run under each of the `laws`; the run in space enters as the last of them."""
    runs: dict[str, list[Curve]] = {}
    lanes = list(_lanes(mechanism, laws, seed))
    for names, loaded, scenarios in lanes:
        runs |= _runs(loaded, scenarios, names)
    return _pieces(mechanism, lanes[0][-1], {name: runs[name] for name in laws})


def scenario_motion(loaded: LoadedGains, scenarios: Scenario, name: str = "rig") -> list[Piece]:
    """The pieces of one scenario's run, a batch of one lane, which the plots call `name`."""
    return _pieces(loaded.mechanism, scenarios, _runs(loaded, scenarios, [name]))


def prepare_motion(mechanism: Mechanism, laws: Laws) -> None:
    """Compile what `nominal_motion` will run under such laws."""
    for _, loaded, scenarios in _lanes(mechanism, laws, 0):
        prepare_recording(loaded, scenarios)


def _lanes(mechanism: Mechanism, laws: Laws, seed: int) -> Iterator[tuple[list[str], LoadedGains, Scenario]]:
    """Of each compensator the names of its gains and the nominal scenario in as many lanes."""
    for compensator in dict.fromkeys(compensator for compensator, _ in laws.values()):
        own = {name: gains for name, (one, gains) in laws.items() if one == compensator}
        phase = np.full(len(own), mechanism.approach.phase)
        scenarios = build_scenarios(mechanism, {"approach.phase": phase}, seed)
        every = list(own.values())
        lanes: Any = {name: np.array([gains[name] for gains in every]) for name in every[0]}
        yield list(own), LoadedGains({}, compensator, lanes, mechanism), scenarios


def _runs(loaded: LoadedGains, scenarios: Scenario, names: list[str]) -> dict[str, list[Curve]]:
    """A lane for each of the names; the lanes differ by their gains alone."""
    _, recorded = record_lanes(loaded, scenarios)
    return {name: _split(lane, scenarios) for name, lane in zip(names, recorded, strict=True)}


def _pieces(mechanism: Mechanism, scenarios: Scenario, runs: dict[str, list[Curve]]) -> list[Piece]:
    leading = list(runs.values())[-1]
    clearance = float(scenarios.clearance[0])
    two = bool(np.isfinite(clearance))
    surfaces = (0.0, -clearance) if two else (0.0,)
    pieces = []
    for number, space in enumerate(_in_space(mechanism, scenarios, leading)):
        others = {name: run[number] for name, run in runs.items() if number < len(run)}
        name = f"{mechanism.approach.contacts} contacts" if two else f"contact {number + 1}"
        pieces.append(Piece(name, surfaces, {"in space": space, **others}))
    return pieces


def _split(lane: Lane, scenarios: Scenario) -> list[Curve]:
    """A lane's runs."""
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


def _in_space(mechanism: Mechanism, scenarios: Scenario, entered: list[Curve]) -> list[Curve]:
    """The reference's motion from each contact on, from 0.02 s before the touch to the end of that curve."""
    velocity = np.array([curve.velocity for curve in entered])
    step = (np.array([curve.time[-1] for curve in entered]) + APPROACH) / STEPS
    forces, positions = kept_programs.run(
        _integrate,
        contact_law(mechanism.contact.law).simulated,
        jax.tree.map(lambda leaf: leaf[..., 0], scenarios.contact),
        scenarios.clearance[0],
        scenarios.equivalent_mass[0],
        np.arange(len(entered)),
        velocity,
        step,
    )
    keep = slice(None, None, STEPS // POINTS)
    times = -APPROACH + step[:, None] * np.arange(STEPS)[None]
    motions = zip(times, np.asarray(forces), np.asarray(positions), strict=True)
    return [
        Curve(curve.velocity, time[keep], force[keep], position[keep], None, None)
        for curve, (time, force, position) in zip(entered, motions, strict=True)
    ]


def _integrate(
    law: ContactLaw,
    contacts: ContactParameters,
    clearance: Array,
    mass: Array,
    firsts: Int[Array, "runs"],
    velocities: Float[Array, "runs"],
    steps: Float[Array, "runs"],
) -> tuple[Float[Array, "runs steps"], Float[Array, "runs steps"]]:
    """Force [N] and position [m] of M x'' = -F by semi-implicit Euler, in steps too small to see.

    Runs begin with the contacts `firsts`. The next contact's parameters hold once a contact is left.
    """
    last = contacts.damping.shape[0] - 1

    def one(first, velocity, step):
        def advance(carry, _):
            position, speed, index, touched, state = carry
            parameters = jax.tree.map(lambda leaf: leaf[jnp.minimum(index, last)], contacts)
            force, state = two_sided(law, parameters, state, position, speed, clearance)
            touching = (position > 0) | (position < -clearance)
            index = jnp.where(touched & ~touching, index + 1, index)
            speed = speed - step * force / mass
            return (position + step * speed, speed, index, touching, state), (force, position)

        start = (-velocity * APPROACH, velocity, first, jnp.array(False), law.init(velocity))
        return lax.scan(advance, start, None, length=STEPS)[1]

    return jax.vmap(one)(firsts, velocities, steps)
