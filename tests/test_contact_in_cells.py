"""Contact force between samples: sensor lags, derivatives, and subdivision of the control period."""

import dataclasses

import jax
import numpy as np
import pytest
from lanes import QUICK, join, mechanism, run_rollout, spread, validated
from oracle import simulate

from jaxhil.simulation.cells import (
    MAX_POLE,
    NO_CELLS,
    CellCounts,
    count_cells,
    fastest_pole,
    merge_cell_counts,
)
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import build_scenarios

PERIOD = 4e-3


def fast_mechanism(simulator, time_constant=2e-3, **contact):
    """Return a mechanism at a control period of 4 ms with held command and fast motion simulator."""
    sensor = {"time_constant": time_constant}
    return mechanism(
        {"law": "linear", "stiffness": [124e3], **contact},
        simulator,
        0.0,
        period=PERIOD,
        command_hold="zoh",
        force_sensor=sensor,
    )


def second_order(frequency):
    return {"model": "second_order", "natural_frequency": frequency, "damping_ratio": 0.8}


@pytest.mark.slow
def test_restitution_with_sensor_lag_converges_for_increasingly_fast_simulator():
    cases = [fast_mechanism(second_order(frequency)) for frequency in (300.0, 600.0, 1200.0)]
    parsed = [validated(case) for case in cases]
    scenarios = join(build_scenarios(member) for member in parsed)
    metrics = run_rollout(build_loop(parsed[0], "none", scenarios), {}, scenarios)
    ideal = validated(fast_mechanism({"model": "ideal"}))
    scenario = join([build_scenarios(ideal)])
    limit = run_rollout(build_loop(ideal, "none", scenario), {}, scenario)
    assert np.all(np.asarray(metrics.status)[0] == OK) and np.asarray(limit.status)[0, 0] == OK
    off = np.asarray(metrics.restitution)[0] - np.asarray(limit.restitution)[0, 0]
    np.testing.assert_allclose(off[1:] / off[:-1], 0.5, atol=0.1)
    assert np.asarray(metrics.restitution)[0, 0] == pytest.approx(
        simulate(cases[0])[0]["restitution"], abs=1e-11
    )


@pytest.mark.slow
def test_derivatives_of_contact_with_sensor_lag_match_finite_differences():
    parsed = validated(fast_mechanism(second_order(60.0), law="kelvin_voigt", damping=[300.0]))
    loop = build_loop(parsed, "none", join([build_scenarios(parsed)]), energies=True)
    scenario = jax.tree.map(jax.numpy.asarray, join([build_scenarios(parsed)]))

    def figures(change):
        contact = scenario.contact._replace(stiffness=scenario.contact.stiffness * (1 + change))
        lag = scenario.force_sensor.time_constant * (1 - change / 2)
        sensor = scenario.force_sensor._replace(time_constant=lag)
        result = rollout(loop, {}, scenario._replace(contact=contact, force_sensor=sensor))
        figures = result.restitution, result.peak_force, result.work_in, result.duration
        return jax.numpy.stack([figure[0, 0] for figure in figures])

    point, step = np.array(0.0), 1e-5
    both = jax.jit(lambda at: jax.jvp(figures, (at,), (jax.numpy.ones_like(at),)), compiler_options=QUICK)
    (_, exact), (ahead, _), (behind, _) = (both(point + move) for move in (0.0, step, -step))
    np.testing.assert_allclose(exact, (ahead - behind) / (2 * step), rtol=1e-5)


def loops_of(raw):
    """Return scenarios at eight phases of a tick, and the loops with sampled and with exact contacts."""
    parsed = validated(raw)
    scenarios = spread(parsed, 8, phase=np.arange(8) / 8)
    return scenarios, *(build_loop(parsed, "none", scenarios, exact=exact) for exact in (False, True))


LAYERED = {"law": "piecewise_linear", "stiffness": [[8e4, 9e4, 7e4]], "depths": [1e-5, 2e-5]}
RIGID = {"law": "piecewise_linear", "stiffness": [[8e4, 1e7, 7e4]], "depths": [1e-5, 2e-5]}


@pytest.mark.parametrize(
    ("contact", "frequency", "lag", "cells"),
    [
        ({"law": "linear", "stiffness": [1e6]}, 150.0, 0.0, False),
        ({"law": "linear", "stiffness": [1e6]}, 180.0, 0.0, True),
        ({"law": "linear", "stiffness": [1e7]}, 12.0, 0.0, True),
        ({"law": "linear", "stiffness": [8e5]}, 20.0, 1e-4, False),
        ({"law": "linear", "stiffness": [8e5]}, 30.0, 1e-4, True),
        (LAYERED, 20.0, 0.0, False),
        (RIGID, 20.0, 0.0, True),
        (LAYERED, 20.0, 1e-4, True),
        ({"law": "preloaded", "preload": 3.0, "friction": 2.0}, 20.0, 1e-4, True),
    ],
)
def test_slow_mechanisms_need_no_subdivision_of_control_period(contact, frequency, lag, cells):
    sensor = {"time_constant": lag}
    raw = mechanism(contact, second_order(frequency), period=1e-3, force_sensor=sensor)
    _, sampled, exact = loops_of(raw)
    assert exact.has_cells and sampled.has_cells == cells and (sampled.cells != NO_CELLS) == cells


