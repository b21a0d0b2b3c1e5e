"""Commands of README and guide print the output shown below them."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import campaigns
import pytest
from test_identify_command import write

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "notebooks" / "guide"
PAGES = [ROOT / "README.md", *sorted(GUIDE.glob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
STEP = re.compile(r"^\$ ((?:.*\\\n)*.*)\n((?:(?!\$ ).*\n)*)", re.M)
COMMAND = re.compile(
    r"`(?:jaxhil|pytest|python3?) [^`]+`|^(?:\$ )?(?:jaxhil|pytest|python3?) |^```python", re.M
)
NUMBER = re.compile(r"\d+\.\d+|\d+")
# Commands that take many minutes, or need logs of a rig.
LEFT_OUT = ("rig", "compare", "identify", "monitor")
# Pages in reading order; each uses the files of the pages before.
ORDER = ("first_ten_minutes", "tuning", "sweeps", "to_the_rig")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_numbers_in_guide_appear_below_the_command_that_prints_them(page):
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        if block[1] == "text" and re.search(r"\d\.\d", block[2]):
            section = text[max(text.rfind("\n#", 0, block.start()), 0) : block.end()]
            assert COMMAND.search(section), block[2]


def read_commands(page):
    """Return the commands of a page with the lines below each, in order."""
    text = page.read_text(encoding="utf-8")
    for block in BLOCK.finditer(text):
        if block[1] == "text":
            yield from ((step[1].replace("\\\n", " "), step[2]) for step in STEP.finditer(block[2]))


@pytest.mark.slow
def test_commands_in_guide_print_the_output_shown(tmp_path):
    """Words and lines must agree; numbers may differ because of a solver, and are then printed."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "110"}
    names = {"jaxhil": [sys.executable, "-m", "tuning"], "python": [sys.executable]}
    printed: dict[str, list[str]] = {}
    for page in [*(GUIDE / f"{name}.md" for name in ORDER), ROOT / "README.md"]:
        for command, lines in read_commands(page):
            first, *others = shlex.split(command)
            if others[0] in LEFT_OUT:
                continue
            if command not in printed:
                ran = subprocess.run(
                    [*names[first], *others], cwd=tmp_path, env=environment, capture_output=True, text=True,
                    check=False,
                )  # fmt: skip
                # A command without shown output may have any verdict.
                allowed = (int("Bad:" in lines),) if lines.strip() else (0, 1)
                assert ran.returncode in allowed, ran.stderr
                printed[command] = [line.rstrip() for line in ran.stdout.splitlines()]
            result = {words_of(line) for line in printed[command]}
            missing = [line for line in lines.splitlines() if words_of(line) not in result]
            assert not missing, f"{page.name}: {command}: {missing}\n" + "\n".join(printed[command])
            for line in set(lines.splitlines()) - set(printed[command]):
                print(f"\n{page.name}: {line}", end="")
    assert len(printed) > 12


@pytest.mark.slow
def test_commands_of_guide_page_on_logs_print_the_output_shown(tmp_path):
    (tmp_path / "day1").mkdir()
    write(tmp_path / "day1", campaigns.campaign("clean", 0))
    environment = {**os.environ, "COLUMNS": "110"}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    for command, lines in read_commands(GUIDE / "from_logs.md"):
        if "day1" in command:
            ran = subprocess.run(
                command.replace("jaxhil", f"{sys.executable} -m tuning", 1), shell=True, cwd=tmp_path,
                env=environment, capture_output=True, text=True, check=False,
            )  # fmt: skip
            assert ran.returncode == 0, ran.stderr
            result = ran.stdout.splitlines()
            assert {words_of(line) for line in lines.splitlines()} <= {words_of(line) for line in result}
            print("\n" + "\n".join(line.rstrip() for line in result), end="")
        if "--guess" in command:
            # Values that only the rig's owner knows.
            draft = (tmp_path / "logs.toml").read_text().replace("# [bodies]", "[bodies]")
            (tmp_path / "logs.toml").write_text(draft.replace("# equivalent_mass", "equivalent_mass"))


def words_of(line):
    """Return a line without its numbers."""
    return " ".join(NUMBER.sub("N", line).split())
