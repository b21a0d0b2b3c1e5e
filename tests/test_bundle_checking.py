"""Checks of an exported bundle: only files that this version exports are ever run.

The checks never block on a file, and never follow a link out of the folder.
"""

import hashlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import time

import pytest
from bundles import run_selftest, signed, small_files, write_files

import tuning
from jaxhil.errors import InputError
from jaxhil.files import exchange_names
from tuning.bundle import selftest
from tuning.bundle.bundle import write_bundle
from tuning.bundle.checking import check_bundle, find_code_differences
from tuning.bundle.checking import run_selftest as run_checked

UDP = ("udp_controller.py", "udp_protocol.py", "udp_task.py", "numerical_model.py", "flight_recorder.py")
CODE = ("selftest.py", "vector_replay.py", "jaxhil_runtime.py", *UDP)
SHORT = 10  # far more than any check takes [s]


@pytest.fixture(scope="module")
def files():
    return small_files()


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "bundle"


@pytest.fixture(autouse=True)
def _in_time():
    """Fail a test that does not finish."""

    def too_long(number, frame):
        raise TimeoutError(f"longer than {SHORT} s")

    before = signal.signal(signal.SIGALRM, too_long)
    signal.alarm(6 * SHORT)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def document_of(files):
    return json.loads(files["gains.json"])


def resealed(manifest):
    """Return the manifest content with valid checksums."""
    body = json.dumps(manifest, indent=1).encode().removesuffix(b"\n}")
    return body + selftest.build_manifest_seal(body)


def entry(content, **changes):
    return {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content), **changes}


def plain_manifest(files, **others):
    """Return the manifest content as data, with additional file entries."""
    made = json.loads(files["manifest.json"])
    made = {name: value for name, value in made.items() if not name.startswith("own_")}
    return {**made, "files": {**made["files"], **others}}


def test_bundle_check_accepts_exported_bundle(files, folder):
    checked = check_bundle(write_files(folder, files))
    assert (checked.reasons, checked.signature) == ([], "not signed")
    assert checked.files == files and checked.document == document_of(files)
    assert find_code_differences(folder, "phase_lead") == []


@pytest.mark.parametrize("name", [*CODE, "c99/jaxhil_controller.c", "README.md", "ros2.yaml", "gains.mat"])
def test_code_of_third_party_bundle_with_valid_checksums_is_not_run(files, folder, tmp_path, name):
    """Add code that would leave a file if executed, and update the manifest."""
    trap = b"\nopen(%r, 'w')\n" % str(tmp_path / "ran").encode()
    signed_files = signed({**files, name: files[name] + trap}, document_of(files))
    verdict = tuning.verify(write_files(folder, signed_files))
    assert not verdict.good and verdict.document["self_test"] == []
    first, last = verdict.reasons
    assert first == f"{name}: differs from what this version exports"
    assert last.startswith("no code of the bundle was run: its manifest names this version, jaxhil ")
    assert (find_code_differences(folder, "phase_lead") == []) is (name not in CODE)
    assert not (tmp_path / "ran").exists()


def test_bundle_check_reports_missing_and_extra_files(files, folder):
    remaining = {name: content for name, content in files.items() if name != "udp_controller.py"}
    signed_files = signed({**remaining, "sitecustomize.py": b"open('ran', 'w')"}, document_of(files))
    reasons = check_bundle(write_files(folder, signed_files)).reasons
    assert reasons[:2] == [
        "sitecustomize.py: this version does not export such a file",
        "udp_controller.py: is missing",
    ]
    assert find_code_differences(folder, "phase_lead") == reasons


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"<h1>", b"<script>fetch('/')</script><h1>"),
        (b"base64,iVBOR", b'x" onerror="fetch(1)" alt="base64,iVBOR'),
        (b"base64,iVBOR", b"base64,iVBO="),
    ],
)
def test_bundle_check_rejects_modified_summary_page(files, folder, old, new):
    assert old in files["summary.html"]
    page = files["summary.html"].replace(old, new)
    signed_files = signed({**files, "summary.html": page}, document_of(files))
    reason = check_bundle(write_files(folder, signed_files)).reasons[0]
    expected = "summary.html: differs from", "gains.json: this version cannot export it"
    assert reason.startswith(expected), reason


