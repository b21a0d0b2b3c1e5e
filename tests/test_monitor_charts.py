"""Control charts of the monitor: change point, false alarms and detection times."""

import numpy as np
import pytest

from tuning.identification.monitor.change_detection import (
    ALARM_THRESHOLD,
    CHANGE_WINDOW,
    CONTACTS_PER_FALSE_ALARM,
    detect_changes,
)
from tuning.identification.monitor.metrics import METRIC_NAMES

CUSUM_LIMIT, AVERAGE_LIMIT = (
    9.0,
    4.07,
)  # CUSUM (allowance 0.5), average (weight 0.2); joint false-alarm rate as for `ALARM_THRESHOLD`


def test_monitor_change_point_equals_calculation_by_hand():
    z = np.array([[0.0, 1.0], [0.0, np.nan], [2.0, 1.0], [2.0, np.nan]])
    likelier, since = detect_changes(z)
    # (2 + 2)^2 / 2 and (1 + 1)^2 / 2: the statistics equal those for a known change point.
    np.testing.assert_allclose(likelier, [8.0, 2.0])
    assert since.tolist() == [2, 0]
    long = np.zeros((CHANGE_WINDOW + 50, 1))
    long[0], long[-1] = 100.0, 1.0
    likelier, since = detect_changes(long)
    assert likelier == 1.0 and since == CHANGE_WINDOW + 49


def alarms(mean, lanes, contacts, rng):
    """Return the contact of the first alarm in each lane, by likelihood ratio and by both other charts."""
    sums, up, down, average = np.zeros((CHANGE_WINDOW, lanes)), *np.zeros((3, lanes))
    first = np.full((2, lanes), contacts)
    for i in range(contacts):
        z = rng.standard_normal(lanes) + mean(i)
        # Row i holds the sum from contact i on.
        sums[i % CHANGE_WINDOW] = 0.0
        sums += z
        window = min(CHANGE_WINDOW, i + 1)
        number = 1.0 + (i - np.arange(window)[:, None]) % CHANGE_WINDOW
        up, down = np.maximum(up + z - 0.5, 0.0), np.maximum(down - z - 0.5, 0.0)
        average += 0.2 * (z - average)
        beyond = np.stack([
            (sums[:window] ** 2 / number).max(axis=0) > ALARM_THRESHOLD,
            (np.maximum(up, down) > CUSUM_LIMIT) | (np.abs(average) > AVERAGE_LIMIT / 3.0),
        ])  # fmt: skip
        first = np.where(beyond & (first == contacts), i, first)
        if np.all(first < contacts):
            break
    return first


def test_first_monitor_alarm_equals_first_alarm_of_control_charts():
    z = np.random.default_rng(2).standard_normal((40, 3)) + np.array([0.0, 1.5, -4.0])
    for figure in range(3):
        first = next((i for i in range(40) if detect_changes(z[: i + 1])[0][figure] > ALARM_THRESHOLD), 40)
        series = iter(z[:, figure])
        result = alarms(lambda i, series=series: next(series), 1, 40, Silent())
        assert result[0, 0] == first


class Silent:
    """Noise generator that returns zeros."""

    def standard_normal(self, lanes):
        return np.zeros(lanes)


@pytest.mark.slow
def test_control_charts_have_stated_false_alarm_rate_and_detect_as_fast_as_cusum():
    rng, contacts = np.random.default_rng(0), 4000
    first = alarms(lambda i: 0.0, 1500, contacts, rng)
    watched, raised = first.sum(axis=1), (first < contacts).sum(axis=1)
    between = watched / raised / len(METRIC_NAMES)
    print("contacts to a false alarm", between.round(), "of", raised)
    assert abs(between[0] / CONTACTS_PER_FALSE_ALARM - 1.0) < 0.15 and between[1] < 1.2 * between[0]
    for name, mean in (
        ("a jump of 1", lambda i: 1.0), ("of 2", lambda i: 2.0), ("of 4", lambda i: 4.0),
        ("of 6", lambda i: 6.0), ("a drift of 0.1", lambda i: 0.1 * i), ("of 1", lambda i: 1.0 * i),
    ):  # fmt: skip
        delay = alarms(mean, 2000, 100, rng).mean(axis=1) + 1.0
        print(
            f"{name} std a contact: found after {delay[0]:.2f} contacts, by CUSUM and average {delay[1]:.2f}"
        )
        assert delay[0] < 1.15 * delay[1]
