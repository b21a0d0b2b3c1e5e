"""Self-test of a bundle with FMUs: the test compiles their sources and detects one changed digit."""

import io
import json
import re
import zipfile

import c99_cases
import pytest
from bundles import run_selftest, signed, small_files, write_files
from six_axis_documents import LIMITS, six_axis_document

from jaxhil.simulation.jax_environment import jax_context
from tuning.bundle.bundle import build_bundle, write_bundle
from tuning.bundle.writers import fmi2_files, fmi3_files

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler")
WRITERS = {"fmi3": fmi3_files, "fmi2": fmi2_files}
CONTROLLER = "jaxhil_controller.fmu"


def files_of(name):
    """Return the files of a small bundle with the FMUs of one version, and without the folder `c99`."""
    files = {path: content for path, content in small_files().items() if not path.startswith("c99/")}
    document = json.loads(files["gains.json"])
    return signed({**files, **WRITERS[name](document)}, document)


def with_changed_digit(archive):
    """Return the archive of an FMU with another digit in the start value of a gain."""
    changed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            text = old.read(name)
            if name == "sources/fmu_variables.c":
                value = re.search(rb'"gains.phase_lead", FMU_REAL, FMU_PARAMETER, ([0-9.e-]+),', text)
                assert value is not None
                digit = value.start(1) + len(value[1].split(b"e")[0]) // 2
                text = text[:digit] + (b"1" if text[digit : digit + 1] != b"1" else b"2") + text[digit + 1 :]
            new.writestr(name, text)
    return changed.getvalue()


@pytest.mark.parametrize("name", ["fmi3", pytest.param("fmi2", marks=pytest.mark.slow)])
def test_self_test_replays_vectors_through_the_fmu(name, tmp_path):
    files = files_of(name)
    folder = write_files(tmp_path, files)
    good, out = run_selftest(folder, "--c")
    assert good and re.search(rf"ok    {name}: vectors.csv: \d+ ticks, the same bit for bit", out), out
    assert "c99" not in out


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_self_test_detects_a_changed_digit_in_the_sources_of_an_fmu(name, tmp_path):
    files, path = files_of(name), f"{name}/{CONTROLLER}"
    folder = write_files(tmp_path, files)
    changed = with_changed_digit(files[path])
    (folder / path).write_bytes(changed)
    good, out = run_selftest(folder, "--c")
    assert not good and f"FAIL  {path}: differs from what was exported" in out
    assert f"FAIL  {name}: is not compiled, because a file is missing or differs" in out
    # With matching checksums, the results show the change.
    write_files(folder, signed({**files, path: changed}, json.loads(files["gains.json"])))
    good, out = run_selftest(folder, "--c")
    assert not good and re.search(rf"FAIL  {name}: vectors.csv:\d+: force_command: found", out), out


def test_self_test_reports_an_unreadable_fmu_and_a_failing_compiler_in_one_line(tmp_path, monkeypatch):
    files = files_of("fmi3")
    folder = write_files(tmp_path, files)
    monkeypatch.setenv("CC", "false")
    assert "FAIL  fmi3: exit code 1" in run_selftest(folder, "--c")[1]
    garbage = signed({**files, f"fmi3/{CONTROLLER}": b"no archive"}, json.loads(files["gains.json"]))
    _, out = run_selftest(write_files(folder, garbage), "--c")
    assert "FAIL  fmi3: cannot be compiled and run: BadZipFile: File is not a zip file" in out
    monkeypatch.setenv("PATH", "")
    assert "FAIL  fmi3: found no C compiler" in run_selftest(write_files(folder, files), "--c")[1]


@pytest.mark.slow
@pytest.mark.parametrize("format_name", ["fmu", "fmu2"])
def test_self_test_replays_vectors_through_six_axis_fmu(format_name, tmp_path):
    with jax_context():
        built = build_bundle(six_axis_document(limits=LIMITS), [format_name])
    write_bundle(tmp_path / "bundle", built.files)
    good, out = run_selftest(tmp_path / "bundle", "--c")
    assert good and re.search(r"ok    fmi[23]: vectors.csv: \d+ ticks, the same bit for bit", out), out
