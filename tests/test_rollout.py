"""Rollout compared with the event-accurate oracle for all registered cases; independence of lanes.

Linear systems and samples of memoryless laws agree to rounding. Values between samples (peak, work, sensor
lag) agree within the errors stated below.
"""

from functools import partial

import cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import CASES, Case
from compiling import programs_of
from lanes import (
    MASS,
    PERIOD,
    QUICK,
    SECOND_ORDER,
    STIFFNESS,
    join,
    mechanism,
    nominal_gains,
    per_lane,
    run_record,
    validated,
)

from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop import build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import DIVERGED, NON_FINITE, NOT_REACHED, OK, TIMEOUT
from jaxhil.simulation.rollout import rollout, run_contacts, segment_length
from jaxhil.simulation.scenario import build_scenarios

# Restitution tolerance: the oracle uses parabolas for the output of a lagging sensor.
ACCURACY = {
    name: 1e-7 for name, case in CASES.items() if "time_constant" in case.mechanism["rig"]["force_sensor"]
}
# The oracle uses a cubic for the motion near the deepest point.
ACCURACY |= {name: 1e-7 for name in CASES if "elastoplastic" in name}
# The simulation does not divide sampling intervals at the corners of layers and at the end of a contact.
WORK_ACCURACY = {
    "layers": 1e-4,
    "damped layers": 1e-4,
    "rattling against layers": 1e-4,
    "rattling, the next touch at once": 3e-4,
}

# Each of these cases has its own program; their features have separate tests.
SELDOM = ("depth-damped", "layers", "damped layers")
SELDOM += ("transfer function with latency", "third order with latency", "position lead", "first order")
SELDOM += ("hardening", "damped hardening", "elastoplastic", "cut dead zone")
SELDOM += ("lag", "damped, lag", "stiff, damped, lag", "no lag beside")
SELDOM += ("rattling",)  # test_plant.py compares these cases with the oracle every day
slow_if_seldom = [
    pytest.param(name, marks=pytest.mark.slow if name.startswith(SELDOM) else ()) for name in CASES
]
every_case = pytest.mark.parametrize("name", slow_if_seldom)


def contact_pairs(name):
    """Return (contact of the simulation, contact of the oracle) for every contact of a case."""
    return zip(cases.loop_contacts(name), cases.oracle_contacts(name), strict=True)


@every_case
def test_rollout_motion_agrees_with_oracle_in_every_contact(name):
    accuracy = ACCURACY.get(name, 1e-11)
    for result, expected in contact_pairs(name):
        assert result["status"] == OK and expected["status"] == "over"
        assert result["restitution"] == pytest.approx(expected["restitution"], rel=0, abs=accuracy)
        assert result["approach_velocity"] == pytest.approx(
            expected["approach_velocity"], rel=min(accuracy, 1e-7)
        )
        assert result["peak_command"] == pytest.approx(expected["peak_command"], rel=accuracy)
        # The shortfall is exactly 0 if no limit is reached.
        shortfall = expected["position_shortfall"]
        assert result["position_shortfall"] == pytest.approx(shortfall, rel=1e-8, abs=0)
        assert shortfall == 0 or "velocity_limit" in CASES[name].mechanism["rig"]["simulator"]
        assert result["excess_variation"] == pytest.approx(
            expected["excess_variation"], rel=accuracy, abs=accuracy * expected["peak_command"]
        )


@pytest.mark.slow
def test_position_shortfall_is_zero_after_drives_have_caught_up():
    rattling, always = (
        [result["position_shortfall"] for result in cases.loop_contacts(name)]
        for name in ("rattling, faster than the drives at first", "velocity limit")
    )
    assert rattling[0] > 1e-6 and rattling[1:] == [0, 0] and min(always) > 1e-6


@every_case
def test_rollout_peak_force_agrees_with_oracle(name):
    # Dry friction changes sign at the deepest point, which lies between samples.
    accuracy = 1e-3 if "preload" in name else 1e-4
    for result, expected in contact_pairs(name):
        assert result["peak_force"] == pytest.approx(expected["peak_force"], rel=accuracy)


@every_case
def test_rollout_mechanical_work_agrees_with_oracle(name):
    for result, expected in contact_pairs(name):
        accuracy = expected["work_in"] * WORK_ACCURACY.get(name, 3e-5)
        if CASES[name].mechanism["rig"]["simulator"]["model"] == "ideal" and name not in WORK_ACCURACY:
            accuracy = 1e-12 * expected["work_in"]
        assert result["work_in"] == pytest.approx(expected["work_in"], rel=0, abs=accuracy)
        assert result["work_out"] == pytest.approx(expected["work_out"], rel=0, abs=accuracy)


@pytest.mark.parametrize(
    "name", [one for one in slow_if_seldom if "clearance" not in CASES[one.values[0]].mechanism["contact"]]
)
def test_rollout_first_contact_ends_at_same_tick_as_oracle(name):
    ticks, length = cases.loop_contacts(name)[0]["ticks"], segment_length(cases.batches()[name].loop)
    assert 0 < ticks - cases.oracle_contacts(name)[0]["end_tick"] <= length


