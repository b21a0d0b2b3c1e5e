"""Self-test of an export: passes unchanged files, and names file, line and value of any change."""

import json
import os
import random
import re
import shutil
import string
import subprocess
import sys
from pathlib import Path

import pytest
from bundles import TICKS, run_selftest, signed, small_files, write_files

from tuning.bundle import selftest, vector_replay
from tuning.bundle.manifest import is_text

MUTATIONS = 50  # mutations of each text file
OWN_MUTATIONS = 40  # mutations of the self-test itself, each in a separate process


@pytest.fixture(scope="module")
def files():
    return small_files()


@pytest.fixture
def folder(files, tmp_path):
    """Return a copy of the small bundle."""
    return write_files(tmp_path / "bundle", files)


def in_a_bare_process(folder, *arguments, cwd="/", python=("-I", "-S")):
    """Run the self-test in Python without installed packages."""
    command = [sys.executable, *python, str(folder / "selftest.py"), *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, errors="replace", cwd=cwd, check=False)
    return ran.returncode, ran.stdout, ran.stderr


def test_self_test_passes_in_python_without_installed_packages(folder):
    code, out, err = in_a_bare_process(folder)
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "PASSED" and "FAIL" not in out
    assert re.search(rf"vectors.csv: {TICKS + 60} ticks of 2 runs, the same bit for bit", out)
    code, out, err = in_a_bare_process(Path("."), cwd=folder, python=())
    assert (code, err) == (0, "") and "PASSED" in out
    assert not (folder / "__pycache__").exists()


def test_self_test_uses_only_the_standard_library(folder):
    program = (
        "import runpy, sys\ntry: runpy.run_path(sys.argv.pop(1), run_name='__main__')\n"
        "except SystemExit as stop: assert not stop.code, stop.code\n"
        "assert not {'jax', 'numpy', 'jaxhil', 'tuning'} & {name.split('.')[0] for name in sys.modules}"
    )
    command = [sys.executable, "-c", program, str(folder / "selftest.py")]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, ""), ran.stderr


def mutated(source, content):
    """Change or drop one character; return the text and the line of the change."""
    index = source.randrange(len(content))
    old = chr(content[index])
    choices = string.digits if old.isdigit() else string.printable
    new = source.choice([choice for choice in choices if choice != old] + ([""] if not old.isdigit() else []))
    return content[:index] + new.encode() + content[index + 1 :], content.count(b"\n", 0, index) + 1


def test_self_test_names_file_and_line_of_any_changed_character(files, folder):
    source = random.Random(5)
    names = [name for name, content in files.items() if is_text(content) and name != "selftest.py"]
    assert {"gains.json", "vectors.csv", "jaxhil_runtime.py", "manifest.json", "README.md"} <= {*names}
    for name in names:
        for turn in range(MUTATIONS):
            content, line = mutated(source, files[name])
            (folder / name).write_bytes(content)
            _, problems = selftest.find_differences(folder)
            messages = [text for other, text in problems if other == name]
            assert len(problems) == len(messages) > 0, (name, line)
            if name != "manifest.json":
                assert (
                    re.search(rf"line ({line}|{line + 1}): differs", messages[0]) or "endings" in messages[0]
                ), messages
            if turn == 0:
                good, out = run_selftest(folder)
                assert not good and out.splitlines()[-1].startswith("FAILED"), (name, line)
                assert f"FAIL  {name}: {messages[0]}" in out
        (folder / name).write_bytes(files[name])
    assert run_selftest(folder)[0]


def test_self_test_names_the_changed_line_of_the_manifest(files, folder):
    lines = files["manifest.json"].split(b"\n")
    for number in range(1, len(lines) - 4):
        changed = [*lines]
        changed[number] = lines[number][:-2] + b"~" + lines[number][-1:]
        (folder / "manifest.json").write_bytes(b"\n".join(changed))
        good, out = run_selftest(folder)
        assert not good and f"FAIL  manifest.json: line {number + 1}: differs" in out, out


def test_self_test_never_passes_if_its_own_code_was_changed(files, folder):
    source = random.Random(6)
    content = files["selftest.py"]
    program = content.index(b"def main")
    for turn in range(OWN_MUTATIONS):
        # Mutations include docstrings and constants, but mostly executed code.
        begin = program if turn % 4 else 0
        changed, _ = mutated(source, content[begin:])
        (folder / "selftest.py").write_bytes(content[:begin] + changed)
        code, out, err = in_a_bare_process(folder)
        # A syntax error is reported by Python itself.
        assert code != 0 and "selftest.py" in out + err, (changed, out, err)


