"""README of a bundle, made from the template `bundle_readme.md` and the bundle's data."""

import html
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from jaxhil.errors import to_one_line
from jaxhil.rig.bounds import FORCES, POSITIONS, SPEEDS
from jaxhil.rig.faults import FAULTS, Fault
from jaxhil.rig.law_status import STATUSES
from tuning.bundle.controller_kind import ONE_AXIS, kind_of

TEMPLATE = Path(__file__).parent / "bundle_readme.md"
SIX_AXIS_TEMPLATE = Path(__file__).parent / "bundle_readme_six_axes.md"
LOOP_SECTION = Path(__file__).parent / "bundle_readme_loop.md"

# Purpose of each file and folder in a bundle.
FILE_DESCRIPTIONS = {
    "gains.json": "gains, limits for the rig, and the mechanism and uncertainty of the tuning",
    "jaxhil_runtime.py": "controller in Python, which needs no further packages",
    "flight_recorder.py": "log of readings and commands, which `jaxhil shadow` and `identify` read",
    "vectors.csv": "test vectors: recorded and damaged ticks, with the controller's commands",
    "selftest.py": "program that checks all files and replays the test vectors",
    "vector_replay.py": "replay of the test vectors for this program",
    "summary.html": "summary on one page: gains, limits, errors, range of validity",
    "udp_controller.py": "program that runs the controller as a process, which answers a rig over UDP",
    "udp_protocol.py": "protocol between this process and a rig",
    "udp_task.py": "computation of this process's answers",
    "numerical_model.py": "numerical model of the docking for this process",
    "numerical_model_six_axes.py": "numerical model of the docking for this process",
    "c99": "controller in C99, its gains, its test program, and a real-time loop for Linux",
    "fmi3": "FMUs of FMI 3.0 with sources: the controller and the simulated rig",
    "fmi2": "FMUs of FMI 2.0 with sources: the controller and the simulated rig",
    "rehearsal": "simulated rig in C for the real-time loop of `c99`: a rehearsal without Python",
    "ros2.yaml": "gains as ROS 2 parameters",
    "gains.mat": "gains for MATLAB",
    "gains.csv": "gains as a table",
    "manifest.json": "checksums of every file and of every line",
}


def readme_text(document: Mapping[str, Any], files: Collection[str]) -> str:
    """Return the README of a bundle, in Markdown; `files` are the paths of the bundle's files."""
    present = {*(name.partition("/")[0] for name in files), "manifest.json"}
    table_rows = [f"| `{name}` | {text} |" for name, text in FILE_DESCRIPTIONS.items() if name in present]
    kind = kind_of(document)
    template = TEMPLATE if kind is ONE_AXIS else SIX_AXIS_TEMPLATE
    return Template(template.read_text(encoding="utf-8")).substitute(
        mechanism=_escape_text(to_one_line(document["mechanism"]["name"], 80)),
        compensator=document["compensator"],
        period=repr(document["control_period"]),
        digest=document["sha256"],
        content="\n".join(("| file | content |", "|---|---|", *table_rows)),
        side="moving" if document.get("constants", {}).get("sensor_sign") == 1.0 else "fixed",
        statuses=status_table(),
        faults=fault_table(kind.faults),
        loop=LOOP_SECTION.read_text(encoding="utf-8").rstrip(),
        **({"model": describe_numerical_model(document["mechanism"])} if kind is ONE_AXIS else {}),
        outermost=f"forces to {FORCES[1]:g} N, positions to {POSITIONS[1]:g} m either way, position commands "
        f"that change by up to {SPEEDS[1]:g} m/s",
    )


# Change of the position in one period T for each integrator; `velocity` is that at the end of the period.
POSITION_CHANGES = {
    "semi_implicit_euler": "T * velocity",
    "explicit_euler": "T * velocity - T * T * acceleration",
    "zoh": "T * velocity - T * T * acceleration / 2",
}
HOLDS = {
    "linear": "the drives interpolate linearly from each command to the next",
    "zoh": "the drives hold each command",
}


def describe_numerical_model(mechanism: Mapping[str, Any]) -> str:
    """Return the README's text on the numerical model: mass, signs, code of a step, hold and latency."""
    bodies, rig = mechanism["bodies"], mechanism["rig"]
    mass = bodies.get("equivalent_mass")
    if mass is None:
        chaser, target = bodies["chaser_mass"], bodies["target_mass"]
        mass = chaser * (target / (chaser + target))
    integrator = rig.get("integrator", "semi_implicit_euler")
    change, latency = POSITION_CHANGES[integrator], rig.get("command_latency", 0)
    steps = (
        "acceleration = -force / M",
        "velocity = velocity + T * acceleration",
        f"position = position + {change}",
    )
    python = [f"    {step}" for step in steps]
    c99 = [f"    {step};" for step in steps]
    return "\n".join((
        f"The gains were tuned with this model: equivalent mass M = {mass:.9g} kg, control period "
        f"T = {rig['control_period']!r} s, integrator `{integrator}`.",
        "Position and velocity are positive towards contact, and a compressing force is positive: it acts as",
        "`-force`. In every tick, between `step` and `position_command`, in Python",
        "", *python, "", "and in C", "", *c99, "",
        f"Command hold `{rig.get('command_hold', 'linear')}`: {HOLDS[rig.get('command_hold', 'linear')]}. "
        f"Command latency: {latency} {'period' if latency == 1 else 'periods'} from a command to its effect.",
    ))  # fmt: skip


def status_table() -> str:
    """Return a Markdown table of the compensator's statuses: name and meaning."""
    rows = [f"| `{status.name}` | {_escape_cell(status.meaning)} |" for status in STATUSES]
    return "\n".join(("| status | meaning |", "|---|---|", *rows))


def fault_table(faults: Sequence[Fault] = FAULTS) -> str:
    """Return a Markdown table of the controller's faults: bit, name, condition and reaction."""
    rows = [
        f"| `{fault.bit:#x}` | `{fault.name}` | {_escape_cell(fault.condition)} | "
        f"{_escape_cell(fault.reaction)} |"
        for fault in faults
    ]
    return "\n".join(("| bit | fault | raised when | reaction |", "|---|---|---|---|", *rows))


def _escape_text(text: str) -> str:
    """Escape the Markdown and HTML characters in a user's text."""
    return re.sub(r"([\\`*_\[\]|~$#])", r"\\\1", html.escape(text, quote=False))


def _escape_cell(text: str) -> str:
    """Escape the column separator in a text for a Markdown table."""
    return text.replace("|", "\\|")
