"""Commands on a cluster that go wrong: one line, exit code 2 or 130, and `--resume` ends with the same."""

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


def begin(*arguments, folder):
    """A command as a user starts it."""
    command = [sys.executable, "-m", "tuning", *map(str, arguments), "--json"]
    ours = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "NPROC")}
    return subprocess.Popen(
        command, env={**ours, "PYTHONPATH": str(ROOT)}, cwd=folder, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def ended(process):
    """Exit code, standard output, and what standard error says but for progress."""
    out, err = process.communicate(timeout=600)
    said = [line for line in err.splitlines() if not line.startswith(tuple("0123456789"))]
    return process.returncode, out, said


def wait(process, folder, pattern, number):
    while len([*folder.glob(pattern)]) < number:
        assert process.poll() is None
        time.sleep(0.02)


def same(one, other):
    return all(one[name] == other[name] for name in ("failure_probability", "worst", "drivers"))


def test_a_scheduler_that_dies_and_ctrl_c_lose_nothing_that_was_finished(tmp_path):
    write_gain_file(tmp_path / "gains.json", case())
    asked = "sweep", "gains.json", *MANY, *STUDY
    code, out, _ = ended(begin(*asked, "-o", "here", folder=tmp_path))
    assert code == 1
    whole, store = json.loads(out), tmp_path / "store"
    with started(tmp_path) as cluster:
        cluster.worker()
        on = *asked, "-o", "store", "--scheduler", cluster.address
        process = begin(*on, folder=tmp_path)
        wait(process, store, "parts/*.parquet", 3)
        os.kill(process.pid, signal.SIGINT)
        code, out, said = ended(process)
        assert (code, out, said) == (130, "", ["jaxhil: interrupted"])
        kept = {path: path.stat().st_mtime_ns for path in store.glob("parts/*.parquet")}
        process = begin(*on, "--resume", folder=tmp_path)
        wait(process, store, ".pieces/*.piece", 2)
        cluster.kill(cluster.processes[0])
        code, out, said = ended(process)
        assert code == 2 and out == "" and len(said) == 1
        assert said[0].startswith(f"jaxhil: --scheduler: {cluster.address}: lost, ")
        assert said[0].endswith("; what is finished is kept, --resume goes on")
    (tmp_path / "later").mkdir()
    with started(tmp_path / "later") as cluster:
        cluster.worker()
        on = *asked, "-o", "store", "--scheduler", cluster.address, "--resume"
        code, out, said = ended(begin(*on, folder=tmp_path))
    assert code == 1 and said == [] and same(json.loads(out), whole)
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


def test_a_bootstrap_whose_scheduler_dies_goes_on(jaxhil, tmp_path):
    write(tmp_path, campaigns.campaign("clean", 0, speeds=(0.006, 0.012) * 4, seconds=10.0))
    asked = "identify", *logs(tmp_path), "--map", "map.toml", "--law", "kelvin_voigt", "--bootstrap", 40
    guess = jaxhil("identify", "--guess", *logs(tmp_path)).out
    (tmp_path / "map.toml").write_text(guess.replace("# [b", "[b").replace("# equiv", "equiv"))
    assert ended(begin(*asked, "-o", "here", folder=tmp_path))[0] == 0
    with started(tmp_path) as cluster:
        cluster.worker()
        process = begin(*asked, "-o", "there", "--scheduler", cluster.address, folder=tmp_path)
        wait(process, tmp_path / "there", ".pieces/*.piece", 2)
        cluster.kill(cluster.processes[0])
        code, out, said = ended(process)
    assert code == 2 and out == "" and len(said) == 1
    assert said[0].startswith(f"jaxhil: --scheduler: {cluster.address}: lost, ")
    kept = len([*tmp_path.glob("there/.pieces/*.piece")])
    assert 2 <= kept < 8 and not (tmp_path / "there" / "mechanism.toml").exists()
    process = begin(*asked, "-o", "there", "--resume", folder=tmp_path)
    wait(process, tmp_path / "there", ".pieces/*.piece", kept + 1)
    assert ended(process)[0] == 0 and not (tmp_path / "there" / ".pieces").exists()
    for name in ("mechanism.toml", "identification.json"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_worker_of_another_version_is_refused(tmp_path):
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