def test_self_test_detects_damage_of_its_own_integrity_check(files, folder):
    content = files["selftest.py"].decode()
    for old, new in [
        ('if __name__ == "__main__":', 'if __name__ == "__main_":'),
        ('    if not good:\n        sys.exit("FAIL  the self-test")\n', ""),
        ('    check_this_file()\n    if not good:\n        sys.exit("FAIL  the self-test")\n', ""),
        ("    check_this_file()\n    if not good", "    if not good"),
        ("\ncheck_this_file()\n", "\n"),
        ("good = not damaged", "good = True"),
        ("return good", "return True"),
        ("!= digest:", "== digest:"),
        ('["selftest.py"]["sha256"]', '["selftest.pi"]["sha256"]'),
    ]:
        assert old in content, old
        (folder / "selftest.py").write_text(content.replace(old, new))
        code, out, err = in_a_bare_process(folder)
        assert code != 0 and "FAIL  selftest.py" in out + err, (old, out, err)


def test_self_test_detects_a_change_of_any_digit_of_any_gain(files, folder):
    document = json.loads(files["gains.json"])
    text = files["gains.json"].decode()
    values = {f"gains.{name}.value": one["value"] for name, one in document["gains"].items()}
    values["limits.force_limit.value"] = 900.0
    for key, value in values.items():
        shown = json.dumps(value)
        digits = [index for index, one in enumerate(shown) if one.isdigit()]
        section = text.index(f'"{key.split(".")[1]}"', text.index(f'"{key.split(".")[0]}"'))
        at = text.index(f'"value": {shown}', section) + len('"value": ')
        for index in digits:
            digit = int(shown[index])
            new = shown[:index] + str(digit - 1 if digit == 9 else digit + 1) + shown[index + 1 :]
            (folder / "gains.json").write_text(text[:at] + new + text[at + len(shown) :])
            good, out = run_selftest(folder)
            result = json.dumps(json.loads(new))
            assert not good
            assert f"FAIL  gains.json: {key}: found {result}, expected {shown}" in out, out
            assert f"line {text.count(chr(10), 0, at) + 1}: differs" in out


def test_self_test_names_recorded_and_computed_command_if_different(files, folder):
    lines = files["vectors.csv"].decode().split("\n")
    force = vector_replay.VECTOR_COLUMNS.split(",").index("force_command")
    number = next(n for n, line in enumerate(lines[1:], start=1) if float(line.split(",")[force]) > 1)
    fields = lines[number].split(",")
    expected = fields[force]
    fields[force] = expected[:-1] + str((int(expected[-1]) + 5) % 10)
    lines[number] = ",".join(fields)
    stated = repr(float(fields[force]))
    assert stated != expected
    (folder / "vectors.csv").write_text("\n".join(lines))
    good, out = run_selftest(folder)
    assert not good
    assert f"line {number + 1}: differs from what was exported" in out
    assert f"line {number + 1}, run 0: force_command: found {expected}, expected {stated}" in out


def test_self_test_replays_vectors_even_if_all_checksums_match(files, folder):
    """A controller that was translated wrongly may have a manifest with correct checksums."""
    document = json.loads(files["gains.json"])
    runtime = files["jaxhil_runtime.py"]
    for old, new in [(b"2.0 * lag - period", b"2.0 * lag + period"), (b"held = 0", b"held = 1")]:
        if old not in runtime:
            continue
        wrong = signed({**files, "jaxhil_runtime.py": runtime.replace(old, new)}, document)
        for name in ("jaxhil_runtime.py", "manifest.json"):
            (folder / name).write_bytes(wrong[name])
        good, out = run_selftest(folder)
        assert not good and "ok    manifest.json" in out
        assert re.search(r"FAIL  vectors.csv: line \d+, run \d+: force_command: found", out), out
        assert re.search(r"FAIL  vectors.csv: \d+ of \d+ ticks differ", out)


@pytest.mark.parametrize("share, good", [(1e-12, True), (3e-11, False)])
def test_self_test_tolerance_of_simulated_forces_is_a_fraction_of_force_range(files, folder, share, good):
    document = json.loads(files["gains.json"])
    rows = [line.split(",") for line in files["vectors.csv"].decode().split("\n")[1:-1]]
    forces = [float(row[-1]) for row in rows if row[-1] != "nan"]
    span = max(forces) - min(0.0, *forces)
    tick = max(range(len(forces)), key=lambda index: forces[index] < 0.9 * max(forces) and forces[index])
    rows[tick][-1] = repr(float(rows[tick][-1]) + share * span)
    text = "\n".join([vector_replay.VECTOR_COLUMNS, *(",".join(row) for row in rows), ""])
    for name, content in signed({**files, "vectors.csv": text.encode()}, document).items():
        (folder / name).write_bytes(content)
    result, out = run_selftest(folder)
    assert result is good, out
    assert good or f"FAIL  vectors.csv: line {tick + 2}: run 0: force" in out


