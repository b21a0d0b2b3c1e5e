"""Which tick's readings a row holds, told by noise: rigs of an independent simulator, logged in every way."""

from dataclasses import replace

import campaigns
import pytest

from jaxhil.errors import InputError
from tuning.identification.logs.causality import check_rows_of, rows_ahead

SPEEDS = (0.003, 0.006, 0.012) * 2


def logged(run, ahead):
    """The run in rows whose readings are `ahead` of what a row of one tick has."""
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
def test_noise_tells_which_readings_are_in_a_row(kind):
    for ahead, row in ((-1, "after"), (0, "tick"), (1, "sent")):
        runs, timing = runs_of(kind, ahead)
        assert rows_ahead(runs) == ahead
        check_rows_of(runs, replace(timing, row=row), 0)
        for other in {"tick", "sent", "after"} - {row}:
            with pytest.raises(InputError, match=f'timing.row: found "{other}", but .* row = "{row}"'):
                check_rows_of(runs, replace(timing, row=other), 0)
    # Rows with the next tick's readings look as if the controller took a tick to compute.
    runs, timing = runs_of(kind, -1)
    check_rows_of(runs, timing, 1)
    with pytest.raises(InputError, match="or computing_delay = 1"):
        check_rows_of(runs, timing, 0)


def test_without_noise_or_runs_enough_nothing_is_said():
    (run, *others), timing = runs_of("clean")
    assert rows_ahead([run, *others]) == 0
    assert rows_ahead([run]) is None and rows_ahead([]) is None
    steady = [replace(one, force_measured=one.position_measured * 1e5) for one in (run, *others)]
    smooth = [replace(one, force_measured=one.position_desired * 1e5) for one in (run, *others)]
    assert rows_ahead(smooth) is None
    assert rows_ahead(steady) in (None, 0)
    check_rows_of(smooth, replace(timing, row="sent"), 0)
