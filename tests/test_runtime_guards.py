"""Guards of the runtime: every fault on its tick, its reaction, and limited outputs."""

import itertools
import math
from typing import Any

import pytest
from gain_documents import gain_document, sign
from guarded import LIMITED, PERIOD, limited

from jaxhil.rig import Controller, GainFileError
from jaxhil.rig.faults import (
    CLOCK,
    EMERGENCY_STOP,
    FAULTS,
    FORCE_IN_FLIGHT,
    FORCE_LIMIT,
    FORCE_NOT_FINITE,
    FORCE_OUT_OF_RANGE,
    FORCE_SLEW,
    FORCE_STUCK,
    LATE_TICK,
    MISSED_TICK,
    POSITION_NOT_FINITE,
    POSITION_OUT_OF_RANGE,
    POSITION_STUCK,
    STROKE,
    TARE,
    VELOCITY_LIMIT,
    fault_names,
)
from jaxhil.rig.limits import LIMITS


def simulate_flight(controller: Controller, ticks: int, start: float = -0.02) -> float:
    """Simulate uniform motion out of contact; return the next time and position."""
    for n in range(ticks):
        position = start + 5e-6 * n
        assert controller.step(0.0, position, 5e-3, position - 1e-5, n * PERIOD) == 0.0
        assert controller.position_command(position + 5e-6, 5e-3, 0.0) == position + 5e-6
        assert controller.faults == 0, fault_names(controller.faults)
    return start + 5e-6 * ticks


def test_fault_table_has_one_bit_and_one_name_per_fault():
    assert [fault.bit for fault in FAULTS] == [1 << n for n in range(len(FAULTS))]
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    assert fault_names(FORCE_SLEW | TARE) == ["force_slew", "tare"]


BAD_READINGS = {
    FORCE_NOT_FINITE: (math.nan, None),
    FORCE_OUT_OF_RANGE: (2000.0, None),
    POSITION_NOT_FINITE: (None, -math.inf),
    POSITION_OUT_OF_RANGE: (None, 0.011),
}


@pytest.mark.parametrize("fault", BAD_READINGS)
def test_nonfinite_readings_are_bridged_for_a_few_ticks_before_trip(fault):
    controller = limited()
    controller.step(3.0, 1e-4, 5e-3, 1e-4)
    force, measured = BAD_READINGS[fault]
    for n in range(1, 4):
        position = 1e-4 + 5e-6 * n
        command = controller.step(
            3.0 + n if force is None else force, position, 5e-3, position if measured is None else measured
        )
        assert controller.faults == fault
        assert controller.tripped is (n > 2)
        # While bridging, the last good force is used; for a bad position, the force is the reading.
        assert command == (0.0 if n > 2 else 3.0 if measured is None else 3.0 + n)
    assert controller.seen == controller.cause == fault


def test_finite_reading_ends_bridging_of_nonfinite_readings():
    controller = limited()
    for n in range(30):
        position = -1e-4 + 5e-6 * n
        controller.step(math.nan if n % 3 else 1.0 + n, position, 5e-3, position)
        assert bool(controller.faults) is bool(n % 3)
    assert controller.status == "ok"


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_constant_force_in_contact_raises_force_stuck_fault(side):
    controller = limited()
    document = gain_document("none")
    assert "clearance" not in document["mechanism"]["contact"]
    first = None
    for n in range(60):
        measured = side * (1e-4 + 5e-6 * n)
        controller.step(7.0 if n else 6.0, measured, side * 5e-3, measured, n * PERIOD)
        if controller.faults:
            first = n
            break
    if side > 0:
        # The force is 7 N since tick 1; from then on the travel is 5 um per tick.
        assert controller.cause == FORCE_STUCK and first in (1 + 40, 1 + 41)
    else:
        assert first is None


def test_constant_position_while_model_moves_raises_position_stuck_fault():
    controller = limited()
    simulate_flight(controller, 30)
    for n in range(30, 60):
        controller.step(0.0, -0.02 + 5e-6 * n, 5e-3, -0.02, n * PERIOD)
        if controller.faults:
            break
    assert controller.cause == POSITION_STUCK
    assert n in (30 + 20, 30 + 21)


