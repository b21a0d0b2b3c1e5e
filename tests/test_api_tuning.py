"""Public interface of `tuning`: results equal those of the commands, and error messages have one line."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest
from user_registered_laws import ScaledLead, ScaledLeadOnTheRig, SquaredSpring

import jaxhil
import tuning

SCRIPT = Path(__file__).parent / "interface_script.py"
SMALL = {"scenarios": 4, "starts": 1, "steps": 2, "validation": 16}
TINY = ["--scenarios", "4", "--starts", "1", "--steps", "2", "--evaluated", "16"]


@pytest.fixture(scope="module")
def tuned():
    return tuning.tune("rig-300kg", "phase_lead", **SMALL)


@pytest.mark.slow
@pytest.mark.users_options
def test_python_interface_script_of_readme_runs(tmp_path):
    """Use a separate process, in which JAX must remain in its float32 default."""
    shutil.copy(SCRIPT, tmp_path)
    check = "import jax; assert not jax.config.jax_enable_x64 and 'XLA_FLAGS' not in __import__('os').environ"
    (tmp_path / "script.py").write_text(f"{SCRIPT.read_text()}\n{check}\n")
    environment = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "NPROC")}
    environment["PYTHONPATH"] = str(SCRIPT.parent.parent)
    ran = subprocess.run(
        [sys.executable, "-W", "error", "script.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr == ""
    printed = ran.stdout.splitlines()
    assert printed[3].split()[-1] == "64" and printed[5] == "True"
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {SCRIPT.name, "script.py", "run.csv", "run.png", "gains.json", "bundle"}


def test_tuning_import_loads_submodules_lazily():
    code = "import sys, tuning; assert 'sweep' in dir(tuning); tuning.sweep; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
def test_tune_function_gives_the_results_of_tune_command(jaxhil, tuned, tmp_path):
    jaxhil("tune", "rig-300kg", "--compensator", "phase_lead", "-o", tmp_path, *TINY)
    written = json.loads((tmp_path / "rig-300kg" / "gains.json").read_text())
    assert written["sha256"] == tuned.document["sha256"]
    assert tuned.verdict == "bad" and tuned.figures["tuned"].rms < tuned.figures["before"].rms


@pytest.mark.slow
def test_sweep_function_without_folder_equals_stored_sweep(tuned, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    study = tuning.sweep(tuned, scenarios=40, chunk=32, limit=0.5)
    assert not list(tmp_path.iterdir()) and capsys.readouterr() == ("", "")
    stored = tuning.sweep(tuned, scenarios=40, chunk=32, limit=0.5, folder="store")
    assert study.table.equals(stored.table) and study.table.num_rows == 40
    assert study.failure_probability == stored.failure_probability
    assert study.interval.low <= study.failure_probability <= study.interval.high
    with study.store() as first, stored.store() as second:
        assert first.manifest.sha256 == second.manifest.sha256
    again = tuning.sweep(tuned, scenarios=40, chunk=32, limit=0.5, folder="store", resume=True)
    max(Path("store", "parts").iterdir()).unlink()
    with pytest.raises(jaxhil.InputError, match="store: found 32 scenarios, expected 40"):
        _ = again.table


@pytest.mark.slow
def test_user_registered_compensators_are_tuned_swept_exported_and_verified(tmp_path):
    jaxhil.register(SquaredSpring())
    jaxhil.register(ScaledLead())
    contact = {"law": "squared_spring", "stiffness": [1e8]}
    mechanism = jaxhil.load("rig-300kg", {"contact": contact, "approach.contacts": 2})
    run = jaxhil.simulate(mechanism, "scaled_lead")
    slope = jaxhil.jacobian(mechanism, "scaled_lead", of="restitution", by=["gains.toy_lead"])
    assert run.status == "ok" and slope["gains.toy_lead"][0] < 0
    result = tuning.tune(mechanism, "scaled_lead", **SMALL)
    assert result.gains["toy_lead"] > 0 and result.figures["tuned"].rms < result.figures["literature"].rms
    result.save(tmp_path / "gains.json")
    study = tuning.sweep(tmp_path / "gains.json", scenarios=32, chunk=32)
    assert study.table.num_rows == 32
    with pytest.raises(jaxhil.InputError, match=r"found 'squared_spring', .*perturb_damping"):
        tuning.compare(mechanism, ["scaled_lead"], scenarios=4, judged=8)
    board = tuning.compare("rig-300kg", ["scaled_lead"], scenarios=4, judged=8)
    figures = board.figures["scaled_lead"]
    assert figures["tuned"].rms < figures["literature"].rms.low
    for refused in (lambda: tuning.export(result, tmp_path / "bundle"), lambda: tuning.verify(result)):
        with pytest.raises(jaxhil.InputError, match="scaled_lead: found no runtime class"):
            refused()
    jaxhil.register(ScaledLead(), runtime=ScaledLeadOnTheRig)
    exported = tuning.export(tmp_path / "gains.json", tmp_path / "bundle", sweep=study)
    assert exported.good, exported.reasons
    assert "c99" in exported.document["formats"]
    assert tuning.verify(tmp_path / "bundle").good

    class Other(ScaledLeadOnTheRig):
        """Controller of the same compensator, defined by other source code."""

    jaxhil.register(ScaledLead(), runtime=Other)
    actual = tuning.verify(tmp_path / "bundle")
    assert not actual.good and "jaxhil_runtime.py: differs from what this version exports" in actual.reasons


@pytest.mark.slow
def test_user_objective_receives_contacts_and_scenarios():
    shapes = []

    def largest(metrics):
        shapes.append({leaf.shape for leaf in metrics})
        return jnp.abs(metrics.error).max()

    result = tuning.tune("varying", "phase_lead", objective=largest, **SMALL)
    assert all(shape == {(3, 4)} for shape in shapes)
    worst = result.tune_result.starts[0].history[0]
    assert min(start.rms for start in result.tune_result.starts) <= worst


@pytest.mark.parametrize(
    ("objective", "words"),
    [
        (lambda metrics: metrics.error, "shape"),
        (lambda metrics: -2.0 + 0 * jnp.max(metrics.error), "returns -2,"),
        (lambda metrics: jnp.nan * jnp.max(metrics.error), "nan"),
        (lambda metrics: jnp.max(metrics.speed), "AttributeError"),
        (lambda metrics: None, "NoneType"),
        ("least", "rms, cvar, worst"),
    ],
)
def test_tune_rejects_unusable_objective(objective, words):
    with pytest.raises(jaxhil.InputError, match="objective: found") as refused:
        tuning.tune("rig-300kg", "phase_lead", objective=objective, **SMALL)
    assert words in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: tuning.tune("nowhere", "phase_lead"), "nowhere"),
        (lambda: tuning.tune([], "phase_lead"), "mechanism: found an empty list"),
        (lambda: tuning.tune(3, "phase_lead"), "mechanism: found 3"),
        (lambda: tuning.tune("varying", "lead"), "compensator: found 'lead', expected none,"),
        (lambda: tuning.tune("varying", starts="2"), "starts: found '2', expected an integer >= 1"),
        (lambda: tuning.tune("varying", scenarios=0), "scenarios: found 0, expected an integer >= 1"),
        (lambda: tuning.tune("varying", setting="soft"), "setting: found 'soft'"),
        (lambda: tuning.tune("varying", start="nowhere.json"), "nowhere.json: cannot be read"),
        (lambda: tuning.tune("varying", limit=-1), "limit: found -1, expected a number >= 0"),
        (lambda: tuning.sweep("nowhere.json"), "nowhere.json: cannot be read"),
        (lambda: tuning.sweep(7), "gains: found 7, expected a path"),
        (lambda: tuning.sweep("x", sampling="grid"), "sampling: found 'grid', expected random, sobol"),
        (lambda: tuning.sweep("x", resume=True), "resume: found no folder"),
        (lambda: tuning.compare("varying", ["none", "lead"]), "compensators: found 'lead'"),
        (lambda: tuning.compare("varying", 3), "compensators: found 3"),
        (lambda: tuning.export("nowhere.json", "x"), "nowhere.json: cannot be read"),
        (lambda: tuning.export("x", "y", limits={"speed": 1}), "limits: found 'speed', expected one of"),
        (lambda: tuning.verify("nowhere"), "nowhere: cannot be read"),
        (lambda: tuning.verify("nowhere", scenarios=0), "scenarios: found 0"),
    ],
)
def test_tuning_functions_reject_unusable_arguments_with_one_line_message(call, words):
    with pytest.raises(jaxhil.InputError) as refused:
        call()
    assert words in str(refused.value) and "\n" not in str(refused.value)
