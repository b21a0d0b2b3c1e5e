"""FMUs in FMPy: build from sources, run, and replay of test vectors."""

import csv
import importlib
import io
import struct
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

from jaxhil.rig.flight_recorder import COORDINATES, TWIST, WRENCH
from tuning.bundle.fmu.archive import add_library, compile_library, find_compiler
from tuning.rig.contact_detector import ContactDetector, RigContact

fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed (pip install jaxhil[fmu])")
validate_fmu = importlib.import_module("fmpy.validation").validate_fmu
if find_compiler() is None:
    pytest.skip("no C compiler on this machine", allow_module_level=True)

GETTERS = {"Float64": "getFloat64", "Int32": "getInt32", "Real": "getReal", "Integer": "getInteger"}
SETTERS = {"Float64": "setFloat64", "Int32": "setInt32", "Real": "setReal", "Integer": "setInteger"}
GETTERS |= {"Boolean": "getBoolean", "String": "getString"}
SETTERS |= {"Boolean": "setBoolean", "String": "setString"}


class RunningFmu:
    """Instance of an FMU in FMPy."""

    def __init__(self, folder: Path, **parameters: float) -> None:
        self.description = fmpy.read_model_description(str(folder))
        self.variables = {variable.name: variable for variable in self.description.modelVariables}
        self.messages: list[str] = []
        self.instance = fmpy.instantiate_fmu(str(folder), self.description, logger=self._logger())
        self.period = float(self.description.defaultExperiment.stepSize)
        self.begin(**parameters)

    def _logger(self) -> Any:
        if self.description.fmiVersion == "2.0":
            return None
        return lambda environment, status, category, message: self.messages.append(message.decode())

    def begin(self, **values: Any) -> None:
        """Set parameters and inputs, and initialise at time 0."""
        self.ticks = 0
        if self.description.fmiVersion == "2.0":
            self.instance.setupExperiment(startTime=0.0)
        self.instance.enterInitializationMode()
        self.set(values)
        self.instance.exitInitializationMode()

    def reset(self, **values: Any) -> None:
        self.instance.reset()
        self.begin(**values)

    def set(self, values: dict[str, Any]) -> None:
        for type_, names in self._by_type([*values]).items():
            references = [self.variables[name].valueReference for name in names]
            getattr(self.instance, SETTERS[type_])(references, [values[name] for name in names])

    def get(self, *names: str) -> dict[str, Any]:
        values = {}
        for type_, group in self._by_type(names).items():
            references = [self.variables[name].valueReference for name in group]
            values |= dict(zip(group, getattr(self.instance, GETTERS[type_])(references), strict=True))
        return values

    def step(self, step: float | None = None) -> None:
        self.instance.doStep(self.ticks * self.period, self.period if step is None else step)
        self.ticks += 1

    def close(self) -> None:
        self.instance.freeInstance()

    def _by_type(self, names: Any) -> dict[str, list[str]]:
        groups: dict[str, list[str]] = {}
        for name in names:
            groups.setdefault(self.variables[name].type, []).append(name)
        return groups


def write_fmu(path: Path, archive: bytes, with_library: bool = True) -> Path:
    """Write the archive of an FMU to a file; return its path."""
    path.write_bytes(add_library(archive, compile_library(archive) if with_library else None))
    return path


def extract(path: Path) -> Path:
    """Extract the archive of an FMU; return the folder."""
    return Path(fmpy.extract(str(path), str(path.with_suffix(""))))


def built_by_fmpy(path: Path) -> Path:
    """Extract an FMU without library, and let FMPy compile its sources; return the folder."""
    from fmpy.build import build_platform_binary

    folder = extract(path)
    assert not (folder / "binaries").exists()
    with tempfile.TemporaryDirectory(prefix="jaxhil-fmu-build-") as build_folder:
        build_platform_binary(folder, build_folder)
    return folder


ONE_AXIS_COLUMNS = {
    **{name: name for name in ("force_measured", "position_desired", "velocity_desired")},
    **{name: name for name in ("position_measured", "position", "velocity", "acceleration")},
}
ONE_AXIS_RESULTS = {name: name for name in ("force_command", "position_command", "faults")}


def bits(value: float) -> bytes:
    """Return the bytes of a number; all NaNs have the same bytes."""
    return b"nan" if value != value else struct.pack("<d", value)


