"""Ticks from time stamps that scatter, drift and have gaps."""

import numpy as np
import pytest

from jaxhil.errors import InputError
from tuning.identification.logs.clock import PHASE_CHUNK_ROWS, assign_ticks, number_rows

PERIOD = 1e-3


def stamps(rows=20_000, jitter=0.0, drift=0.0, lost=(), seed=0):
    """Return the time stamps of all ticks that are not `lost`, and the numbers of these ticks."""
    tick = np.setdiff1d(np.arange(rows), np.asarray(lost, int))
    error = jitter * np.random.default_rng(seed).standard_normal(len(tick))
    return 12.3 + PERIOD * (1 + drift) * tick + np.clip(error, -0.45 * PERIOD, 0.45 * PERIOD), tick


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-3])
@pytest.mark.parametrize("jitter", [0.0, 5e-5, 1.5e-4])
def test_every_log_row_is_assigned_its_tick(jitter, drift):
    lost = [5, 700, 701, 702, 703, *range(3000, 3060), 12_000, 12_002, 19_998]
    times, tick = stamps(jitter=jitter, drift=drift, lost=lost)
    result = assign_ticks(times, PERIOD, "a")
    np.testing.assert_array_equal(result.tick, tick)
    assert result.clock.lost == len(lost)
    # The slope of a line through n points that scatter by s has a standard deviation of s sqrt(12 / n^3) / T.
    assert abs(result.clock.drift - 1e6 * drift) < 1e-3 + 4e6 * jitter / PERIOD * np.sqrt(12 / 20_000**3)
    assert abs(result.clock.jitter - jitter) <= 0.03 * jitter + 1e-3 * PERIOD


def test_log_rows_with_time_stamp_in_neighbouring_tick_keep_their_order():
    times, tick = stamps(jitter=0.0)
    times[100] += 0.55 * PERIOD
    times[5000] -= 0.6 * PERIOD
    np.testing.assert_array_equal(assign_ticks(times, PERIOD, "a").tick, tick)


def test_short_logs_and_logs_without_time_stamps_are_assigned_ticks():
    for rows in (2, PHASE_CHUNK_ROWS - 1, PHASE_CHUNK_ROWS, PHASE_CHUNK_ROWS + 1, 2 * PHASE_CHUNK_ROWS + 1):
        times, tick = stamps(rows)
        np.testing.assert_array_equal(assign_ticks(times, PERIOD, "a").tick, tick)
    result = number_rows(7, PERIOD)
    assert result.tick.tolist() == [*range(7)] and result.clock.jitter == result.clock.lost == 0


def test_unusable_time_stamps_are_rejected():
    times, _ = stamps(3000)
    slower = np.concatenate([times[:1500], times[1500] + 2 * (times[1500:] - times[1500])])
    cases = [
        (
            1e3 * times,
            "time: found rows 1 s apart, expected the control period, 0.001 s (is the unit of time right?)",
        ),
        (slower[:2900], "row 1537: time: found rows 0.002 s apart, expected 0.001 s throughout"),
        (np.where(np.arange(3000) == 9, times[3], times), "row 10: time: found 12.303 s after 12.308 s"),
        (stamps(3000, jitter=4e-4)[0], "time: found"),
        # Jitter stays within a tenth of the period, so that phases of neighbouring row groups cannot be
        # confused.
        (0.98 * times, "time: found rows 0.00098 s apart, expected the control period, 0.001 s"),
    ]
    for bad_times, reason in cases:
        with pytest.raises(InputError) as caught:
            assign_ticks(bad_times, PERIOD, "a.csv")
        assert str(caught.value).startswith("a.csv: ") and reason in str(caught.value)
