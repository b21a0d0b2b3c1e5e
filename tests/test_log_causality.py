"""Tick of the readings in a log row, estimated from sensor noise in logs of an independent simulator."""

from dataclasses import replace

import campaigns
import numpy as np
import pytest

from jaxhil.errors import InputError
from tuning.identification.logs.row_convention import (
    check_row_convention,
    detect_common_integrator,
    detect_reading_offset,
)

SPEEDS = (0.003, 0.006, 0.012) * 2


def logged(run, ahead):
    """Return the run with rows whose readings were measured `ahead` ticks later."""
    end = len(run.tick) - 1
    command = slice(1, None) if ahead > 0 else slice(0, end)
    reading = slice(1, None) if ahead < 0 else slice(0, end)
    return replace(
        run,
        tick=run.tick[:end],
        position_desired=run.position_desired[command],
        position_measured=run.position_measured[reading],
        force_measured=run.force_measured[reading],
        valid=run.valid[reading],
    )


def runs_of(kind, ahead=0, speeds=SPEEDS):
    whole = campaigns.campaign(kind, 1, speeds=speeds, seconds=0, rest=0)
    return [logged(run, ahead) for run in whole.runs], whole.timing


KINDS = ["noisy", *(pytest.param(one, marks=pytest.mark.slow) for one in campaigns.KINDS if one != "noisy")]


@pytest.mark.parametrize("kind", KINDS)
def test_sensor_noise_reveals_the_tick_of_readings_in_a_log_row(kind):
    for ahead, row in ((-1, "after"), (0, "tick"), (1, "sent")):
        runs, timing = runs_of(kind, ahead)
        assert detect_reading_offset(runs) == ahead
        check_row_convention(runs, replace(timing, row=row))
        for other in {"tick", "sent", "after"} - {row}:
            with pytest.raises(InputError, match=f'timing.row: found "{other}", but .* row = "{row}"'):
                check_row_convention(runs, replace(timing, row=other))
    # Rows with the next tick's readings look as if the controller took a tick to compute.
    runs, timing = runs_of(kind, -1)
    check_row_convention(runs, replace(timing, computing_delay=1))
    with pytest.raises(InputError, match=r'or computing_delay = 1 or .* rig.integrator is "explicit_euler"'):
        check_row_convention(runs, timing)


def test_tick_of_log_readings_is_estimated_if_rig_moves_before_and_after_contact():
    runs, _ = runs_of("noisy", -1)
    rng, path = np.random.default_rng(0), 1e-3 * np.cos(np.linspace(0.0, 3.0, 1000))
    for at, run in enumerate(runs):
        before, after = run.position_desired[0] + path - path[-1], run.position_desired[-1] + path - path[0]
        noise = 2.67 * rng.standard_normal((2, 1000))
        force = np.concatenate([noise[0], run.force_measured, noise[1]])
        x = np.concatenate([before, run.position_desired, after])
        runs[at] = replace(run, position_desired=x, force_measured=force, valid=np.ones(len(x), bool))
    assert detect_reading_offset(runs) == -1


def test_force_command_of_explicit_integrator_acts_one_tick_later():
    """The position is integrated with the old velocity, as if the controller needed a further tick."""
    runs, timing = runs_of("noisy", -1)
    speeds = [np.diff(run.position_desired, append=np.nan) / 1e-3 for run in runs]
    moved = [replace(run, velocity_desired=v) for run, v in zip(runs, speeds, strict=True)]
    result = detect_common_integrator(moved, 1e-3)
    assert result == "explicit_euler" and detect_common_integrator(runs[:0], 1e-3) is None
    check_row_convention(moved, timing, result)
    with pytest.raises(InputError, match=r'"sent", but .* expected row = "tick" or computing_delay = 1$'):
        check_row_convention(moved, replace(timing, row="sent"), result)


def test_tick_of_log_readings_is_not_reported_without_noise_or_enough_runs():
    (run, *others), timing = runs_of("clean")
    assert detect_reading_offset([run, *others]) == 0
    assert detect_reading_offset([run]) is None and detect_reading_offset([]) is None
    steady = [replace(one, force_measured=one.position_measured * 1e5) for one in (run, *others)]
    smooth = [replace(one, force_measured=one.position_desired * 1e5) for one in (run, *others)]
    assert detect_reading_offset(smooth) is None
    assert detect_reading_offset(steady) in (None, 0)
    check_row_convention(smooth, replace(timing, row="sent"))
