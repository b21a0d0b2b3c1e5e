"""Lost rows: commands are restored by the model, sensor readings are not; division into runs."""

import numpy as np
import pytest
from log_cases import MASS, PERIOD, touches

from tuning.identification.logs.lost_rows import MAX_RECONSTRUCTED_ROWS, split_at_gaps

LOG = touches(2, noise=2.0)
CHANNELS = {
    "position_desired": "xd",
    "position_measured": "xm",
    "force_measured": "F",
    "velocity_desired": "vd",
    "force_command": "Fc",
}
TOUCH = 260  # a row in the middle of the first touch


def cut(lost, without=(), cuts=()):
    rows = np.setdiff1d(np.arange(1200), lost)
    channels = {name: None if name in without else LOG[column][rows] for name, column in CHANNELS.items()}
    channels["contact_index"] = np.repeat([0, 1], 600)[rows]
    return split_at_gaps(rows, channels, np.array(cuts, int), PERIOD, MASS)


@pytest.mark.parametrize(("lost", "error"), [(1, 1e-17), (2, 1e-17), (3, 1e-8)])
def test_lost_commands_are_restored_by_the_numerical_model(lost, error):
    gone = np.arange(TOUCH, TOUCH + lost)
    (result,) = cut(gone)
    np.testing.assert_array_equal(result.tick, np.arange(1200))
    assert np.flatnonzero(~result.valid).tolist() == gone.tolist()
    assert np.max(np.abs(result.channels["position_desired"] - LOG["xd"])) <= error
    for name in ("position_measured", "force_measured", "force_command"):
        np.testing.assert_array_equal(np.isnan(result.channels[name]), ~result.valid)
        np.testing.assert_array_equal(result.channels[name][result.valid], LOG[CHANNELS[name]][result.valid])
    assert set(result.channels["contact_index"]) == {0, 1}


def test_lost_commands_without_model_are_mostly_restored_by_cubic_interpolation():
    (result,) = cut([TOUCH, TOUCH + 1], without=["force_command"])
    assert np.max(np.abs(result.channels["position_desired"] - LOG["xd"])) < 1e-7
    (many,) = cut([TOUCH, TOUCH + 4, TOUCH + 6, TOUCH + 7, 1198], without=["velocity_desired"])
    assert np.max(np.abs(many.channels["position_desired"] - LOG["xd"])) < 1e-6
    assert len(many.tick) == 1200


def test_log_is_divided_at_long_gaps_and_specified_times():
    first, second, third = cut(
        np.arange(300, 300 + MAX_RECONSTRUCTED_ROWS + 1), cuts=[700 - MAX_RECONSTRUCTED_ROWS - 1]
    )
    assert [(one.tick[0], one.tick[-1]) for one in (first, second, third)] == [
        (0, 299),
        (304, 699),
        (700, 1199),
    ]
    assert all(one.valid.all() for one in (first, second, third))
    np.testing.assert_array_equal(third.channels["position_desired"], LOG["xd"][700:])