def test_force_out_of_contact_raises_fault_after_settling_time():
    controller = limited()
    for n in range(40):
        controller.step(6.0, -0.02 + 5e-6 * n, 5e-3, -0.02 + 5e-6 * n, n * PERIOD)
        assert bool(controller.faults & FORCE_IN_FLIGHT) is (n >= 10)
        if controller.tripped:
            break
    assert (n, controller.cause) == (12, FORCE_IN_FLIGHT)
    # Near the surface this is no fault.
    controller = limited()
    for n in range(40):
        controller.step(6.0, -4e-4, 0.0, -4e-4, n * PERIOD)
        assert controller.faults == 0


def test_late_ticks_missed_ticks_and_stopped_clock_are_detected():
    controller = limited()
    seen = []
    for time in (0.0, 1e-3, 2.3e-3, 3.3e-3, 5.3e-3, 9.3e-3):
        controller.step(0.0, -0.02, 0.0, -0.02 + time * 1e-6, time)
        seen.append(controller.faults)
    assert seen == [0, 0, LATE_TICK, 0, MISSED_TICK, MISSED_TICK]
    assert (controller.late_ticks, controller.missed_ticks) == (1, 1 + 3)
    controller.step(0.0, -0.02, 0.0, -0.02, 14.4e-3)
    assert controller.cause == MISSED_TICK
    for late in (0.0, -1e-3, math.inf):
        controller = limited()
        controller.step(0.0, -0.02, 0.0, -0.02, 1.0)
        controller.step(0.0, -0.02, 0.0, -0.03, 1.0 + late)
        assert controller.cause == CLOCK


def test_tare_removes_the_bias_from_every_reading_until_the_next_tare():
    controller = limited()
    spread = [1.5 * math.sin(n) for n in range(50)]
    assert [controller.tare(12.0 + value) for value in spread] == [False] * 49 + [True]
    total = 0.0
    for value in spread:  # one after the other, as in C; `sum` is more exact from Python 3.12 on
        total += 12.0 + value
    assert controller.bias == total / 50
    assert controller.step(112.0, 1e-4, 0.0, 1e-4) == 112.0 - controller.bias
    assert controller.reset() and controller.bias != 0.0
    for _ in range(50):
        controller.tare(1.0)
    assert controller.bias == 1.0


@pytest.mark.parametrize("readings", [[25.0], [0.0, 9.0], [math.nan], [1999.0, 2001.0]])
def test_controller_trips_if_tare_is_unusable(readings):
    controller = limited()
    for n in range(50):
        if controller.tare(readings[n % len(readings)]):
            break
    assert controller.cause == TARE and controller.bias == 0.0
    assert controller.step(5.0, 0.0, 0.0, 0.0) == 0.0


def test_force_command_fades_after_force_limit_trip():
    controller = limited()
    for n in range(10):
        assert controller.step(100.0 * (n + 1), 1e-4 * n, 0.0, 1e-4 * n) == 100.0 * (n + 1)
    # 1001 N exceeds the limit of 1000 N: the force decreases to 0 by 100 N per tick.
    forces = [controller.step(1001.0, 2e-3, 0.0, 2e-3) for _ in range(12)]
    assert controller.cause == FORCE_LIMIT
    assert forces == [*(1000.0 - 100.0 * (n + 1) for n in range(10)), 0.0, 0.0]


def test_force_slew_rate_is_limited_and_persistent_excess_trips():
    controller = limited()
    assert [controller.step(250.0, 1e-4 * n, 0.0, 1e-4 * n) for n in range(3)] == [100.0, 200.0, 250.0]
    assert controller.seen == FORCE_SLEW and not controller.tripped
    controller = limited()
    forces = [controller.step(900.0, 1e-5 * n, 0.0, 1e-5 * n) for n in range(6)]
    assert controller.cause == FORCE_SLEW
    assert forces == [100.0, 200.0, 300.0, 400.0, 300.0, 200.0]


