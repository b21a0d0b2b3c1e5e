"""Test vectors: readings of the simulation with the runtime's commands, and hostile ticks."""

import csv
import io
import itertools
import math
import struct

import numpy as np
import pytest
from bundles import document

from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.rig import Controller
from jaxhil.rig.gain_file import check_gain_document
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.recording import nominal_and_draws, record_lanes
from tuning.bundle import vector_replay
from tuning.bundle.bundle import replace_limits
from tuning.bundle.vectors import (
    NEXT_CONTACT,
    RUN_START,
    VectorRow,
    format_csv,
    make_vectors,
    remove_fixed_uncertainty,
)

pytestmark = pytest.mark.users_options

LIMITS = {"held_readings": 3.0, "missed_in_a_row": 3.0, "limited_in_a_row": 3.0, "force_limit": 500.0}


@pytest.fixture(scope="module")
def loaded():
    made = document("varying", "response_error")
    return check_document(replace_limits(made, {**LIMITS, "velocity_limit": 0.1, "deceleration": 1.0}))


@pytest.fixture(scope="module")
def vectors(loaded):
    return make_vectors(loaded, seed=3, draws=2)


def runs_of(vectors):
    runs = {}
    for row in vectors.rows:
        runs.setdefault(row.run, []).append(row)
    return runs


def test_vector_file_columns_equal_columns_read_by_self_test():
    assert ",".join(VectorRow._fields) == vector_replay.VECTOR_COLUMNS


def test_recorded_vectors_contain_simulation_and_agree_with_runtime(loaded, vectors):
    assert vectors.reasons == [] and vectors.ended == [None] * 3
    _, lanes = record_lanes(loaded, nominal_and_draws(remove_fixed_uncertainty(loaded.mechanism), 3, 3))
    runs = runs_of(vectors)
    for number, lane in enumerate(lanes):
        rows = runs[number]
        assert len(rows) == len(lane.command) > 300
        assert [row.force_measured for row in rows] == lane.signals.force_measured.tolist()
        expected, result = lane.command, np.array([row.force_command for row in rows])
        assert np.max(np.abs(result - expected)) <= 1e-13 * np.ptp(expected)
        assert np.array([row.force_simulated for row in rows]) == pytest.approx(expected, rel=0, abs=0)
        begins = np.flatnonzero(lane.signals.age == 0)
        assert rows[0].event == RUN_START and [row.event for row in rows].count(RUN_START) == 1
        assert [i for i, row in enumerate(rows) if row.event == NEXT_CONTACT] == begins[1:].tolist()
        assert len(begins) == loaded.mechanism.approach.contacts == 3


def test_model_motion_in_vectors_equals_simulation(vectors):
    """Position and velocity after a tick equal the values before the next tick, to rounding."""
    for rows in list(runs_of(vectors).values())[:3]:
        for row, following in itertools.pairwise(rows):
            if following.event == 0:
                assert row.position == pytest.approx(following.position_desired, rel=1e-9, abs=1e-13)
                assert row.velocity == pytest.approx(following.velocity_desired, rel=1e-9, abs=1e-13)
        assert [row.time for row in rows] == [tick * 0.001 for tick in range(len(rows))]


def test_scenarios_of_vectors_differ_and_depend_on_the_seed(loaded, vectors):
    runs = runs_of(vectors)
    first = [rows[60].force_measured for rows in list(runs.values())[:3]]
    assert len({*first}) == 3
    again = make_vectors(loaded, seed=3, draws=2)
    assert format_csv(again.rows) == format_csv(vectors.rows)
    other = make_vectors(loaded, seed=4, draws=2)
    assert format_csv(other.rows) != format_csv(vectors.rows)


def test_hostile_vectors_contain_every_kind_of_bad_reading(vectors):
    rows = [row for row in vectors.rows if row.run > 2]
    inputs = [value for row in rows for value in row[2:10] if value is not None]
    assert any(math.isnan(value) for value in inputs) and {math.inf, -math.inf} <= {*inputs}
    assert {1e308, 5e-324} <= {abs(value) for value in inputs}
    assert any(row.time is None for row in rows) and any(row.event == NEXT_CONTACT for row in rows)
    seen = 0
    for row in rows:
        seen |= row.faults
    # Faults: non-finite force, position, model; missed tick, clock; limits of force and velocity.
    for bit in (0x1, 0x2, 0x4, 0x200, 0x400, 0x800, 0x4000):
        assert seen & bit, hex(bit)
    assert all(math.isfinite(row.force_command) and math.isfinite(row.position_command) for row in rows)
    assert all(math.isnan(row.force_simulated) for row in rows)


