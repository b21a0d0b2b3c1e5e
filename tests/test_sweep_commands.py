"""`jaxhil sweep` and `jaxhil replay`: exit codes, one JSON document, refusals of one line."""

import json
import subprocess
import sys

import pytest
from sweep_cases import case

from tuning.__main__ import main
from tuning.gain_file import write_gain_file
from tuning.sweeps.store import read_part, read_store, write_part

TINY = ["--scenarios", "100", "--chunk", "64"]


pytestmark = pytest.mark.usefixtures("no_cache")


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


def refused(ran, *words):
    code, out, err = ran
    assert code == 2 and out == ""
    assert err.startswith("jaxhil: ") and err.count("\n") == 1
    assert all(word in err for word in words), err


def document(ran):
    return json.loads(ran[1], parse_constant=pytest.fail)


def test_sweep_says_what_it_found_in_json(jaxhil, gains, store):
    ran = jaxhil("sweep", gains, *TINY, "-o", store, "--limit", "1.5", "--resume", "--json")
    found = document(ran)
    assert ran[0] == 1 and found["verdict"] == "bad"
    probability = found["failure_probability"]
    assert probability["low"] < found["failed"] / 100 == probability["value"] < probability["high"]
    assert sum(found["outcomes"].values()) == found["scenarios"] == 100
    errors = [abs(one["worst_error"]) for one in found["worst"]]
    assert len(errors) == 10 and errors == sorted(errors, reverse=True) and errors[0] > 1.5
    assert found["worst"][0]["inputs"].keys() == {
        *("contact.stiffness_1", "rig.force_sensor.delay", "approach.phase_1"),
    }


def test_the_acceptable_probability_decides(jaxhil, gains, store):
    again = ["sweep", gains, *TINY, "-o", store, "--limit", "1.5", "--resume"]
    high = document(jaxhil(*again, "--json"))["failure_probability"]["high"]
    assert jaxhil(*again, "--acceptable", high + 1e-6)[0] == 0
    assert jaxhil(*again, "--acceptable", high - 1e-6)[0] == 1


def test_no_failure_is_good(jaxhil, gains, tmp_path):
    code, out, _ = jaxhil("sweep", gains, *TINY, "-o", tmp_path / "new", "--limit", "inf")
    assert code == 0 and "Good" in out and "Failure probability 0," in out


def test_the_last_few_of_a_sobol_sweep_are_outcomes_alone(jaxhil, gains, tmp_path):
    sobol = ["sweep", gains, *TINY, "--sampling", "sobol", "--limit", "1.5", "-o", tmp_path / "new"]
    ran = jaxhil(*sobol, "--json")
    found = document(ran)
    assert sum(found["outcomes"].values()) == 100 and found["left_out_of_replicates"] == 4
    probability = found["failure_probability"]
    assert 0 < probability["low"] < probability["value"] < probability["high"] < 1
    assert (probability["value"] * 96).is_integer()
    code, out, _ = jaxhil(*sobol, "--resume")
    assert code == 1 and "The last 4 scenarios" in out


def test_float32_is_compared_with_float64(jaxhil, gains, tmp_path):
    ran = jaxhil("sweep", gains, *TINY, "-o", tmp_path / "n", "--precision", "float32", "--json")
    compared = document(ran)["float32"]
    assert compared["scenarios"] == 64 and 0 < compared["largest_difference"] < 1e-4


def test_a_width_stops_the_sweep(jaxhil, gains, tmp_path):
    wide = ["sweep", gains, "--scenarios", "1000", "--chunk", "64", "--limit", "1.5", "-o", tmp_path / "n"]
    wide += ["--until-width", "0.3"]
    ran = jaxhil(*wide, "--json")
    found = document(ran)
    assert ran[0] == 1 and found["scenarios"] < found["most_scenarios"] == 1000
    probability = found["failure_probability"]
    assert probability["high"] - probability["low"] <= 0.3 and "repeated looks" in probability["method"]
    code, out, _ = jaxhil(*wide, "--resume")
    assert code == 1 and f"Stopped after {found['scenarios']} of at most 1000" in out
    assert "valid under repeated" in out
    assert jaxhil("replay", tmp_path / "n", 0)[0] == 0
    refused(jaxhil("replay", tmp_path / "n", 999), "before the sweep stopped")


