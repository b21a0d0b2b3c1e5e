"""Commands of `jaxhil`: exit codes, JSON output, one-line error messages, and preserved files."""

import contextlib
import io
import json

import pytest
from sweep_cases import case

from jaxhil.mechanism.file import builtin_path
from tuning.__main__ import main
from tuning.gain_file import write_gain_file

TINY = ["--scenarios", "4", "--starts", "2", "--steps", "2", "--evaluated", "16"]
CONTACT_KEYS = {
    *("restitution", "reference_restitution", "error", "peak_force", "duration", "approach_velocity"),
}


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Run a tiny tuning; return its folder, exit code, output and error output."""
    folder, out, err = tmp_path_factory.mktemp("tuned"), io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["tune", "rig-300kg", "--compensator", "phase_lead", "-o", str(folder), *TINY])
    return folder / "rig-300kg", code, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def tuned(table):
    """Return the result folder of a tiny tuning."""
    return table[0]


def refused(ran, *words):
    """Check for exit code 2, no standard output, and one line on standard error with all `words`."""
    assert ran.code == 2
    assert ran.out == ""
    assert ran.err.startswith("jaxhil: ") and ran.err.count("\n") == 1 and ran.err.endswith("\n")
    for word in words:
        assert word in ran.err


def test_simulate_command_reports_results_in_json(jaxhil):
    ran = jaxhil("simulate", "rig-300kg", "--json")
    assert ran.code == 1 and ran.err == ""
    document = ran.document
    assert document["mechanism"] == "rig-300kg"
    assert document["compensator"] == "none"
    assert document["status"] == "ok"
    (contact,) = document["contacts"]
    assert contact.keys() >= CONTACT_KEYS
    assert contact["error"] == pytest.approx(contact["restitution"] - contact["reference_restitution"])
    assert contact["error"] > 0.3
    assert contact["approach_velocity"] == pytest.approx(0.005)


def test_simulate_exit_code_depends_on_error_limit(jaxhil, tmp_path):
    assert jaxhil("simulate", "rig-300kg", "--limit", "10", "--log", tmp_path / "run.csv").code == 0
    assert (tmp_path / "run.csv").read_text().startswith("time,force_measured,force_command,")
    ran = jaxhil("simulate", "rig-300kg", "--limit", "0.1")
    assert ran.code == 1
    assert "divergence" in ran.out and "0.1" in ran.out


def test_simulate_applies_set_overrides_to_mechanism(jaxhil):
    ran = jaxhil("simulate", "rig-300kg", "--json", "--set", "approach.velocity=0.01", "--set", "name=other")
    document = ran.document
    assert document["mechanism"] == "other"
    assert document["contacts"][0]["approach_velocity"] == pytest.approx(0.01)
    assert document["contacts"][0]["position_shortfall"] == 0


def test_simulate_reports_failed_run(jaxhil):
    # The force sensor saturates at 1e-6 N, so that the force command never stops the bodies.
    weak = ["--set", "rig.force_sensor.range=1e-6"]
    ran = jaxhil("simulate", "rig-300kg", "--json", *weak)
    assert ran.code == 1
    document = ran.document
    assert document["status"] == "timeout"
    assert document["contacts"][0]["restitution"] is None
    assert document["contacts"][0]["error"] is None
    assert "timeout" in jaxhil("simulate", "rig-300kg", *weak).out


def test_simulate_gives_equal_results_for_name_and_file_of_mechanism(jaxhil):
    document = jaxhil("simulate", builtin_path("rig-300kg"), "--json").document
    assert document == jaxhil("simulate", "rig-300kg", "--json").document


PLOT_NAMES = ("errors.png", "loss.png", "contact.png", "one_contact.png")


def test_tune_command_writes_gains_and_plots(jaxhil, tuned):
    assert {path.name for path in tuned.iterdir()} == {"gains.json", *PLOT_NAMES}
    document = json.loads((tuned / "gains.json").read_text())
    assert document["compensator"] == "phase_lead"
    figures = document["figures"]
    evaluated = {"nominal", "robust", "tuned_intervals"}
    assert figures.keys() == evaluated | {"without_noise", "command", "warnings"}
    assert figures["without_noise"] is None and figures["command"]["noise_amplification"] > 1
    for name in ("nominal", "robust"):
        assert figures[name].keys() == {"before", "literature", "tuned"}
    for name in ("rms", "p99"):
        interval = figures["tuned_intervals"][name]
        assert interval["low"] <= figures["robust"]["tuned"][name] <= interval["high"]
    assert (
        document["envelope"]["contact_frequency"]["low"]
        < 3
        < document["envelope"]["contact_frequency"]["high"]
    )


def test_tune_command_prints_tables_or_json_if_requested(jaxhil, table, tmp_path):
    tuned, code, out, err = table
    assert code == 1 and out.startswith("rig-300kg: equivalent mass 300 kg; contact at 3 Hz, ")
    words = ("before", "literature", "tuned", "rms", "99th", "chatter", "lead_filter", "step limit")
    for word in (*words, "exceeds 0.01", "no sensor noise"):
        assert word in out
    assert "evaluating on 16 fresh scenarios" in err
    arguments = ["tune", "rig-300kg", "--compensator", "phase_lead", "-o", tmp_path, *TINY]
    ran = jaxhil(*arguments, "--json", "--limit", "inf")
    assert ran.code == 0
    assert ran.document["verdict"] == "good"
    (entry,) = ran.document["mechanisms"]
    assert entry["meaning"]["equivalent_mass"] == 300.0 and entry["meaning"]["warnings"] == []
    assert entry["sensor_noise"] is False and entry["figures"]["tuned"]["chatter"] >= 0
    again = json.loads((tuned / "gains.json").read_text())
    assert entry["gains"] == again["gains"]
    assert json.loads((tmp_path / "rig-300kg" / "gains.json").read_text())["sha256"] == again["sha256"]


def test_last_line_of_command_output_suggests_the_next_command(jaxhil, table, tmp_path):
    tuned, _, out, _ = table
    assert out.splitlines()[-1] == "Next: jaxhil compare rig-300kg"  # the gains are not good
    for arguments, words in ((["mechanisms"], "init NAME"), (["init", "-o", tmp_path / "a"], "simulate ")):
        assert jaxhil(*arguments).out.splitlines()[-1].startswith(f"Next: jaxhil {words}")
    assert jaxhil("verify", tuned / "gains.json").out.splitlines()[-1].startswith("Next: jaxhil export")
    change = ("--set", "rig.force_sensor.delay=0.003")
    for arguments, words in (
        (("rig-300kg", *change), "tune rig-300kg --set rig.force_sensor.delay=0.003"),
        (("rig-300kg", "--compensator", "phase_lead"), "tune rig-300kg --compensator phase_lead"),
        (("--gains", tuned / "gains.json"), f"sweep {tuned / 'gains.json'}"),
    ):
        ran = jaxhil("simulate", *arguments)
        assert ran.out.splitlines()[-1] == f"Next: jaxhil {words}"


@pytest.mark.slow
def test_json_output_of_tune_states_sensor_noise(jaxhil, tmp_path):
    ran = jaxhil("tune", "suite-noisy", "--compensator", "none", "-o", tmp_path, "--json", *TINY)
    (entry,) = ran.document["mechanisms"]
    assert entry["sensor_noise"] is True


def test_tune_skips_unusable_mechanism_files(jaxhil, tmp_path):
    files = ["nowhere.toml", "rig-300kg", builtin_path("rig-300kg")]
    arguments = ["--compensator", "none", "-o", tmp_path, "--json", "--limit", "inf", *TINY]
    ran = jaxhil("tune", *files, *arguments)
    assert ran.code == 2
    missing, twice = ran.document["problems"]
    assert "nowhere.toml" in missing and "name" in twice
    # Problems are reported when they occur, and again at the end.
    assert ran.err.count(missing) == ran.err.count(twice) == 2
    assert ran.err.endswith(f"jaxhil: 2 problems:\njaxhil: {missing}\njaxhil: {twice}\n")
    assert [entry["mechanism"] for entry in ran.document["mechanisms"]] == ["rig-300kg"]
    assert (tmp_path / "rig-300kg" / "gains.json").exists()


def test_tune_keeps_finished_mechanisms_after_interrupt(jaxhil, tuned, tmp_path, monkeypatch):
    from tuning.gains.tune_all import tune_all

    def stopped_after_the_first(*arguments, **named):
        yield next(tune_all(*arguments, **named))
        raise KeyboardInterrupt

    monkeypatch.setattr("tuning.gains.tune_all.tune_all", stopped_after_the_first)
    files = ["rig-300kg", "rod-100n-mm", "--compensator", "none"]
    ran = jaxhil("tune", *files, "-o", tmp_path, "--json", *TINY)
    assert ran.code == 130
    assert ran.document["interrupted"] and len(ran.document["mechanisms"]) == 1
    assert "1 of 2" in ran.err
    assert (tmp_path / "rig-300kg" / "gains.json").exists()


def test_tune_accepts_folder_of_mechanism_files(jaxhil, tmp_path):
    (tmp_path / "files").mkdir()
    text = builtin_path("rig-300kg").read_text()
    for number in range(5):
        name = f"like-{number}"
        changed = text.replace('name = "rig-300kg"', f'name = "{name}"')
        (tmp_path / "files" / f"{name}.toml").write_text(changed)
    (tmp_path / "files" / "notes.txt").write_text("no mechanism")
    arguments = ["--compensator", "none", "-o", tmp_path / "out", "--limit", "inf", *TINY]
    ran = jaxhil("tune", tmp_path / "files", *arguments)
    assert ran.code == 0
    assert all(f"like-{number}" in ran.out for number in range(5))
    # Many mechanisms share one plot.
    made = (path.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("*.*"))
    written = sorted(str(path) for path in made if not str(path).startswith("."))
    assert written == [*(f"like-{number}/gains.json" for number in range(5)), "overview.png"]
    gains = [json.loads(path.read_text())["gains"] for path in (tmp_path / "out").rglob("gains.json")]
    assert all(values == gains[0] for values in gains)


@pytest.mark.slow
def test_tuning_from_earlier_gains_is_never_worse_than_these_gains(jaxhil, tuned, tmp_path):
    arguments = ["tune", "rig-300kg", "--compensator", "phase_lead", "-o", tmp_path, *TINY]
    cold = jaxhil(*arguments, "--json").document["mechanisms"][0]
    assert cold["carried_over"] == []
    warm = jaxhil(*arguments, "--json", "--start", tuned).document["mechanisms"][0]
    assert warm["carried_over"] == [
        {"start": 2, "source": str(tuned), "mechanism": "rig-300kg", "distance": 0.0}
    ]
    assert warm["starts"][0] == cold["starts"][0]
    assert warm["starts"][1]["rms"] <= min(start["rms"] for start in cold["starts"])
    table = jaxhil(*arguments, "--starts", "1", "--start", tuned / "gains.json").out
    assert "begins at" in table and "literature" in table and "gains of" in table


@pytest.mark.slow
def test_tune_pareto_writes_gain_file_for_each_point(jaxhil, tmp_path):
    folder = tmp_path / "rig-300kg"
    # A file left by an earlier, longer Pareto front.
    (folder / "pareto" / "07").mkdir(parents=True)
    write_gain_file(folder / "pareto" / "07" / "gains.json", case())
    # A file that was not written by this program.
    (folder / "pareto" / "08").mkdir(parents=True)
    (folder / "pareto" / "08" / "gains.json").write_text("{}")
    arguments = ["tune", "rig-300kg", "--compensator", "phase_lead", "-o", tmp_path, *TINY]
    ran = jaxhil(*arguments, "--pareto", "3", "--json", "--limit", "inf")
    assert ran.code == 0
    front = ran.document["mechanisms"][0]["pareto"]
    assert [point["noise_weight"] == 0 for point in front["points"]] == [True, False, False]
    paths = [folder / "pareto" / f"0{number}" / "gains.json" for number in (1, 2, 3)]
    assert sorted((folder / "pareto").rglob("*.*")) == [*paths, folder / "pareto" / "08" / "gains.json"]
    for point, path in zip(front["points"], paths, strict=True):
        written = json.loads(path.read_text())
        assert point["gain_file"] == str(path)
        assert point["gains"] == written["gains"]
        assert written["figures"]["robust"]["tuned"] == point["figures"]
        assert written["figures"]["pareto"]["noise_amplification"] == point["noise_amplification"]
    assert front["plot"] == str(folder / "pareto.png") and (folder / "pareto.png").stat().st_size > 0
    assert jaxhil("verify", paths[2], "--scenarios", "1").code == 0
    table = jaxhil(*arguments, "--pareto", "3", "--limit", "1")
    for word in ("noise weight", "literature's rule", "front", "Least noise within 1: point", "pareto.png"):
        assert word in table.out


def test_tune_rejects_impossible_pareto_option(jaxhil, tmp_path):
    arguments = ["tune", "rig-300kg", "-o", tmp_path / "out"]
    refused(
        jaxhil(*arguments, "--pareto", "8", "--compensator", "none"),
        "--pareto",
        "none",
        "does not depend on its gains",
    )
    refused(jaxhil(*arguments, "--pareto", "1"), "--pareto", "0 or an integer >= 2")
    refused(jaxhil(*arguments, "--pareto", "-3"), "--pareto", "-3")
    assert not (tmp_path / "out").exists()


def test_tune_rejects_unusable_starting_gains(jaxhil, tuned, tmp_path):
    (tmp_path / "broken.json").write_text("{")
    start = ["tune", "rig-300kg", "-o", tmp_path / "out", "--start"]
    refused(jaxhil(*start, tuned), "--start", str(tuned)[:20], "phase_lead", "response_error")
    refused(jaxhil(*start, tuned, "nowhere.json"), "expected gains of response_error")
    refused(jaxhil(*start, tmp_path / "broken.json"), "broken.json")
    refused(jaxhil(*start, "nowhere.json"), "nowhere.json", "No such file")
    assert not (tmp_path / "out").exists()


def test_tune_rejects_unknown_objective_and_bad_weight(jaxhil, tmp_path):
    weights = ["--divergence-weight", "0"], ["--noise-weight", "-1"], ["--chatter-weight", "nan"]
    for wrong in (["--objective", "mean"], *weights):
        ran = jaxhil("tune", "-o", tmp_path, *wrong, *TINY)
        assert ran.code == 2 and ran.err.count("\n") == 1 and "expected" in ran.err


def test_tune_rejects_folder_without_mechanism_files(jaxhil, tmp_path):
    ran = jaxhil("tune", tmp_path, "-o", tmp_path / "out")
    assert ran.code == 2 and ran.err.count("\n") == 1
    assert "found no mechanism file" in ran.err


def test_verify_command_accepts_tuned_gains(jaxhil, tuned):
    ran = jaxhil("verify", tuned, "--json", "--scenarios", "2")
    assert ran.code == 0
    assert ran.document["verdict"] == "good"
    assert len(ran.document["replay"]) == 2
    assert "Good" in jaxhil("verify", tuned / "gains.json", "--scenarios", "2").out


def test_verify_command_detects_modified_gain_file(jaxhil, tuned, tmp_path):
    document = json.loads((tuned / "gains.json").read_text())
    document["gains"]["phase_lead"]["value"] *= 1.001
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(document))
    ran = jaxhil("verify", path, "--json")
    assert ran.code == 1
    assert ran.document["verdict"] == "bad"
    assert "sha256" in ran.document["reasons"][0]
    path.write_text("{")
    assert jaxhil("verify", path).code == 1


def test_simulate_command_uses_gain_file(jaxhil, tuned):
    path = tuned / "gains.json"
    ran = jaxhil("simulate", "--gains", path, "--json")
    document = ran.document
    assert (document["mechanism"], document["compensator"]) == ("rig-300kg", "phase_lead")
    gains = json.loads(path.read_text())["gains"]
    assert document["gains"] == {name: entry["value"] for name, entry in gains.items()}
    faster = jaxhil("simulate", "--gains", path, "--json", "--set", "approach.velocity=0.02").document
    assert faster["contacts"][0]["approach_velocity"] == pytest.approx(0.02)
    other = jaxhil("simulate", "rod-100n-mm", "--gains", path, "--json").document
    assert other["mechanism"] == "rod-100n-mm"


def test_simulate_rejects_gain_file_with_other_compensator_or_period(jaxhil, tuned):
    path = tuned / "gains.json"
    refused(jaxhil("simulate", "--gains", path, "--compensator", "none"), "--compensator", "phase_lead")
    slower = ["--set", "rig.control_period=0.002"]
    refused(jaxhil("simulate", "--gains", path, *slower), "control_period", "0.001", "0.002")
    refused(jaxhil("simulate", "--gains", path, "--set", "bodies.weight=1"), "--set", "bodies.weight")
