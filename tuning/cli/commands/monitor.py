"""`jaxhil monitor`: whether the rig still is the one that was identified, contact by contact."""

from pathlib import Path
from typing import Any

from jaxhil.mechanism.file import load
from jaxhil.rig import digest
from jaxhil.simulation.sources import versions
from tuning import terminal
from tuning.cli.commands.identify import read_logs
from tuning.cli.options_identify import Monitor
from tuning.identification.monitor.figures import FIGURES
from tuning.identification.monitor.monitor import Monitored, monitor

SCHEMA = "jaxhil/monitor/1"
UNSTATED = (
    "the mechanism file has no [uncertainty]: what is off by more than a clock or a scale may be is bad"
)


def run(options: Monitor) -> int:
    """Hold contacts against the mechanism; 1 where the rig is beyond the file's uncertainty, else 0."""
    loaded = load(options.mechanism)
    with terminal.stages(2) as stages:
        stages.turn_to("reading the logs")
        campaign = read_logs([Path(log) for log in options.logs], options.map, loaded.mechanism)
        stages.turn_to("setting the contacts against the mechanism")
        found = monitor(campaign, loaded.mechanism)
    content = {
        "schema": SCHEMA,
        "mechanism": loaded.label,
        "mechanism_sha256": loaded.sha256,
        "state": found.state,
        "reason": found.verdict,
        "alarm": _counted(found.alarm),
        "since": _counted(found.since),
        "changes": [{"figure": one.name, "value": one.value, "std": one.std} for one in found.changes],
        "contacts": [_contact(number, found) for number in range(len(found.contacts))],
        "notes": [*campaign.notes, *([] if loaded.mechanism.uncertainty else [UNSTATED])],
        "sources": campaign.sources,
        "versions": versions(),
    }
    plain = terminal.finite(content)
    document = {**plain, "sha256": digest(plain)}
    terminal.warn(document["notes"])
    if options.json:
        terminal.emit_json(document)
    else:
        _print(document)
    return 1 if found.state == "bad" else 0


def _counted(number: int | None) -> int | None:
    """Contacts are counted from 1."""
    return None if number is None else number + 1


def _contact(number: int, found: Monitored) -> dict[str, Any]:
    one = found.contacts[number]
    figures = {
        name: {"value": float(value), "predicted_std": float(std), "z": float(z)}
        for (name, _, _), value, std, z in zip(FIGURES, one.value, one.predicted_std, one.z, strict=True)
    }
    return {"contact": number + 1, "log": one.source, "state": one.state, "figures": figures}


def _print(document: dict[str, Any]) -> None:
    headings = ["contact", *(_heading(name, unit) for name, unit, _ in FIGURES)]
    rows = [
        [
            one["contact"],
            *(_shown(one["figures"][name]["value"], scale) for name, _, scale in FIGURES),
            one["state"],
        ]
        for one in document["contacts"]
    ]
    title = f"By {document['mechanism']}: 0 where the rig is that of the file"
    table = terminal.table(title, [*headings, "state"], rows, texts=(len(headings),))
    spread = ", ".join(
        f"{name} {terminal.figure(scale * std, 2)}{'' if unit == '1' else f' {unit}'}"
        for name, unit, scale in FIGURES
        if (std := document["contacts"][-1]["figures"][name]["predicted_std"]) is not None
    )
    terminal.emit(table, f"Predicted to scatter in the last contact by: {spread}.", f"{document['reason']}.")


def _heading(name: str, unit: str) -> str:
    """On three lines, so that all columns find room."""
    first, _, last = name.rpartition(" ")
    return "\n".join([first, last, "" if unit == "1" else f"[{unit}]"])


def _shown(value: float | None, scale: float) -> str:
    return "-" if value is None else f"{scale * value:+.2g}"
