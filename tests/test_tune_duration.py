"""Estimate of the duration of a tuning from the previous tuning on this computer."""

import time
from types import SimpleNamespace

import tuning.api.tune
import tuning.gains.tune_all
from jaxhil.mechanism.file import load, load_any
from jaxhil.simulation.jax_environment import CACHE_VARIABLE
from tuning import terminal
from tuning.api.tune import tune_each
from tuning.api.tune_duration import RECORD_FILE, describe_expected_duration, record_duration
from tuning.api.tune_options import TuneOptions


def test_expected_duration_is_proportional_to_the_last_tuning(monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    one, six = [load("rig-300kg").mechanism], [load_any("probe-drogue").mechanism]
    for mechanisms in (one, six):
        assert "the time is unknown" in describe_expected_duration(mechanisms, "phase_lead", 1000)
        record_duration(mechanisms, "phase_lead", 1000, 30.0)
        assert "about 0:01:00 as measured" in describe_expected_duration(mechanisms, "phase_lead", 2000)
        assert "0:00:03 to 0:00:30, the time of a longer" in describe_expected_duration(
            mechanisms, "phase_lead", 100
        )
    assert "the time is unknown" in describe_expected_duration(one, "response_error", 1000)
    (tmp_path / RECORD_FILE).write_text("no JSON")
    assert "the time is unknown" in describe_expected_duration(one, "phase_lead", 1000)


def test_recorded_duration_excludes_the_time_of_the_caller(monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    seconds, texts = 0.0, []
    monkeypatch.setattr(time, "monotonic", lambda: seconds)

    def tune_all(mechanisms, compensator, settings, work, *_, **__):
        nonlocal seconds
        work.announce(2000)
        for index, mechanism in enumerate(mechanisms):
            seconds += 15.0
            work.report_runs(500)
            yield index, SimpleNamespace(mechanism=mechanism)

    monkeypatch.setattr(tuning.gains.tune_all, "tune_all", tune_all)
    monkeypatch.setattr(tuning.api.tune.TunedGains, "__init__", lambda *_, **__: None)
    loaded, options = [load("rig-300kg"), load("rig-300kg")], TuneOptions(compensator="phase_lead")
    with terminal.show_progress(2, "mechanisms", False) as bar:
        for _ in tune_each(loaded, options, bar):
            seconds += 1000.0  # such as the time to draw plots
        next(tune_each(loaded, options, bar, announce=texts.append))
    assert len(texts) == 1 and "about 0:01:00 as measured" in texts[0]
