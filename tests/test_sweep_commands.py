"""`jaxhil sweep` and `jaxhil replay`: exit codes, JSON documents, one-line error messages."""

import json
import resource
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from sweep_cases import case

from jaxhil.rig import digest
from tuning.__main__ import main
from tuning.gain_file import write_gain_file
from tuning.sweeps.store import read_chunk, read_store, write_chunk
from tuning.sweeps.studies import estimate_rare_failure

TINY = ["--scenarios", "100", "--chunk", "64"]


@pytest.fixture(scope="module")
def gains(tmp_path_factory):
    path = tmp_path_factory.mktemp("gains") / "gains.json"
    write_gain_file(path, case())
    return path


@pytest.fixture(scope="module")
def store(gains, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "store"
    assert main(["sweep", str(gains), *TINY, "-o", str(folder), "--limit", "1.5"]) == 1
    return folder


@pytest.fixture
def own_store(gains, store, tmp_path):
    """Return a store used by a single test, and the command that resumes its sweep."""
    folder = tmp_path / "own"
    shutil.copytree(store, folder)
    return folder, ["sweep", gains, *TINY, "-o", folder, "--limit", "1.5", "--resume"]


def refused(ran, *words):
    code, out, err = ran
    assert code == 2 and out == ""
    assert err.startswith("jaxhil: ") and err.count("\n") == 1
    assert all(word in err for word in words), err


def document(ran):
    return json.loads(ran[1], parse_constant=pytest.fail)


def test_sweep_command_prints_results_as_json(jaxhil, gains, store):
    ran = jaxhil("sweep", gains, *TINY, "-o", store, "--limit", "1.5", "--resume", "--json")
    result = document(ran)
    assert ran[0] == 1 and result["verdict"] == "bad"
    probability = result["failure_probability"]
    assert probability["low"] < result["failed"] / 100 == probability["value"] < probability["high"]
    assert sum(result["outcomes"].values()) == result["scenarios"] == 100
    errors = [abs(one["worst_error"]) for one in result["worst"]]
    assert len(errors) == 10 and errors == sorted(errors, reverse=True) and errors[0] > 1.5
    assert result["worst"][0]["inputs"].keys() == {
        *("contact.stiffness_1", "rig.force_sensor.delay", "approach.phase_1"),
    }


def test_sweep_verdict_depends_on_the_acceptable_probability(jaxhil, gains, store):
    again = ["sweep", gains, *TINY, "-o", store, "--limit", "1.5", "--resume"]
    high = document(jaxhil(*again, "--json"))["failure_probability"]["high"]
    assert jaxhil(*again, "--acceptable", high + 1e-6)[0] == 0
    assert jaxhil(*again, "--acceptable", high - 1e-6)[0] == 1


def test_sweep_verdict_is_good_without_failures(jaxhil, gains, tmp_path):
    shutil.copy(gains, tmp_path / "best.json")
    code, out, _ = jaxhil("sweep", tmp_path / "best.json", *TINY, "--limit", "inf")
    assert code == 0 and "Good" in out and "Failure probability 0," in out
    assert (tmp_path / "best-sweep" / "manifest.json").is_file()
    # The title stays on one line above a narrower table.
    assert "case, compensation: none, 100 scenarios (random, float64)\n" in out


def test_sobol_sweep_excludes_last_incomplete_block_from_replicates(jaxhil, gains, tmp_path):
    sobol = ["sweep", gains, *TINY, "--sampling", "sobol", "--limit", "1.5", "-o", tmp_path / "new"]
    ran = jaxhil(*sobol, "--json")
    result = document(ran)
    assert sum(result["outcomes"].values()) == 100 and result["left_out_of_replicates"] == 4
    probability = result["failure_probability"]
    assert 0 < probability["low"] < probability["value"] < probability["high"] < 1
    assert (probability["value"] * 96).is_integer()
    code, out, _ = jaxhil(*sobol, "--resume")
    assert code == 1 and "The last 4 scenarios" in out


def test_sweep_command_compares_float32_with_float64(jaxhil, gains, tmp_path):
    ran = jaxhil("sweep", gains, *TINY, "-o", tmp_path / "n", "--precision", "float32", "--json")
    compared = document(ran)["float32"]
    assert compared["scenarios"] == 64 and 0 < compared["largest_difference"] < 1e-4


def test_sweep_stops_at_the_requested_interval_width(jaxhil, gains, tmp_path):
    wide = ["sweep", gains, "--scenarios", "1000", "--chunk", "64", "--limit", "1.5", "-o", tmp_path / "n"]
    wide += ["--until-width", "0.3"]
    ran = jaxhil(*wide, "--json")
    result = document(ran)
    assert ran[0] == 1 and result["scenarios"] < result["most_scenarios"] == 1000
    probability = result["failure_probability"]
    assert probability["high"] - probability["low"] <= 0.3 and "repeated looks" in probability["method"]
    code, out, _ = jaxhil(*wide, "--resume")
    assert code == 1 and f"Stopped after {result['scenarios']} of at most 1000" in out
    assert "valid under repeated" in out
    assert jaxhil("replay", tmp_path / "n", 0)[0] == 0
    refused(jaxhil("replay", tmp_path / "n", 999), "before the sweep's end")


def test_sweep_command_reports_quantiles_of_the_error(jaxhil, gains, store):
    again = ["sweep", gains, *TINY, "-o", store, "--limit", "1.5", "--resume"]
    result = document(jaxhil(*again, "--json"))["error_quantiles"]
    assert [one["order"] for one in result] == [0.5, 0.95, 0.99, 0.999]
    assert result[0]["low"] < result[0]["value"] < result[0]["high"] < result[1]["value"]
    out = jaxhil(*again)[1]
    assert "99.9 %" in out and "no bound" in out


def test_sweep_command_reports_sobol_indices_and_subset_simulation(jaxhil, own_store):
    again = [*own_store[1], "--drivers", "16", "--rare"]
    result = document(jaxhil(*again, "--json"))
    drivers, rare = result["drivers"], result["rare"]
    assert drivers["evaluations"] == 16 * 5 and drivers["cap"] == 15
    names = [one["input"] for one in drivers["inputs"]]
    assert sorted(names) == ["approach.phase", "contact.stiffness", "rig.force_sensor.delay"]
    assert rare["limit"] == 1.5 and rare["low"] < rare["probability"] < rare["high"]
    brute = result["failure_probability"]
    assert brute["low"] < rare["probability"] < brute["high"]
    out = jaxhil(*again)[1]
    assert "Subset simulation" in out and "first order" in out and names[0] in out


STUDIES = ["--drivers", "16", "--rare", "1.6"]
KEPT = ("studies/drivers-16.json", "studies/rare-1.6-10x1000.json")


@pytest.fixture
def quick(monkeypatch):
    """Return options for subset simulation with few samples, without plots."""
    monkeypatch.setattr(
        "tuning.sweeps.studies.estimate_rare_failure", partial(estimate_rare_failure, samples=20)
    )
    monkeypatch.setattr("tuning.plots.sweep.write_plots", lambda *_: [])


def no_study(monkeypatch, *names):
    for name in names:
        monkeypatch.setattr(f"tuning.sweeps.studies.{name}", lambda *_: pytest.fail("run again"))


def test_saved_sweep_verdict_equals_printed_verdict(jaxhil, own_store):
    folder, again = own_store
    ran = jaxhil(*again, "--json")
    assert (folder / "verdict.json").read_text() == ran[1]
    (folder / "verdict.json").unlink()
    assert jaxhil(*again, "--acceptable", "1")[0] == 0
    result = json.loads((folder / "verdict.json").read_text())
    assert result["sha256"] == digest(result) and document(ran)["sha256"] == digest(document(ran))
    changed = {"acceptable": 1.0, "verdict": "good", "sha256": result["sha256"]}
    assert result == {**document(ran), **changed}
    assert jaxhil("replay", folder, 5)[0] == 0


def test_finished_sweep_studies_are_not_repeated(jaxhil, own_store, quick, monkeypatch):
    folder, again = own_store
    first = jaxhil(*again, *STUDIES, "--json")
    assert (folder / "verdict.json").read_text() == first[1] and "as kept" not in first[2]
    assert sorted(path.name for path in (folder / "studies").iterdir()) == [Path(one).name for one in KEPT]
    no_study(monkeypatch, "compute_error_indices", "estimate_rare_failure")
    second = jaxhil(*again, *STUDIES, "--json")
    assert second[1] == first[1]
    assert all(f"read from {folder / one}\n" in second[2] for one in KEPT)
    # Results for other arguments are not reused.
    with pytest.raises(pytest.fail.Exception):
        jaxhil(*again, "--drivers", "32")


def test_new_sweep_does_not_reuse_studies_of_old_sweep(jaxhil, gains, own_store, quick, tmp_path):
    folder, again = own_store
    jaxhil(*again, *STUDIES)
    new = [*("sweep", gains, *TINY, "-o", tmp_path / "other", "--limit", "1.5"), *STUDIES]
    ran = jaxhil(*new)
    assert ran[0] == 1 and "as kept" not in ran[2]
    # The same manifest gives the same studies, to the bit.
    for one in KEPT:
        assert (tmp_path / "other" / one).read_bytes() == (folder / one).read_bytes()
    refused(jaxhil(*new), "other", "--resume")


def test_interrupted_sweep_keeps_verdict_and_finished_studies(jaxhil, own_store, quick, monkeypatch):
    folder, again = own_store
    (folder / "verdict.json").unlink()

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("tuning.plots.sweep.write_plots", interrupted)
        assert jaxhil(*again, *STUDIES)[:2] == (130, "")
    assert json.loads((folder / "verdict.json").read_text())["verdict"] == "bad"
    with monkeypatch.context() as patched:
        patched.setattr("tuning.sweeps.studies.estimate_rare_failure", interrupted)
        assert jaxhil(*again, *STUDIES)[:2] == (130, "")
    so_far = json.loads((folder / "verdict.json").read_text())
    assert so_far["verdict"] == "bad" and so_far["drivers"]["evaluations"] == 80 and "rare" not in so_far
    assert [(folder / one).exists() for one in KEPT] == [True, False]
    no_study(monkeypatch, "compute_error_indices")
    result = document(jaxhil(*again, *STUDIES, "--json"))
    assert result["drivers"] == so_far["drivers"] and result["rare"]["limit"] == 1.6


def test_damaged_sweep_study_is_computed_again(jaxhil, own_store, quick):
    folder, again = own_store
    first = jaxhil(*again, *STUDIES, "--json")
    contents = {folder / one: (folder / one).read_bytes() for one in KEPT}
    for path, content in contents.items():
        path.write_bytes(content.replace(b'"evaluations": ', b'"evaluations": 1'))
    second = jaxhil(*again, *STUDIES, "--json")
    assert second[1] == first[1] and "as kept" not in second[2]
    assert {path: path.read_bytes() for path in contents} == contents


def unwritable(ran, name):
    """Check for one line and exit code 2, with the verdict printed."""
    code, out, err = ran
    assert code == 2 and err.splitlines()[-1].startswith("jaxhil: ") and err.count("jaxhil: ") == 1
    assert f"{name}: cannot be written: " in err.splitlines()[-1]
    return json.loads(out)


def test_sweep_verdict_is_printed_if_study_cannot_be_written(jaxhil, own_store, quick):
    folder, again = own_store
    (folder / "studies").touch()
    result = unwritable(jaxhil(*again, *STUDIES, "--json"), KEPT[0])
    assert (
        result["verdict"] == "bad"
        and result["drivers"]["evaluations"] == 80
        and result["rare"]["limit"] == 1.6
    )
    assert json.loads((folder / "verdict.json").read_text()) == result
    (folder / "studies").unlink()
    assert document(jaxhil(*again, *STUDIES, "--json")) == result


def test_sweep_verdict_is_printed_if_disk_is_full(jaxhil, own_store, quick):
    folder, again = own_store
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        ran = jaxhil(*again, *STUDIES, "--json")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    result = unwritable(ran, "verdict.json")
    assert (
        result["verdict"] == "bad"
        and result["drivers"]["evaluations"] == 80
        and result["rare"]["limit"] == 1.6
    )
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_replay_command_reproduces_row_bit_for_bit(jaxhil, store, tmp_path):
    ran = jaxhil("replay", store, 77, "--json", "--plot", tmp_path / "plots" / "77.png")
    result = document(ran)
    assert ran[0] == 0 and result["verdict"] == "good" and result["different"] == []
    assert result["index"] == 77 and len(result["contacts"]) == 1
    assert (tmp_path / "plots" / "77.png").stat().st_size > 10_000
    code, out, _ = jaxhil("replay", store, 0)
    assert code == 0 and "to the bit" in out


def test_replay_command_detects_changed_rows(jaxhil, gains, tmp_path):
    folder = tmp_path / "store"
    jaxhil("sweep", gains, *TINY, "-o", folder)
    opened = read_store(folder)
    rows = dict(read_chunk(opened, 0))
    rows["duration_1"] = rows["duration_1"] * (1 + 1e-15)
    write_chunk(opened, 0, rows)
    code, out, _ = jaxhil("replay", folder, 3)
    assert code == 1 and "Bad: differs" in out and "duration_1" in out
    rows["error_1"] = rows["error_1"] * (1 + 1e-15)
    write_chunk(opened, 0, rows)
    refused(jaxhil("replay", folder, 3), "parts/part-000000.parquet: found a damaged file or one of another")


def test_sweep_and_replay_reject_impossible_arguments(jaxhil, gains, store, tmp_path):
    new = ["-o", tmp_path / "new"]
    refused(jaxhil("sweep", gains, *new, "--scenarios", "0"), "--scenarios", "found 0")
    refused(jaxhil("sweep", gains, *new, "--scenarios", 2**33), "--scenarios", str(2**32))
    refused(jaxhil("sweep", gains, *new, "--sampling", "dice"), "--sampling", "random, sobol")
    few = ["--scenarios", "15", "--sampling", "sobol"]
    refused(jaxhil("sweep", gains, *few, *new), "--scenarios: found 15", "16")
    refused(jaxhil("sweep", gains, *new, "--precision", "half"), "--precision", "float32")
    refused(jaxhil("sweep", gains, *new, "--limit", "nan"), "--limit")
    refused(jaxhil("sweep", gains, *new, "--acceptable", "2"), "--acceptable")
    refused(jaxhil("sweep", gains, *new, "--until-width", "0"), "--until-width: found 0")
    sobol = ["--until-width", "0.1", "--sampling", "sobol"]
    refused(
        jaxhil("sweep", gains, *new, *sobol), "--until-width: found sampling sobol, expected sampling random"
    )
    refused(jaxhil("sweep", gains, *new, "--drivers", "100"), "--drivers: found 100", "power of two")
    refused(jaxhil("sweep", gains, *new, "--rare", "0.001"), "--rare: found 0.001", "at least --limit")
    refused(jaxhil("sweep", gains, *new, "--rare", "--limit", "inf"), "--rare")
    refused(jaxhil("sweep", tmp_path / "none.json", *new), "none.json")
    refused(jaxhil("sweep", gains, *TINY, "-o", store), "--resume")
    refused(jaxhil("sweep", gains, *TINY, "-o", store, "--resume"), "limit: found 1.5, requested 0.01")
    (tmp_path / "file").touch()
    refused(jaxhil("sweep", gains, *TINY, "-o", tmp_path / "file" / "store"), "cannot be written")
    refused(jaxhil("replay", store, 100), "found 100, expected 0 to 99")
    refused(jaxhil("replay", tmp_path, 0), "manifest.json")
    assert not (tmp_path / "new").exists()


def test_sweep_command_configures_jax_before_importing_it():
    # XLA reads its flags, which affect the last bits of every row, when it starts.
    program = (
        "import sys, tuning.cli.commands.sweep, tuning.cli.commands.replay; sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
