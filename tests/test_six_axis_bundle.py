"""Bundle of a six-axis rig: its files, its self-test in Python and C, and its verification."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import c99_cases
import jax
import numpy as np
import pytest
from bundles import run_selftest
from msgspec import structs
from six_axis_documents import LIMITS, six_axis_document

import tuning
from jaxhil.errors import InputError
from jaxhil.rig import digest
from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS
from jaxhil.rig.six_axes.gain_file import check_six_axis_document
from jaxhil.rig.six_axes.limits import SIX_AXIS_LIMITS, complete_six_axis_limits
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.jax_environment import jax_context
from tuning.bundle.bundle import build_bundle, write_bundle
from tuning.bundle.summary import summary_html
from tuning.bundle.vector_replay import SIX_AXIS_VECTOR_COLUMNS
from tuning.bundle.vectors_six_axes import compare_with_record, record_inputs, run_controller
from tuning.reporting.result_files import read_results
from tuning.sweeps.draws import draw_scenarios
from tuning.sweeps.manifest import ManifestOptions, build_manifest
from tuning.sweeps.store import SweepStore
from tuning.verification.six_axes import run_six_axis_loop
from tuning.verification.six_axis_replay import command_difference, compare_record, record_runs
from tuning.watchdog import six_axes
from tuning.watchdog.six_axes import DrawnRun, alarm_rates, calibrate_six_axes, longest_sum, signal_limits


class Result:
    """Replacement for the result of `tuning.tune`, as an argument of `tuning.export`."""

    def __init__(self, document):
        self.document = document


@pytest.fixture(scope="module")
def built():
    with jax_context():
        return build_bundle(six_axis_document(limits=LIMITS), ["ros2", "matlab", "csv", "c99"])


@pytest.fixture
def folder(built, tmp_path):
    write_bundle(tmp_path / "bundle", built.files)
    return tmp_path / "bundle"


def test_six_axis_bundle_is_complete_and_its_vectors_agree_with_simulation(built):
    assert built.reasons == [] and built.ended == [None] * 4 and built.runs == 52
    assert {name.partition("/")[0] for name in built.files} == {
        *("gains.json", "vectors.csv", "summary.html", "jaxhil_runtime.py", "selftest.py", "ros2.yaml"),
        *("udp_controller.py", "udp_protocol.py", "udp_task.py", "numerical_model_six_axes.py"),
        *("flight_recorder.py", "vector_replay.py"),
        *("gains.mat", "gains.csv", "c99", "README.md", "manifest.json"),
    }
    readme, summary = (built.files[name].decode() for name in ("README.md", "summary.html"))
    assert all(f"`{fault.name}`" in readme for fault in SIX_AXIS_FAULTS) and "Controller6" in readme
    assert "Six axes: target of 1800 kg" in summary and "momentum_error" in summary
    assert len(built.files["vectors.csv"]) < 8e6


def test_report_reads_six_axis_bundle(folder):
    results = read_results([folder])
    assert results.axes == 6 and [source.command for source in results.sources] == ["export"]


def test_six_axis_selftest_passes_in_isolated_python_and_in_c(folder):
    ran = subprocess.run(
        [sys.executable, "-I", "-S", str(folder / "selftest.py")], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0 and ran.stdout.endswith("PASSED\n"), ran.stdout + ran.stderr
    if c99_cases.COMPILER is not None:
        good, text = run_selftest(folder, "--c")
        assert good and "c99: vectors.csv" in text


@pytest.mark.parametrize("name", ["gains.json", "vectors.csv", "jaxhil_runtime.py", "c99/jaxhil_gains.h"])
def test_six_axis_selftest_detects_a_changed_digit(folder, name):
    path = folder / name
    content = bytearray(path.read_bytes())
    digits = [index for index, byte in enumerate(content) if 0x30 <= byte <= 0x38]
    content[digits[2 * len(digits) // 3]] += 1
    path.write_bytes(content)
    good, text = run_selftest(folder)
    assert not good and f"FAIL  {name}" in text


def test_six_axis_c_test_program_detects_a_changed_bit(folder, tmp_path):
    if c99_cases.COMPILER is None:
        pytest.skip("no C compiler (cc) on this machine")
    shutil.copytree(folder / "c99", tmp_path / "c99")
    program = c99_cases.compiled(tmp_path / "c99", "test_vectors.c", "vectors", "jaxhil_controller.c")
    lines = (folder / "vectors.csv").read_text().splitlines()
    columns = SIX_AXIS_VECTOR_COLUMNS.split(",")
    for column in ("wrench_command_z", "pose_command_rx", "faults"):
        row, index = lines[120].split(","), columns.index(column)
        value = float(row[index])
        row[index] = repr(int(value) + 1) if column == "faults" else repr(float(np.nextafter(value, 1e9)))
        changed = tmp_path / "changed.csv"
        changed.write_text("\n".join([*lines[:120], ",".join(row), *lines[121:]]) + "\n")
        ran = subprocess.run([str(program), str(changed)], capture_output=True, text=True)
        assert ran.returncode == 1 and f"changed.csv:121: {column[:12]}" in ran.stdout
    ran = subprocess.run([str(program), str(folder / "vectors.csv")], capture_output=True, text=True)
    assert ran.returncode == 0


def test_six_axis_vector_comparison_ends_at_first_fault_and_reports_difference(built):
    document = six_axis_document(limits={**LIMITS, "force_limit": 20.0})
    with jax_context():
        loaded = check_document(document, any_axes=True)
        _, [record] = record_runs(loaded.mechanism, loaded.compensator, loaded.gains, 0, 0)
    gain_file = check_six_axis_document(document)
    rows, end, reason = compare_with_record(
        run_controller(gain_file, list(record_inputs(0, record, 1e-3))), record
    )
    assert "force_limit" in end and reason is None
    assert np.isnan(rows[-1].inputs.simulated).all() and not np.isnan(rows[0].inputs.simulated).any()
    free = gain_file._replace(limits=complete_six_axis_limits({}))
    changed = free._replace(gains={**free.gains, "velocity_gain": 201.0})
    for other, agrees in ((free, True), (changed, False)):
        rows = run_controller(other, list(record_inputs(0, record, 1e-3)))
        assert (compare_with_record(rows, record)[2] is None) is agrees


def test_six_axis_gain_file_is_checked_against_six_axis_limits():
    with jax_context():
        loaded = check_document(six_axis_document(limits=LIMITS), any_axes=True)
        assert loaded.compensator == "impulse_ledger"
        with pytest.raises(InputError, match="axes"):
            check_document(six_axis_document())
        wrong = six_axis_document(limits=LIMITS)
        wrong["limits"]["torque_range"]["unit"] = "N"
        wrong["sha256"] = digest(wrong)
        with pytest.raises(InputError, match=r"torque_range\.unit"):
            check_document(wrong, any_axes=True)


def test_six_axis_export_rejects_one_axis_limit_names(tmp_path):
    with pytest.raises(InputError, match="free_force"):
        tuning.export(Result(six_axis_document()), tmp_path / "b", limits={"free_force": 1.0})
    with pytest.raises(InputError, match="torque_limit"):
        tuning.export(Result(six_axis_document()), tmp_path / "b", limits={"torque_limit": -1.0})


def test_six_axis_command_difference_is_divided_by_range_of_force_or_torque():
    expected = np.zeros((3, 6))
    expected[1, 0], expected[2, 4] = 100.0, 2.0
    found = expected.copy()
    found[0, 2] += 1.0
    found[1, 5] -= 0.1
    np.testing.assert_allclose(command_difference(found, expected), [0.01, 0.05, 0])
    assert command_difference(np.full((1, 6), 1.0), np.zeros((1, 6)))[0] == np.inf


def test_travel_with_constant_reading_adds_only_successive_steps():
    still = np.array([True, True, False, True, False, True, True, True])
    assert longest_sum(np.arange(1.0, 9.0), still) == 6 + 7 + 8
    assert longest_sum(np.ones(3), np.zeros(3, bool)) == 0.0


@pytest.mark.slow
def test_calibrated_six_axis_limits_accept_good_runs_and_detect_wrong_mass():
    with jax_context():
        loaded = check_document(six_axis_document(), any_axes=True)
        calibration = calibrate_six_axes(loaded, scenarios=64, seed=3)
        assert {*calibration.limits} == {*SIX_AXIS_LIMITS}
        complete_six_axis_limits({k: v for k, v in calibration.limits.items() if v is not None})
        rates = calibration.rates
        # Only sixteen runs determine the limits, so a few of the other runs exceed them.
        assert rates["false_alarms"]["alarms"] <= 8 and rates["false_alarms"]["runs"] >= 40
        (mass,) = rates["fault_runs"]
        assert mass["alarms"] == 0 and mass["runs"] == rates["false_alarms"]["runs"]
        assert rates["verdict"] in ("unknown", "bad")  # there are too few runs for "good"
        tight = {**calibration.limits, "force_limit": 1.0}
        _, records = record_runs(loaded.mechanism, loaded.compensator, loaded.gains, 64, 3)
    gain_file = check_six_axis_document(loaded.document)
    stopped = alarm_rates(gain_file, tight, [DrawnRun(record, 0.01, True) for record in records])
    assert stopped["false_alarms"]["alarms"] == len(records)
    limits = signal_limits(records, 1e-3, loaded.mechanism)
    assert limits["force_limit"] > 1.4 * max(np.max(np.abs(record.command[:, :3])) for record in records)


def test_six_axis_limits_follow_from_the_scenarios_of_a_sweep(monkeypatch):
    """Record the sweep's scenarios in chunks, up to the number of draws."""

    class Recorded(Exception):
        pass

    document, batches = six_axis_document(), []

    def record(mechanism, compensator, gains, batch):
        batches.append(batch)
        if len(batches) == 2:
            raise Recorded
        return SimpleNamespace(status=np.full((1, 4), 1), twist_error=np.full((1, 4), 0.1)), [None] * 4

    monkeypatch.setattr(six_axes, "record_scenarios", record)
    monkeypatch.setattr(six_axes, "LANES", 4)
    with jax_context():
        loaded = check_document(document, any_axes=True)
        manifest = build_manifest(loaded, ManifestOptions(100, seed=5, sampling="sobol", limit=0.3))
        with pytest.raises(Recorded):
            calibrate_six_axes(loaded, SweepStore(Path("sweep"), manifest), scenarios=6)
        _, expected = draw_scenarios(loaded.mechanism, "sobol", 5, 4, 2)
    for leaf, other in zip(jax.tree.leaves(batches[1]), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(leaf, other)
    other = structs.replace(manifest, gains_sha256="0" * 64)
    with pytest.raises(InputError, match=r"sweep: gains_sha256: found 000000000000"):
        calibrate_six_axes(loaded, SweepStore(Path("sweep"), other))


def test_missed_six_axis_alarms_are_counted_above_the_limit_of_the_sweep(built):
    gain_file = check_six_axis_document(built.document)
    with jax_context():
        loaded = check_document(built.document, any_axes=True)
        _, [record] = record_runs(loaded.mechanism, loaded.compensator, loaded.gains, 0, 0)
    runs = [DrawnRun(record, 0.2, False)]
    assert alarm_rates(gain_file, LIMITS, runs, 0.1)["missed_alarms"]["runs"] == 1
    assert alarm_rates(gain_file, LIMITS, runs, 0.3)["missed_alarms"]["runs"] == 0


def test_six_axis_summary_states_the_failure_probability_of_the_sweep():
    probability = {"value": 0.0125, "low": 0.002, "high": 0.04, "method": "binomial, exact"}
    sweep = {"scenarios": 80, "failed": 1, "limit": 0.05, "failure_probability": probability}
    document = six_axis_document(limits=LIMITS)
    page = summary_html({**document, "figures": {**document["figures"], "sweep": sweep}}, b"").decode()
    assert "<p>Sweep: failure probability 0.0125 (95 %: 0.002 to 0.04). 1 of 80 scenarios failed; " in page
    assert "limit of the twist error 0.05.</p>" in page


@pytest.mark.slow
def test_six_axis_verify_passes_in_closed_loop_and_detects_changed_digit(folder):
    good = tuning.verify(folder, scenarios=3)
    assert good.good and good.document["axes"] == 6
    assert good.document["closed_loop"]["difference"] < 1e-10
    path = folder / "gains.json"
    document = json.loads(path.read_text())
    document["gains"]["velocity_gain"]["value"] = 200.1
    path.write_text(json.dumps(document))
    bad = tuning.verify(folder, scenarios=3)
    assert not bad.good and any("gains.json" in reason for reason in bad.reasons)


@pytest.mark.slow
def test_six_axis_closed_loop_detects_controller_with_changed_gains():
    document = six_axis_document()
    with jax_context():
        loaded = check_document(document, any_axes=True)
        gain_file = check_six_axis_document(document)
        changed = gain_file._replace(gains={**gain_file.gains, "velocity_gain": 180.0})
        assert run_six_axis_loop(loaded, gain_file, 240).difference < 1e-10
        assert run_six_axis_loop(loaded, changed, 240).difference > 1e-6
        _, [record] = record_runs(loaded.mechanism, loaded.compensator, loaded.gains, 0, 0)
        assert compare_record(Controller6(gain_file), record).difference < 1e-9
        assert compare_record(Controller6(changed), record).difference > 1e-9


@pytest.mark.slow
def test_six_axis_export_reports_good_alarm_rates(tmp_path):
    exported = tuning.export(Result(six_axis_document()), tmp_path / "bundle")
    assert exported.verdict == "good", exported.reasons
    rates = exported.document["rates"]
    assert rates["false_alarms"]["high"] <= 0.01 and rates["fault_runs"][0]["high"] <= 0.02
    assert tuning.verify(tmp_path / "bundle", scenarios=2).good
