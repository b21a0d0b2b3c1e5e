"""`jaxhil export` writes a bundle completely or not at all; `jaxhil verify` detects a corrupt bundle."""

import errno
import html
import json
import os
import re
import shutil

import pytest
from bundles import document, run_selftest, signed, small_files, write_files
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from jaxhil.errors import InputError
from jaxhil.files import TEMPORARY_SUFFIX
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.rig.faults import FAULTS
from jaxhil.simulation.gain_file import load_gain_file
from tuning.bundle.bundle import (
    build_bundle,
    check_bundle_folder,
    check_same_mechanism,
    replace_limits,
    write_bundle,
)
from tuning.bundle.checking import check_bundle
from tuning.bundle.checking import run_selftest as run_selftest_alone
from tuning.bundle.fmu.rig import SOURCE_FILES
from tuning.bundle.readme import readme_text
from tuning.bundle.writers import ON_REQUEST, WRITERS
from tuning.gain_file import write_gain_file

pytestmark = pytest.mark.users_options

ALWAYS = {
    *("gains.json", "jaxhil_runtime.py", "vectors.csv", "selftest.py", "vector_replay.py", "manifest.json"),
    "README.md",
    "summary.html",
}
UDP = ("udp_controller.py", "udp_protocol.py", "udp_task.py", "numerical_model.py", "flight_recorder.py")
# Compensators whose exported files hardly differ from the files of other compensators.
LIKE_OTHERS = {"dead_zone_observer", "multi_parameter_lead", "passivity", "phase_lead", "smith_hybrid"}
LIKE_OTHERS |= {"none", "position_lead", "response_error", "smith_predictor", "virtual_contact"}


@pytest.fixture
def gains(tmp_path):
    path = tmp_path / "gains.json"
    write_gain_file(path, document())
    return path


def refused(ran, *words):
    assert ran.code == 2 and ran.out == ""
    last = ran.err.splitlines()[-1]
    assert last.startswith("jaxhil: ") and all(word in last for word in words), ran.err


