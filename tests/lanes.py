"""Mechanisms, gains and scenarios for tests: many lanes with separate values in one program.

Arrays are NumPy arrays: each JAX array operation would be a small program to compile.
"""

import copy
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
from compiling import QUICK

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Gains
from jaxhil.mechanism.file import from_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.loop import Loop, build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK, Metrics
from jaxhil.simulation.rollout import begin_next_contacts, rollout, run_segment, segment_length, start_rollout
from jaxhil.simulation.scenario import Scenario, build_scenarios
from jaxhil.simulation.tick import Tick

PERIOD = 2e-3  # coarse, so that discretisation errors are visible and the oracle is fast
MASS, VELOCITY, STIFFNESS = 350.0, 0.005, 124355.0
IDEAL = {"model": "ideal"}
SECOND_ORDER = {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8, "delay": 0.0037}

run_rollout = jax.jit(rollout, static_argnums=0, compiler_options=QUICK)


@partial(jax.jit, static_argnums=(0, 3), compiler_options=QUICK)
def run_record(loop: Loop, gains: Gains, scenario: Scenario, ticks: int) -> tuple[Metrics, Tick]:
    """Return metrics and every tick, (ticks, *batch), for at least this many ticks.

    The number of ticks is rounded up to whole segments; free flight is not skipped.
    """
    rig = build_rig_constants(loop, scenario)

    def body(run, _):
        run, seen = run_segment(loop, rig, gains, run, record=True)
        return begin_next_contacts(loop, rig, gains, run, skip_flight=False), seen

    stretches = -(-ticks // segment_length(loop))
    run, seen = jax.lax.scan(body, start_rollout(loop, rig, gains, skip_flight=False), None, length=stretches)
    return run.metrics, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), seen)


def mechanism(
    contact: Mapping[str, Any],
    simulator: Mapping[str, Any] = SECOND_ORDER,
    force_delay: float = 0.0041,
    contacts: int = 1,
    *,
    period: float = PERIOD,
    velocity: float = VELOCITY,
    phase: float = 1 / 3,
    force_sensor: Mapping[str, Any] | None = None,
    **rig: Any,
) -> dict[str, Any]:
    """Return a mechanism file as plain data: 350 kg at 5 mm/s, Kelvin-Voigt contact by default."""
    return {
        "schema": "jaxhil/mechanism/1",
        "name": "case",
        "bodies": {"equivalent_mass": MASS},
        "approach": {"velocity": velocity, "contacts": contacts, "phase": phase},
        "contact": {"law": "kelvin_voigt", "stiffness": [STIFFNESS], **contact},
        "rig": {
            "control_period": period,
            "simulator": dict(simulator),
            "force_sensor": {"delay": force_delay, **(force_sensor or {})},
            **rig,
        },
    }


def validated(raw: Mapping[str, Any]) -> Mechanism:
    """Return the validated mechanism."""
    return from_plain_data(copy.deepcopy(dict(raw)), "case")


def nominal_gains(mechanism: Mechanism, compensator: str, **values: float) -> dict[str, float]:
    """Return the literature's gains for this mechanism, some replaced."""
    gains = {gain.name: float(gain.nominal(mechanism)) for gain in COMPENSATORS[compensator].gains}
    assert set(values) <= set(gains)
    return gains | values


def as_arrays(gains: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return gains as float64 arrays."""
    return {name: np.asarray(value, float) for name, value in gains.items()}


def join(scenarios: Iterable[Scenario]) -> Scenario:
    """Join scenarios of the same form as lanes of one batch."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *scenarios)


def spread(parsed: Mechanism, lanes: int, **leaves: Any) -> Scenario:
    """Return `lanes` copies of the nominal scenario with some arrays replaced, by field name of `Scenario`.

    A compound name such as contact__damping is a field of a part. Values are broadcast over lanes and
    successive contacts.
    """
    scenario = jax.tree.map(lambda leaf: np.repeat(leaf, lanes, axis=-1), build_scenarios(parsed))
    for name, value in leaves.items():
        part, _, leaf = name.rpartition("__")
        owner = getattr(scenario, part) if part else scenario
        old = getattr(owner, leaf)
        value = np.asarray(value, old.dtype)
        if leaf not in ("numerator", "denominator"):
            value = np.broadcast_to(value, old.shape)
        owner = owner._replace(**{leaf: value})
        scenario = scenario._replace(**{part: owner}) if part else owner
    return scenario


def grid(*axes: Any) -> list[np.ndarray]:
    """Return every combination of the axes' values, flattened: one array per axis."""
    return [axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]


def per_lane(gains: Mapping[str, Any], lanes: int) -> dict[str, np.ndarray]:
    """Return gains, given as scalars or per lane, as arrays over the lanes."""
    return {name: np.full(lanes, value, float) for name, value in gains.items()}


def first_contact(
    parsed: Mechanism,
    scenario: Scenario,
    compensator: str = "none",
    gains: Mapping[str, Any] | None = None,
    energies: bool = False,
    chatter: bool = False,
) -> dict[str, np.ndarray]:
    """Return metrics of every lane's first contact; fail if a contact has not ended."""
    loop = build_loop(parsed, compensator, scenario, energies, chatter)
    metrics = run_rollout(loop, per_lane(gains or {}, scenario.velocity.shape[0]), scenario)
    assert np.all(np.asarray(metrics.status)[0] == OK)
    return {name: np.asarray(value)[0] for name, value in metrics._asdict().items()}
