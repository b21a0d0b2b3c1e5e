"""Command `jaxhil monitor`: compares contacts in newer logs with the identified mechanism."""

from pathlib import Path
from typing import Any

from jaxhil.mechanism.file import load
from jaxhil.rig import digest
from jaxhil.simulation.source_fingerprint import dependency_versions
from tuning import terminal
from tuning.cli.commands.identify import read_logs
from tuning.cli.options_identify import MonitorOptions
from tuning.identification.monitor.metrics import METRICS
from tuning.identification.monitor.monitor import MonitorResult, monitor_contacts

SCHEMA = "jaxhil/monitor/1"
NO_UNCERTAINTY_NOTE = (
    "the mechanism file has no [uncertainty]: every deviation beyond plausible clock and scale errors is bad"
)


def run(options: MonitorOptions) -> int:
    """Compare the contacts in the logs with the mechanism file, and print the result.

    Return the exit code: 1 if the rig changed by more than the uncertainty in the mechanism file, else 0.
    """
    loaded = load(options.mechanism)
    with terminal.show_stages(2) as stages:
        stages.turn_to("reading the logs")
        campaign = read_logs([Path(log) for log in options.logs], options.map, loaded.mechanism)
        stages.turn_to("comparing the contacts with the mechanism")
        result = monitor_contacts(campaign, loaded.mechanism)
    content = {
        "schema": SCHEMA,
        "mechanism": loaded.label,
        "mechanism_sha256": loaded.sha256,
        "verdict": "bad" if result.state == "bad" else "good",
        "state": result.state,
        "reason": result.verdict,
        "alarm": _count_from_one(result.alarm),
        "since": _count_from_one(result.since),
        "changes": [{"figure": item.name, "value": item.value, "std": item.std} for item in result.changes],
        "contacts": [_contact_entry(number, result) for number in range(len(result.contacts))],
        "notes": [*campaign.notes, *([] if loaded.mechanism.uncertainty else [NO_UNCERTAINTY_NOTE])],
        "sources": campaign.sources,
        "versions": dependency_versions(),
    }
    plain = terminal.to_json_data(content)
    document = {**plain, "sha256": digest(plain)}
    terminal.warn(document["notes"])
    if options.json:
        terminal.emit_json("monitor", document)
    else:
        _print(document)
        if result.state == "bad":
            terminal.suggest("identify", "LOGS", "--prior", options.mechanism)
        else:
            terminal.suggest("monitor", options.mechanism, "LATER_LOGS")
    return 1 if result.state == "bad" else 0


def _count_from_one(number: int | None) -> int | None:
    """Convert an index that counts from 0 to a number that counts from 1; None stays None."""
    return None if number is None else number + 1


def _contact_entry(number: int, result: MonitorResult) -> dict[str, Any]:
    """Return the JSON entry of contact `number`, counted from 0: log, state (such as good) and metrics."""
    contact = result.contacts[number]
    metrics = {
        name: {"value": float(value), "predicted_std": float(std), "z": float(z)}
        for (name, _, _), value, std, z in zip(
            METRICS, contact.value, contact.predicted_std, contact.z, strict=True
        )
    }
    return {"contact": number + 1, "log": contact.source, "state": contact.state, "figures": metrics}


def _print(document: dict[str, Any]) -> None:
    headings = ["contact", *(_format_heading(name, unit) for name, unit, _ in METRICS)]
    rows = [
        [
            contact["contact"],
            *(_format_scaled(contact["figures"][name]["value"], scale) for name, _, scale in METRICS),
            contact["state"],
        ]
        for contact in document["contacts"]
    ]
    title = f"Deviations from {document['mechanism']}: 0 if the rig matches the file"
    table = terminal.build_table(title, [*headings, "state"], rows, texts=(len(headings),))
    spread = ", ".join(
        f"{name} {terminal.format_number(scale * std, 2)}{'' if unit == '1' else f' {unit}'}"
        for name, unit, scale in METRICS
        if (std := document["contacts"][-1]["figures"][name]["predicted_std"]) is not None
    )
    terminal.emit(
        table, f"Predicted standard deviations in the last contact: {spread}.", f"{document['reason']}."
    )


def _format_heading(name: str, unit: str) -> str:
    """Return a column heading on three lines, so that the table is narrow enough for a terminal."""
    first, _, last = name.rpartition(" ")
    return "\n".join([first, last, "" if unit == "1" else f"[{unit}]"])


def _format_scaled(value: float | None, scale: float) -> str:
    """Return `scale * value` as text with its sign, or a dash if the value is None."""
    return "-" if value is None else f"{scale * value:+.2g}"
