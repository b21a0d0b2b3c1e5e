"""`jaxhil export`: gains as a bundle that a rig computer can check and run by itself."""

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, shown
from jaxhil.rig.limits import LIMITS
from tuning import terminal
from tuning.cli.options_rig import Export
from tuning.front_door.export import ExportOptions, allowed_values, export


def run(options: Export) -> int:
    """1 if something is bad, else 0: nothing is written if the runtime's forces are not those simulated."""
    formats = [name.strip() for given in options.formats for name in given.split(",")]
    found = export(
        options.gains,
        options.output,
        sweep=options.sweep,
        formats=formats or None,
        limits=_replaced(options.limits),
        progress=True,
        **{field.name: getattr(options, field.name) for field in fields(ExportOptions)},
    )
    if options.json:
        terminal.emit_json(found.document)
    else:
        _print(found.document, found.sizes)
    return 0 if found.good else 1


def _replaced(given: tuple[str, ...]) -> dict[str, float | None]:
    """The limits that the user sets, None for no limit. Raises `InputError`."""
    replaced: dict[str, float | None] = {}
    for words in given:
        name, _, text = words.partition("=")
        if name not in LIMITS:
            raise InputError(
                f"--set: found {shown(words)}, allowed LIMIT=VALUE, LIMIT one of {', '.join(LIMITS)}"
            )
        try:
            value = None if text == "none" else float(text)
        except ValueError:
            value = math.nan
        if value is not None and not LIMITS[name].admits(value):
            raise InputError(f"--set: found {shown(words)}, allowed {allowed_values(name)}")
        replaced[name] = value
    return replaced


def _print(document: dict[str, Any], sizes: dict[str, int]) -> None:
    from tuning.bundle.summary import alarm_rates, is_shown

    tables = []
    if document["limits"]:
        rows = [
            (name, terminal.figure(one["value"], 6), one["unit"])
            for name, one in document["limits"].items()
            if is_shown(name)
        ]
        tables.append(terminal.table("Limits for the rig", ["limit", "value", "unit"], rows, texts=(0, 2)))
    lines = [
        f"{'draw ' + str(number) if number else 'The nominal run'}, {end}: not compared from there on."
        for number, end in enumerate(document["ended"])
        if end
    ]
    if document["rates"]:
        lines += [f"Watchdog: {text}" for text in alarm_rates(document["rates"])]
    if document["bundle"]:
        lines += [
            f"wrote {len(sizes)} files, {sum(sizes.values()) / 1e6:.2g} MB, to {document['bundle']}",
            *(["Signed: `jaxhil verify --key` with the public key proves it."] if document["signed"] else []),
            f"On the rig: python {Path(document['bundle']).name}/selftest.py",
        ]
    lines += [f"Bad: {reason}" for reason in document["reasons"]]
    lines += [f"Unknown: {text}." for text in document["unknown"]]
    if document["verdict"] != "bad":
        good = document["verdict"] == "good"
        lines.append(
            f"{'Good' if good else 'Not known to be good'}: {document['ticks']} ticks of {document['runs']} "
            "runs recorded; the controller's forces are those simulated, "
            f"{'wrong alarms as rare as' if good else 'wrong alarms perhaps not as rare as'} allowed."
        )
    terminal.emit(*tables, *lines)