def test_bundle_check_names_version_that_wrote_bundle(files, folder):
    for stated, words in [("jaxhil 0.0.9", "names 'jaxhil 0.0.9'"), (None, "names no version"), ([1], "[1]")]:
        other = plain_manifest(files)
        other.update(version=stated)
        if stated is None:
            del other["version"]
        write_files(folder, {**files, "manifest.json": resealed(other)})
        first, last = check_bundle(folder).reasons
        assert first == "manifest.json: differs from what this version exports for these files"
        assert words in last
    assert run_selftest(folder)[0]  # the self-test on a rig finds no inconsistency


def test_bundle_check_rejects_gain_file_with_other_formatting(files, folder):
    for text in (
        files["gains.json"].replace(b": ", b":  ", 1),
        files["gains.json"].replace(b"{\n", b'{\n  "seed": 7,\n', 1),
        b"[]",
        b"[" * 100_000,
        b"\xff",
    ):
        signed_files = signed({**files, "gains.json": text}, document_of(files))
        reasons = check_bundle(write_files(folder, signed_files)).reasons
        assert reasons[0].startswith("gains.json: "), reasons


def test_self_test_runs_checked_content_even_if_files_change_afterwards(files, folder, tmp_path):
    checked = check_bundle(write_files(folder, files))
    for name in ("selftest.py", "jaxhil_runtime.py"):
        (folder / name).write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    lines, reasons = run_checked(checked, "bundle")
    assert reasons == [] and lines[0].startswith("self-test of bundle,") and lines[-1] == "PASSED"
    assert not (tmp_path / "ran").exists()


def test_bundle_check_reports_pycache_beside_sources(files, folder):
    write_files(folder, files)
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "jaxhil_runtime.cpython-311.pyc").write_bytes(b"who knows")
    [reason] = check_bundle(folder).reasons
    assert reason.startswith("__pycache__/: contains compiled code, which is not checked")
    good, out = run_selftest(folder)
    assert good and "note  __pycache__/: contains compiled code" in out


HOSTILE_PATHS = [
    *("../../../dev/zero", "/dev/zero", "../secret", "a/../../secret", "a/../b", "./gains.json", "a//b", ""),
    *(".", "..", "c99", "c99/..", "c99/", "c99\\b", "..\\secret", "C:/secret", "a\0b", "gains.json\n"),
    *("\u00e9", "a" * 300, "a/" * 40 + "b", "manifest.json", "manifest.sig", "~/secret", "-rf"),
]


@pytest.mark.parametrize("path", HOSTILE_PATHS)
def test_manifest_paths_outside_bundle_are_rejected(files, folder, path):
    (folder.parent / "secret").write_bytes(b"secret")
    hostile_files = {**files, "manifest.json": resealed(plain_manifest(files, **{path: entry(b"secret")}))}
    begun = time.monotonic()
    checked = check_bundle(write_files(folder, hostile_files))
    good, out = run_selftest(folder)
    assert time.monotonic() - begun < SHORT
    assert not good and f"FAIL  {'c99' if path == 'c99' else 'manifest.json'}: cannot be read: " in out
    assert checked.reasons and all(reason.isprintable() and len(reason) <= 300 for reason in checked.reasons)
    assert b"secret" not in checked.files.values()


@pytest.mark.parametrize("name", ["gains.json", "manifest.json", "manifest.sig", "selftest.py", "c99"])
@pytest.mark.parametrize("kind", ["pipe", "link", "link to a device", "loop", "folder", "socket", "vast"])
def test_bundle_check_rejects_links_pipes_and_folders_without_blocking(
    files, folder, monkeypatch, name, kind
):
    write_files(folder, files)
    path = folder / name
    elsewhere = folder.parent / "elsewhere"
    path.rename(elsewhere) if path.exists() else elsewhere.write_bytes(bytes(64))
    if kind == "pipe":
        os.mkfifo(path)
    elif kind.startswith("link"):
        path.symlink_to("/dev/zero" if "device" in kind else elsewhere)
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "folder":
        (path / "inner").mkdir(parents=True)
    elif kind == "socket":
        monkeypatch.chdir(folder)  # the path of a socket must be short
        with socket.socket(socket.AF_UNIX) as opened:
            opened.bind(name)
    else:
        with path.open("wb") as file:
            file.truncate(1 << 40)
    begun = time.monotonic()
    verdict = tuning.verify(folder)
    program = str(elsewhere if name == "selftest.py" else folder / "selftest.py")
    command = [sys.executable, "-I", "-S", "-B", program]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=SHORT, check=False)
    assert time.monotonic() - begun < SHORT
    assert not verdict.good and verdict.document["self_test"] == []
    assert any(reason.startswith(name) for reason in verdict.reasons), verdict.reasons
    assert ran.returncode == 1 and "Traceback" not in ran.stderr
    assert name == "selftest.py" or f"FAIL  {name}" in ran.stdout