def test_command_stops_inside_stroke_after_stroke_limit_trip():
    controller = limited()
    sent = []
    for n in range(30):
        position = 7.9e-3 + 1e-5 * n
        controller.step(0.0, position, 0.0, position + 1e-7 * n)
        sent.append(controller.position_command(position, 1e-2, 0.0))
        assert controller.tripped is (position > 8e-3)
    assert controller.cause == STROKE
    assert max(sent) <= 0.008 and sent[-1] < 0.008


@pytest.mark.parametrize("start", [1e-3, -1e-5, -0.01])
def test_position_command_after_trip_brakes_and_rests_out_of_contact(start):
    controller = limited()
    sent, resting = [], False
    for n in range(3000):
        position = start + 1e-5 * n
        if n == 10:
            controller.emergency_stop(True)
        controller.step(0.0, position, 0.0, position)
        sent.append(controller.position_command(position, 1e-2, 0.0))
        resting = resting or controller.at_rest
        assert controller.at_rest is resting and (not resting or sent[-1] == sent[-2])
    changes = [b - a for a, b in itertools.pairwise(sent)]
    braking = 0.5 * PERIOD**2
    assert all(abs(b - a) <= braking * (1 + 1e-6) for a, b in itertools.pairwise(changes))
    assert min(changes) > -1e-5 * (1 + 1e-6)
    # Braking takes a distance of v^2/2a.
    length = 0.01**2 / (2 * 0.5) + 1e-5
    assert max(sent) < start + 1e-4 + length
    assert controller.at_rest and -0.01 < sent[-1] < (-5e-4 if start > -0.01 else -9e-3)
    assert start < -5e-4 or sent[-1] > -5e-4 - length


def test_command_velocity_is_limited_and_persistent_excess_trips():
    controller = limited()
    controller.step(0.0, -0.02, 0.0, -0.02)
    assert controller.position_command(-0.02, 0.0, 0.0) == -0.02
    sent = [controller.position_command(-0.01, 0.0, 0.0) for _ in range(4)]
    assert sent == pytest.approx([-0.02 + 2e-5 * (n + 1) for n in range(4)], rel=1e-12)
    assert controller.faults == VELOCITY_LIMIT and not controller.tripped
    controller.position_command(-0.01, 0.0, 0.0)
    assert controller.cause == VELOCITY_LIMIT


def test_reset_after_trip_causes_no_jump_of_position_command():
    controller = limited()
    simulate_flight(controller, 20)
    controller.emergency_stop(True)
    command = [controller.position_command(-0.01, 0.0, 0.0) for _ in range(100)][-1]
    assert controller.at_rest and not controller.reset()
    controller.emergency_stop(False)
    assert controller.tripped and controller.cause == EMERGENCY_STOP
    assert controller.reset() and controller.status == "ok"
    position, before = -0.0195, command
    for n in range(2000):
        controller.step(0.0, position, 5e-3, position + 1e-9 * n)
        position += 5e-6
        sent = controller.position_command(position, 5e-3, 0.0)
        assert abs(sent - before) <= 2e-5 * (1 + 1e-9)
        assert controller.faults == (VELOCITY_LIMIT if sent != position else 0)
        before = sent
        if sent == position:
            break
    assert sent == position and not controller.tripped
    # Once the command has caught up, the limit applies again.
    for _ in range(5):
        controller.position_command(position + 1e-3, 5e-3, 0.0)
    assert controller.cause == VELOCITY_LIMIT


def test_trip_keeps_its_first_cause():
    controller = limited()
    simulate_flight(controller, 20)
    for _ in range(5):
        controller.position_command(-0.01, 0.0, 0.0)
    controller.emergency_stop(True)
    assert controller.cause == VELOCITY_LIMIT and controller.seen & EMERGENCY_STOP


