"""Position commands start and continue at the drives' position, in Python and, bit for bit, in C."""

import math

import c99_cases
import numpy as np
import pytest
from c99_cases import (
    COMMAND_FIRST,
    EVENTS,
    NEXT_CONTACT,
    PERIOD,
    RESET,
    RESULT,
    ROW,
    STEP_ONLY,
    STOP,
    TICK,
    assert_same,
    controller_in_python,
    packed,
)
from gain_documents import GAINS
from guarded import LIMITED, limited
from hypothesis import given, reject
from hypothesis import strategies as st

from jaxhil.rig import COMPENSATORS, Controller
from jaxhil.rig.faults import (
    COMMAND_NOT_FINITE,
    ENERGY_BALANCE,
    MODEL_NOT_FINITE,
    POSITION_NOT_FINITE,
    RESTITUTION,
    STROKE,
    VELOCITY_LIMIT,
)
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.limits import LIMITS, complete_limits
from jaxhil.rig.surfaces import deflection

LAWS = ("none", "position_lead", "response_error")
STEP = LIMITED["velocity_limit"] * PERIOD
POSITION, ANSWER, TRIPPED = (RESULT.index(name) for name in ("position", "answer", "tripped"))


def in_both(gain_file: GainFile, rows: np.ndarray) -> np.ndarray:
    """Return the results of the rows in Python, after checking that C agrees if a compiler is installed."""
    results = controller_in_python(gain_file, rows)
    if c99_cases.COMPILER is not None:
        made = c99_cases.loaded(gain_file.compensator)
        assert made.begin(packed(gain_file.compensator, gain_file))
        assert_same(made.run(rows, True), results, rows)
    return results


def rows_of(*rows: dict[str, float]) -> np.ndarray:
    """Return rows of successive ticks at rest, with the given exceptions."""
    made = np.zeros((len(rows), len(ROW)))
    for n, row in enumerate(rows):
        for name, value in {"time": n * PERIOD, "timed": 1.0, **row}.items():
            made[n, ROW.index(name)] = value
    return made


class Reference:
    """Allowed starting position and allowed distance from it, computed from the rows alone."""

    def __init__(self, gain_file: GainFile) -> None:
        self.limits, self.clearance = gain_file.limits, gain_file.clearance
        self.last: float | None = None
        self.read: float | None = None
        self.fresh = False

    def see(self, measured: float) -> None:
        if self.limits["measured_lowest"] <= measured <= self.limits["measured_highest"]:
            self.read, self.fresh = measured, True
        elif not self.fresh and abs(measured) <= 50.0:
            self.read = measured

    def check(self, command: float, model: float, tripped: bool) -> None:
        limits = self.limits
        most = limits["velocity_limit"] * PERIOD
        free = math.isfinite(model) and deflection(model, self.clearance) == 0.0
        begins, where, far = self.last is None, self.read if self.last is None else self.last, most
        if begins and free and not tripped:
            where = where if self.fresh else model
            far += limits["start_distance"]
        assert math.isfinite(command)
        if where is None:
            # The drive position is unknown, so the command must be out of contact.
            out_of_contact = abs(deflection(command, self.clearance)) <= most
            assert out_of_contact or not limits["command_lowest"] <= 0.0 <= limits["command_highest"]
        else:
            assert abs(command - where) <= far * (1 + 1e-9) + 1e-14 * abs(where)
            low, high = limits["command_lowest"], limits["command_highest"]
            outside = max(low - command, command - high, 0.0)
            assert outside <= max(low - where, where - high, 0.0)
        self.last = command

    def follow(self, rows: np.ndarray, results: np.ndarray) -> None:
        before = False
        for row, result in zip(rows.tolist(), results.tolist(), strict=True):
            event, tripped = row[0], bool(result[TRIPPED])
            if event == COMMAND_FIRST:
                self.check(result[ANSWER], row[7], tripped)
            # An audit that trips when the next contact is announced does not change the current run.
            audited = int(result[RESULT.index("cause")]) & (RESTITUTION | ENERGY_BALANCE)
            if event == NEXT_CONTACT and not before and not audited:
                self.last, self.fresh = None, False
            self.see(row[4])
            if event != STEP_ONLY:
                self.check(result[POSITION], row[7], tripped)
            before = tripped


PLACES = st.one_of(
    st.sampled_from([-0.02, -5e-3, -1e-4, -1e-5, 0.0, 1e-5, 5e-4, 5e-3, 0.02]),
    st.floats(-0.05, 0.05),
    st.floats(-60.0, 60.0),
    st.sampled_from(c99_cases.HOSTILE.tolist()),
)
NUMBERS = st.one_of(st.floats(-1.0, 1.0), st.sampled_from(c99_cases.HOSTILE.tolist()))


