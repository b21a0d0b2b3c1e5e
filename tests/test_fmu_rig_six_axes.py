"""FMU of the rig with six axes: final twist of `simulate` in a closed loop, states, seeds, and refusals."""

import ctypes
import shutil
import subprocess
from typing import Any

import jax
import numpy as np
import pytest
from fmus import RunningFmu, built_by_fmpy, compile_sources, extract, part_names, validate_fmu, write_fmu
from msgspec import structs
from six_axis_documents import six_axis_document
from test_fmu import PEDANTIC, SANITIZED, sanitised

import jaxhil
import tuning
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.gain_file import check_document
from tuning.bundle.bundle import build_bundle, write_bundle
from tuning.bundle.fmu.closed_loop import compare_fmu_loop
from tuning.bundle.fmu.controller import controller_fmu
from tuning.bundle.fmu.rig import describe_unsupported, rig_fmu
from tuning.bundle.writers import fmi2_files, fmi3_files
from tuning.gain_file import build_document

READINGS = ("wrench_measured", "pose_measured", "pose", "twist")
COMMANDS = ("wrench_command", "pose_command")
START = {  # outputs of the rig, from which a run of the numerical model begins, by inputs of the controller
    "pose_desired": "pose",
    "twist_desired": "twist",
    "target_angular_velocity": "target_angular_velocity",
}
NOISY = (
    "rig.force_sensor.noise_std=[1.0, 1.0, 1.0, 0.1, 0.1, 0.1]",
    "rig.position_sensor.noise_std=[1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6]",
    "rig.force_sensor.loss_probability=0.1",
)
CASES = [
    *((name, "none", ()) for name in ("probe-drogue", "ring-capture", "petals", "hydraulic-hexapod")),
    *((name, "impulse_ledger", ()) for name in ("probe-drogue", "ring-capture", "petals")),
    *((name, "response_error", ()) for name in ("probe-drogue", "claw-two-arms")),
    ("probe-drogue", "impulse_ledger", (*NOISY, "rig.force_sensor.time_constant=0.002")),
    ("probe-drogue", "none", (*NOISY, "rig.force_sensor.jitter=0.001")),
    ("probe-drogue", "none", ("rig.force_sensor.bias_random_walk=[2.0, 1.0, 3.0, 0.1, 0.2, 0.1]",)),
    ("petals", "none", ("rig.command_latency=1", "rig.command_hold=zoh", "rig.integrator=zoh")),
]  # fmt: skip


@pytest.fixture(autouse=True)
def release_memory():
    """Release the compiled programs after each test, which no other test uses, and return the memory."""
    yield
    jax.clear_caches()
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):  # glibc otherwise holds the memory, 300 MiB per mechanism
        libc.malloc_trim(0)


def document_of(name, compensator, overrides=()):
    """Return a gain document with the gains of the literature."""
    mechanism, sha256, _ = load_any(name, overrides)
    gains = literature_gains(mechanism, compensator)
    return build_document(compensator, gains, mechanism, sha256, {}, {}, 0, {})


def names_of(*vectors):
    return [name for vector in vectors for name in part_names(vector)]


def run_loop(controller, rig, ticks):
    """Run both FMUs as a sequential master does; return the final twist (6,)."""
    for _ in range(ticks):
        sensed = rig.get(*names_of(*READINGS))
        desired = {
            name.replace(vector, f"{vector}_desired", 1): sensed[name]
            for vector in ("pose", "twist")
            for name in part_names(vector)
        }
        controller.set(sensed | desired)
        controller.step()
        rig.set(controller.get(*names_of(*COMMANDS)))
        rig.step()
    return np.array([*rig.get(*names_of("twist")).values()])


