"""Command `jaxhil shadow`: shows what a controller would have commanded on the readings of a rig's logs."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxhil.errors import to_one_line
from tuning import terminal
from tuning.api.shadow import shadow
from tuning.cli.commands import checks
from tuning.cli.options_rig import Shadow

MAX_TABLE_ROWS = 12  # largest number of contacts in the printed table
MAX_ROUNDING_SHARE = 1e-3  # difference, divided by the range, that rounded logs can explain [1]
METRICS = "largest", "rms", "range"


def run(options: Shadow) -> int:
    """Compare a controller's commands with those in the logs, and print the result.

    Return exit code 0, or 1 if the controller would have tripped.
    """
    if options.plot is not None:
        checks.check_plot(options.plot)
    result = shadow(options.path, options.logs, map=options.map, session=options.session, progress=True)
    document = result.document
    if options.plot is not None:
        result.plot(options.plot)
        terminal.note(f"wrote {options.plot}")
    terminal.warn(document["notes"])
    if options.json:
        terminal.emit_json("shadow", document)
    else:
        _print(document)
        if result.good and (Path(options.path) / "manifest.json").is_file():
            terminal.suggest("rig", options.path)
        elif result.good:
            terminal.suggest("export", options.path, "-o", "bundle")
    return 0 if result.good else 1


def _print(document: dict[str, Any]) -> None:
    contacts = document["contacts"]
    parts = [("force", "N"), ("moment", "Nm")][: len(contacts[0]["differences"])]
    rows = [
        [
            contact["contact"],
            to_one_line(contact["log"].rsplit("/", 1)[-1], 24),
            contact["ticks"],
            *(_format(contact["differences"][part][key]) for part, _ in parts for key in METRICS),
            contact["missed"],
            contact["late"],
            contact["law_status"].replace("_", " "),
        ]
        for contact in contacts[:MAX_TABLE_ROWS]
    ]
    headings = [f"{key}\n[{unit}]" for _, unit in parts for key in METRICS]
    table = terminal.build_table(
        f"{document['mechanism']}, {document['compensator']}: largest and rms difference of commands, range "
        "of the logged ones",
        ["contact", "log", "ticks", *headings, "missed", "late", "status"],
        rows,
        texts=(1, len(headings) + 5),
    )
    terminal.emit(table, *_describe(document))


def _describe(document: dict[str, Any]) -> Iterator[str]:
    """Yield the lines below the table: number of unlisted contacts, faults, findings and the verdict."""
    contacts = document["contacts"]
    if len(contacts) > MAX_TABLE_ROWS:
        yield f"... and {len(contacts) - MAX_TABLE_ROWS} more contacts."
    shares = [contact["share"] for contact in contacts if contact["share"] is not None]
    if shares:
        yield f"Largest difference: {max(shares):.2g} of the range of the logged commands."
    if len(shares) < len(contacts):
        yield "A contact with a constant logged command, or without rows to compare, has no such range."
    for contact in contacts[:MAX_TABLE_ROWS]:
        faults = ", ".join(
            f"{fault['name']} {fault['ticks']} times from {fault['first']:.4f} s"
            for fault in contact["faults"]
        )
        if faults:
            yield f"Contact {contact['contact']}: faults: {faults}."
    yield from (f"{finding}." for finding in document["findings"])
    if document["verdict"] == "good":
        yield "Good: the controller would not have tripped."
        agrees = len(shares) == len(contacts) and max(shares) <= MAX_ROUNDING_SHARE
        if document["findings"] or not agrees:
            yield "This verdict is about trips only, not about the differences and findings above."
    yield from (f"Bad: {reason}." for reason in document["reasons"])


def _format(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
