"""Command `jaxhil mechanisms`: lists built-in mechanisms and sets of them, or prints the JSON Schema."""

import math
from typing import Any

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.file import (
    DEFAULT_MECHANISM,
    builtin_names,
    builtin_path,
    load,
    load_any,
    six_axis_names,
    suite_names,
)
from jaxhil.mechanism.json_schema import build_json_schema
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from tuning import terminal
from tuning.cli.options import MechanismsOptions


def run(options: MechanismsOptions) -> int:
    """Print the lists of mechanisms, or the JSON Schema of mechanism files; return exit code 0."""
    if options.schema:
        terminal.print_json(build_json_schema())
        return 0
    titles = {"Built-in mechanisms": builtin_names(), "Standard suites": suite_names()}
    tables = {
        title: [_mechanism_entry(name, load(name).mechanism) for name in names]
        for title, names in titles.items()
    }
    six_axes = [_six_axis_entry(name) for name in six_axis_names()]
    if options.json:
        mechanisms, suites = tables.values()
        lists = {"mechanisms": mechanisms, "suites": suites, "six_axes": six_axes}
        terminal.emit_json("mechanisms", lists)
        return 0
    headings = ["name", "contact law", "contacts", "mass [kg]", "contact frequencies [Hz]"]
    for title, entries in tables.items():
        terminal.emit(
            terminal.build_table(
                title, headings, [_mechanism_row(entry) for entry in entries], texts=(0, 1, 4)
            ),
            *(f"{entry['name']}: {entry['source']}\n" for entry in entries),
        )
    rows = [[*(entry[key] for key in SIX_AXIS_COLUMNS), " ".join(entry["laws"])] for entry in six_axes]
    terminal.emit(
        terminal.build_table(
            "Built-in mechanisms of six axes",
            ["name", "masses [kg]", "pairs of shapes", "contact laws"], rows, texts=(0, 1, 3),
        ),
        *(f"{entry['name']}: {entry['source']}\n" for entry in six_axes),
    )  # fmt: skip
    terminal.emit_line(f"The files are in {builtin_path(DEFAULT_MECHANISM).parent}.")
    terminal.suggest("init", "NAME")
    return 0


def _mechanism_row(entry: dict[str, Any]) -> list[Any]:
    frequencies = " ".join(f"{value:.3g}" for value in entry["contact_frequencies"]) or "-"
    return [entry["name"], entry["law"], entry["contacts"], entry["mass"], frequencies]


def _mechanism_entry(name: str, mechanism: Mechanism) -> dict[str, Any]:
    return {
        "name": name,
        "law": mechanism.contact.law,
        "contacts": mechanism.approach.contacts,
        "mass": mechanism.bodies.mass,
        "contact_frequencies": _contact_frequencies(mechanism),
        "control_period": mechanism.rig.control_period,
        "source": mechanism.source,
        "path": str(builtin_path(name)),
    }


SIX_AXIS_COLUMNS = ("name", "masses", "pairs")


def _six_axis_entry(name: str) -> dict[str, Any]:
    mechanism = load_any(name).mechanism
    assert isinstance(mechanism, SixAxisMechanism)
    contacts = mechanism.contact.values()
    return {
        "name": name,
        "masses": f"{mechanism.target.mass:g} and {mechanism.chaser.mass:g}",
        "pairs": sum(contact.pattern.count if contact.pattern else 1 for contact in contacts),
        "laws": sorted({contact.law for contact in contacts}),
        "control_period": mechanism.rig.control_period,
        "source": mechanism.source,
        "path": str(builtin_path(name)),
    }


def _contact_frequencies(mechanism: Mechanism) -> list[float]:
    """Return the frequency sqrt(k/M)/(2 pi) [Hz] of each distinct stiffness k; M is the equivalent mass.

    The list is empty if the contact law has an exponent, so that k does not have the unit N/m.
    """
    if find_contact_law(mechanism.contact.law).stiffness_unit != "N/m":
        return []
    stiffness: list[float] = []
    for entry in mechanism.contact.stiffness:
        stiffness.extend(entry if isinstance(entry, list) else [entry])
    mass = mechanism.bodies.mass
    return [math.sqrt(value / mass) / (2 * math.pi) for value in dict.fromkeys(stiffness)]