def files_of(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_export_command_writes_signed_bundle_that_verifies(jaxhil, gains, tmp_path):
    folder, private, public = tmp_path / "new" / "bundle", tmp_path / "key.pem", tmp_path / "public.pem"
    pair = Ed25519PrivateKey.generate()
    private.write_bytes(pair.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    public.write_bytes(pair.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    # With these gains every run diverges: an active watchdog would stop it.
    blind = ("--set", "restitution_margin=none", "--missed", "1")
    ran = jaxhil("export", gains, "-o", folder, "--format", "csv,ros2", "--sign", private, "--json", *blind)
    assert ran.code == 0, ran
    output = ran.document
    assert output["verdict"] == "unknown" and not output["reasons"] and output["stop"] is None
    assert "runs is good: gains with smaller errors are needed" in output["unknown"][0]
    assert output["bundle"] == str(folder) and output["formats"] == ["ros2", "csv"]
    assert output["signed"] is True
    assert files_of(folder) == {*output["files"]} == ALWAYS | {"ros2.yaml", "gains.csv", *UDP, "manifest.sig"}
    written, original = (load_gain_file(path).document for path in (folder / "gains.json", gains))
    assert {name for name in written if written[name] != original.get(name)} == {
        "limits",
        "figures",
        "sha256",
    }
    assert os.listdir(tmp_path / "new") == ["bundle"]
    ran = jaxhil("verify", folder, "--scenarios", "4", "--key", public)
    assert ran.code == 0 and "Good: commands agree" in ran.out and "\nPASSED\n" in ran.out
    assert "Signature: valid for the given key." in ran.out
    # Export again into the same folder, without a signature.
    ran = jaxhil("export", folder, "-o", folder, "--format", "matlab", *blind)
    assert ran.code == 0 and "\nNot known to be good: " in ran.out and "selftest.py" in ran.out
    assert "gains.mat" in files_of(folder) and not {"gains.csv", "manifest.sig"} & files_of(folder)
    ran = jaxhil("verify", folder, "--key", public, "--json")
    assert ran.code == 1 and ran.document["signature"] == "not signed" and ran.document["self_test"] == []
    [reason] = ran.document["reasons"]
    assert reason == "manifest.sig: found no signature, expected the signature by the given key"


@pytest.mark.parametrize(
    "compensator",
    [pytest.param(name, marks=pytest.mark.slow if name in LIKE_OTHERS else ()) for name in COMPENSATORS],
)
def test_export_builds_bundle_for_every_compensator(compensator, tmp_path):
    made = build_bundle(
        document(compensator=compensator), [name for name in WRITERS if name not in ON_REQUEST]
    )
    write_bundle(tmp_path / "bundle", made.files)
    good, output = run_selftest(tmp_path / "bundle", *(["--c"] if shutil.which("cc") else []))
    assert good and made.ticks > 300 and not made.reasons, output
    assert run_selftest_alone(check_bundle(tmp_path / "bundle"), "bundle")[1] == []


def test_export_is_reproducible_for_equal_gains_and_seed():
    made = document()
    first, second = (build_bundle(made, ["matlab", "csv"], {"force_limit": 900.0}).files for _ in range(2))
    assert first == second
    other = build_bundle(made, ["matlab", "csv"], {"force_limit": 900.0}, seed=1).files
    assert {name for name in first if first[name] != other[name]} == {"vectors.csv", "manifest.json"}


def test_replacement_of_limits_updates_digest_and_stores_alarm_rates():
    made = document()
    changed = replace_limits(made, {"force_limit": 900.0, "velocity_limit": None}, {"limit": 0.01})
    assert changed["limits"] == {
        "force_limit": {"value": 900.0, "unit": "N"},
        "velocity_limit": {"value": None, "unit": "m/s"},
    }
    assert changed["figures"]["watchdog"] == {"limit": 0.01} and changed["sha256"] != made["sha256"]
    assert replace_limits(made, None) == made


def test_export_rejects_controller_that_differs_from_simulation(jaxhil, gains, tmp_path, monkeypatch):
    class Wrong(ON_THE_RIG["phase_lead"]):
        def step(self, force_measured, position_desired, velocity_desired, position_measured):
            return (1 + 1e-8) * self._lead.step(force_measured)

    Wrong.__module__ = ON_THE_RIG["phase_lead"].__module__
    monkeypatch.setitem(ON_THE_RIG, "phase_lead", Wrong)
    ran = jaxhil("export", gains, "-o", tmp_path / "bundle")
    assert ran.code == 1 and "Bad: the nominal run, tick " in ran.out and "wrote" not in ran.out
    assert not (tmp_path / "bundle").exists()


@pytest.mark.slow
def test_export_reports_limits_that_stop_the_nominal_run(jaxhil, gains, tmp_path):
    ran = jaxhil("export", gains, "-o", tmp_path / "bundle", "--set", "force_limit=1")
    output = " ".join(ran.out.split())
    assert ran.code == 1 and "Bad: the nominal run is stopped at " in output
    assert "by the guard's check force_limit: " in output and ", force_limit 1 N; " in output
    assert "--set force_limit=" in output and " lets this run and similar runs pass" in output
    assert (tmp_path / "bundle" / "manifest.json").exists()


@pytest.mark.slow
def test_export_takes_limits_from_the_specified_sweep(jaxhil, gains, tmp_path):
    store, folder = tmp_path / "store", tmp_path / "bundle"
    assert jaxhil("sweep", gains, "--scenarios", "40", "--limit", "5", "-o", store).code == 0
    replaced = ["--set", "command_lowest=-0.05", "--set", "force_range=none"]
    ran = jaxhil("export", gains, "-o", folder, "--sweep", store, "--format", "csv", *replaced)
    assert ran.code == 0, ran
    written = load_gain_file(folder / "gains.json").document
    rates = written["figures"]["watchdog"]
    assert rates["limit"] == 5.0
    sweep = written["figures"]["sweep"]
    assert sweep["scenarios"] == 40 and sweep["failed"] == 0 and sweep["limit"] == 5.0
    sentence = "Sweep: failure probability 0 (95 %: 0 to 0.0881). 0 of 40 scenarios failed; "
    assert sentence in (folder / "summary.html").read_text() and sentence in " ".join(ran.out.split())
    assert rates["calibrated_on"]["scenarios"] == 40 and rates["calibrated_on"]["sweep_sha256"]
    alarms, runs = (rates["false_alarms"][name] for name in ("alarms", "runs"))
    assert 0 < runs < 40 and f"false alarms {alarms} of {runs} good runs (95 %: " in ran.out
    assert rates["verdict"] == "unknown" and "\nUnknown: " in ran.out
    assert {fault["name"] for fault in rates["fault_runs"]} >= {"force_delay", "simulator_delay"}
    limits = written["limits"]
    assert limits["command_lowest"] == {"value": -0.05, "unit": "m"}
    assert limits["force_range"] == {"value": None, "unit": "N"}
    assert limits["force_limit"]["value"] > 0 and "force_limit" in ran.out


@pytest.mark.slow
def test_export_verdict_is_bad_if_watchdog_stops_good_runs(jaxhil, gains, tmp_path):
    store, folder = tmp_path / "store", tmp_path / "bundle"
    assert jaxhil("sweep", gains, "--scenarios", "40", "--limit", "5", "-o", store).code == 0
    command = ["export", gains, "-o", folder, "--sweep", store, "--format", "csv"]
    ran = jaxhil(*command, "--false-alarms", "1", "--missed", "1")
    assert ran.code == 0 and "\nGood: " in ran.out and "nknown" not in ran.out
    assert load_gain_file(folder / "gains.json").document["figures"]["watchdog"]["verdict"] == "good"
    ran = jaxhil(*command, "--set", "restitution_margin=0")
    assert ran.code == 1 and "\nBad: false alarms: 95 % interval " in ran.out and "\nGood" not in ran.out
    page = (folder / "summary.html").read_text()
    assert "<b>Bad: false alarms: 95 % interval " in page and ", limit 0.01)" in page


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--false-alarms", "1.5"], ["--false-alarms", "1.5", "0 to 1"]),
        (["--missed", "nan"], ["--missed", "nan", "0 to 1"]),
        (["--format", "xml"], ["--format", "'xml'", "ros2, matlab, csv"]),
        (["--format", "csv,"], ["--format", "''"]),
        (["--seed", "-1"], ["--seed", "-1"]),
        (["--sweep", "no-such-store"], ["no-such-store"]),
        (["--set", "stroke=1"], ["--set", "'stroke=1'", "command_lowest"]),
        (["--set", "force_limit=-1"], ["--set", "'force_limit=-1'", "from 0 to 1e+06 N, or none"]),
        (["--set", "command_lowest=inf"], ["--set", "'command_lowest=inf'", "finite"]),
        (["--set", "command_lowest"], ["--set", "'command_lowest'", "none"]),
    ],
)
def test_export_command_rejects_wrong_arguments(jaxhil, gains, tmp_path, arguments, words):
    refused(jaxhil("export", gains, "-o", tmp_path / "bundle", *arguments), *words)
    assert not (tmp_path / "bundle").exists()


def test_export_command_rejects_unreadable_gains(jaxhil, tmp_path):
    refused(
        jaxhil("export", tmp_path / "none.json", "-o", tmp_path / "bundle"), "none.json", "cannot be read"
    )
    (tmp_path / "gains.json").write_text("{}")
    refused(jaxhil("export", tmp_path, "-o", tmp_path / "bundle"), "gains.json: schema: found nothing")


def test_export_leaves_third_party_folder_unchanged(jaxhil, gains, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    refused(jaxhil("export", gains, "-o", folder), "mine", "'thesis.txt' and no bundle")
    refused(jaxhil("export", gains, "-o", folder / "thesis.txt"), "thesis.txt", "found a file")
    write_files(folder, small_files())
    refused(jaxhil("export", gains, "-o", folder), "thesis.txt: is not a file of this bundle")
    (folder / "thesis.txt").unlink()
    check_bundle_folder(folder)
    for name in ("manifest.json", "README.md"):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content + b"my notes")
        expected = "expected a new or empty folder, or an unchanged bundle"
        refused(jaxhil("export", gains, "-o", folder), name, expected)
        assert (folder / name).read_bytes() == content + b"my notes"
        (folder / name).write_bytes(content)
    check_bundle_folder(folder)


@pytest.mark.parametrize("before", [False, True])
def test_failed_write_of_bundle_keeps_the_old_bundle(tmp_path, monkeypatch, before):
    folder = tmp_path / "bundle"
    if before:
        write_files(folder, small_files())
    old_files = {name: (folder / name).read_bytes() for name in files_of(folder)}
    calls = []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ValueError, match="bundle: cannot be written: No space left"):
        write_bundle(folder, small_files())
    assert {name: (folder / name).read_bytes() for name in files_of(folder)} == old_files
    assert [name for name in os.listdir(tmp_path) if name.endswith(TEMPORARY_SUFFIX)] == []
    monkeypatch.undo()
    move, moved = os.replace, []

    def interrupted(source, target):
        """Interrupt after the old bundle has been moved aside."""
        moved.append(target)
        if len(moved) == 1 + before:
            raise KeyboardInterrupt
        move(source, target)

    def cannot(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr("tuning.bundle.bundle.exchange_names", cannot)
    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bundle(folder, small_files())
    assert {name: (folder / name).read_bytes() for name in files_of(folder)} == old_files
    assert {*os.listdir(tmp_path)} - {"file"} == ({"bundle"} if before else set())
    monkeypatch.setattr(os, "replace", move)
    write_bundle(folder, small_files())
    assert {*os.listdir(tmp_path)} - {"file"} == {"bundle"} and (folder / "manifest.json").exists()


def test_bundle_is_replaced_in_one_step(tmp_path, monkeypatch):
    folder = write_files(tmp_path / "bundle", small_files())
    monkeypatch.setattr(os, "replace", lambda *_: pytest.fail("a moment without a bundle"))
    write_bundle(folder, {**small_files(), "new": b"new"})
    assert (folder / "new").read_bytes() == b"new" and os.listdir(tmp_path) == ["bundle"]


def test_bundle_is_written_through_link_to_folder(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    write_bundle(tmp_path / "link", small_files())
    assert (tmp_path / "link").is_symlink() and (tmp_path / "there" / "manifest.json").exists()


@pytest.mark.parametrize(
    "name", ["gains.json", "vectors.csv", "jaxhil_runtime.py", "selftest.py", "gains.mat"]
)
def test_verify_command_rejects_corrupt_bundle_without_running_it(jaxhil, tmp_path, name):
    folder = write_files(tmp_path / "bundle", small_files())
    content = (folder / name).read_bytes()
    trap = f"\nopen({str(tmp_path / 'ran')!r}, 'w')\n".encode()
    (folder / name).write_bytes(content + trap)
    ran = jaxhil("verify", folder, "--json")
    assert ran.code == 1 and ran.document["verdict"] == "bad" and ran.document["self_test"] == []
    assert any(reason.startswith(f"{name}: ") for reason in ran.document["reasons"])
    assert f"Bad: {name}: " in jaxhil("verify", folder).out
    assert not (tmp_path / "ran").exists()


def test_verify_command_rejects_incomplete_and_missing_bundle(jaxhil, tmp_path):
    folder = write_files(tmp_path / "bundle", small_files())
    (folder / "manifest.json").unlink()
    ran = jaxhil("verify", folder)
    assert ran.code == 1 and "Bad: manifest.json: cannot be read" in ran.out
    (tmp_path / "empty").mkdir()
    refused(jaxhil("verify", tmp_path / "empty"), "empty", "cannot be read")
    refused(jaxhil("verify", tmp_path / "no such"), "cannot be read")
    refused(jaxhil("verify", "a" * 5000), "cannot be read")


def test_verify_command_reports_failed_self_test(jaxhil, tmp_path):
    files = small_files()
    lines = files["vectors.csv"].split(b"\n")
    fields = lines[50].split(b",")
    fields[10] = b"1.5"
    lines[50] = b",".join(fields)
    wrong = signed({**files, "vectors.csv": b"\n".join(lines)}, json.loads(files["gains.json"]))
    folder = write_files(tmp_path / "bundle", small_files())
    for name, content in wrong.items():
        (folder / name).write_bytes(content)
    ran = jaxhil("verify", folder, "--json")
    assert ran.code == 1
    assert ran.document["reasons"][0].startswith("vectors.csv: line 51, run 0: force_command: found")


def test_bundle_readme_lists_faults_and_files():
    text = small_files()["README.md"].decode()
    for fault in FAULTS:
        assert f"| `{fault.bit:#x}` | `{fault.name}` | {fault.condition} | {fault.reaction} |" in text
    content = text.partition("## Before")[0]
    assert "acceleration = -force / M;" in text and "M = 300 kg, control period T = 0.001 s" in text
    assert "`gains.mat`" in content and "`ros2.yaml`" in content and "`c99`" in content
    assert "$" not in text


def test_bundle_readme_escapes_mechanism_name():
    name = "<img src=x onerror=a()> *a* _b_ `c` [d](e) | ~f~ \\ $g$ &amp; #"
    made = document()
    text = readme_text({**made, "mechanism": {**made["mechanism"], "name": name}}, ["gains.json"])
    heading = text.splitlines()[0].removeprefix("# Controller for ")
    assert "<" not in heading and not re.search(r"(?<!\\)(?:\\\\)*[`*_\[\]|~$#]", heading.replace("\\\\", ""))
    assert html.unescape(re.sub(r"\\(.)", r"\1", heading)) == name


def test_export_rejects_folder_with_bundle_of_another_mechanism(tmp_path):
    folder = write_files(tmp_path / "bundle", small_files())
    before = (folder / "gains.json").read_bytes()
    check_same_mechanism(folder, json.loads(before)["mechanism"]["name"])
    check_same_mechanism(tmp_path / "none", "another")
    with pytest.raises(InputError, match=r"bundle: found a bundle of the mechanism .*, expected 'another'"):
        check_same_mechanism(folder, "another")


def test_each_export_format_writes_its_own_files():
    made = document()
    for name, names in {
        "ros2": {"ros2.yaml"},
        "matlab": {"gains.mat"},
        "csv": {"gains.csv"},
        "c99": {f"c99/{file}" for file in (*C_FILES, *LOOP_FILES)},
        "fmu": {f"fmi3/{file}" for file in FMU_FILES},
        "fmu2": {f"fmi2/{file}" for file in FMU_FILES},
        "rehearsal": {f"rehearsal/{file}" for file in RIG_FILES},
    }.items():
        assert {*WRITERS[name](made)} == names
    assert len(WRITERS) == 7


C_FILES = ("jaxhil_controller.h", "jaxhil_controller.c", "jaxhil_gains.h", "test_vectors.c")
FMU_FILES = ("jaxhil_controller.fmu", "jaxhil_rig.fmu", "test_vectors.c")
RIG_FILES = (
    *("rt_plant_rig.c", "rt_plant_rig.h", "fmu.h", "fmu_log.h", "fmu_model.h", "fmu_model.c"),
    *("fmu_variables.h", "fmu_variables.c", "rig_constants.h", *SOURCE_FILES),
)
LOOP_FILES = (
    *("rt_loop.h", "rt_loop.c", "rt_task.h", "rt_task.c", "rt_model.h", "rt_model.c"),
    *("rt_log.h", "rt_log.c", "rt_plant_udp.c"),
)
