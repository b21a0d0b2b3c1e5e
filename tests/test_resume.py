"""Interrupted and resumed `jaxhil tune` and `compare_compensators` give the uninterrupted result."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from jaxhil.mechanism.file import builtin_path, load
from jaxhil.mechanism.structs import Mechanism
from tuning.benchmark import comparison
from tuning.benchmark.comparison import CompareSettings, CompensatorMetrics, compare_compensators
from tuning.caches import checkpoints
from tuning.caches.checkpoints import CHECKPOINT_FOLDER, Checkpoints
from tuning.gains.common_program import group_by_common_program
from tuning.gains.settings import TuneSettings
from tuning.gains.tune_all import tune_all
from tuning.statistics.intervals import IntervalEstimate

HERE = Path(__file__).parent
FILES = 5  # more mechanisms than have separate plots
TINY = ["--compensator", "phase_lead", "--scenarios", "4", "--starts", "2", "--steps", "2"]
TINY += ["--evaluated", "16", "--limit", "inf", "--json"]
SETTINGS = TuneSettings(scenarios=4, starts=2, steps=2, validation=16)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return the files of mechanisms that share one program."""
    folder, text = tmp_path_factory.mktemp("files"), builtin_path("rig-300kg").read_text()
    for number in range(FILES):
        (folder / f"m{number}.toml").write_text(text.replace('"rig-300kg"', f'"m{number}"'))
    return folder


@pytest.fixture(scope="module")
def uninterrupted_run(files, tmp_path_factory):
    """Return results of an uninterrupted run, and the number of checkpoints written."""
    from tuning import terminal
    from tuning.__main__ import main

    folder, printed = tmp_path_factory.mktemp("whole") / "out", []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(terminal, "emit_json", printed.append)
        writes = Writes(patched)
        assert main(["tune", str(files), "-o", str(folder), *TINY]) == 0
    return outputs(terminal.format_json(printed[0]), folder), writes.number


def outputs(said, folder):
    """Return output and files of a run without dates, timings and output folders."""
    document = json.loads(said.replace(str(folder), "DIR"))
    for entry in document["mechanisms"]:
        entry.pop("timings")
    gains = {}
    for path in sorted(folder.glob("*/gains.json")):
        content = json.loads(path.read_text())
        content.pop("created")
        content.pop("timings")
        gains[path.parent.name] = content
    return json.dumps(document), gains


class Writes:
    """Interrupts before or after the write of checkpoint number `stop`."""

    def __init__(self, monkeypatch, stop=None, after=False):
        self.number, self.stop, self.after = 0, stop, after
        self.write = checkpoints.write_checksummed
        monkeypatch.setattr(checkpoints, "write_checksummed", self)

    def __call__(self, path, content):
        self.number += 1
        if self.number == self.stop and not self.after:
            raise KeyboardInterrupt
        self.write(path, content)
        if self.number == self.stop:
            raise KeyboardInterrupt


def interrupted_and_resumed(jaxhil, files, folder, stop, after):
    with pytest.MonkeyPatch.context() as patched:
        Writes(patched, stop, after)
        ran = jaxhil("tune", files, "-o", folder, *TINY)
    assert ran.code == 130 and "repeat the command with --resume" in ran.err
    with pytest.MonkeyPatch.context() as patched:
        writes = Writes(patched)
        again = jaxhil("tune", files, "-o", folder, *TINY, "--resume")
    assert again.code == 0 and "warning" not in again.err
    return outputs(again.out, folder), writes.number


@pytest.mark.slow
def test_resumed_run_gives_result_of_uninterrupted_run(jaxhil, files, uninterrupted_run, tmp_path):
    expected, every = uninterrupted_run
    # Checkpoints of search rounds, of the search, and one per result.
    assert every >= 2 + FILES
    for stop in (2, every):
        result, made = interrupted_and_resumed(jaxhil, files, tmp_path / str(stop), stop, after=stop > 2)
        assert result == expected
        # Saved results are not computed again.
        assert made == (every - 1 if stop == 2 else 0)
    # Steps are removed, results stay.
    assert len(list((tmp_path / "2" / CHECKPOINT_FOLDER).iterdir())) == FILES


@pytest.mark.slow
def test_run_resumes_after_interruption_at_any_checkpoint(jaxhil, files, uninterrupted_run, tmp_path):
    expected, every = uninterrupted_run
    for stop in range(1, every + 1):
        for after in (False, True):
            folder = tmp_path / f"{stop} {after}"
            result, _ = interrupted_and_resumed(jaxhil, files, folder, stop, after)
            assert result == expected, (stop, after)


