"""FMUs of the controller: valid descriptions, compilation, results equal to the runtime's, errors, states."""

import functools
import json
import random
import subprocess
import tempfile
from pathlib import Path

import fmus
import pytest
from bundles import document, small_files
from fmus import (
    RunningFmu,
    built_by_fmpy,
    compile_sources,
    extract,
    fmpy,
    replay_vectors,
    validate_fmu,
    write_fmu,
)
from six_axis_documents import LIMITS, six_axis_document

import tuning
from jaxhil.errors import InputError
from jaxhil.rig import COMPENSATORS
from jaxhil.rig.six_axes import SIX_AXIS_COMPENSATORS, Controller6
from jaxhil.simulation.gain_file import check_document
from tuning.bundle.bundle import build_bundle, write_bundle
from tuning.bundle.fmu.archive import add_library, compile_library, find_library
from tuning.bundle.fmu.controller import controller_fmu
from tuning.bundle.fmu.description import unit_exponents

PEDANTIC = ("-pedantic", "-Wall", "-Wextra", "-Werror")
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
DOCUMENTS = {"one axis": document, "six axes": lambda: six_axis_document("phase_lead", limits=LIMITS)}
TEMPORARY = tempfile.TemporaryDirectory(prefix="jaxhil-fmu-tests-")


@functools.cache
def folder_of(axes: str, fmi: int) -> Path:
    """Return the folder of a compiled and extracted FMU."""
    path = Path(TEMPORARY.name) / f"{axes.replace(' ', '_')}{fmi}.fmu"
    return extract(write_fmu(path, controller_fmu(DOCUMENTS[axes](), fmi)))


@pytest.fixture(params=[3, 2])
def fmu(request):
    """Return a running FMU on one axis, in both versions of FMI."""
    running = RunningFmu(folder_of("one axis", request.param))
    yield running
    running.close()


def variables(description, causality):
    return {
        variable.name: variable for variable in description.modelVariables if variable.causality == causality
    }


@pytest.mark.parametrize("fmi", [3, 2])
@pytest.mark.parametrize("axes", DOCUMENTS)
def test_fmu_description_is_valid_and_has_units_and_bounds_of_the_code(axes, fmi, tmp_path):
    made = DOCUMENTS[axes]()
    path = write_fmu(tmp_path / "controller.fmu", controller_fmu(made, fmi), with_library=False)
    assert validate_fmu(str(path)) == []
    parameters = variables(fmpy.read_model_description(str(path)), "parameter")
    table = COMPENSATORS if axes == "one axis" else SIX_AXIS_COMPENSATORS
    specifications = table["phase_lead"].gains
    assert {name for name in parameters if name.startswith("gains.")} == {
        f"gains.{name}" for name in specifications
    }
    for name, gain in specifications.items():
        variable = parameters[f"gains.{name}"]
        assert float(variable.start) == made["gains"][name]["value"]
        assert (float(variable.min), float(variable.max)) == (gain.lowest, gain.highest)
        assert variable.unit == (None if gain.unit == "1" else gain.unit)


def test_fmu_unit_exponents_cover_products_quotients_and_powers():
    assert unit_exponents("N s/m") == {"kg": 1, "s": -1}
    assert unit_exponents("s^2/m^2") == {"s": 2, "m": -2}
    assert unit_exponents("1/s") == {"s": -1} and unit_exponents("parsec") is None


@pytest.mark.parametrize("fmi", [3, 2])
def test_fmu_compiled_by_fmpy_reproduces_vectors_bit_for_bit(fmi, tmp_path):
    files = small_files()
    archive = controller_fmu(json.loads(files["gains.json"]), fmi)
    running = RunningFmu(built_by_fmpy(write_fmu(tmp_path / "controller.fmu", archive, with_library=False)))
    assert replay_vectors(running, files["vectors.csv"]) > 240
    running.close()


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
def test_six_axis_fmu_equals_runtime_bit_for_bit(fmi):
    controller = Controller6.from_dict(six_axis_document("phase_lead", limits=LIMITS))
    running = RunningFmu(folder_of("six axes", fmi))
    rng = random.Random(0)
    inputs = {name: 6 * [0.0] for name in fmus.SIX_AXIS_INPUTS}
    results = [name for vector in fmus.SIX_AXIS_RESULTS for name in fmus.part_names(vector)]
    for tick in range(300):
        for name, values in inputs.items():
            scale = 30.0 if name.startswith("wrench") else 1e-4
            inputs[name] = [value + scale * rng.gauss(0.0, 1.0) for value in values]
        if tick == 250:
            inputs["wrench_measured"][2] = float("nan")
        controller_inputs = [inputs[name] for name in fmus.SIX_AXIS_INPUTS[:4]]
        expected = [
            *controller.step(*controller_inputs),
            *controller.pose_command(inputs["pose"], inputs["twist"]),
        ]
        running.set(
            {
                part: value
                for name, values in inputs.items()
                for part, value in zip(fmus.part_names(name), values, strict=True)
            }
        )
        running.step()
        outputs = running.get(*results, "faults", "tripped")
        commands = [fmus.bits(outputs[name]) for name in results]
        assert commands == [fmus.bits(value) for value in expected], tick
        assert (outputs["faults"], outputs["tripped"]) == (controller.faults, controller.tripped)
    assert controller.seen != 0
    running.close()