@st.composite
def runs(draw):
    law = draw(st.sampled_from(LAWS))
    gains = {name: entry["value"] for name, entry in GAINS[law].items()}
    clearance = draw(st.sampled_from([math.inf, math.inf, 0.0, 1e-4, 0.01]))
    limits = dict(LIMITED)
    guards = ("velocity_limit", "deceleration", "retreat_velocity", "free_distance", "start_distance")
    for name in (*guards, "command_lowest", "command_highest", "measured_lowest", "measured_highest"):
        if draw(st.booleans()):
            low, high = max(LIMITS[name].lowest, -0.1), min(LIMITS[name].highest, 0.1)
            limits[name] = draw(st.floats(low, high))
    for name in draw(st.sets(st.sampled_from(sorted(limits)), max_size=3)):
        limits[name] = LIMITS[name].default
    try:
        limits = complete_limits(limits)
    except ValueError:
        reject()
    row = st.tuples(
        st.sampled_from([TICK] * 4 + list(EVENTS)),
        *(NUMBERS, PLACES, NUMBERS, PLACES, st.floats(0.0, 1.0), st.just(0.0), PLACES, NUMBERS, NUMBERS),
    )
    rows = draw(st.lists(row, min_size=1, max_size=25))
    if draw(st.booleans()):  # drives near the model, so that runs last long
        rows = [(*row[:4], row[2] - 1e-5, *row[5:7], row[2] + 1e-5, *row[8:]) for row in rows]
    return GainFile(law, gains, PERIOD, clearance, limits), np.array(rows)


@given(run=runs())
def test_position_command_distance_from_drive_position_is_within_limits(run):
    gain_file, rows = run
    Reference(gain_file).follow(rows, in_both(gain_file, rows))


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_position_command_stays_near_drive_position_for_a_million_ticks(law):
    rng = np.random.default_rng([12, LAWS.index(law)])
    made = c99_cases.loaded(law)
    for n in range(1000):
        gain_file = c99_cases.drawn_gains(law, rng, hostile=n % 2 == 1, period=PERIOD)
        rows = c99_cases.drawn_rows(("contact", "random", "hostile")[n % 3], 1000, rng, PERIOD)
        assert made.begin(packed(law, gain_file))
        Reference(gain_file).follow(rows, made.run(rows, True))


# Past faults: cases in which the drives jumped.


def plain(law: str = "none", **limits: float) -> GainFile:
    gains = {name: entry["value"] for name, entry in GAINS[law].items()}
    return GainFile(law, gains, PERIOD, math.inf, complete_limits({**LIMITED, **limits}))


@pytest.mark.parametrize("before", [[], [{"desired": -0.02, "measured": -0.02, "x": -0.02}] * 3])
@pytest.mark.parametrize("model", [5e-3, 0.02, 1e300, -0.5])
@pytest.mark.parametrize("drives", [-5e-3, -5e-4, 0.02, 5e-4])
def test_first_position_command_does_not_jump_for_model_of_wrong_sign(drives, model, before):
    """The controller trips at once, or moves within the velocity limit."""
    wrong = {"desired": model, "measured": drives, "x": model}
    sent = in_both(plain(), rows_of(*before, {**wrong, "event": NEXT_CONTACT}, *[wrong] * 400))[len(before) :]
    commands = sent[:, POSITION]
    assert abs(commands[0] - drives) <= STEP * (1 + 1e-9)
    assert np.all(np.abs(np.diff(commands)) <= STEP * (1 + 1e-9))
    if not LIMITED["command_lowest"] <= model <= LIMITED["command_highest"]:
        # After a trip the command is out of contact, and never at the deepest allowed position.
        assert np.all(sent[:, TRIPPED]) and np.all(np.diff(commands) <= 0.0)
        assert (
            int(sent[0, RESULT.index("cause")]) & STROKE or not LIMITED["measured_lowest"] <= drives <= 0.01
        )


@pytest.mark.parametrize("bad", ["desired", "velocity"])
@pytest.mark.parametrize("drives", [0.02, -0.02, 5e-4, -40.0])
def test_nonfinite_first_model_position_holds_the_drive_position(bad, drives):
    rows = rows_of(*[{"measured": drives, "x": 0.0, bad: math.nan}] * 3)
    results = in_both(plain(), rows)
    assert int(results[0, RESULT.index("cause")]) == MODEL_NOT_FINITE
    assert abs(results[0, POSITION] - drives) <= STEP


@pytest.mark.parametrize(("drives", "way", "rest"), [(0.02, -1.0, -5e-4), (-0.046, 1.0, -0.0295)])
def test_retreat_from_position_outside_the_stroke_has_no_jump(drives, way, rest):
    gain_file = plain()._replace(clearance=0.03)
    results = in_both(gain_file, rows_of(*[{"measured": drives, "x": math.nan}] * 4000))
    commands = results[:, POSITION]
    assert commands[0] == pytest.approx(drives, abs=STEP) and np.all(way * np.diff(commands) >= 0.0)
    assert results[-1, RESULT.index("at_rest")] and 0.0 <= way * (commands[-1] - rest) < 1.2e-4
    assert np.all(np.abs(np.diff(commands)) <= LIMITED["retreat_velocity"] * PERIOD * (1 + 1e-9))