def test_bundle_check_rejects_oversized_manifest_entries(files, folder):
    many = {f"f{number}": entry(b"") for number in range(selftest.MAX_FILES + 1)}
    for others in (many, {"vast": entry(b"", bytes=1 << 60)}, {"odd": entry(b"", bytes=True)}):
        write_files(folder, {**files, "manifest.json": resealed(plain_manifest(files, **others))})
        [reason] = check_bundle(folder).reasons
        assert reason.startswith("manifest.json: cannot be read: ValueError: ")
    # The file's size differs from the stated one; its digest is as stated.
    wrong = plain_manifest(files, **{"ros2.yaml": entry(files["ros2.yaml"], bytes=3)})
    write_files(folder, {**files, "manifest.json": resealed(wrong)})
    [reason] = check_bundle(folder).reasons
    assert reason == f"ros2.yaml: differs from what was exported (found {len(files['ros2.yaml'])} bytes)"


def flipped(source, content):
    index, bit = source.randrange(len(content)), source.randrange(8)
    return content[:index] + bytes([content[index] ^ 1 << bit]) + content[index + 1 :]


@pytest.mark.parametrize("flips", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_bundle_check_detects_every_flipped_bit(files, folder, flips):
    source, names = random.Random(flips), sorted(files)
    write_files(folder, files)
    for turn in range(flips):
        name = names[turn % len(names)]
        (folder / name).write_bytes(flipped(source, files[name]))
        reasons = check_bundle(folder).reasons
        assert reasons and all(reason.startswith(f"{name}: ") for reason in reasons), (name, reasons)
        (folder / name).write_bytes(files[name])
    assert check_bundle(folder).reasons == []


def test_only_an_unmodified_bundle_is_rewrite_files(files, folder, tmp_path):
    write_files(folder, files)
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "thesis.txt").write_text("years of work")

    def refused():
        with pytest.raises(InputError, match="expected a new or empty folder, or an unchanged bundle"):
            write_bundle(folder, files)
        assert (secret / "thesis.txt").read_text() == "years of work"
        assert sorted(os.listdir(tmp_path)) == ["bundle", "secret"]

    (folder / "empty").mkdir()
    refused()
    (folder / "empty").rmdir()
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "thesis.txt").write_text("years of work")
    refused()
    (folder / "__pycache__" / "thesis.txt").rename(folder / "__pycache__" / "selftest.cpython-311.pyc")
    (folder / "c99" / "link").symlink_to(secret)
    refused()
    (folder / "c99" / "link").unlink()
    (folder / "gains.mat").unlink()
    (folder / "gains.mat").symlink_to(secret / "thesis.txt")
    refused()
    (folder / "gains.mat").unlink()
    (folder / "gains.mat").write_bytes(files["gains.mat"])
    write_bundle(folder, {"manifest.json": b"another"})
    assert os.listdir(folder) == ["manifest.json"]
    assert sorted(os.listdir(tmp_path)) == ["bundle", "secret"]


def test_file_added_during_replacement_of_bundle_is_kept(files, folder, monkeypatch):
    write_files(folder, files)

    def late(new, target):
        if not (new / "thesis.txt").exists():
            (target / "thesis.txt").write_text("years of work")
        exchange_names(new, target)

    monkeypatch.setattr("tuning.bundle.bundle.exchange_names", late)
    with pytest.raises(InputError, match=r"thesis\.txt: is not a file of this bundle"):
        write_bundle(folder, {"manifest.json": b"another"})
    assert (folder / "thesis.txt").read_text() == "years of work"
    assert (folder / "manifest.json").read_bytes() == files["manifest.json"]
    assert os.listdir(folder.parent) == ["bundle"]
