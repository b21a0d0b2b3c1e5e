"""Commands on a failing cluster: one-line errors, exit code 2 or 130, and `--resume` with the same result."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import campaigns
import pytest
from campaign_logs import logs, write
from clusters import ROOT, started
from sweep_cases import case

import tuning
from jaxhil.errors import InputError
from tuning.gain_file import write_gain_file

pytestmark = [pytest.mark.users_options, pytest.mark.slow]
MANY, STUDY = ("--scenarios", "20000", "--chunk", "512", "--limit", "1.5"), ("--drivers", "4096")


def start(*arguments, folder):
    """Start a command as a user would."""
    command = [sys.executable, "-m", "tuning", *map(str, arguments), "--json"]
    ours = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "NPROC")}
    return subprocess.Popen(
        command, env={**ours, "PYTHONPATH": str(ROOT)}, cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def result_of(process):
    """Return exit code, standard output, and standard error without progress lines."""
    out, err = process.communicate(timeout=600)
    messages = [line for line in err.splitlines() if not line.startswith(tuple("0123456789"))]
    return process.returncode, out, messages


def wait(process, folder, pattern, number):
    while len([*folder.glob(pattern)]) < number:
        assert process.poll() is None
        time.sleep(0.02)


def same(first, second):
    return all(first[name] == second[name] for name in ("failure_probability", "worst", "drivers"))


def test_sweep_resumes_after_interrupt_and_lost_scheduler(tmp_path):
    write_gain_file(tmp_path / "gains.json", case())
    asked = "sweep", "gains.json", *MANY, *STUDY
    code, out, _ = result_of(start(*asked, "-o", "here", folder=tmp_path))
    assert code == 1
    whole, store = json.loads(out), tmp_path / "store"
    with started(tmp_path) as cluster:
        cluster.worker()
        on = *asked, "-o", "store", "--scheduler", cluster.address
        process = start(*on, folder=tmp_path)
        wait(process, store, "parts/*.parquet", 3)
        os.kill(process.pid, signal.SIGINT)
        code, out, messages = result_of(process)
        assert (code, out, messages) == (130, "", ["jaxhil: interrupted"])
        finished = {path: path.stat().st_mtime_ns for path in store.glob("parts/*.parquet")}
        process = start(*on, "--resume", folder=tmp_path)
        wait(process, store, ".pieces/*.piece", 2)
        cluster.kill(cluster.processes[0])
        code, out, messages = result_of(process)
        assert code == 2 and out == "" and len(messages) == 1
        assert messages[0].startswith(f"jaxhil: --scheduler: {cluster.address}: connection lost, ")
        assert messages[0].endswith("; finished results are cached; continue with --resume")
    (tmp_path / "later").mkdir()
    with started(tmp_path / "later") as cluster:
        cluster.worker()
        on = *asked, "-o", "store", "--scheduler", cluster.address, "--resume"
        code, out, messages = result_of(start(*on, folder=tmp_path))
    assert code == 1 and messages == [] and same(json.loads(out), whole)
    assert {path: path.stat().st_mtime_ns for path in finished} == finished


def test_bootstrap_resumes_after_lost_scheduler(jaxhil, tmp_path):
    write(tmp_path, campaigns.campaign("clean", 0, speeds=(0.006, 0.012) * 4, seconds=10.0))
    asked = "identify", *logs(tmp_path), "--map", "map.toml", "--law", "kelvin_voigt", "--bootstrap", 40
    guess = jaxhil("identify", "--guess", *logs(tmp_path)).out
    (tmp_path / "map.toml").write_text(guess.replace("# [b", "[b").replace("# equiv", "equiv"))
    assert result_of(start(*asked, "-o", "here", folder=tmp_path))[0] == 0
    with started(tmp_path) as cluster:
        cluster.worker()
        process = start(*asked, "-o", "there", "--scheduler", cluster.address, folder=tmp_path)
        wait(process, tmp_path / "there", ".pieces/*.piece", 2)
        cluster.kill(cluster.processes[0])
        code, out, messages = result_of(process)
    assert code == 2 and out == "" and len(messages) == 1
    assert messages[0].startswith(f"jaxhil: --scheduler: {cluster.address}: connection lost, ")
    number_finished = len([*tmp_path.glob("there/.pieces/*.piece")])
    assert 2 <= number_finished < 8 and not (tmp_path / "there" / "mechanism.toml").exists()
    process = start(*asked, "-o", "there", "--resume", folder=tmp_path)
    wait(process, tmp_path / "there", ".pieces/*.piece", number_finished + 1)
    assert result_of(process)[0] == 0 and not (tmp_path / "there" / ".pieces").exists()
    for name in ("mechanism.toml", "identification.json"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_cluster_worker_with_different_source_code_is_rejected(tmp_path):
    write_gain_file(tmp_path / "gains.json", case())
    for package in ("jaxhil", "tuning"):
        shutil.copytree(ROOT / package, tmp_path / "other" / package)
    with open(tmp_path / "other" / "jaxhil" / "errors.py", "a") as source:
        source.write("# another\n")
    with started(tmp_path) as cluster:
        cluster.worker(PYTHONPATH=str(tmp_path / "other"))
        refused = pytest.raises(InputError, match=r"a worker: sources_sha256: found .* results would differ")
        on = {"scheduler": cluster.address}
        with refused:
            tuning.sweep(tmp_path / "gains.json", scenarios=64, folder=tmp_path / "store", **on)
        with refused:
            tuning.tune("varying", scenarios=4, starts=1, steps=1, validation=15, **on)
        with refused:
            tuning.map("varying", "rig.force_sensor.delay", "contact.stiffness", points=4, **on)
        with refused:
            tuning.compare("varying", ["none"], untuned=True, judged=16, **on)