def test_next_run_begins_at_current_drive_position():
    controller = limited()
    for model, expected in ((-0.03, -0.03), (5e-4, -0.01 + STEP), (0.02, -0.01)):
        controller.reset()
        controller.next_contact()
        controller.step(0.0, -0.01, 0.0, -0.01)
        controller.next_contact()
        assert controller.position_command(model, 0.0, 0.0) == pytest.approx(expected, rel=1e-12)


def test_nonfinite_first_position_reading_trips_immediately():
    """There is no earlier good reading to continue with."""
    rows = rows_of({"measured": math.nan, "desired": -5e-3, "x": -5e-3}, {"measured": -0.02})
    results = in_both(plain(), rows)
    assert int(results[0, RESULT.index("cause")]) == POSITION_NOT_FINITE


def test_emergency_stop_before_the_first_command_holds_the_drives():
    stopped = {"event": STOP, "desired": 5e-3, "measured": -5e-3, "x": 5e-3}
    commands = in_both(plain(), rows_of(stopped, {**stopped, "event": TICK}))[:, POSITION]
    assert commands.tolist() == [-5e-3, -5e-3]


@pytest.mark.parametrize(
    ("model", "expected"),
    [(-5e-3, -5e-3), (-5e-4, -5e-4), (5e-4, -5e-4), (math.nan, -5e-4), (1e300, -5e-4), (-1e300, -0.04)],
)
def test_command_before_the_first_reading_is_never_in_contact(model, expected):
    """The command follows the model out of contact while the drive position is unknown."""
    results = in_both(plain(), rows_of({"event": COMMAND_FIRST, "x": model, "measured": -5e-3}))
    assert results[0, ANSWER] == pytest.approx(expected, abs=STEP * (1 + 1e-9))


@pytest.mark.parametrize("law", LAWS)
def test_run_with_delayed_drives_starts_without_a_jump(law):
    """Within `start_distance`, the first command is the compensator's command, without a fault."""
    start = {"desired": -4e-4, "velocity": 5e-3, "measured": -5e-4, "x": -3.95e-4, "v": 5e-3}
    gain_file = plain(law, start_distance=5e-4)
    result = in_both(gain_file, rows_of(start))[0]
    sent = COMPENSATORS[law](gain_file.gains, PERIOD, math.inf).position_command(-3.95e-4, 5e-3, 0.0)
    assert (result[POSITION], result[RESULT.index("seen")]) == (sent, 0)
    strict = in_both(plain(law), rows_of(start))[0]
    assert strict[POSITION] == pytest.approx(-5e-4 + STEP, rel=1e-12)
    assert strict[RESULT.index("seen")] == VELOCITY_LIMIT
    # In contact only the velocity limit counts.
    pressed = rows_of({"desired": 1e-4, "measured": -1e-4, "x": 1e-4})
    assert in_both(gain_file, pressed)[0, POSITION] == pytest.approx(-1e-4 + STEP, rel=1e-12)


def test_run_that_starts_away_from_drive_position_catches_up_within_velocity_limit():
    model = {"desired": -0.01, "measured": -0.011, "x": -0.01}
    rows = rows_of(*[{**model, "measured": -0.011 + 1e-7 * n} for n in range(60)])
    results = in_both(plain(), rows)
    commands = results[:, POSITION]
    assert commands[:50] == pytest.approx(-0.011 + STEP * np.arange(1, 51), rel=1e-12)
    assert np.all(commands[50:] == -0.01) and not results[-1, TRIPPED]


def test_command_after_reset_continues_from_last_command():
    first_row, second_row = (
        {"desired": -0.01, "measured": -0.01, "x": -0.01},
        {"measured": -0.03, "desired": -0.03},
    )
    moved = {**second_row, "x": -0.03}
    rows = rows_of(
        first_row, {**first_row, "x": math.nan}, {**moved, "event": RESET}, {**moved, "event": NEXT_CONTACT}
    )
    commands = in_both(plain(), rows)[:, POSITION]
    assert commands[2] == pytest.approx(commands[1] - STEP, rel=1e-12)
    assert commands[3] == -0.03


@pytest.mark.parametrize("error", [ValueError, RuntimeError, ZeroDivisionError])
def test_exception_in_compensator_holds_the_drive_position(error, monkeypatch):
    def fail(*_):
        raise error("gone wrong")

    controller = limited()
    monkeypatch.setattr(COMPENSATORS["none"], "step", fail)
    assert controller.step(0.0, -5e-3, 0.0, -5e-3) == 0.0
    assert controller.cause == COMMAND_NOT_FINITE
    assert controller.position_command(5e-3, 0.0, 0.0) == -5e-3
    controller = limited()
    monkeypatch.undo()
    monkeypatch.setattr(COMPENSATORS["none"], "position_command", fail)
    controller.step(0.0, -5e-3, 0.0, -5e-3)
    assert controller.position_command(5e-3, 0.0, 0.0) == -5e-3
    assert isinstance(controller, Controller) and controller.cause == MODEL_NOT_FINITE