def test_quantiles_are_told(jaxhil, gains, store):
    again = ["sweep", gains, *TINY, "-o", store, "--limit", "1.5", "--resume"]
    found = document(jaxhil(*again, "--json"))["error_quantiles"]
    assert [one["order"] for one in found] == [0.5, 0.95, 0.99, 0.999]
    assert found[0]["low"] < found[0]["value"] < found[0]["high"] < found[1]["value"]
    out = jaxhil(*again)[1]
    assert "99.9 %" in out and "no bound" in out


def test_studies_are_told(jaxhil, gains, store):
    again = ["sweep", gains, *TINY, "-o", store, "--limit", "1.5", "--resume", "--drivers", "16", "--rare"]
    found = document(jaxhil(*again, "--json"))
    drivers, rare = found["drivers"], found["rare"]
    assert drivers["evaluations"] == 16 * 5 and drivers["cap"] == 15
    names = [one["input"] for one in drivers["inputs"]]
    assert sorted(names) == ["approach.phase", "contact.stiffness", "rig.force_sensor.delay"]
    assert rare["limit"] == 1.5 and rare["low"] < rare["probability"] < rare["high"]
    brute = found["failure_probability"]
    assert brute["low"] < rare["probability"] < brute["high"]
    out = jaxhil(*again)[1]
    assert "Subset simulation" in out and "first order" in out and names[0] in out


def test_replay_is_the_same_to_the_bit(jaxhil, store, tmp_path):
    ran = jaxhil("replay", store, 77, "--json", "--plot", tmp_path / "pictures" / "77.png")
    found = document(ran)
    assert ran[0] == 0 and found["verdict"] == "good" and found["different"] == []
    assert found["index"] == 77 and len(found["contacts"]) == 1
    assert (tmp_path / "pictures" / "77.png").stat().st_size > 10_000
    code, out, _ = jaxhil("replay", store, 0)
    assert code == 0 and "to the bit" in out


def test_replay_finds_out_what_was_changed(jaxhil, gains, tmp_path):
    folder = tmp_path / "store"
    jaxhil("sweep", gains, *TINY, "-o", folder)
    opened = read_store(folder)
    rows = dict(read_part(opened, 0))
    rows["error_1"] = rows["error_1"] * (1 + 1e-15)
    write_part(opened, 0, rows)
    code, out, _ = jaxhil("replay", folder, 3)
    assert code == 1 and "Bad: differs" in out and "error_1" in out


def test_what_cannot_be_is_refused(jaxhil, gains, store, tmp_path):
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
    refused(jaxhil("sweep", gains, *new, *sobol), "--until-width: found with --sampling sobol")
    refused(jaxhil("sweep", gains, *new, "--drivers", "100"), "--drivers: found 100", "power of two")
    refused(jaxhil("sweep", gains, *new, "--rare", "0.001"), "--rare: found 0.001", "at least --limit")
    refused(jaxhil("sweep", gains, *new, "--rare", "--limit", "inf"), "--rare")
    refused(jaxhil("sweep", tmp_path / "none.json", *new), "none.json")
    refused(jaxhil("sweep", gains, *TINY, "-o", store), "--resume")
    refused(jaxhil("sweep", gains, *TINY, "-o", store, "--resume"), "limit: found 1.5, asked for 0.01")
    refused(jaxhil("sweep", gains, *TINY, "-o", tmp_path / "file" / "store"), "cannot be written")
    refused(jaxhil("replay", store, 100), "found 100, allowed 0 to 99")
    refused(jaxhil("replay", tmp_path, 0), "manifest.json")
    assert not (tmp_path / "new").exists()


def test_jax_is_not_imported_before_it_is_configured():
    # Its flags, and with them the last bits of every row, are read when it starts.
    program = "import sys, tuning.commands.sweep, tuning.commands.replay; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
