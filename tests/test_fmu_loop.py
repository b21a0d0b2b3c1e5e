"""Loop of controller and rig as FMUs, closed by `verify` without FMPy, compared with the simulation."""

import math
from types import SimpleNamespace
from typing import ClassVar

import bundles
import c99_cases
import pytest
from gain_documents import sign

import jaxhil
import tuning
from jaxhil.simulation.gain_file import check_document
from tuning.bundle.bundle import build_bundle, write_bundle
from tuning.bundle.fmu import closed_loop, library
from tuning.bundle.fmu.closed_loop import compare_fmu_loop
from tuning.bundle.writers import fmi2_files, fmi3_files

needs_compiler = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler")
LATER = ("rig.command_latency=1",)


def loaded(document):
    return check_document(dict(document))


class Simulated:
    """Stand-in for a run of the simulation."""

    contacts: ClassVar = ()


class Stalled(Simulated):
    """Stand-in for a run with a contact that does not end."""

    contacts: ClassVar = (SimpleNamespace(restitution=math.nan, status="timeout"),)


@needs_compiler
def test_fmu_loop_is_skipped_if_simulation_or_compiler_cannot_reproduce_it(monkeypatch):
    gains = loaded(bundles.document())
    files = fmi3_files(gains.document)
    assert compare_fmu_loop({}, gains) is None
    biased = loaded(bundles.document(overrides=("rig.force_sensor.bias=1",)))
    assert compare_fmu_loop(files, biased) is None
    late = loaded(bundles.document(overrides=("rig.command_latency=4",)))
    assert compare_fmu_loop(files, late) is None
    monkeypatch.setattr(closed_loop, "find_compiler", lambda: None)
    assert compare_fmu_loop(files, gains) is None


@needs_compiler
def test_fmu_loop_reports_sources_that_do_not_compile(monkeypatch):
    monkeypatch.setattr(closed_loop, "simulate", lambda *arguments: Simulated)
    monkeypatch.setattr(library, "compile_library", lambda archive: None)
    gains = loaded(bundles.document())
    result = compare_fmu_loop(fmi3_files(gains.document), gains)
    assert result is not None and result.reasons == ("fmi3: the sources cannot be compiled",)


@needs_compiler
@pytest.mark.parametrize("status, number", [("timeout", 0), ("diverged", 1)])
def test_fmu_loop_compares_statuses_of_contacts_that_do_not_end(monkeypatch, status, number):
    monkeypatch.setattr(closed_loop, "simulate", lambda *arguments: Stalled)
    ended = SimpleNamespace(restitution=math.nan, status=status)
    monkeypatch.setattr(closed_loop, "_run_loop", lambda *arguments: [ended])
    gains = loaded(bundles.document())
    result = compare_fmu_loop(fmi3_files(gains.document), gains)
    assert result is not None and len(result.reasons) == number
    assert all("status 'diverged' with both FMUs, expected 'timeout'" in text for text in result.reasons)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("write", [fmi3_files, fmi2_files])
@pytest.mark.parametrize("extra", [0, 1])
def test_fmu_loop_reproduces_simulation_with_the_period_of_the_master(write, extra):
    document = bundles.document(overrides=LATER if extra else ())
    if extra:
        document = sign(document | {"figures": {"co_simulation": {"extra_periods": 1}}})
    gains = loaded(document)
    result = compare_fmu_loop(write(gains.document), gains)
    [contact] = result.contacts
    [expected] = jaxhil.simulate(jaxhil.load("rig-300kg", {"rig.command_latency": 1}), "phase_lead").contacts
    assert result.reasons == () and result.command_latency == 1
    assert contact.restitution == pytest.approx(expected.restitution, abs=1e-9)


@needs_compiler
@pytest.mark.slow
def test_fmu_loop_detects_a_rig_with_another_delay():
    gains = loaded(bundles.document())
    other = fmi3_files(bundles.document(overrides=("rig.force_sensor.delay=0.005",)))
    files = {**fmi3_files(gains.document), "fmi3/jaxhil_rig.fmu": other["fmi3/jaxhil_rig.fmu"]}
    [reason] = compare_fmu_loop(files, gains).reasons
    assert reason.startswith("fmi3, contact 1: found e = ") and "rig.command_latency = 1" in reason


@needs_compiler
@pytest.mark.slow
def test_verify_closes_the_loop_through_the_fmus_of_a_bundle(jaxhil, tmp_path):
    made = build_bundle(bundles.document("varying", "response_error"), ["fmu"], bundles.LIMITS)
    write_bundle(tmp_path / "bundle", made.files)
    document = tuning.verify(tmp_path / "bundle", scenarios=2).document
    loop = document["fmu_loop"]
    assert document["verdict"] == "good" and (loop["fmi"], loop["command_latency"], loop["reasons"]) == (
        3,
        1,
        (),
    )
    assert [contact["status"] for contact in loop["contacts"]] == ["ok"] * 3
    ran = jaxhil("verify", tmp_path / "bundle", "--scenarios", 2)
    assert ran.code == 0 and "Nominal contacts with the FMUs of FMI 3, rig.command_latency = 1" in ran.out