@pytest.mark.slow
def test_rollout_with_sensor_lag_agrees_with_oracle_at_every_control_period():
    periods = (0.25e-3, 1e-3, 2e-3, 4e-3)
    lagged = {
        (ratio, period): Case(
            mechanism(
                {"stiffness": [3 * STIFFNESS], "damping": cases.damping(ratio, 3 * STIFFNESS)},
                period=period,
                **cases.LAGGED,
            ),
            "response_error",
        )
        for ratio in (0.0, 0.3)
        for period in periods
    }
    result = cases.build_batch(lagged).run().restitution[0]
    for (_, period), case, restitution in zip(lagged, lagged.values(), result, strict=True):
        (expected,) = cases.run_oracle(case)
        assert expected["status"] == "over"
        accuracy = 1e-7 if period <= 1e-3 else 3e-5
        assert restitution == pytest.approx(expected["restitution"], rel=0, abs=accuracy)


RECORDED = ("response error", "late position", "dead zone", "quantum", "range", "velocity limit")


@pytest.fixture(scope="module")
def recorded():
    batch = cases.batches()["response error"]
    metrics, ticks = run_record(batch.loop, batch.gains, batch.scenario, 256)
    return batch, jax.tree.map(np.asarray, metrics), jax.tree.map(np.asarray, ticks)


@pytest.mark.parametrize("name", RECORDED)
def test_rollout_agrees_with_oracle_at_every_tick_of_the_first_contact(recorded, name):
    batch, _, ticks = recorded
    lane = batch.names.index(name)
    expected = cases.run_oracle(CASES[name], contacts=1, record=True)[0]["signals"]
    count = int(np.sum(ticks.active[:, lane] & (ticks.contact[:, lane] == 0)))
    assert count >= 90
    for result, key, scale in (
        (ticks.signals.position_desired, "x_desired", 1e-4),
        (ticks.signals.velocity_desired, "v_desired", 1e-2),
        (ticks.signals.position_measured, "x_measured", 1e-4),
        (ticks.signals.force_measured, "force_measured", 50.0),
        (ticks.command, "force_command", 50.0),
    ):
        np.testing.assert_allclose(result[:count, lane], expected[key][:count], rtol=0, atol=1e-11 * scale)


def test_recorded_rollout_signals_agree_with_metrics(recorded):
    batch, metrics, ticks = recorded
    rolled = batch.run()
    # The recording ends before the later contacts do.
    reached = metrics.status == OK
    assert reached[0].all() and reached[1].any()
    for name, result in metrics._asdict().items():
        # The remainder of an excess is rounded like the excess.
        rounding = 1e-12 * np.max(metrics.peak_command[reached]) if name == "excess_variation" else 0
        np.testing.assert_allclose(
            result[reached], getattr(rolled, name)[reached], rtol=1e-12, atol=rounding, err_msg=name
        )
    for slot, lane in np.argwhere(reached):
        ticks_of_slot = np.flatnonzero(ticks.active[:, lane] & (ticks.contact[:, lane] == slot))
        # `active` ends with the tick at which the contact ends; that tick still belongs to it.
        ticks_of_slot = np.append(ticks_of_slot, ticks_of_slot[-1] + 1)
        velocity = ticks.signals.velocity_desired[ticks_of_slot, lane]
        force, works = (
            ticks.plant_signals.force[ticks_of_slot, lane],
            [w[ticks_of_slot, lane] for w in ticks.plant_signals.work],
        )
        assert np.array_equal(ticks_of_slot, np.arange(ticks_of_slot[0], ticks_of_slot[-1] + 1))
        assert (
            ticks.signals.age[ticks_of_slot[0], lane] == 0
            and velocity[0] == metrics.approach_velocity[slot, lane]
        )
        assert abs(velocity[-1]) / velocity[0] == pytest.approx(metrics.restitution[slot, lane], rel=1e-12)
        assert np.abs(ticks.command[ticks_of_slot, lane]).max() == metrics.peak_command[slot, lane]
        # The vertex between samples is barely higher than the highest sample.
        peak = metrics.peak_force[slot, lane]
        assert np.abs(force).max() <= peak <= 1.002 * np.abs(force).max()
        assert np.sum(force != 0) * PERIOD == pytest.approx(metrics.duration[slot, lane], rel=1e-12)
        assert np.sum(works[0]) == pytest.approx(metrics.work_in[slot, lane], rel=1e-12)
        assert np.sum(works[1]) == pytest.approx(metrics.work_out[slot, lane], rel=1e-12)
        assert velocity[-1] < 0 and force[-1] == 0