def run_parallel_loop(controller, rig, ticks):
    """Run both FMUs as a parallel master does, which exchanges all values before each step.

    The controller's FMU integrates the numerical model; return its final twist (6,).
    """
    start = rig.get(*names_of(*START.values()))
    inputs = dict(zip(names_of(*START), start.values(), strict=True))
    controller.reset(integrates_model=True, **inputs)
    for _ in range(ticks):
        sensed = rig.get(*names_of("wrench_measured", "pose_measured"))
        rig.set(controller.get(*names_of(*COMMANDS)))
        controller.set(sensed)
        controller.step()
        rig.step()
    return np.array([*controller.get(*names_of("model_twist")).values()])


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [3, 2])
@pytest.mark.parametrize(("name", "compensator", "overrides"), CASES)
def test_both_fmus_with_six_axes_reproduce_simulation_with_one_more_period(
    name, compensator, overrides, fmi, tmp_path
):
    if fmi == 2 and (name, overrides) != ("probe-drogue", ()):
        pytest.skip("FMI 2 has the same C code")
    made = document_of(name, compensator, overrides)
    path = write_fmu(tmp_path / "rig.fmu", rig_fmu(made, fmi), with_library=False)
    assert validate_fmu(str(path)) == []
    rig = RunningFmu(built_by_fmpy(path))
    controller = RunningFmu(extract(write_fmu(tmp_path / "controller.fmu", controller_fmu(made, fmi))))
    mechanism = load_any(name, overrides).mechanism
    late = structs.replace(mechanism.rig, command_latency=mechanism.rig.command_latency + 1)
    gains = {name: gain["value"] for name, gain in made["gains"].items()}
    run: Any = jaxhil.simulate(structs.replace(mechanism, rig=late), compensator, gains)
    without: Any = jaxhil.simulate(mechanism, compensator, gains)
    for loop in (run_loop, run_parallel_loop):
        rig.reset()
        final_twist = loop(controller, rig, round(run.final.time / mechanism.rig.control_period))
        difference = float(np.max(np.abs(final_twist - run.final.twist)))
        print(f"{name} {compensator} {' '.join(overrides)} FMI {fmi} {loop.__name__}: {difference:.1e}")
        assert difference < 1e-9 < np.max(np.abs(final_twist))
        assert np.max(np.abs(final_twist - without.final.twist)) > 1e-6
    controller.close()
    rig.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of an extracted FMU of a noisy rig, with a library."""
    path = tmp_path_factory.mktemp("six") / "rig.fmu"
    return extract(write_fmu(path, rig_fmu(document_of("probe-drogue", "none", NOISY), 3)))


@pytest.mark.slow
def test_rig_fmu_with_six_axes_repeats_noise_and_states(folder):
    rig = RunningFmu(folder)

    def readings(count):
        results = []
        for _ in range(count):
            rig.set(dict.fromkeys(names_of("pose_command"), 0.01))
            rig.step()
            results.append(rig.get(*names_of(*READINGS, "wrench_contact")))
        return results

    first = readings(20)
    rig.reset(seed=1)
    other = readings(20)
    rig.reset(seed=0)
    assert readings(20) == first != other
    state = rig.instance.getFMUState()
    stored = rig.instance.serializeFMUState(state)
    expected = readings(20)
    rig.instance.setFMUState(rig.instance.deserializeFMUState(stored))
    assert readings(20) == expected
    rig.close()


@pytest.mark.slow
def test_rig_fmu_with_six_axes_compiles_without_warning_and_runs_under_sanitizers(folder, tmp_path):
    for compiler in ("gcc", "clang"):
        if shutil.which(compiler):
            assert compile_sources(folder, compiler, "-std=c99", *PEDANTIC) == ""
    for standard in ("c++11", "c++20"):
        assert compile_sources(folder, "g++", f"-std={standard}", "-x", "c++", *PEDANTIC) == ""
    program = sanitised(folder, tmp_path / "calls", *SANITIZED)
    ran = subprocess.run([program, "100000"], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert int(ran.stdout.split()[0]) > 25000


@pytest.mark.slow
def test_rig_fmu_with_six_axes_memory_does_not_grow_over_many_instances(folder, tmp_path):
    program = sanitised(folder, tmp_path / "calls", "-O1")
    ran = subprocess.run([program, "-", "100000"], capture_output=True, text=True)
    assert ran.returncode == 0 and int(ran.stdout) < 64


@pytest.mark.slow
@pytest.mark.parametrize("write", [fmi3_files, fmi2_files])
def test_fmu_loop_with_six_axes_reproduces_simulation_and_detects_another_delay(write):
    made = check_document(six_axis_document("phase_lead"), any_axes=True)
    files = write(made.document)
    result = compare_fmu_loop(files, made)
    assert result is not None and result.reasons == () and result.command_latency == 1
    assert result.final_twist is not None and result.final_twist.difference < 1e-9
    other = document_of("probe-drogue", "phase_lead", ("rig.force_sensor.delay=0.005",))
    [path] = [path for path in files if path.endswith("jaxhil_rig.fmu")]
    different = compare_fmu_loop({**files, path: write(other)[path]}, made)
    assert different is not None
    [reason] = different.reasons
    assert "final twist: found a difference of" in reason


@pytest.mark.slow
def test_verify_closes_the_loop_through_the_six_axis_fmus_of_a_bundle(tmp_path, jaxhil):
    write_bundle(tmp_path / "bundle", build_bundle(six_axis_document("none"), ["fmu"]).files)
    document = tuning.verify(tmp_path / "bundle", scenarios=1).document
    assert document["verdict"] == "good" and document["fmu_loop"]["final_twist"]["difference"] < 1e-9
    ran = jaxhil("verify", tmp_path / "bundle", "--scenarios", 1)
    assert "Final twist of the nominal run with the FMUs of FMI 3, rig.command_latency = 1" in ran.out


def test_rig_fmu_with_six_axes_rejects_missed_ticks_and_filters():
    for overrides, reason in (
        (("rig.missed_tick_probability=0.1",), "rig.missed_tick_probability: found 0.1, expected 0"),
        (
            ("rig.force_sensor.filter={kind='bessel', order=2, cutoff=100.0}",),
            "rig.force_sensor.filter: found a filter, expected none",
        ),
    ):
        assert describe_unsupported(load_any("petals", overrides).mechanism) == reason
