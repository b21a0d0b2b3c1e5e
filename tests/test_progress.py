"""Progress messages of long computations without a terminal: completed work, rate and remaining time."""

import re
import time

import pytest

from tuning import terminal


@pytest.fixture
def clock(monkeypatch):
    """Return a clock whose time is set by the test."""
    now = [1000.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    return now


def lines(capsys):
    return capsys.readouterr().err.splitlines()


def test_progress_line_states_completed_work_rate_and_remaining_time(clock, capsys):
    with terminal.show_progress(64, "mechanisms") as bar:
        bar.tell("first", 0)
        clock[0] += 60
        bar.tell("second", 16)
        bar.tell("second", 17)
        clock[0] += 60
        bar.tell("second", 32)
        clock[0] += 1
        bar.tell("second", 33)
    first, second, third = lines(capsys)
    assert first == "0:00:00 so far, first"
    assert second == "16 of 64 mechanisms, 16 mechanisms/min, 0:03:00 left, second"
    assert third == "32 of 64 mechanisms, 16 mechanisms/min, 0:02:00 left, second"


def test_progress_rate_excludes_work_done_before_resuming(clock, capsys):
    with terminal.show_progress(40, "results") as bar:
        bar.tell("as kept", 20, 20)
        clock[0] += 100
        bar.tell("more", 30, 20)
    assert lines(capsys)[1] == "30 of 40 results, 6 results/min, 0:01:40 left, more"


def test_progress_of_a_single_item_is_shown_as_percentage(clock, capsys):
    with terminal.show_progress(1, "fronts") as bar:
        clock[0] += 36
        bar.tell("searching", 0.25)
    assert lines(capsys) == ["25 %, 41.7 %/min, 0:01:48 left, searching"]


def test_progress_counts_each_stage_when_the_stage_begins(clock, capsys):
    with terminal.show_stages(3) as stages:
        for text in ("one", "two", "three"):
            stages.begin(text)
            clock[0] += 2
    assert [line.split(", ")[0] for line in lines(capsys)] == [
        "0:00:00 so far",
        "1 of 3 stages",
        "2 of 3 stages",
    ]


def test_progress_of_short_work_is_not_printed(clock, capsys):
    with terminal.show_stages(3) as stages:
        for text in ("one", "two", "three"):
            stages.turn_to(text)
        clock[0] += 11
        stages.reach(2)
    assert lines(capsys) == ["2 of 3 stages, 10.9 stages/min, 0:00:06 left, three"]


def test_progress_is_printed_with_elapsed_time_after_silence(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "PROGRESS_INTERVAL", 0.02)
    monkeypatch.setattr(terminal, "MAX_SILENCE", 0.03)
    with terminal.show_progress(10, "scenarios") as bar:
        bar.tell("compiling", 1)
        time.sleep(0.5)
    result = lines(capsys)
    assert len(result) >= 3 and all(line.endswith("compiling") for line in result)
    assert all(re.match(r"1 of 10 scenarios, .* left, compiling", line) for line in result)


def test_progress_shows_elapsed_time_before_first_work_is_reported(clock, capsys):
    with terminal.show_progress(100, "runs") as bar:
        clock[0] += 21
        bar.remind()
        bar.advance(1)
    assert lines(capsys) == ["0:00:21 so far"]


def test_progress_is_printed_only_on_request(clock, capsys):
    with terminal.show_progress(2, "parts", shown=False) as bar:
        bar.advance(1, "one")
        clock[0] += 100
        bar.advance(1, "two")
    assert capsys.readouterr() == ("", "")
