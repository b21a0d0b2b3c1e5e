"""README of a bundle: the template `bundle_readme.md`, filled with the data of the bundle."""

import html
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from string import Template
from typing import Any

from jaxhil.errors import to_one_line
from jaxhil.rig.bounds import FORCES, POSITIONS, SPEEDS
from jaxhil.rig.faults import FAULTS
from jaxhil.rig.law_status import STATUSES

TEMPLATE = Path(__file__).parent / "bundle_readme.md"

# Files and folders of a bundle with their purpose.
FILE_DESCRIPTIONS = {
    "gains.json": "the gains, their limits for the rig, and all that they were tuned for and over",
    "jaxhil_runtime.py": "the controller, in Python without further packages",
    "vectors.csv": "recorded and hostile ticks, and what the controller commands at each",
    "selftest.py": "checks all files and replays the vectors",
    "summary.html": "one page for people: gains, limits, what they reach, where they hold",
    "udp_controller.py": "the controller as a process that answers a rig over UDP",
    "udp_protocol.py": "what that process and a rig say to each other",
    "c99": "the controller in C99, its gains, its test program",
    "ros2.yaml": "the gains as ROS 2 parameters",
    "gains.mat": "the gains for MATLAB",
    "gains.csv": "the gains as a table",
    "manifest.json": "what every file must be, line by line",
}


def readme_text(document: Mapping[str, Any], files: Collection[str]) -> str:
    """Return the README of the bundle of a gain document that contains these files."""
    present = {*(name.partition("/")[0] for name in files), "manifest.json"}
    table_rows = [f"| `{name}` | {text} |" for name, text in FILE_DESCRIPTIONS.items() if name in present]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        mechanism=_escape_text(to_one_line(document["mechanism"]["name"], 80)),
        compensator=document["compensator"],
        period=repr(document["control_period"]),
        digest=document["sha256"],
        content="\n".join(("| file | is |", "|---|---|", *table_rows)),
        statuses=status_table(),
        faults=fault_table(),
        outermost=f"forces to {FORCES[1]:g} N, positions to {POSITIONS[1]:g} m either way, position commands "
        f"that change by up to {SPEEDS[1]:g} m/s",
    )


def status_table() -> str:
    """Return the runtime's table of a compensator's statuses in Markdown."""
    rows = [f"| `{status.name}` | {_escape_cell(status.meaning)} |" for status in STATUSES]
    return "\n".join(("| status | says |", "|---|---|", *rows))


def fault_table() -> str:
    """Return the runtime's table of faults in Markdown: bit, name, condition, reaction."""
    rows = [
        f"| `{fault.bit:#x}` | `{fault.name}` | {_escape_cell(fault.condition)} | "
        f"{_escape_cell(fault.reaction)} |"
        for fault in FAULTS
    ]
    return "\n".join(("| bit | fault | raised when | reaction |", "|---|---|---|---|", *rows))


def _escape_text(text: str) -> str:
    """Return a user's text with escaped Markdown and HTML."""
    return re.sub(r"([\\`*_\[\]|~$#])", r"\\\1", html.escape(text, quote=False))


def _escape_cell(text: str) -> str:
    """Return a text for a cell of a Markdown table."""
    return text.replace("|", "\\|")
