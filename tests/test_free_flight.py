"""Skipped approaches compared with approaches simulated tick by tick."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from lanes import (
    STIFFNESS,
    as_arrays,
    mechanism,
    nominal_gains,
    run_record,
    run_rollout,
    validated,
)

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.none.simulation import NoCompensator
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.rollout import segment_length
from jaxhil.simulation.scenario import build_scenarios

LANES, TICKS = 5, 1200
WAITING = sorted(name for name, law in COMPENSATORS.items() if vars(type(law)).get("waits_for_contact"))
EVERYDAY = "none", "response_error"  # each compensator needs two compiled programs


def case(law, mechanism="varying", overrides=()):
    drawn = load(mechanism, overrides).mechanism
    scenarios = build_scenarios(drawn, draw(drawn, LANES, 1))
    return build_loop(drawn, law, scenarios), as_arrays(nominal_gains(drawn, law)), scenarios


@pytest.mark.parametrize(
    "law", [pytest.param(law, marks=() if law in EVERYDAY else pytest.mark.slow) for law in WAITING]
)
def test_skipping_the_approach_changes_no_metric(law):
    loop, gains, scenarios = case(law)
    assert loop.is_idle_in_flight
    result = run_rollout(loop, gains, scenarios)
    flown, seen = run_record(loop, gains, scenarios, TICKS)
    assert not np.any(seen.active[-1])
    for name in set(result._fields) - {"ticks"}:
        np.testing.assert_allclose(getattr(result, name), getattr(flown, name), rtol=1e-9, err_msg=name)
    # Metrics are recorded at the end of a segment, which falls on other ticks.
    later = np.asarray(result.ticks) - np.asarray(flown.ticks)
    assert np.all(np.abs(later) < segment_length(loop) * scenarios.contacts)


@pytest.mark.slow
def test_flight_between_two_surfaces_with_moving_average_is_skipped_and_changes_no_metric():
    simulator = {"model": "moving_average", "window": 0.0344}
    rattling = {"stiffness": [STIFFNESS], "clearance": 0.0075}
    drawn = validated(mechanism(rattling, simulator, 0.003, 2, velocity=0.01))
    scenarios = build_scenarios(drawn)
    loop, gains = build_loop(drawn, "none", scenarios), {}
    result = run_rollout(loop, gains, scenarios)
    flown, _ = run_record(loop, gains, scenarios, TICKS)
    np.testing.assert_allclose(result.restitution, flown.restitution, rtol=1e-9)
    np.testing.assert_allclose(result.peak_force, flown.peak_force, rtol=1e-9)
    assert np.max(flown.ticks) - np.max(result.ticks) > 100


@pytest.mark.parametrize(
    "overrides",
    [
        ["rig.force_sensor.noise_std=0.1"],
        ["rig.position_sensor.noise_std=1e-6"],
        ["rig.position_sensor.quantum=1e-6"],
        ["rig.simulator.velocity_limit=0.5"],
    ],
)
def test_approach_with_noise_or_limits_is_simulated_and_not_skipped(overrides):
    loop, _, _ = case("none", overrides=overrides)
    assert not loop.is_idle_in_flight


class Early(NoCompensator):
    """Compensator that acts on the numerical model's position before contact."""

    name: ClassVar[str] = "early"

    def step(self, prepared, state, signals, tick):
        return signals.force_measured + jnp.maximum(signals.position_desired, 0), state


def test_approach_is_not_skipped_for_compensators_active_before_contact():
    """Include a compensator that wraps an ordinary one."""
    loop, _, _ = case("virtual_contact")
    assert not loop.is_idle_in_flight
    waiting, _, _ = case("none")
    assert not Loop(**{**vars(waiting), "compensator": Early()}).is_idle_in_flight
