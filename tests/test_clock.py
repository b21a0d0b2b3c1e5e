"""Clock check of the runtime: early, late and missed ticks, and drift of the clock."""

import itertools
import math

import c99_cases
import numpy as np
import pytest
from c99_cases import NEXT_CONTACT, RESULT, ROW, assert_same, controller_in_python, packed
from hypothesis import given
from hypothesis import strategies as st

from jaxhil.rig.faults import CLOCK, EARLY_TICK, LATE_TICK, MISSED_TICK
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.limits import NO_LIMITS, complete_limits

OK = 0
BRIDGED = {"missed_in_a_row": 3.0}


def faults(times, period: float = 1e-3, events=None, **limits: float) -> list[int]:
    """Return the faults of ticks at these times [s], after checking that C agrees; None after a trip."""
    gain_file = GainFile("none", {}, period, math.inf, complete_limits(limits) if limits else NO_LIMITS)
    rows = np.zeros((len(times), len(ROW)))
    rows[:, ROW.index("time")] = times
    rows[:, ROW.index("timed")] = 1.0
    if events is not None:
        rows[:, 0] = events
    results = controller_in_python(gain_file, rows)
    if c99_cases.COMPILER is not None:
        made = c99_cases.loaded("none")
        assert made.begin(packed("none", gain_file))
        assert_same(made.run(rows, True), results, rows)
    fault_bits = results[:, RESULT.index("faults")].astype(int).tolist()
    tripped = results[:, RESULT.index("tripped")].tolist()
    assert all(
        not stopped or fault in (0, CLOCK, MISSED_TICK)
        for fault, stopped in zip(fault_bits, tripped, strict=True)
    )
    return fault_bits


def periods(*gaps: float, period: float = 1e-3, start: float = 7.0) -> list[float]:
    return [start + period * total for total in itertools.accumulate((0.0, *gaps))]


@pytest.mark.parametrize("period", [1e-4, 1e-3, 0.04])
@pytest.mark.parametrize(
    ("gap", "expected"),
    [
        (0.01, [OK, EARLY_TICK, CLOCK]),  # repeated ticks
        (0.5, [OK, *[EARLY_TICK] * 3, CLOCK]),
        (0.74, [OK, *[EARLY_TICK] * 5, CLOCK]),
        (0.76, [OK, *[OK] * 6, CLOCK]),
        (1.24, [OK, *[OK] * 6, CLOCK]),
        (1.26, [OK, *[LATE_TICK] * 5, CLOCK]),
        (1.49, [OK, *[LATE_TICK] * 3, CLOCK]),
        (1.51, [OK, *[MISSED_TICK] * 3, CLOCK]),
        (2.0, [OK, *[MISSED_TICK] * 6]),
        (0.0, [OK, CLOCK]),
        (-1.0, [OK, CLOCK]),
    ],
)
def test_clock_check_raises_faults_for_wrong_tick_rate_at_default_limits(gap, expected, period):
    assert faults(periods(*[gap] * (len(expected) - 1), period=period), period) == expected


@pytest.mark.parametrize("time", [math.nan, math.inf, -math.inf])
def test_clock_check_trips_on_non_finite_time(time):
    assert faults([0.0, 1e-3, time]) == [OK, OK, CLOCK]
    assert faults([time]) == [CLOCK]


@pytest.mark.parametrize("rate", [0.98, 0.984, 1.016, 1.02, 1.1])
def test_clock_check_trips_on_rate_error_above_1_5_percent(rate):
    """A rate error r causes a drift of r (1 - 0.99^n)/0.01 periods after n ticks; the limit is 1.5."""
    wrong = abs(rate - 1.0)
    ticks = math.ceil(math.log(1.0 - 0.015 / wrong) / math.log(0.99))
    result = faults(periods(*[rate] * 300))
    assert result.index(CLOCK) == ticks and not any(result[:ticks])


