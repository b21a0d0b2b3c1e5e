"""Hand-written C++ baseline (baseline.cpp), compiled on demand and called through ctypes.

The supported options are listed in baseline.cpp. All computations are in double precision, even if the input
is in single precision.
"""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.contact.laws import KelvinVoigt
from jaxhil.laws.response_error.simulation import ResponseError
from jaxhil.simulation.contact_tracking import build_end_conditions
from jaxhil.simulation.loop import Loop, RigConstants
from jaxhil.simulation.metrics import NOT_REACHED
from jaxhil.simulation.scenario import Scenario

SOURCE = Path(__file__).with_name("baseline.cpp")
FLAGS = ("-O3", "-march=native", "-std=c++17", "-pthread")
KINDS = {"none": 0, "phase_lead": 1, "response_error": 2}
# Same order as `Gain` in baseline.cpp; compensators do not read gains that they do not have.
GAINS = tuple(gain.name for gain in ResponseError.gains)
RESULTS = ("restitution", "approach_velocity", "peak_force", "peak_command", "duration")

_SIZES = ("lanes", "slots", "ring", "kind", "threads")
_NUMBERS = (
    "period", "mass", "velocity", "phase", "stiffness", "damping", "transition", "position_row",
    "velocity_row", "measured_row", "steady_command", "steady_velocity", "quiet", "patience", "gains",
)  # fmt: skip
_COUNTS = ("contacts", "force_intervals", "real_intervals", "position_intervals")
_OUTPUT_COUNTS = ("status", "ticks")


class _Problem(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int64) for name in _SIZES] + [
        (name, ctypes.c_void_p) for name in _NUMBERS + _COUNTS + RESULTS + _OUTPUT_COUNTS
    ]


class Baseline(NamedTuple):
    """Compiled C++ baseline."""

    library: ctypes.CDLL
    block_lanes: int

    def run(
        self,
        loop: Loop,
        rig: RigConstants,
        gains: dict[str, Any],
        scenario: Scenario,
        horizon_ticks: int,
        threads: int = 2,
    ) -> dict[str, Any]:
        """Simulate `horizon_ticks` ticks with all contacts of every lane.

        `scenario` is the scenario from which `rig` was built, with one batch axis of lanes; `gains` are
        scalars or (lanes,). Returns arrays (slots, lanes) named as in `jaxhil.simulation.metrics.Metrics`:
        restitution, approach_velocity, peak_force, peak_command, duration, status (`NOT_REACHED` if the
        horizon ends before the contact) and ticks; and "seconds" spent in C++. Raises ValueError for
        unsupported options.
        """
        return self._call(self.library.run_contacts, loop, rig, gains, scenario, horizon_ticks, threads)

    def run_ticks(
        self,
        loop: Loop,
        rig: RigConstants,
        gains: dict[str, Any],
        scenario: Scenario,
        ticks: int,
        threads: int = 2,
    ) -> dict[str, Any]:
        """Simulate `ticks` ticks of every lane: its first contact and the flight after this contact.

        Returns the arrays of `run`; only slot 0 is used.
        """
        return self._call(self.library.run_ticks, loop, rig, gains, scenario, ticks, threads)

    def _call(self, function, loop, rig, gains, scenario, ticks, threads):
        _check_scope(loop, rig, scenario)
        lanes, slots = scenario.velocity.shape[0], scenario.phase.shape[0]
        inputs = _inputs(rig, gains, scenario, lanes)
        _check_reach(loop, inputs)
        results = {name: np.full((slots, lanes), np.nan) for name in RESULTS}
        results["status"] = np.full((slots, lanes), NOT_REACHED, np.int32)
        results["ticks"] = np.zeros((slots, lanes), np.int32)
        problem = _Problem(lanes, slots, loop.ring, KINDS[loop.compensator.name], max(1, threads))
        for name, array in (inputs | results).items():
            setattr(problem, name, array.ctypes.data)
        seconds = function(ctypes.byref(problem), ctypes.c_int64(ticks))
        return results | {"seconds": seconds}


