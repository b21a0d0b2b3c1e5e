"""Command `jaxhil export`: writes gains as a bundle that a rig computer can check and run."""

import math
from dataclasses import fields
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, format_value
from jaxhil.rig.limits import LIMITS
from tuning import terminal
from tuning.api.export import ALL_LIMITS, ExportOptions, allowed_values, export
from tuning.cli.options_rig import Export


def run(options: Export) -> int:
    """Export the bundle, and print the result; return exit code 1 if the verdict is bad, else 0.

    If the force commands of the rig's runtime differ from the simulated ones, nothing is written.
    """
    formats = [name.strip() for names in options.formats for name in names.split(",")]
    result = export(
        options.gains,
        options.output,
        sweep=options.sweep,
        formats=formats or None,
        limits=_parse_limits(options.limits),
        progress=True,
        **{field.name: getattr(options, field.name) for field in fields(ExportOptions)},
    )
    if options.json:
        terminal.emit_json("export", result.document)
    else:
        _print(result.document, result.sizes)
        if result.document["bundle"]:
            terminal.suggest("verify", str(result.document["bundle"]))
    return 0 if result.good else 1


def _parse_limits(settings: tuple[str, ...]) -> dict[str, float | None]:
    """Return limits by name from texts LIMIT=VALUE ('none': None); raise `InputError` for invalid texts."""
    replaced: dict[str, float | None] = {}
    for words in settings:
        name, _, text = words.partition("=")
        if name not in ALL_LIMITS:
            raise InputError(
                f"--set: found {format_value(words)}, expected LIMIT=VALUE with LIMIT "
                f"one of {', '.join(LIMITS)}"
            )
        try:
            value = None if text == "none" else float(text)
        except ValueError:
            value = math.nan
        if value is not None and not ALL_LIMITS[name].admits(value):
            raise InputError(f"--set: found {format_value(words)}, expected {allowed_values(name)}")
        replaced[name] = value
    return replaced


def _print(document: dict[str, Any], sizes: dict[str, int]) -> None:
    from tuning.bundle.summary import (
        ERROR_TABLES,
        describe_alarm_rates,
        describe_limit,
        describe_sweep,
        is_user_limit,
    )

    tables = []
    if document["limits"]:
        rows = [
            (name, *describe_limit(limit["value"], limit["unit"]))
            for name, limit in document["limits"].items()
            if is_user_limit(name)
        ]
        tables.append(
            terminal.build_table(
                "Limits for the rig (gains.json and --set use SI units)",
                ["limit", "value", "unit"],
                rows,
                texts=(0, 2),
            )
        )
    lines = [
        f"{'draw ' + str(number) if number else 'The nominal run'}, {end}: later ticks are not compared."
        for number, end in enumerate(document["ended"])
        if end
    ]
    error_name = ERROR_TABLES[document["axes"]][0][1].partition(" |")[0]
    lines += describe_sweep(document["sweep"], error_name)
    if document["rates"]:
        lines += [f"Watchdog: {text}" for text in describe_alarm_rates(document["rates"])]
    if document["bundle"]:
        lines += [
            f"wrote {len(sizes)} files, {sum(sizes.values()) / 1e6:.2g} MB, to {document['bundle']}",
            *(
                ["Signed; to check the signature: `jaxhil verify --key` with the public key."]
                if document["signed"]
                else []
            ),
            f"On the rig: python {Path(document['bundle']).name}/selftest.py",
        ]
        lines += document["fmu_notes"]
        if any(name.endswith("jaxhil_rig.fmu") for name in document["files"]):
            lines.append(
                "A co-simulation that steps the controller's FMU before the rig's FMU adds one control "
                "period: tune with `--extra-periods 1`."
            )
    lines += [f"Bad: {reason}" for reason in document["reasons"]]
    lines += [f"Unknown: {text}." for text in document["unknown"]]
    if document["verdict"] != "bad":
        good = document["verdict"] == "good"
        lines.append(
            f"{'Good' if good else 'Not known to be good'}: in {document['ticks']} ticks of "
            f"{document['runs']} runs, the controller's forces equal the simulated ones; wrong alarms "
            f"{'are as rare as required' if good else 'may be too frequent'}."
        )
    terminal.emit(*tables, *lines)