@pytest.mark.parametrize("axes", DOCUMENTS)
@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
def test_fmu_sources_compile_without_warning_as_c_and_as_cpp(axes, fmi):
    folder = folder_of(axes, fmi)
    assert compile_sources(folder, "gcc", "-std=c99", *PEDANTIC) == ""
    for standard in ("c++11", "c++20"):
        assert compile_sources(folder, "g++", f"-std={standard}", "-x", "c++", *PEDANTIC) == ""


def test_fmu_rejects_communication_step_other_than_control_period(fmu):
    for step in (0.0, -0.001, 0.0005, 0.002, float("nan"), float("inf")):
        with pytest.raises(Exception, match="failed with status 3"):
            fmu.step(step)
    fmu.step()
    assert all("control period" in message for message in fmu.messages)


def test_fmu_rejects_values_beyond_bounds_and_late_or_unknown_values(fmu):
    fmu.instance.reset()
    bounds = fmu.variables["gains.phase_lead"]
    for value in (float(bounds.min) - 1e-9, float(bounds.max) + 1e-9, float("nan"), float("inf")):
        with pytest.raises(Exception, match="failed with status 3"):
            fmu.set({"gains.phase_lead": value})
    fmu.begin(**{"gains.phase_lead": 0.002})
    assert fmu.get("gains.phase_lead") == {"gains.phase_lead": 0.002}
    for name in ("gains.phase_lead", "force_command"):
        with pytest.raises(Exception, match="failed with status 3"):
            fmu.set({name: 0.001})
    with pytest.raises(Exception, match="failed with status 3"):
        getattr(fmu.instance, fmus.GETTERS["Float64" if fmu.description.fmiVersion == "3.0" else "Real"])(
            [10000]
        )


def test_fmu_rejects_limits_that_contradict_each_other(fmu):
    fmu.instance.reset()
    with pytest.raises(Exception, match="failed with status 3"):
        fmu.begin(**{"limits.command_lowest": 1.0, "limits.command_highest": 0.0})


def test_fmu_trips_on_nan_input_and_continues_after_reset(fmu):
    fmu.set({"force_measured": 5.0, "position_desired": -0.01, "position_measured": -0.01})
    fmu.step()
    fmu.set({"position_desired": float("nan")})
    fmu.step()
    assert fmu.get("tripped", "faults") == {"tripped": True, "faults": 4}
    fmu.set({"position_desired": -0.01, "reset": True})
    fmu.step()
    assert fmu.get("tripped", "faults", "seen_faults") == {"tripped": False, "faults": 0, "seen_faults": 0}


def test_fmu_detects_missed_ticks_from_tick_times(fmu):
    for number, time in enumerate((0.0, 0.001, 0.004)):
        fmu.set({"has_tick_time": True, "tick_time": time})
        fmu.step()
        assert fmu.get("missed_ticks") == {"missed_ticks": 2 if number == 2 else 0}


def test_fmu_stops_while_emergency_stop_is_active(fmu):
    fmu.set({"emergency_stop": True})
    fmu.step()
    assert fmu.get("tripped") == {"tripped": True}
    fmu.set({"reset": True})
    fmu.step()
    assert fmu.get("tripped") == {"tripped": True}
    fmu.set({"emergency_stop": False})
    fmu.step()
    assert fmu.get("tripped") == {"tripped": False}


def test_tare_of_fmu_subtracts_mean_of_readings():
    running = RunningFmu(folder_of("one axis", 3))
    running.reset(**{"limits.tare_ticks": 2.0})
    running.set({"tare": True})
    for reading, done in ((4.0, False), (6.0, True)):
        running.set({"force_measured": reading})
        running.step()
        assert running.get("tare_done") == {"tare_done": done}
    assert running.get("force_bias", "force_command") == {"force_bias": 5.0, "force_command": 0.0}
    running.close()


def test_fmu_state_restores_the_same_commands(fmu):
    is_fmi2 = fmu.description.fmiVersion == "2.0"
    suffix, restoring = (
        ("FMUstate", "deSerializeFMUstate") if is_fmi2 else ("FMUState", "deserializeFMUState")
    )
    names = (f"get{suffix}", f"set{suffix}", f"free{suffix}", f"serialize{suffix}", restoring)
    read, write, free, serialise, restore = (getattr(fmu.instance, name) for name in names)

    def commands(count):
        results = []
        for tick in range(count):
            fmu.set({"force_measured": 10.0 * tick, "position_measured": 1e-4 * tick})
            fmu.step()
            results.append(fmu.get("force_command", "position_command"))
        return results

    commands(5)
    state = read()
    stored = serialise(state)
    expected = commands(8)
    write(state)
    assert commands(8) == expected
    write(restore(stored))
    assert commands(8) == expected
    damaged = bytearray(stored)
    damaged[-1] ^= 1
    for wrong in (bytes(damaged), stored[:-1], b"x" + stored[1:]):
        with pytest.raises(Exception, match="failed with status 3"):
            restore(wrong)
    free(state)