def test_next_contact_starts_at_model_position_except_after_trip():
    controller = limited()
    simulate_flight(controller, 20)
    controller.next_contact()
    controller.step(0.0, -0.03, 5e-3, -0.03, 7.0)
    assert controller.position_command(-0.03, 5e-3, 0.0) == -0.03
    assert controller.seen == 0
    controller.emergency_stop(True)
    controller.next_contact()
    assert abs(controller.position_command(-0.01, 5e-3, 0.0) + 0.03) < 1e-4


def test_controller_without_limits_applies_compensator_within_default_bounds():
    for values in (None, {}, dict.fromkeys(LIMITED)):
        document = gain_document("none")
        if values is not None:
            document["limits"] = {name: {"value": None, "unit": LIMITS[name].unit} for name in values}
        controller = Controller.from_dict(sign(document))
        for n in range(200):
            position = 9.9e-3 * n * (-1) ** (n // 100)
            controller.next_contact()
            force = 9.9e5 * (-1) ** n
            assert controller.step(force, 1e3, 5.0, position, 10.0**n / 1e200) == force
            assert controller.position_command(position, 5.0, 0.0) == position
        assert controller.status == "ok"


@pytest.mark.parametrize(
    ("reading", "moved", "cause"),
    [
        ((1.1e6, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), FORCE_OUT_OF_RANGE),
        ((0.0, 0.0, 0.0, -50.1), (0.0, 0.0, 0.0), POSITION_OUT_OF_RANGE),
        ((9e5, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), FORCE_LIMIT),
        ((0.0, 0.0, 0.0, 0.0), (50.1, 0.0, 0.0), STROKE),
        ((0.0, 0.0, 0.0, 0.0), (0.011, 0.0, 0.0), VELOCITY_LIMIT),
    ],
)
def test_controller_without_limits_trips_beyond_default_bounds(reading, moved, cause):
    controller = Controller.from_dict(gain_document("phase_lead"))
    controller.step(0.0, 0.0, 0.0, 0.0)
    assert controller.position_command(0.0, 0.0, 0.0) == 0.0
    force = controller.step(*reading)
    position = controller.position_command(*moved)
    assert (force, position, controller.cause) == (0.0, 0.0, cause)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"force_limit": {"value": -1.0, "unit": "N"}}, ["limits.force_limit.value", "-1.0", "0.0 to"]),
        ({"force_limit": {"value": 2e6, "unit": "N"}}, ["force_limit.value", "2000000.0", "to 1000000.0"]),
        ({"command_lowest": {"value": -51, "unit": "m"}}, ["command_lowest.value", "-51", "-50.0 to 50.0"]),
        ({"force_limit": {"value": 1.0, "unit": "kN"}}, ["limits.force_limit.unit", "'kN'", "'N'"]),
        ({"force_limit": {"value": math.inf, "unit": "N"}}, ["JSON"]),
        ({"force_limit": {"unit": "N"}}, ["limits.force_limit.value", "nothing"]),
        ({"strength": {"value": 1.0, "unit": "N"}}, ["unknown limit 'strength'"]),
        ({"force_limit": 3.0}, ["limits.force_limit", "3.0", "an object"]),
        ([], ["limits", "a list"]),
        (
            {"command_lowest": {"value": 1.0, "unit": "m"}, "command_highest": {"value": 0.5, "unit": "m"}},
            ["limits", "command_lowest 1.0 is not below command_highest 0.5"],
        ),
        (
            {
                "velocity_limit": {"value": 0.1, "unit": "m/s"},
                "retreat_velocity": {"value": 1, "unit": "m/s"},
            },
            ["limits", "retreat_velocity", "velocity_limit"],
        ),
    ],
)
def test_inconsistent_controller_limits_are_rejected(limits, words):
    document: dict[str, Any] = gain_document("none")
    document["limits"] = limits
    try:
        signed = sign(document)
    except ValueError:
        signed = {**document, "sha256": "0"}
    with pytest.raises(GainFileError) as caught:
        Controller.from_dict(signed)
    assert all(word in str(caught.value) for word in words), str(caught.value)
