"""Position shortfall caused by limits of the motion simulator: 0 without limits, else as in the oracle."""

import dataclasses
import functools

import cases
import jax
import numpy as np
import oracle
import pytest
from cases import Case
from lanes import SECOND_ORDER, VELOCITY, mechanism, run_rollout

from jaxhil.laws.none.simulation import NoCompensator
from jaxhil.simulation.loop import build_rig_constants
from jaxhil.simulation.metrics import NOT_REACHED, OK
from jaxhil.simulation.rollout import start_rollout

LATE = 0.011  # s of force delay: uncompensated, a contact ends faster than it begins
LIMITS = {  # speed [m/s], and whether the limit is reached
    "none": (np.inf, False),
    "far above": (100 * VELOCITY, False),
    "above the rebounds": (7 * VELOCITY, False),
    "below the rebounds": (1.1 * VELOCITY, True),
    "the approach": (VELOCITY, True),
}


class Leading(NoCompensator):
    """Compensator that commands the future position of the model."""

    lead: float

    def position_command(self, gains, state, position, velocity, acceleration):
        return position + self.lead * velocity, state


class LeadingOracle(oracle.NoCompensator):
    """Version of the same compensator for the oracle."""

    def __init__(self, lead):
        self.lead = lead

    def position_command(self, position, velocity, acceleration):
        return position + self.lead * velocity


def limited(limit, damping, force_delay=LATE):
    """Return two contacts under a velocity limit [m/s]; the drives cannot follow the rebound of one."""
    simulator = SECOND_ORDER | ({"velocity_limit": limit} if np.isfinite(limit) else {})
    contacts = 2 if limit > 1.5 * VELOCITY or damping > 1e3 else 1
    return Case(mechanism({"damping": [damping]}, simulator, force_delay, contacts=contacts))


CONTACTS = {name: limited(limit, 300.0) for name, (limit, _) in LIMITS.items()}
# Starts exactly at the speed limit and then slows down.
CONTACTS["just reached"] = limited(VELOCITY, 6000.0, 0.0)
BINDING = [name for name, (_, binds) in LIMITS.items() if binds]


def single(scenario):
    def cast(leaf):
        return np.asarray(leaf, np.float32) if leaf.dtype == np.float64 else leaf

    return jax.tree.map(cast, scenario)


@functools.cache
def oracle_shortfalls(name):
    return [contact["position_shortfall"] for contact in cases.run_oracle(CONTACTS[name])]


@pytest.fixture(scope="module")
def batch():
    return cases.build_batch(CONTACTS)


@pytest.fixture(scope="module", params=["float64", "float32"])
def shortfalls_found(request, batch):
    """Return the position shortfalls [m] of every contact by the case's name."""
    scenario = batch.scenario if request.param == "float64" else single(batch.scenario)
    metrics = batch._replace(scenario=scenario).run()
    assert metrics.position_shortfall.dtype == request.param
    result = {}
    for lane, name in enumerate(batch.names):
        contacts = scenario.contacts[lane]
        assert np.all(metrics.status[:contacts, lane] == OK)
        result[name] = metrics.position_shortfall[:contacts, lane]
    return result


def test_position_shortfall_is_exactly_zero_if_no_limit_is_reached(shortfalls_found):
    assert {name for name, shortfalls in shortfalls_found.items() if np.all(shortfalls > 0)} == set(BINDING)
    for name in set(shortfalls_found) - set(BINDING):
        np.testing.assert_array_equal(shortfalls_found[name], 0, err_msg=name)


@pytest.mark.parametrize("name", BINDING)
def test_position_shortfall_agrees_with_oracle(shortfalls_found, name):
    expected = oracle_shortfalls(name)
    assert min(expected) > 1e-6
    accuracy = 1e-10 if shortfalls_found[name].dtype == "float64" else 1e-3
    np.testing.assert_allclose(shortfalls_found[name], expected, rtol=accuracy)


def test_run_ends_if_drives_cannot_follow_the_rebound():
    simulator = SECOND_ORDER | {"velocity_limit": 1.1 * VELOCITY}
    case = Case(mechanism({"damping": [300.0]}, simulator, LATE, contacts=3))
    metrics = cases.build_batch({"": case}).run()
    assert metrics.restitution[0, 0] > 1.1
    assert metrics.status[:3, 0].tolist() == [OK, NOT_REACHED, NOT_REACHED]


def test_position_shortfall_broadcasts_over_trailing_axes(batch):
    def fold(leaf):
        wide = np.concatenate([leaf, np.asarray(leaf)[..., :2]], axis=-1)
        return wide.reshape(*leaf.shape[:-1], 2, 4)

    scenario = jax.tree.map(fold, batch.scenario)
    result = np.asarray(run_rollout(batch.loop, {}, scenario).position_shortfall)[:2].reshape(2, 8)
    np.testing.assert_allclose(result[:, :6], batch.run().position_shortfall[:2], rtol=1e-12)


def test_position_shortfall_with_position_lead_refers_to_sent_command():
    lead = 0.008
    laned = {times: limited(times * VELOCITY, 300.0) for times in (1.05, 20.0)}
    leading = cases.build_batch(laned)
    loop = dataclasses.replace(leading.loop, compensator=Leading(lead))
    metrics = jax.tree.map(np.asarray, run_rollout(loop, {}, leading.scenario))
    for lane, (times, case) in enumerate(laned.items()):
        for number, expected in enumerate(oracle.simulate(case.mechanism, LeadingOracle(lead))):
            shortfall = expected["position_shortfall"]
            assert (shortfall > 0) == (times < 20)
            assert metrics.restitution[number, lane] == pytest.approx(expected["restitution"], abs=1e-11)
            assert metrics.position_shortfall[number, lane] == pytest.approx(shortfall, rel=1e-9, abs=0)


def test_loop_without_motion_limits_has_no_shortfall_state(batch):
    free = cases.build_batch({"": CONTACTS["none"]})
    assert batch.loop.has_limits and not free.loop.has_limits
    for one in (batch, free):
        rig = jax.eval_shape(functools.partial(build_rig_constants, one.loop), one.scenario)
        run = jax.eval_shape(functools.partial(start_rollout, one.loop), rig, one.gains)
        state = run.tracker.shortfall, run.state.plant.unlimited_command
        assert [leaf is not None for leaf in state] == [one.loop.has_limits] * 2
