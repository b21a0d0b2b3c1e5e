"""`jaxhil export`: gains as a bundle that a rig computer can check and run by itself."""

import math
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, shown
from jaxhil.runtime.limits import LIMITS
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options_rig import Export
from tuning.environment import prepare


def run(options: Export) -> int:
    """0 if the runtime does what was simulated; 1 if not: nothing is written if the forces differ."""
    checks.at_least(0, seed=options.seed)
    from tuning.bundle.bundle import build_bundle, check_target, write_bundle
    from tuning.bundle.writers import WRITERS

    formats = _formats(options, list(WRITERS))
    replaced = _replaced(options.limits)
    path = checks.gain_file(options.gains)
    folder = Path(options.output)
    check_target(folder)
    prepare()
    from tuning.gain_file import load_gain_file

    loaded = load_gain_file(path)
    limits, rates = _calibrated(loaded, options, replaced)
    with terminal.stages(2) as stages:
        bundle = build_bundle(loaded.document, formats, limits, rates, options.seed, stages.begin)
        if not bundle.reasons:
            write_bundle(folder, bundle.files)
    # A run that ends early in the bundle itself does so on the rig.
    stopped = bundle.ended[0] if bundle.ended else None
    reasons = [*bundle.reasons, *([f"the nominal run, {stopped}"] if stopped else [])]
    document: dict[str, Any] = {
        "bundle": None if bundle.reasons else str(folder),
        "mechanism": loaded.mechanism.name,
        "compensator": loaded.compensator,
        "gains_sha256": bundle.document["sha256"],
        "formats": formats,
        "files": sorted(bundle.files),
        "limits": bundle.document.get("limits"),
        "rates": rates,
        "ticks": bundle.ticks,
        "runs": bundle.runs,
        "ended": bundle.ended,
        "reasons": reasons,
        "verdict": "bad" if reasons else "good",
    }
    if options.json:
        terminal.emit_json(document)
    else:
        _print(document, {name: len(content) for name, content in bundle.files.items()})
    return 1 if reasons else 0


def _calibrated(loaded, options: Export, replaced: dict[str, float | None]) -> tuple[Any, Any]:
    """The limits for the rig, and what is known of the watchdog's alarms."""
    from tuning.sweeps.store import read_store
    from tuning.watchdog.calibration import WITHOUT_STORE, calibrate

    store = None if options.sweep is None else read_store(Path(options.sweep))
    runs = WITHOUT_STORE if store is None else store.manifest.scenarios
    with terminal.progress(runs, "runs") as progress:
        found = calibrate(
            loaded,
            store,
            replaced=replaced,
            progress=lambda number: progress.advance(number, "working out the limits"),
        )
    return found.limits, found.rates


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
        lowest = LIMITS[name].lowest
        if value is not None and not (math.isfinite(value) and value >= lowest):
            at_least = "" if math.isinf(lowest) else f" of at least {lowest:g}"
            raise InputError(f"--set: found {shown(words)}, allowed a finite number{at_least}, or none")
        replaced[name] = value
    return replaced


def _formats(options: Export, available: list[str]) -> list[str]:
    """The formats asked for, or all. Raises `InputError` for one that is not there."""
    asked = [name.strip() for given in options.formats for name in given.split(",")]
    for name in asked:
        if name not in available:
            raise InputError(f"--format: found {shown(name)}, allowed {', '.join(available)}")
    return [name for name in available if name in asked or not asked]


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
            f"On the rig: python {Path(document['bundle']).name}/selftest.py",
        ]
    if document["reasons"]:
        lines += [f"Bad: {reason}" for reason in document["reasons"]]
    else:
        lines.append(
            f"Good: {document['ticks']} ticks of {document['runs']} runs recorded; the controller's forces "
            "are those simulated."
        )
    terminal.emit(*tables, *lines)