def compile_baseline(block_lanes: int | None = None, skips: bool = True) -> Baseline | None:
    """Compile and load baseline.cpp; return None without g++.

    `block_lanes` overrides the number of lanes per block. Approaches are simulated unless `skips` is set.
    Raises `subprocess.CalledProcessError` if the compiler fails.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    defined = [f"-DSKIPS={int(skips)}"] + ([] if block_lanes is None else [f"-DLANES={block_lanes}"])
    with tempfile.TemporaryDirectory(prefix="jaxhil-baseline-") as folder:
        path = Path(folder) / "baseline.so"
        command = [compiler, *FLAGS, *defined, "-shared", "-fPIC", str(SOURCE), "-o", str(path)]
        subprocess.run(command, check=True)
        # The loaded library remains usable after its file is deleted.
        library = ctypes.CDLL(str(path))
    for function in (library.run_ticks, library.run_contacts):
        function.argtypes = [ctypes.POINTER(_Problem), ctypes.c_int64]
        function.restype = ctypes.c_double
    return Baseline(library, library.block_lanes())


def _check_scope(loop: Loop, rig: RigConstants, scenario: Scenario) -> None:
    supported = {
        "one axis of lanes": np.ndim(scenario.velocity) == 1,
        "Kelvin-Voigt contact": isinstance(loop.law, KelvinVoigt),
        "no tension": not np.any(scenario.contact.tension),
        "a compensator of " + ", ".join(KINDS): loop.compensator.name in KINDS,
        "semi_implicit_euler": loop.integrator == "semi_implicit_euler",
        "linear hold": loop.hold == "linear",
        "latency 0": loop.latency == 0,
        "a motion simulator of order 2": rig.propagation.steady_command.shape[0] == 2,
        "ideal sensors": not (
            loop.has_lag
            or loop.has_force_bias
            or loop.has_force_noise
            or loop.has_position_noise
            or loop.has_sample_effects
        ),
        "no limits": not loop.has_limits,
        "one surface": not loop.is_two_sided,
        "no energies": not loop.energies,
    }
    missing = [condition for condition, met in supported.items() if not met]
    if missing:
        raise ValueError("the C++ baseline is written for " + ", ".join(missing))


def _check_reach(loop: Loop, inputs: dict[str, np.ndarray]) -> None:
    """Raise ValueError if a delay exceeds the delay lines: the C++ code does not check its indices."""
    intervals = [np.max(inputs[name]) for name in _COUNTS if name.endswith("_intervals")]
    if loop.compensator.name == "response_error":
        delay = inputs["gains"][GAINS.index("identification_delay")]
        intervals.append(np.max(delay / inputs["period"]))
    if not max(intervals) <= loop.ring - 2:
        raise ValueError(f"delays: found {max(intervals):g} periods, expected {loop.ring - 2}")


def _inputs(rig, gains, scenario, lanes) -> dict[str, np.ndarray]:
    """Return every input array of the C++ code by name: doubles and 32-bit integers, lanes last."""

    def spread(array, dtype):
        array = np.asarray(array, dtype)
        return np.ascontiguousarray(np.broadcast_to(array, (*array.shape[:-1], lanes)))

    plant, rules = rig.propagation, build_end_conditions(scenario)
    # Gains that the compensator lacks have no effect on the result, so any finite value will do.
    table = [np.broadcast_to(np.asarray(gains.get(name, 1.0), float), (lanes,)) for name in GAINS]
    numbers = {
        "period": scenario.control_period,
        "mass": scenario.equivalent_mass,
        "velocity": scenario.velocity,
        "phase": scenario.phase,
        "stiffness": scenario.contact.stiffness,
        "damping": scenario.contact.damping,
        "transition": plant.transition,
        "position_row": plant.position,
        "velocity_row": plant.velocity,
        "measured_row": plant.measured_position,
        "steady_command": plant.steady_command,
        "steady_velocity": plant.steady_velocity,
        "quiet": rules.force_free_ticks,
        "patience": rules.max_force_free_ticks,
        "gains": np.stack(table),
    }
    counts = {
        "contacts": scenario.contacts,
        "force_intervals": rig.delays.force.intervals,
        "real_intervals": rig.delays.real,
        "position_intervals": rig.delays.position.intervals,
    }
    return {name: spread(numbers[name], np.float64) for name in _NUMBERS} | {
        name: spread(counts[name], np.int32) for name in _COUNTS
    }