DAMPED = {"stiffness": [1e5], "damping": [6e3]}
RUBBING = {"law": "preloaded", "stiffness": [8e5], "preload": 3.0, "friction": 2.0}


@pytest.mark.parametrize(
    ("contact", "frequency", "lag", "hold"),
    [
        pytest.param(DAMPED, 155.0, 0.0, "zoh", marks=pytest.mark.slow),
        (DAMPED, 23.0, 2e-4, "zoh"),
        *(
            pytest.param(*case, hold, marks=pytest.mark.slow)
            for hold in ("zoh", "linear")
            for case in (
                ({"stiffness": [1e6], "damping": [700.0]}, 155.0, 0.0),
                (RUBBING, 155.0, 0.0),
                ({"law": "hunt_crossley", "stiffness": [3e7], "damping": [1.0]}, 23.0, 5e-5),
                ({"law": "elastoplastic", "stiffness": [3e5], "unloading_ratio": 1.5}, 23.0, 5e-5),
            )
        ),
    ],
)
def test_sampled_contact_of_slow_mechanism_agrees_with_exact_motion(contact, frequency, lag, hold):
    sensor = {"time_constant": lag}
    raw = mechanism(contact, second_order(frequency), period=1e-3, command_hold=hold, force_sensor=sensor)
    scenarios, *loops = loops_of(raw)
    assert [loop.has_cells for loop in loops] == [False, True]
    sampled, exact = (run_rollout(loop, {}, scenarios) for loop in loops)
    bound = 1e-5 if lag else 1e-12
    np.testing.assert_allclose(sampled.restitution[0], exact.restitution[0], rtol=0, atol=bound)
    np.testing.assert_allclose(sampled.peak_force[0], exact.peak_force[0], rtol=2e-3)
    # Onset and release lie between samples, and a damper releases between steps of a held command.
    np.testing.assert_allclose(sampled.duration[0], exact.duration[0], rtol=0, atol=4e-3)


@pytest.mark.parametrize("fastest", [0.0, 0.1, 0.9, 5.0, MAX_POLE])
@pytest.mark.parametrize("lag", [0.0, 1e-9, 0.01, 0.3, 5.0])
def test_subdivisions_of_control_period_are_at_most_one_radian_and_one_time_constant(fastest, lag):
    counts = count_cells(fastest, np.array([lag]))
    window = min(1.0, 40 * lag) if counts.plain else 1.0
    if counts.plain:
        assert fastest / counts.plain <= 1.01
    if lag > 0:
        assert window / counts.window <= 1.01 * min(lag, 1 / max(fastest, 1e-9))
    assert counts.degree == (1 if fastest == 0 else 8 if fastest <= 0.12 else 16)


def test_merged_subdivision_counts_suffice_for_every_mechanism():
    whole, windowed, plain = CellCounts(0, 16, 16), CellCounts(2, 64, 8), CellCounts(4, 0, 8)
    assert merge_cell_counts([NO_CELLS, NO_CELLS]) == NO_CELLS
    assert merge_cell_counts([NO_CELLS, plain]) == plain
    assert merge_cell_counts([whole, CellCounts(0, 4, 8)]) == whole
    assert merge_cell_counts([whole, plain]) == CellCounts(16, 64, 16)
    assert merge_cell_counts([windowed, plain]) == CellCounts(4, 64, 8)


def test_fastest_simulator_pole_is_correct_for_every_order():
    rng = np.random.default_rng(1)
    for order in range(1, 7):
        roots = -rng.uniform(1.0, 300.0, order)
        denominator = 3.0 * np.poly(roots)[:, None]
        np.testing.assert_allclose(fastest_pole(denominator), np.max(-roots), rtol=1e-9)
    pair = np.array([[1.0], [2 * 0.3 * 50.0], [50.0**2]])
    np.testing.assert_allclose(fastest_pole(pair), 50.0, rtol=1e-12)


def test_exact_simulation_differs_from_sampled_simulation_only_in_subdivision():
    parsed = validated(mechanism({}, second_order(12.0), period=1e-3))
    scenarios = join([build_scenarios(parsed)])
    plain = build_loop(parsed, "none", scenarios)
    exact = build_loop(parsed, "none", scenarios, exact=True)
    assert dataclasses.replace(exact, cells=plain.cells) == plain
