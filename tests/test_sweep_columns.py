"""Rows of a sweep: columns of good and of failed runs."""

import numpy as np
import pytest
from sweep_cases import case

from jaxhil.mechanism.file import load
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.metrics import DIVERGED, NON_FINITE, NOT_REACHED, OK, TIMEOUT, Metrics
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.scenario import build_scenarios
from tuning.sweeps.columns import (
    CONTACT_STATUSES,
    SCENARIO_OUTCOMES,
    build_rows,
    classify_outcomes,
    find_key_unit,
    list_error_columns,
    list_sweep_columns,
)

LIMIT = 0.01
NAN = np.nan


def rows(errors, status, peak_force=10.0, force_range=np.inf, shortfall=0.0, ideal=(10.0, 1.0)):
    """Return rows of a sweep of two contacts; errors and status are (2, lanes).

    `ideal` holds peak force [N] and duration [s] of the ideal contact; the real contact has `peak_force` and
    a duration of 1 s.
    """
    parsed = check_document(case(2, force_sensor={"range": 1e6})).mechanism
    errors, status = np.array(errors, float), np.array(status, np.int32)
    lanes = errors.shape[1]
    pad = np.zeros((2, lanes))
    error = np.concatenate([errors, pad])
    status = np.concatenate([status, pad.astype(np.int32) + NOT_REACHED])
    draws = {"approach.phase": np.zeros((lanes, 2))}
    scenarios = build_scenarios(parsed, draws)
    sensor = scenarios.force_sensor._replace(range=np.full(lanes, force_range))
    scenarios = scenarios._replace(force_sensor=sensor)
    like = np.ones_like(error)
    metrics = Metrics(
        restitution=0.9 + error,
        approach_velocity=2 * like,
        peak_force=peak_force * like,
        position_shortfall=shortfall * like,
        **dict.fromkeys(
            ("peak_command", "excess_variation", "duration", "work_in", "work_out", "trajectory_error"), like
        ),
        force_delay=0 * like,
        status=status,
        ticks=status,
    )
    outcome = Outcome(
        metrics,
        0.9 * like,
        ideal[0] * like,
        ideal[1] * like,
        error,
        like,
        like,
        status == OK,
        status == OK,
        status != status,
    )
    return build_rows(parsed, 7, draws, scenarios, outcome, LIMIT, False)


def outcomes(rows_of_sweep):
    return [SCENARIO_OUTCOMES[index] for index in rows_of_sweep["outcome"]]


def test_scenario_outcome_depends_on_error_of_largest_magnitude():
    result = rows([[0.005, 0.002, -0.03], [-0.009, 0.02, 0.02]], [[OK] * 3, [OK] * 3])
    np.testing.assert_array_equal(result["worst_error"], [-0.009, 0.02, -0.03])
    assert outcomes(result) == ["good", "error beyond limit", "error beyond limit"]
    np.testing.assert_array_equal(result["failed"], [False, True, True])
    np.testing.assert_array_equal(result["index"], [7, 8, 9])


def test_failed_run_is_stored_as_row_with_cause_of_failure():
    errors = [[NAN, 0.5, 0.0, 0.0], [0.0, 0.0, NAN, 0.0]]
    status = [[NON_FINITE, DIVERGED, OK, OK], [NOT_REACHED, NOT_REACHED, TIMEOUT, NOT_REACHED]]
    result = rows(errors, status)
    assert outcomes(result) == ["non-finite", "diverged", "timeout", "not reached"]
    assert result["failed"].all()
    np.testing.assert_array_equal(result["worst_error"], [NAN, NAN, 0.0, 0.0])
    assert [CONTACT_STATUSES[index] for index in result["status_2"]] == ["not reached"] * 2 + [
        "timeout",
        "not reached",
    ]
    # A contact that did not end keeps known values; values that require its end are missing.
    np.testing.assert_array_equal(np.isnan(result["restitution_1"]), [True, True, False, False])
    assert np.isfinite(result["peak_force_1"]).all()
    np.testing.assert_array_equal(np.isnan(result["peak_force_2"]), [True, True, False, True])


def test_force_beyond_the_sensor_range_counts_as_saturation():
    assert outcomes(rows([[0.0], [0.0]], [[OK], [OK]], 10.0, 9.0)) == ["saturated"]
    assert outcomes(rows([[0.0], [0.0]], [[OK], [OK]], 10.0, 11.0)) == ["good"]