STICKY = mechanism(
    {"damping": [2.4 * (STIFFNESS * MASS) ** 0.5], "tension": True},
    {**SECOND_ORDER, "natural_frequency": 100.0, "delay": 0.0},
    0.0,
)
LANES = {
    "plain": Case(mechanism({"damping": [300.0]}), "phase_lead"),
    "sticks": Case(STICKY, "phase_lead", {"phase_lead": 0.0}),
    "runs away": Case(mechanism({}), "phase_lead", {"phase_lead": 1e3}),
    "not finite": Case(mechanism({}), "phase_lead", {"phase_lead": float("nan")}),
    "padding": Case(mechanism({}), "phase_lead"),
}


@pytest.fixture(scope="module")
def mixed_batch():
    """Return a batch of the lanes above, the function that runs it, and its metrics."""

    def run_mixed(*arguments):
        return rollout(*arguments)

    batch = cases.build_batch(LANES)
    contacts = jnp.array([0 if name == "padding" else 1 for name in batch.names], jnp.int32)
    batch = batch._replace(scenario=batch.scenario._replace(contacts=contacts))
    run = jax.jit(run_mixed, static_argnums=0, compiler_options=QUICK)
    return batch, run, jax.tree.map(np.asarray, run(batch.loop, batch.gains, batch.scenario))


def test_rollout_reports_a_contact_status_for_every_scenario(mixed_batch):
    batch, _, metrics = mixed_batch
    assert dict(zip(batch.names, metrics.status[0].tolist(), strict=True)) == {
        "plain": OK,
        "sticks": TIMEOUT,
        "runs away": DIVERGED,
        "not finite": NON_FINITE,
        "padding": NOT_REACHED,
    }
    assert np.all(metrics.status[1:] == NOT_REACHED)
    # A contact may last 10 s, and a run ends at most one segment later.
    sticks = batch.names.index("sticks")
    assert 0 <= metrics.ticks[0, sticks] * PERIOD - 10.0 < 0.2
    assert metrics.restitution[0, batch.names.index("runs away")] > 1e3
    assert metrics.restitution[0, 0] == pytest.approx(
        cases.run_oracle(LANES["plain"])[0]["restitution"], abs=1e-11
    )


@pytest.mark.parametrize("name", ["varying", "rattling"])
def test_unused_position_reading_does_not_change_rollout(name):
    drawn = load(name).mechanism
    scenario = build_scenarios(drawn, draw(drawn, 5, 1))
    loop = build_loop(drawn, "none", scenario)

    @partial(jax.jit, static_argnums=0, compiler_options=QUICK)
    def run(measured, scenario):
        return run_contacts(loop, {}, build_rig_constants(loop, scenario, measured))

    metrics = run(False, scenario)
    assert np.all(metrics.status[: scenario.contacts[0]] == OK)
    jax.tree.map(np.testing.assert_array_equal, metrics, run(True, scenario))


def test_padding_elements_of_a_batch_do_not_affect_other_elements(mixed_batch):
    batch, run, metrics = mixed_batch
    lane = batch.names.index("padding")
    for name, values in metrics._asdict().items():
        if name == "status":
            continue
        # These fields are 0: no shortfall, no probe, no delay estimate.
        nothing = "ticks", "position_shortfall", "trajectory_error", "force_delay"
        expected = 0 if name in nothing else np.nan
        np.testing.assert_array_equal(values[:, lane], expected, err_msg=name)
    # With only padding lanes the loop runs no tick.
    idle = batch.scenario._replace(contacts=jnp.zeros_like(batch.scenario.contacts))
    assert np.all(np.asarray(run(batch.loop, batch.gains, idle).status) == NOT_REACHED)
    # The first lane is the same, bit for bit, when all others are padding.
    alone = batch.scenario._replace(contacts=jnp.array([1, 0, 0, 0, 0], jnp.int32))
    for result, expected in zip(run(batch.loop, batch.gains, alone), metrics, strict=True):
        np.testing.assert_array_equal(np.asarray(result)[:, 0], expected[:, 0])


def test_rollouts_of_similar_mechanisms_share_a_compiled_program(mixed_batch):
    batch, run, _ = mixed_batch
    other = validated(
        mechanism(
            {"stiffness": [2e5, 1e5], "damping": [100.0]},
            {"model": "second_order", "natural_frequency": 17.0, "damping_ratio": 0.9, "delay": 0.0031},
            0.0052,
            2,
            velocity=0.007,
        )
    )
    draws = {"contact.stiffness": np.outer(np.linspace(0.5, 1.5, 5), [2e5, 1e5])}
    for seed in (0, 1):
        scenario = join([build_scenarios(other, draws, seed=seed)])
        # Delay lines have lengths of powers of two; the delays of all lanes must fit.
        loop = build_loop(other, "phase_lead", scenario, energies=True, chatter=True)
        assert (loop.ring, loop.controller_ring) == (batch.loop.ring, batch.loop.controller_ring)
        result = run(batch.loop, per_lane(nominal_gains(other, "phase_lead"), 5), scenario)
        assert np.all(np.asarray(result.status)[:2] == OK)
    assert programs_of("run_mixed") == 1
