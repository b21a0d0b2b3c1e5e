"""Recovery of commands from failing system calls and from kills, without wrong or lost output.

The method is that of SQLite: every call on the output folder or the program cache fails once, in turn, and
the process is killed there once, in turn. Afterwards every file is either the old one or the complete new
one, and the user's files are unchanged. Running the command again gives the result of an undisturbed run.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from faults import COMPILER, HANGS, Ran, Runner, without_times
from sweep_cases import case

from jaxhil.files import is_temporary, read_checksummed
from jaxhil.rig import digest
from tuning.caches.checkpoints import CHECKPOINT_FOLDER as PIECES
from tuning.gain_file import write_gain_file

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")

USERS = {".thesis.docx.tmp": b"years", ".thesis.docx.1.tmp": b"of", "notes.txt": b"work"}


class Command(NamedTuple):
    """Command that writes files; `arguments` takes the output folder and the folder of the gain files."""

    arguments: Callable[[Path, Path], list[Any]]
    again: tuple[str, ...] = ()  # arguments added in the next run
    before: tuple[tuple[str, ...], ...] = ()  # earlier undisturbed runs with these arguments
    one_piece: str | None = None  # folder that is replaced as a whole
    cold: bool = False  # whether the program cache is empty
    new: str | None = None  # file that the command must not overwrite
    logged: bool = False  # whether the command reads the log of a run


TUNED = ["--compensator", "phase_lead", "--scenarios", 2, "--starts", 1, "--steps", 1, "--evaluated", 4]


NOISE = ["--set", "rig.force_sensor.noise_std=0.5", "--set", "rig.position_sensor.noise_std=5e-6"]


def _sweep(out: Path, gains: Path) -> list[Any]:
    few = ["--scenarios", 6, "--chunk", 2, "--limit", 1.5]
    return ["sweep", gains / "none.json", *few, "--json", "-o", out / "store"]


def _export(out: Path, gains: Path) -> list[Any]:
    return ["export", gains / "lead.json", "--json", "--format", "csv", "-o", out / "bundle"]


def _map(out: Path, _: Path) -> list[Any]:
    axes = ["--x", "contact.stiffness", "--y", "rig.force_sensor.delay", "--points", 3]
    return ["map", "rig-300kg", *axes, "--json", "-o", out / "map"]


def _identify(out: Path, gains: Path) -> list[Any]:
    return ["identify", gains / "run.csv", "--prior", "rig-300kg", "--law", "linear", "--json", "-o", out]


def _compare(out: Path, gains: Path) -> list[Any]:
    few = ["--scenarios", 2, "--evaluated", 4, "--untuned", "--compensators", "phase_lead"]
    return ["compare", "rig-300kg", *few, "--json", "-o", out]


COMMANDS = {
    "init": Command(lambda out, _: ["init", "--json", "-o", out / "mine.toml"], new="mine.toml"),
    "simulate": Command(lambda out, _: ["simulate", "rig-300kg", "--json", "--plot", out / "plot.png"]),
    "simulate-cold": Command(lambda out, _: ["simulate", "rig-300kg", "--json"], cold=True),
    "simulate-log": Command(lambda out, _: ["simulate", "rig-300kg", "--json", "--log", out / "run.csv"]),
    "identify": Command(_identify, logged=True),
    "map": Command(_map),
    "report": Command(lambda out, gains: ["report", gains / "lead.json", "--json", "-o", out / "page.html"]),
    "tune": Command(lambda out, _: ["tune", "rig-300kg", *TUNED, "--json", "-o", out], again=("--resume",)),
    "sweep": Command(_sweep, again=("--resume",)),
    "export": Command(_export, before=(("--seed", "1"),), one_piece="bundle"),
    "compare": Command(_compare, again=("--resume",)),
}


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    for name in ("cache", "scratch", "gains"):
        (folder / name).mkdir()
    for name, law in (("none", "none"), ("lead", "phase_lead")):
        write_gain_file(folder / "gains" / f"{name}.json", case(compensator=law))
    runner = Runner(folder / "cache", folder / "scratch")
    for name, content in USERS.items():
        (runner.cache / name).write_bytes(content)
    yield runner
    runner.close()


class Bench:
    """Command, files that existed before the command, and result of an undisturbed run."""

    def __init__(self, runner: Runner, folder: Path, name: str) -> None:
        self.runner, self.command = runner, COMMANDS[name]
        self.out, self.kept = folder / "out", folder / "kept"
        self.gains = runner.scratch.parent / "gains"
        self.kept.mkdir()
        for name, content in USERS.items():
            (self.kept / name).write_bytes(content)
        if self.command.logged:
            logged = runner.run("simulate", "rig-300kg", *NOISE, "--log", self.gains / "run.csv")
            assert logged.code == 1 and (self.gains / "run.csv").is_file(), logged
        self.restore()
        for other in self.command.before:
            self.run(*other)
            shutil.rmtree(self.kept)
            shutil.copytree(self.out, self.kept)
        self.run()
        self.restore()
        self.undisturbed = self.run()
        assert self.undisturbed.code in (0, 1), self.undisturbed
        self.after = self.tree()

    def restore(self) -> None:
        """Restore the files that existed before."""
        shutil.rmtree(self.out, ignore_errors=True)
        shutil.copytree(self.kept, self.out)
        for path in self.runner.cache.iterdir() if self.command.cold else ():
            if path.name not in USERS:
                path.unlink()

    def run(self, *more: str, **fault: Any) -> Ran:
        arguments = self.command.arguments(self.out, self.gains)
        return self.runner.run(*arguments, *more, folders=(self.out, self.runner.cache), **fault)

    def tree(self) -> dict[str, Any]:
        """Return every finished file without dates and times, after checking the checksums of checkpoints."""
        paths = [path.relative_to(self.out) for path in self.out.rglob("*") if path.is_file()]
        finished = [path for path in paths if not any(map(is_temporary, path.parts))]
        assert all(read_checksummed(self.out / path) is not None for path in finished if PIECES in path.parts)
        return {str(path): _content(self.out / path) for path in finished if PIECES not in path.parts}

    def everything(self) -> dict[str, bytes]:
        """Return every file below the output folder and the folder of cached programs."""
        files = [
            path for folder in (self.out, self.runner.cache) for path in folder.rglob("*") if path.is_file()
        ]
        return {os.path.relpath(path, self.out): path.read_bytes() for path in files}

    def disturb(self, at: int, kill: bool, *more: str) -> bool:
        """Run with a fault and check the files; return whether any file changed."""
        files_before, everything = self.tree(), self.everything()
        ran = self.run(*more, at=at, kill=kill)
        what = f"{'killed' if kill else 'failed'} at call {at}, {ran.calls[-1:]}: {ran.code} {ran.err[-400:]}"
        assert ran.code != HANGS and "internal error" not in ran.err and "Traceback" not in ran.err, what
        result = self.tree()
        if not kill and ran.code == self.undisturbed.code:
            assert result == self.after, f"{what}: {_differing(result, self.after)}"
            assert ran.document == self.undisturbed.document, what
        elif not kill:
            assert ran.code == 2 and ran.err.splitlines()[-1].startswith("jaxhil: "), what
        for name, content in result.items():
            # A verdict changes as more results are finished.
            whole = content in (files_before.get(name), self.after.get(name)) or _is_signed(content)
            assert whole, f"{what}: {name}"
        assert files_before.keys() <= result.keys(), f"{what}: {files_before.keys() - result.keys()}"
        for name, content in USERS.items():
            assert result[name] == (self.runner.cache / name).read_bytes() == content, f"{what}: {name}"
        if (piece := self.command.one_piece) is not None:
            now, old, new = (_below(tree, piece) for tree in (result, files_before, self.after))
            assert now in (old, new), what
        return self.everything() != everything

    def run_again(self) -> None:
        """Run undisturbed after the fault."""
        new = self.command.new
        refused = new is not None and (self.out / new).exists()
        ran = self.run(*self.command.again)
        if refused:
            assert ran.code == 2 and self.tree() == self.after, ran
            return
        assert ran.code == self.undisturbed.code, ran
        assert ran.document == self.undisturbed.document
        assert self.tree() == self.after, _differing(self.tree(), self.after)
        assert not [path for path in self.out.rglob("*") if is_temporary(path.name)]


def _content(path: Path) -> Any:
    content = path.read_bytes()
    if path.suffix != ".json":
        return content
    document = json.loads(content)
    if path.name == "verdict.json":
        assert document["sha256"] == digest(document)
    return without_times(document)


def _is_signed(content: Any) -> bool:
    """Return whether the document is a verdict, whose digest `_content` has checked."""
    return isinstance(content, dict) and "sweep_sha256" in content and "verdict" in content


def _below(tree: dict[str, Any], folder: str) -> dict[str, Any]:
    return {name: content for name, content in tree.items() if name.startswith(f"{folder}/")}


def _differing(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    return [name for name in first.keys() | second.keys() if first.get(name) != second.get(name)]


@pytest.mark.slow
def test_sweep_recovers_from_failed_system_call_and_kill(runner, tmp_path):
    bench = Bench(runner, tmp_path, "sweep")
    bench.restore()
    calls = bench.undisturbed.calls
    writes = [number for number, call in enumerate(calls) if call.startswith(("write", "rename", "fsync"))]
    assert len(writes) > 20
    bench.disturb(writes[4], False)
    bench.disturb(writes[-2], True, "--resume")
    bench.run_again()


@pytest.mark.slow
@pytest.mark.parametrize("kill", [False, True], ids=["fails", "killed"])
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_recovers_from_failed_system_call_and_kill(runner, tmp_path, name, kill):
    bench = Bench(runner, tmp_path, name)
    for at in range(len(bench.undisturbed.calls)):
        bench.restore()
        if bench.disturb(at, kill):
            bench.run_again()