@pytest.mark.slow
def test_checkpoints_of_other_files_and_options_are_not_used(jaxhil, files, tmp_path):
    out = tmp_path / "out"
    jaxhil("tune", files, "-o", out, *TINY)
    paths = [files / f"m{number}.toml" for number in range(FILES - 1)]
    for change in ([files, "--seed", "1"], paths):
        ran = jaxhil("tune", *change, "-o", out, *TINY, "--resume")
        assert ran.code == 0 and "from other files, options or code" in ran.err
        fresh = jaxhil("tune", *change, "-o", tmp_path / "fresh", *TINY)
        assert outputs(ran.out, out)[0] == outputs(fresh.out, tmp_path / "fresh")[0]
        shutil.rmtree(tmp_path / "fresh")


@pytest.mark.parametrize("number", [1, pytest.param(FILES, marks=pytest.mark.slow)])
def test_result_read_from_checkpoint_is_bit_identical(tmp_path, number):
    mechanisms = [load("rig-300kg", [f"name=m{i}"]).mechanism for i in range(number)]
    made = dict(tune_all(mechanisms, "phase_lead", SETTINGS, checkpoints=Checkpoints(tmp_path)))
    read = dict(tune_all(mechanisms, "phase_lead", SETTINGS, checkpoints=Checkpoints(tmp_path, resume=True)))
    assert made.keys() == read.keys()
    for index, one in made.items():
        assert_same(vars(one), vars(read[index]))


def assert_same(one, other):
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            assert_same(*pair)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    else:
        assert one == other or (one != one and other != other)


@pytest.mark.slow
def test_pareto_front_is_checkpointed(jaxhil, tmp_path):
    arguments = ["tune", "rig-300kg", "-o", tmp_path, *TINY, "--pareto", "2"]
    with pytest.MonkeyPatch.context() as patched:
        Writes(patched, stop=8)
        assert jaxhil(*arguments).code == 130
    resumed = jaxhil(*arguments, "--resume")
    again = jaxhil(*arguments, "--resume")
    assert "front from the cache" in again.err and "steps" not in again.err
    shutil.rmtree(tmp_path)
    fresh = jaxhil(*arguments)
    expected = outputs(fresh.out, tmp_path)
    assert outputs(resumed.out, tmp_path) == outputs(again.out, tmp_path) == expected


class Scene(NamedTuple):
    """Scenario set with only the attributes that identify it."""

    mechanism: Mechanism


def test_resumed_comparison_computes_only_missing_results(tmp_path, monkeypatch):
    """The metrics are artificial; the program groups, saves and reads them."""
    names = ["rig-300kg", "suite-noisy", "varying"]
    mechanisms = [load(name).mechanism for name in names]
    groups = [[mechanisms[i] for i in group] for group, _ in group_by_common_program(mechanisms)]
    evaluated = []

    def evaluate(scenes, law, settings, tell):
        evaluated.append((law, len(scenes)))
        if law == "smith":
            raise KeyboardInterrupt
        figures = {"literature": {"rms": IntervalEstimate(0.1, math.nan, 1 / 3)}}
        return [
            CompensatorMetrics(law, scene.mechanism.name, {"literature": {"g": 0.1}}, figures)
            for scene in scenes
        ]

    def build(mechanisms, settings):
        return [[Scene(one) for one in group] for group in groups if group[0] in mechanisms]

    monkeypatch.setattr(comparison, "evaluate_compensator", evaluate)
    monkeypatch.setattr(comparison, "build_scenario_sets", build)

    def run(*laws, resume=True, **settings):
        evaluated.clear()
        checkpoints = Checkpoints(tmp_path, resume)
        result = list(
            compare_compensators(mechanisms, laws, CompareSettings(**settings), 0, checkpoints=checkpoints)
        )
        return sorted(map(repr, result)), [law for law, _ in evaluated]

    with pytest.raises(KeyboardInterrupt):
        run("none", "smith", resume=False)
    assert run("none", "passivity")[1] == ["none"] * (len(groups) - 1) + ["passivity"] * len(groups)
    result, computed = run("passivity", "none")
    assert len(result) == 2 * len(names) and computed == []
    assert run("none", "passivity", resume=False) == (result, ["none", "passivity"] * len(groups))
    assert len(run("none", seed=1)[1]) == len(groups)


@pytest.mark.slow
@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGINT])
def test_killed_run_loses_no_finished_result(jaxhil, files, uninterrupted_run, tmp_path, signal_number):
    program = "import conftest, sys; from tuning.__main__ import main; sys.exit(main())"
    out = tmp_path / "out"
    command = [sys.executable, "-c", program, "tune", str(files), "-o", str(out), *TINY, "--resume"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
    for pieces_there in (1, 3, 4):
        with subprocess.Popen(command, env=environment, cwd=HERE, stdout=subprocess.DEVNULL) as process:
            while (
                process.poll() is None
                and len(list(out.glob(f"{CHECKPOINT_FOLDER}/**/*.piece"))) < pieces_there
            ):
                time.sleep(0.002)
            process.send_signal(signal_number)
    ran = jaxhil("tune", files, "-o", out, *TINY, "--resume")
    assert ran.code == 0 and outputs(ran.out, out) == uninterrupted_run[0]
    assert not [path for path in out.rglob("*") if path.name.endswith(".tmp")]
