"""Estimate of the time of a tuning from the last one on this computer."""

from jaxhil.mechanism.file import load, load_any
from jaxhil.simulation.jax_environment import CACHE_VARIABLE
from tuning.api.tune_duration import RECORD_FILE, describe_expected_duration, record_duration


def test_expected_duration_is_proportional_to_the_last_tuning(monkeypatch, tmp_path):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    one, six = [load("rig-300kg").mechanism], [load_any("probe-drogue").mechanism]
    for mechanisms in (one, six):
        assert "the time is unknown" in describe_expected_duration(mechanisms, "phase_lead", 1000)
        record_duration(mechanisms, "phase_lead", 1000, 30.0)
        assert "about 0:01:00 as measured" in describe_expected_duration(mechanisms, "phase_lead", 2000)
    assert "the time is unknown" in describe_expected_duration(one, "response_error", 1000)
    (tmp_path / RECORD_FILE).write_text("no JSON")
    assert "the time is unknown" in describe_expected_duration(one, "phase_lead", 1000)