def test_fmu_rejects_instantiation_with_token_of_another_fmu():
    folder = folder_of("one axis", 3)
    description = fmpy.read_model_description(str(folder))
    description.guid = "{00000000-0000-0000-0000-000000000000}"
    with pytest.raises(Exception, match="Failed to instantiate"):
        fmpy.instantiate_fmu(str(folder), description)


def test_fmus_are_equal_for_equal_gains_and_have_another_token_for_other_gains():
    first, again = controller_fmu(document(), 3), controller_fmu(document(), 3)
    assert first == again and find_library(first) is None
    other = controller_fmu(document(phase_lead=0.003), 3)
    tokens = {
        fmpy.read_model_description(str(write_fmu(Path(TEMPORARY.name) / "a.fmu", made, False))).guid
        for made in (first, other)
    }
    assert len(tokens) == 2


@pytest.mark.parametrize(("formats", "fmi", "name"), [(["fmu"], 3, "fmi3"), (["fmu", "csv"], 2, "fmi2")])
def test_export_writes_fmu_and_verify_accepts_the_bundle(formats, fmi, name, tmp_path):
    from tuning.api.export import _select_formats
    from tuning.bundle.checking import check_bundle

    made = build_bundle(document(), _select_formats(formats, fmi))
    archive = made.files[f"{name}/jaxhil_controller.fmu"]
    assert find_library(archive) is not None
    write_bundle(tmp_path / "bundle", made.files)
    assert check_bundle(tmp_path / "bundle").reasons == []
    assert f"| `{name}` |" in made.files["README.md"].decode()


def test_export_rejects_unknown_version_of_fmi(tmp_path):
    with pytest.raises(InputError, match="fmi: found 4, expected 2 or 3"):
        tuning.export("gains.json", tmp_path / "bundle", fmi=4)


def sanitised(folder: Path, program: Path, *options: str) -> Path:
    """Compile `fmu_calls.c` with the sources of an extracted FMU."""
    sources = sorted((folder / "sources").glob("*.c"))
    driver = Path(__file__).with_name("fmu_calls.c")
    command = [
        "gcc",
        "-std=gnu99",
        *options,
        "-I",
        folder / "sources",
        driver,
        *sources,
        "-o",
        program,
        "-lm",
    ]
    ran = subprocess.run([*map(str, command)], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return program


@pytest.mark.parametrize("count", [2000, pytest.param(100_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("axes", DOCUMENTS)
def test_random_calls_of_fmu_functions_cause_no_undefined_behaviour(axes, count, tmp_path):
    program = sanitised(folder_of(axes, 3), tmp_path / "calls", *SANITIZED)
    ran = subprocess.run([program, str(count)], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert int(ran.stdout.split()[0]) > 0.25 * count


@pytest.mark.slow
@pytest.mark.parametrize("axes", DOCUMENTS)
def test_fmu_memory_does_not_grow_over_many_instances(axes, tmp_path):
    program = sanitised(folder_of(axes, 3), tmp_path / "calls", "-O1")
    ran = subprocess.run([program, "-", "100000"], capture_output=True, text=True)
    assert ran.returncode == 0 and int(ran.stdout) < 64


TABLES = [(name, mechanism) for mechanism in ("rattling", "suite-noisy") for name in COMPENSATORS]
TABLES += [(name, "probe-drogue") for name in SIX_AXIS_COMPENSATORS]


@pytest.mark.slow
@pytest.mark.parametrize(("compensator", "mechanism"), TABLES)
def test_fmu_of_every_compensator_reproduces_vectors_bit_for_bit(compensator, mechanism, tmp_path):
    from tuning.bundle.bundle import _make_vectors

    six_axes = mechanism == "probe-drogue"
    made = six_axis_document(compensator, mechanism) if six_axes else document(mechanism, compensator)
    _, text = _make_vectors(check_document(made, any_axes=True), 0)
    for fmi in (3, 2):
        path = write_fmu(tmp_path / f"controller{fmi}.fmu", controller_fmu(made, fmi), with_library=False)
        assert validate_fmu(str(path)) == []
        running = RunningFmu(built_by_fmpy(path))
        assert replay_vectors(running, text.encode("ascii")) > 100
        running.close()


def test_fmu_library_is_added_to_archive_and_found_again():
    archive = controller_fmu(document("rig-300kg", "none"), 2)
    library = compile_library(archive)
    assert library is not None and find_library(add_library(archive, library)) == library
