"""`jaxhil mechanisms`: the built-in mechanism files, with their sources."""

import math
from typing import Any

from jaxhil.mechanism import Mechanism
from jaxhil.mechanism_file import builtin_names, builtin_path, load
from tuning import report
from tuning.options import Mechanisms


def run(options: Mechanisms) -> int:
    """List them; always 0."""
    entries = [_entry(name, load(name).mechanism) for name in builtin_names()]
    if options.json:
        report.emit_json({"mechanisms": entries})
        return 0
    rows = [
        [
            entry["name"],
            entry["law"],
            entry["contacts"],
            entry["mass"],
            " ".join(f"{value:.3g}" for value in entry["contact_frequencies"]) or "-",
        ]
        for entry in entries
    ]
    headings = ["name", "law", "contacts", "mass [kg]", "contact frequencies [Hz]"]
    report.emit(
        report.table("Built-in mechanisms", headings, rows, texts=(0, 1, 4)),
        *(f"{entry['name']}: {entry['source']}\n" for entry in entries),
    )
    return 0


def _entry(name: str, mechanism: Mechanism) -> dict[str, Any]:
    return {
        "name": name,
        "law": mechanism.contact.law,
        "contacts": mechanism.approach.contacts,
        "mass": mechanism.bodies.mass,
        "contact_frequencies": _frequencies(mechanism),
        "control_period": mechanism.rig.control_period,
        "source": mechanism.source,
        "path": str(builtin_path(name)),
    }


def _frequencies(mechanism: Mechanism) -> list[float]:
    """sqrt(k/M)/(2 pi) [Hz] of every stiffness in the file, each once; none for a power law."""
    if mechanism.contact.law in ("hunt_crossley", "depth_damped"):
        return []
    stiffness: list[float] = []
    for entry in mechanism.contact.stiffness:
        stiffness.extend(entry if isinstance(entry, list) else [entry])
    mass = mechanism.bodies.mass
    return [math.sqrt(value / mass) / (2 * math.pi) for value in dict.fromkeys(stiffness)]
