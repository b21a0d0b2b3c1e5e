"""Controller and rig as FMUs in one loop of OMSimulator, compared with `simulate`.

OMSimulator exchanges all values before each step (a parallel master). If it is not installed with pip, set
`$OMSIMULATOR` to the folder that contains its Python package, built from its sources.
"""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import document
from fmus import write_fmu
from test_fmu_rig import NOISELESS, assert_same_contacts, simulated
from test_fmu_rig_six_axes import COMMANDS, START, document_of, names_of

from jaxhil.mechanism.file import load, load_any
from jaxhil.sixdof.run import simulate_six_axes
from tuning.bundle.fmu.controller import controller_fmu
from tuning.bundle.fmu.rig import rig_fmu
from tuning.rig.contact_detector import ContactDetector

sys.path.append(os.environ.get("OMSIMULATOR", ""))
try:
    from OMSimulator import Capi
except (ImportError, OSError) as error:
    pytest.skip(f"OMSimulator cannot be imported: {error}", allow_module_level=True)
finally:
    sys.path.pop()

pytestmark = pytest.mark.slow
PERIOD = 0.001  # control period of all mechanisms here [s]
WEAKLY_COUPLED, STOP_TIME = 1, 1e3  # type of the system for co-simulation; end of the simulation [s]
ONE_AXIS_CONNECTIONS = {
    "controller.force_measured": "rig.force_measured",
    "controller.position_measured": "rig.position_measured",
    "controller.position_desired": "rig.position",
    "controller.velocity_desired": "rig.velocity",
    "rig.force_command": "controller.force_command",
    "rig.position_command": "controller.position_command",
}
SENSED = ("wrench_measured", "pose_measured")
SIX_AXIS_LOOPS = [
    *(("probe-drogue", compensator) for compensator in ("none", "response_error", "impulse_ledger")),
    ("petals", "impulse_ledger"),
]


def checked(status):
    assert status.name == "ok", status


def write_fmus(made, fmi, folder):
    """Write the FMUs of a gain document; return their paths by name."""
    archives = {"controller": controller_fmu(made, fmi), "rig": rig_fmu(made, fmi)}
    return {name: write_fmu(folder / f"{name}.fmu", archive) for name, archive in archives.items()}


class OmsLoop:
    """Loop of a controller and a rig in OMSimulator, stepped by one control period at a time."""

    def __init__(self, paths, connections, folder: Path, *parameters: str) -> None:
        self.ticks = 0
        # OMSimulator ignores the dependencies of FMI 3 before the first step, and then solves equations.
        checked(Capi.setCommandLineOption("--algLoopSolver=fixedpoint"))
        checked(Capi.setTempDirectory(str(folder)))
        checked(Capi.newModel("model"))
        checked(Capi.addSystem("model.root", WEAKLY_COUPLED))
        for name, path in paths.items():
            checked(Capi.addSubModel(f"model.root.{name}", str(path)))
        for end, begin in connections.items():
            checked(Capi.addConnection(f"model.root.{begin}", f"model.root.{end}"))
        checked(Capi.setResultFile("model", ""))
        checked(Capi.setStopTime("model", STOP_TIME))
        checked(Capi.setFixedStepSize("model.root", PERIOD))
        checked(Capi.instantiate("model"))
        for name in parameters:
            checked(Capi.setBoolean(f"model.root.{name}", True))
        checked(Capi.initialize("model"))

    def get(self, name: str) -> float:
        value, status = Capi.getReal(f"model.root.{name}")
        checked(status)
        return value

    def step(self, ticks: int = 1) -> None:
        self.ticks += ticks
        checked(Capi.stepUntil("model", (self.ticks - 0.5) * PERIOD))  # sums of periods have rounding errors

    def close(self) -> None:
        checked(Capi.terminate("model"))
        checked(Capi.delete("model"))


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("compensator", ["none", "response_error", "impulse_ledger"])
@pytest.mark.parametrize("name", ["rattling", "suite-lag", "suite-dead-zone"])
def test_omsimulator_loop_reproduces_simulation_with_one_more_period(name, compensator, fmi, tmp_path):
    mechanism = load(name, NOISELESS).mechanism
    paths = write_fmus(document(name, compensator, NOISELESS), fmi, tmp_path)
    loop = OmsLoop(paths, ONE_AXIS_CONNECTIONS, tmp_path, "controller.integrates_model")
    expected = simulated(name, compensator, 1)
    if not np.isfinite(mechanism.contact.clearance):
        expected = expected[:1]  # a further run needs an event, which OMSimulator cannot send
    watch, contacts = ContactDetector(mechanism), []
    motion = loop.get("rig.position"), loop.get("rig.velocity")
    while len(contacts) < len(expected):
        force, reading = loop.get("rig.contact_force"), loop.get("rig.force_measured")
        loop.step()
        contact = watch.observe(*motion, loop.get("controller.force_command"), force, reading)
        contacts += [] if contact is None else [contact]
        motion = loop.get("controller.model_position"), loop.get("controller.model_velocity")
    loop.close()
    differences = [one.restitution - other.restitution for one, other in zip(contacts, expected, strict=True)]
    print(f"{name} {compensator} FMI {fmi}: {np.max(np.abs(differences)):.1e}")
    assert_same_contacts(contacts, expected)
    assert abs(contacts[0].restitution - simulated(name, compensator, 0)[0].restitution) > 1e-6


def six_axis_connections():
    """Return the connections of the FMUs with six axes: the start of each connection by its end."""
    ends, begins = names_of(*SENSED, *START), names_of(*SENSED, *START.values())
    connections = {f"controller.{end}": f"rig.{begin}" for end, begin in zip(ends, begins, strict=True)}
    return connections | {f"rig.{part}": f"controller.{part}" for part in names_of(*COMMANDS)}


def simulate_latency(name, compensator, made, latency):
    """Return the end of the run of `simulate` with this command latency [periods]."""
    mechanism: Any = load_any(name, (f"rig.command_latency={latency}",)).mechanism
    gains = {name: gain["value"] for name, gain in made["gains"].items()}
    return simulate_six_axes(mechanism, compensator, gains).final


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(("name", "compensator"), SIX_AXIS_LOOPS)
def test_omsimulator_loop_with_six_axes_reproduces_simulation_with_one_more_period(
    name, compensator, fmi, tmp_path
):
    made = document_of(name, compensator)
    paths = write_fmus(made, fmi, tmp_path)
    without, expected = (simulate_latency(name, compensator, made, latency) for latency in (0, 1))
    loop = OmsLoop(paths, six_axis_connections(), tmp_path, "controller.integrates_model")
    loop.step(round(expected.time / PERIOD))
    twist = np.array([loop.get(f"controller.{part}") for part in names_of("model_twist")])
    loop.close()
    difference = float(np.max(np.abs(twist - expected.twist)))
    print(f"{name} {compensator} FMI {fmi}: {difference:.1e}")
    assert difference < 1e-9 and np.max(np.abs(twist - without.twist)) > 1e-6