def replay_vectors(fmu: RunningFmu, vectors: bytes) -> int:
    """Replay vectors.csv, and assert that outputs have the same bits; return the number of ticks."""
    rows = list(csv.DictReader(io.StringIO(vectors.decode("ascii"))))
    is_one_axis = "force_measured" in rows[0]
    inputs = ONE_AXIS_COLUMNS if is_one_axis else _columns(SIX_AXIS_INPUTS)
    results = ONE_AXIS_RESULTS if is_one_axis else {**_columns(SIX_AXIS_RESULTS), "faults": "faults"}
    for number, row in enumerate(rows, start=2):
        event = float(row["event"])
        if event == 1.0:
            fmu.reset()
        values: dict[str, Any] = {variable: float(row[column]) for variable, column in inputs.items()}
        values |= {"next_contact": event == 2.0, "has_tick_time": row["time"] != ""}
        values["tick_time"] = float(row["time"] or 0.0)
        fmu.set(values)
        fmu.step()
        outputs = fmu.get(*results)
        for variable, column in results.items():
            assert bits(float(outputs[variable])) == bits(float(row[column])), (number, variable)
    return len(rows)


SIX_AXIS_INPUTS = ("wrench_measured", "pose_desired", "twist_desired", "pose_measured", "pose", "twist")
SIX_AXIS_RESULTS = ("wrench_command", "pose_command")
PARTS = {"wrench": WRENCH, "pose": COORDINATES, "twist": TWIST, "angular": TWIST[3:]}


def part_names(vector: str) -> list[str]:
    """Return the names of the FMU's variables for a vector of six axes."""
    [parts] = [PARTS[word] for word in vector.split("_") if word in PARTS]
    return [f"{vector}.{part}" for part in parts]


def _columns(vectors: tuple[str, ...]) -> dict[str, str]:
    """Return the columns of vectors.csv by the names of the FMU's variables."""
    return {
        name: f"{vector}_{coordinate}"
        for vector in vectors
        for name, coordinate in zip(part_names(vector), COORDINATES, strict=True)
    }


def compile_sources(folder: Path, compiler: str, *options: str) -> str:
    """Compile the sources of an extracted FMU in a separate folder; return the compiler's messages."""
    sources = sorted((folder / "sources").glob("*.c"))
    command = [compiler, *options, "-fsyntax-only", *map(str, sources)]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return ran.stderr


def run_loop(controller: RunningFmu, rig: RunningFmu, mechanism: Any) -> list[RigContact]:
    """Run controller and rig together as a sequential master, the controller first; return all contacts.

    Both FMUs were just initialised. Each run begins at the speed of the previous rebound.
    """
    watch, contacts, two_sided = ContactDetector(mechanism), [], mechanism.contact.clearance < float("inf")
    watch.begin(0)
    readings = ("force_measured", "position_measured", "position", "velocity", "acceleration")
    while len(contacts) < mechanism.approach.contacts:
        sensed = rig.get(*readings, "contact_force")
        desired = {"position_desired": sensed["position"], "velocity_desired": sensed["velocity"]}
        controller.set({name: sensed[name] for name in readings} | desired)
        controller.step()
        commands = controller.get("force_command", "position_command")
        force = commands["force_command"]
        state = sensed["position"], sensed["velocity"]
        contact = watch.observe(*state, force, sensed["contact_force"], sensed["force_measured"])
        controller.set({"next_contact": False})
        rig.set({**commands, "next_run": False})
        if contact is not None:
            contacts.append(contact)
            if contact.status != "ok":
                break
            rig.set({"contact": len(contacts), "next_run": not two_sided})
            controller.set({"next_contact": not two_sided})
            if not two_sided:
                watch.begin(len(contacts))
        rig.step()
    return contacts


def run_parallel_loop(controller: RunningFmu, rig: RunningFmu, mechanism: Any) -> RigContact:
    """Run both FMUs as a parallel master, and return the first contact; the controller integrates the model.

    A parallel master exchanges all values before each step, so that a command takes effect one step later.
    """
    watch = ContactDetector(mechanism)
    watch.begin(0)
    start = rig.get("position", "velocity")
    desired = {"position_desired": start["position"], "velocity_desired": start["velocity"]}
    controller.reset(integrates_model=True, **desired)
    while True:
        sensed = rig.get("force_measured", "position_measured", "contact_force")
        model = controller.get("model_position", "model_velocity")
        rig.set(controller.get("force_command", "position_command"))
        controller.set({name: sensed[name] for name in ("force_measured", "position_measured")})
        controller.step()
        rig.step()
        force = controller.get("force_command")["force_command"]
        contact = watch.observe(*model.values(), force, sensed["contact_force"], sensed["force_measured"])
        if contact is not None:
            return contact
