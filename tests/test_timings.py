"""Option `--timings`: nested times are counted once, and results do not change."""

import jax
import pytest

from tuning.cli import timings


def test_timings_count_overlapping_time_intervals_once():
    assert timings.union_duration([(0.0, 2.0), (1.0, 3.0), (5.0, 6.0), (5.2, 5.5)]) == 4.0
    spans = {
        "importing": [(0.0, 1.0)],
        "reading cached programs": [(2.0, 2.25)],
        "compiling": [(2.0, 3.0)],
        "tracing": [(0.5, 2.0), (1.0, 1.5)],
    }
    assert timings.format_timings(0.0, 10.0, spans) == (
        "10.00 s in all: all else 7.00 s, importing 1.00 s, tracing 1.00 s, compiling 0.75 s, "
        "reading cached programs 0.25 s"
    )


def test_timings_include_compile_and_cache_times_reported_by_jax(capsys):
    with timings.report_timings(True):
        jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 9.5)
        jax.monitoring.record_event_duration_secs("/jax/compilation_cache/cache_retrieval_time_sec", 4.24)
    output = capsys.readouterr().err
    assert "compiling 5." in output and "reading cached programs 4.24 s" in output


@pytest.mark.parametrize("arguments", [(), ("--json",)])
def test_timings_option_does_not_change_command_output(jaxhil, arguments):
    plain, ran = jaxhil("mechanisms", *arguments), jaxhil("mechanisms", "--timings", *arguments)
    assert ran.code == plain.code == 0 and ran.out == plain.out
    assert plain.err == "" and ran.err.startswith("took: ") and "s in all" in ran.err