def test_reached_limit_of_the_motion_simulator_counts_as_saturation():
    errors, status = [[0.0, 0.5, 0.0], [0.0, 0.0, NAN]], [[OK] * 3, [OK, OK, TIMEOUT]]
    result = rows(errors, status, shortfall=1e-9)
    # Saturation ranks above an error and below a contact that does not end.
    assert outcomes(result) == ["saturated", "saturated", "timeout"] and result["failed"].all()
    np.testing.assert_array_equal(result["position_shortfall_2"], 1e-9)
    assert outcomes(rows(errors, status)) == ["good", "error beyond limit", "timeout"]


@pytest.mark.parametrize(
    ("ideal", "outcome"),
    [
        ((5.0, 1.0), "good"),
        ((4.99, 1.0), "unlike the ideal contact"),
        ((100.0, 1.0), "good"),  # softer than the ideal contact
        ((10.0, 0.4981), "good"),  # durations are counted in two control periods of 2 ms
        ((10.0, 0.4979), "unlike the ideal contact"),
        ((10.0, 2.0079), "good"),
        ((10.0, 2.0081), "unlike the ideal contact"),
        ((10.0, np.inf), "good"),  # bodies that stick have no duration to compare with
    ],
)
def test_contact_that_differs_too_much_from_ideal_contact_counts_as_failure(ideal, outcome):
    result = rows([[0.0], [0.0]], [[OK], [OK]], ideal=ideal)
    assert outcomes(result) == [outcome] and result["failed"][0] == (outcome != "good")
    np.testing.assert_array_equal(result["reference_peak_force_2"], ideal[0])
    np.testing.assert_array_equal(result["reference_duration_1"], ideal[1])


def test_outcome_unlike_ideal_contact_ranks_between_error_and_saturation():
    errors, status = [[0.5, 0.5], [0.0, 0.0]], [[OK, OK], [OK, OK]]
    assert outcomes(rows(errors, status, ideal=(1.0, 1.0))) == ["unlike the ideal contact"] * 2
    assert outcomes(rows(errors, status, 10.0, 9.0, ideal=(1.0, 1.0))) == ["saturated"] * 2
    unended = rows([[NAN], [0.0]], [[TIMEOUT], [NOT_REACHED]], ideal=(1.0, 0.1))
    assert outcomes(unended) == ["timeout"]


def test_failures_depend_only_on_errors_if_ideal_contact_columns_are_missing():
    result = rows([[0.0], [0.0]], [[OK], [OK]], ideal=(1.0, 1.0))
    old = {name: values for name, values in result.items() if not name.startswith("reference_")}
    classified = classify_outcomes(
        old, list_error_columns(("error",), 2), np.array(np.inf), np.array(2e-3), LIMIT
    )
    assert outcomes(result) == ["unlike the ideal contact"] and outcomes(classified) == ["good"]


def test_energy_columns_are_kinetic_energies_of_the_numerical_model():
    result = rows([[0.1], [0.0]], [[OK], [OK]])
    np.testing.assert_allclose(result["energy_in_1"], 350 / 2 * 2**2, rtol=1e-15)
    np.testing.assert_allclose(result["energy_out_1"], 350 / 2 * 2**2 * (0.9 + 0.1) ** 2, rtol=1e-15)


def test_sweep_column_names_equal_names_in_rows():
    result = rows([[0.0], [0.0]], [[OK], [OK]])
    parsed = check_document(case(2, uncertainty={})).mechanism
    assert [column.name for column in list_sweep_columns(parsed, False)] == list(result)


@pytest.mark.parametrize(
    ("path", "unit"),
    [
        ("contact.stiffness", "N/m"),
        ("contact.damping", "N s/m"),
        ("rig.force_sensor.noise_std", "N"),
        ("rig.position_sensor.noise_std", "m"),
        ("rig.simulator.natural_frequency", "Hz"),
        ("approach.phase", "1"),
    ],
)
def test_sweep_columns_have_units(path, unit):
    assert find_key_unit(load("varying").mechanism, path) == unit


def test_every_contact_of_a_sweep_has_separate_columns():
    names = [column.name for column in list_sweep_columns(load("varying").mechanism, True)]
    assert {"contact.stiffness_3", "approach.phase_3", "error_3", "work_in_3", "status_3"} <= set(names)
    assert len(names) == len(set(names)) and "error_4" not in names