def test_self_test_compares_controller_commands_bit_for_bit():
    assert vector_replay.are_same_bits(float("nan"), -float("nan"))
    assert not vector_replay.are_same_bits(0.0, -0.0)
    assert not vector_replay.are_same_bits(0.1 + 0.2, 0.3)
    assert not vector_replay.are_same_bits(float("nan"), 0.0)


@pytest.mark.parametrize(
    "name", ["gains.json", "vectors.csv", "jaxhil_runtime.py", "manifest.json", "gains.mat"]
)
@pytest.mark.parametrize(
    "garbage", [b"", b"\x00\xff\xfe" * 999, b"[" * 100_000, b"{}", b"raise SystemExit(0)\n", None, "folder"]
)
def test_self_test_reports_unreadable_files_with_one_line_per_check(folder, name, garbage):
    (folder / name).unlink()
    if garbage == "folder":
        (folder / name).mkdir()
    elif garbage is not None:
        (folder / name).write_bytes(garbage)
    good, out = run_selftest(folder)
    assert not good and f"FAIL  {name}: " in out and "Traceback" not in out
    assert all(re.match("self-test of|ok    |FAIL  |FAILED", line) for line in out.splitlines()), out


def test_self_test_reports_unreadable_files_with_matching_checksums(files, folder):
    document = json.loads(files["gains.json"])
    for name, text, reason in [
        ("jaxhil_runtime.py", "raise SystemExit(0)", "cannot be executed: SystemExit"),
        ("jaxhil_runtime.py", "x = (", "cannot be executed: SyntaxError"),
        ("jaxhil_runtime.py", "Controller = 3", "cannot be executed: NameError"),
        ("gains.json", "[]", "found a list"),
        ("vectors.csv", "a,b\n", "unknown columns"),
        ("vectors.csv", vector_replay.VECTOR_COLUMNS + "\n1,2,3\n", "line 2: not a row of 14 numbers"),
        ("vectors.csv", vector_replay.VECTOR_COLUMNS + "\n" + "0," * 13 + "0\n", "line 2: event: found 0.0"),
        ("vectors.csv", vector_replay.VECTOR_COLUMNS + "\n", "contains no ticks"),
    ]:
        for other, content in signed({**files, name: text.encode()}, document).items():
            (folder / other).write_bytes(content)
        good, out = run_selftest(folder)
        assert not good and f"FAIL  {name}: " in out and reason in out, out


def test_self_test_names_surplus_and_missing_files(files, folder):
    (folder / "other").mkdir()
    (folder / "other" / "notes.txt").write_text("mine")
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "jaxhil_runtime.cpython-311.pyc").write_bytes(b"")
    os.unlink(folder / "summary.html")
    good, out = run_selftest(folder)
    assert not good and out.count("FAIL  ") == 2
    assert "FAIL  other/: is not a file of this bundle" in out
    assert "note  __pycache__/: contains compiled code, which is not checked" in out
    assert "FAIL  summary.html: cannot be read: No such file or directory" in out


def test_self_test_reports_changed_line_endings(files, folder):
    (folder / "gains.csv").write_bytes(files["gains.csv"].replace(b"\n", b"\r\n"))
    good, out = run_selftest(folder)
    assert not good and "FAIL  gains.csv: its line endings differ from what was exported" in out


def test_self_test_rejects_unknown_arguments(folder):
    code, out, err = in_a_bare_process(folder, "--fast")
    assert (code, out, err) == (1, "", "usage: python selftest.py [--c]\n")


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_self_test_compiles_and_runs_the_c_controller(files, folder, monkeypatch):
    good, out = run_selftest(folder, "--c")
    assert good and re.search(rf"ok    c99: vectors.csv: {TICKS + 60} ticks, the same bit for bit", out), out
    document = json.loads(files["gains.json"])
    header = files["c99/jaxhil_gains.h"].decode()
    value = re.search(r"([-0-9.e]+), /\* phase_lead,", header)[1]
    for old, new, reason in [
        (value, str(2 * float(value)), r"FAIL  c99: vectors.csv:\d+: force_command: found"),
        ("#define", "#defin", "FAIL  c99: .*error"),
    ]:
        wrong = signed({**files, "c99/jaxhil_gains.h": header.replace(old, new, 1).encode()}, document)
        for name, content in wrong.items():
            (folder / name).write_bytes(content)
        good, out = run_selftest(folder, "--c")
        assert not good and re.search(reason, out), out
    (folder / "c99" / "jaxhil_controller.h").write_bytes(b"")
    expected = "FAIL  c99: is not compiled, because a file is missing or differs"
    assert expected in run_selftest(folder, "--c")[1]
    for name, content in files.items():
        (folder / name).write_bytes(content)
    monkeypatch.setenv("PATH", "")
    good, out = run_selftest(folder, "--c")
    assert not good and "found no C compiler" in out