@pytest.mark.parametrize("rate", [0.986, 0.9999, 1.0001, 1.014])
def test_clock_check_accepts_rate_error_below_1_5_percent(rate):
    assert not any(faults(periods(*[rate] * 5000)))


@given(
    jitter=st.lists(st.floats(-0.12, 0.12), min_size=2, max_size=80),
    period=st.sampled_from([1e-4, 1e-3, 0.1]),
    start=st.floats(0.0, 1e5),
)
def test_clock_check_accepts_jitter_below_an_eighth_of_the_period(jitter, period, start):
    assert not any(faults([start + period * (n + late) for n, late in enumerate(jitter)], period))


def test_clock_check_never_trips_on_ordinary_jitter():
    """Use normal jitter of 5 % of the period, which flags about one tick in a thousand."""
    late = 0.05 * np.random.default_rng(3).standard_normal(100_000)
    result = np.array(faults((1e-3 * (np.arange(100_000) + late)).tolist()))
    assert set(result) <= {OK, EARLY_TICK, LATE_TICK}
    assert 0 < np.count_nonzero(result) < 100


def test_clock_check_accepts_early_tick_that_compensates_late_tick():
    assert faults(periods(1.0, 1.4, 0.6, 1.0)) == [OK, OK, LATE_TICK, EARLY_TICK, OK]


def test_clock_check_flags_a_repeated_tick_and_trips_on_two_within_69_ticks():
    """The drift after one repeated tick is 0.99^n periods after n ticks: half a period after 69."""
    assert faults(periods(1.0, 0.001, *[1.0] * 20)) == [OK, OK, EARLY_TICK, *[OK] * 20]
    assert faults(periods(0.001, *[1.0] * 67, 0.001))[-1] == CLOCK
    assert faults(periods(0.001, *[1.0] * 69, 0.001))[-1] == EARLY_TICK


def test_clock_check_counts_no_drift_after_stall_followed_by_burst():
    """Three ticks arrive 2.9, 1.9 and 0.9 periods late and already count as missed."""
    stall = (1.0, 3.9, 0.02, 0.02, 0.06, 1.0)
    expected = [OK, MISSED_TICK, *[EARLY_TICK] * 3, OK]
    assert faults(periods(*stall * 5), **BRIDGED) == [OK, *expected * 5]
    # One tick more than the missed ticks counts as repeated; a second one trips.
    assert faults(periods(3.9, *[0.02] * 5), **BRIDGED)[-2:] == [EARLY_TICK, CLOCK]


def test_clock_check_trips_on_consecutive_missed_ticks():
    assert faults(periods(4.0, 1.0, 4.0), **BRIDGED) == [OK, MISSED_TICK, OK, MISSED_TICK]
    # A loop at half the rate misses every second tick.
    half = faults(periods(*[2.0] * 6), **BRIDGED)
    assert half == [OK, *[MISSED_TICK] * 4, OK, OK]
    assert faults(periods(5.0, 1.0), **BRIDGED) == [OK, MISSED_TICK, OK]


def test_next_contact_resets_clock_check_of_controller():
    times = [*periods(0.5, 0.5), *periods(0.5, 0.5, start=-3.0)]
    events = [0.0] * 3 + [NEXT_CONTACT] + [0.0] * 2
    assert faults(times, events=events) == [OK, EARLY_TICK, EARLY_TICK] * 2


def test_late_fraction_limit_sets_threshold_of_late_and_early_ticks():
    gaps = periods(1.1, 0.9, 1.3, 0.7)
    assert faults(gaps, late_fraction=0.05) == [OK, LATE_TICK, EARLY_TICK, LATE_TICK, EARLY_TICK]
    assert faults(gaps, late_fraction=0.25) == [OK, OK, OK, LATE_TICK, EARLY_TICK]
    # From 0.5 on, a late tick counts as missed.
    assert faults(periods(1.49, 0.51, 1.51), late_fraction=0.5) == [OK, OK, OK, MISSED_TICK]