def test_new_controller_reproduces_every_test_vector_bit_for_bit(loaded, vectors):
    gain_file = check_gain_document(loaded.document)
    controller = None
    for row in vectors.rows:
        if row.event == RUN_START:
            controller = Controller(gain_file)
        elif row.event == NEXT_CONTACT:
            controller.next_contact()
        force = controller.step(*row[2:7])
        position = controller.position_command(*row[7:10])
        assert (force, position, controller.faults) == (row.force_command, row.position_command, row.faults)


def test_vector_values_survive_conversion_to_text_bit_for_bit(vectors):
    rows = list(csv.reader(io.StringIO(format_csv(vectors.rows))))[1:]
    for row, fields in zip(vectors.rows, rows, strict=True):
        for value, field in zip(row, fields, strict=True):
            if value is None:
                assert field == ""
            elif value == value:
                assert struct.pack("<d", float(field)) == struct.pack("<d", value)
            else:
                assert field == "nan"


def test_vector_comparison_with_simulation_ends_when_a_limit_acts(loaded):
    tight = check_document(replace_limits(loaded.document, {"force_limit": 20.0}))
    result = make_vectors(tight, seed=3, draws=2)
    assert result.reasons == []
    end = next(i for i, row in enumerate(result.rows) if row.faults)
    assert result.ended[0] == f"tick {end}: the controller acts on force_limit"
    nominal = [row for row in result.rows if row.run == 0]
    assert all(math.isnan(row.force_simulated) for row in nominal[end:])
    assert not any(math.isnan(row.force_simulated) for row in result.rows[:end])


def test_trip_between_two_contacts_ends_vector_comparison(loaded):
    limits = {"equivalent_mass": 300.0, "settling": 10.0, "restitution_margin": 1e-9}
    result = make_vectors(check_document(replace_limits(loaded.document, limits)), seed=3, draws=1)
    assert result.reasons == []
    for run, ended in enumerate(result.ended):
        rows = [row for row in result.rows if row.run == run]
        begins = next(tick for tick, row in enumerate(rows) if row.event == NEXT_CONTACT)
        assert ended == f"tick {begins}: the controller acts on restitution"
        assert [math.isnan(row.force_simulated) for row in rows[begins - 1 : begins + 1]] == [False, True]


def test_runtime_command_that_differs_from_vectors_is_reported(loaded, monkeypatch):
    class Wrong(ON_THE_RIG[loaded.compensator]):
        def step(self, *readings):
            return super().step(*readings) * (1 + 1e-9)

    monkeypatch.setitem(ON_THE_RIG, loaded.compensator, Wrong)
    result = make_vectors(loaded, seed=3, draws=2)
    assert len(result.reasons) == 3 and result.reasons[0].startswith("the nominal run, tick ")
    assert "expected 1e-11" in result.reasons[1] and result.reasons[1].startswith("draw 1, ")


def test_vectors_of_a_noisy_biased_rig_agree_with_runtime():
    """Exclude the first tick, whose force is zero in the simulation."""
    rough = ("rig.force_sensor.noise_std=0.5", "rig.force_sensor.bias=0.3", "rig.command_latency=1")
    result = make_vectors(check_document(document("claw-350kg", "phase_lead", rough)), seed=0, draws=1)
    assert result.reasons == [] and result.ended == [None, None]
    assert math.isnan(result.rows[0].force_simulated) and result.rows[0].force_command != 0
    assert result.rows[0].acceleration == 0
    assert not math.isnan(result.rows[1].force_simulated)


def test_vector_scenarios_do_not_vary_values_fixed_by_the_gain_file(loaded):
    uncertain = remove_fixed_uncertainty(loaded.mechanism).uncertainty
    assert "rig.control_period" not in uncertain and "contact.clearance" not in uncertain
    assert uncertain.keys() <= loaded.mechanism.uncertainty.keys()
