"""`jaxhil sweep`: many scenarios, a failure probability with its interval, and the worst of them."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from tuning import terminal
from tuning.cli.commands import checks, sweep_studies, sweep_tables
from tuning.cli.options import Sweep
from tuning.environment import prepare
from tuning.sweeps import LARGEST_CHUNK, LARGEST_SEED, MOST, PRECISIONS, SAMPLINGS

MOST_DRIVERS = 2**20  # scenarios for each input


def run(options: Sweep) -> int:
    """Run what the store lacks, report all of it; 0 if the verdict is good, else 1."""
    _check(options)
    path = checks.gain_file(options.gains)
    prepare()
    from tuning.gain_file import load_gain_file
    from tuning.statistics.intervals import scenarios_needed
    from tuning.sweeps.manifest import Choices, build_manifest
    from tuning.sweeps.run import on_cluster, run_parts, run_sweep
    from tuning.sweeps.store import locked, open_store
    from tuning.sweeps.tally import failure_probability

    choices = Choices(**{name: getattr(options, name) for name in Choices._fields})
    manifest = build_manifest(load_gain_file(path), choices)
    folder = Path(options.output)
    with locked(folder):
        store = open_store(folder, manifest, options.resume)
        with terminal.progress(manifest.scenarios, "scenarios") as progress:

            def so_far(tally) -> str:
                known = failure_probability(tally)
                text = f"failed {known.value:.3g} ({known.low:.2g} to {known.high:.2g})"
                if options.until_width is None:
                    return text
                needed = scenarios_needed(known.value, options.until_width)
                return f"{text}, about {needed} wanted"

            sweep, tally = run_sweep(
                store,
                lambda rows, _: progress.skip(rows),
                lambda rows, tally: progress.advance(rows, so_far(tally)),
                run_parts if options.scheduler is None else on_cluster(options.scheduler),
            )
        document = _document(options, store, sweep, tally, progress.rate)
        unwritten = _complete(options, store, sweep, document)
    if options.json:
        terminal.emit_json(document)
    else:
        sweep_tables.emit(document)
    if unwritten:
        raise unwritten[0]
    return 0 if document["verdict"] == "good" else 1


def _complete(options: Sweep, store, sweep, document: dict[str, Any]) -> list[InputError]:
    """Add what belongs beside the verdict, and keep all that is known in the store after every step.

    What could not be written is returned, to be reported after the verdict, which no full disk is to cost.
    """
    from tuning.sweeps.pictures import write_pictures
    from tuning.sweeps.run import compare_precisions
    from tuning.sweeps.store import write_verdict

    unwritten: list[InputError] = []

    def plots() -> list[str]:
        with sweep_studies.put_off(unwritten):
            return write_pictures(store, options.acceptable)
        return []

    def keep() -> None:
        with sweep_studies.put_off(unwritten):
            write_verdict(store, terminal.as_json(document))

    steps: dict[str, Callable[[], Any]] = {"plots": plots}
    if store.manifest.precision == "float32":
        steps["float32"] = lambda: compare_precisions(sweep)._asdict()
    if options.drivers is not None:
        steps["drivers"] = lambda: sweep_studies.drivers(options, store, sweep, unwritten)
    if options.rare is not None:
        steps["rare"] = lambda: sweep_studies.rare(options, store, sweep, unwritten)
    keep()
    for key, step in steps.items():
        document[key] = step()
        keep()
    return unwritten


def _check(options: Sweep) -> None:
    checks.at_least(1, scenarios=options.scenarios, chunk=options.chunk)
    checks.at_least(0, seed=options.seed)
    for name, most in (("scenarios", MOST), ("chunk", LARGEST_CHUNK), ("seed", LARGEST_SEED)):
        if getattr(options, name) > most:
            raise InputError(f"--{name}: found {getattr(options, name)}, allowed at most {most}")
    checks.one_of(SAMPLINGS, sampling=options.sampling)
    checks.one_of(PRECISIONS, precision=options.precision)
    checks.limit(options.limit)
    _check_studies(options)
    if (width := options.until_width) is not None:
        if not 0 < width <= 1:
            raise InputError(f"--until-width: found {width}, allowed a width above 0, at most 1")
        if options.sampling != "random":
            raise InputError(f"--until-width: found with --sampling {options.sampling}, allowed with random")
    if options.acceptable is not None and not 0 <= options.acceptable <= 1:
        raise InputError(f"--acceptable: found {options.acceptable}, allowed a probability, 0 to 1")


def _check_studies(options: Sweep) -> None:
    drivers, rare = options.drivers, options.rare
    if drivers is not None and not (2 <= drivers <= MOST_DRIVERS and drivers & (drivers - 1) == 0):
        raise InputError(f"--drivers: found {drivers}, allowed a power of two, 2 to {MOST_DRIVERS}")
    if rare is not None:
        if not (rare == 0 or (math.isfinite(rare) and rare >= options.limit)):
            raise InputError(f"--rare: found {rare}, allowed a finite error, at least --limit")
        if rare == 0 and not math.isfinite(options.limit):
            raise InputError("--rare: found without a limit, allowed with a finite --limit")


def _document(options: Sweep, store, sweep, tally, rate) -> dict[str, Any]:
    from tuning.sweeps.run import describe_outcomes
    from tuning.sweeps.store import read_row
    from tuning.sweeps.tally import error_quantiles, failure_probability

    manifest = store.manifest
    texts = {column.name for column in manifest.columns if column.kind == "text"}
    inputs = [column.name for column in manifest.columns if column.kind == "input"]
    worst = []
    for _, _, index in tally.worst:
        row = read_row(store, index)
        numbers = {name: row[name][0].item() for name in row if name not in texts}
        worst.append(
            {
                "index": index,
                "outcome": _text("outcome", row),
                "worst_error": numbers["worst_error"],
                "worst_contact": _worst_contact(numbers),
                "inputs": {name: numbers[name] for name in inputs},
            }
        )
    probability = failure_probability(tally)
    if options.acceptable is None:
        good = tally.failed == 0
    else:
        good = probability.high <= options.acceptable
    return {
        "store": str(store.folder),
        "gains_sha256": manifest.gains_sha256,
        "mechanism": sweep.mechanism.name,
        "compensator": sweep.loop.compensator.name,
        "scenarios": tally.scenarios,
        "most_scenarios": manifest.scenarios,
        **{key: getattr(manifest, key) for key in ("seed", "sampling", "precision", "limit", "until_width")},
        "failed": tally.failed,
        "failure_probability": probability._asdict(),
        "left_out_of_replicates": tally.left_out,
        "error_quantiles": [one._asdict() for one in error_quantiles(tally)],
        "outcomes": describe_outcomes(tally),
        "worst": worst,
        "scenarios_per_second": rate,
        "acceptable": options.acceptable,
        "verdict": "good" if good else "bad",
    }


def _worst_contact(numbers: dict[str, float]) -> int | None:
    """Number of the contact with the worst error; None if none ended."""
    errors = {name: value for name, value in numbers.items() if name.startswith("error_")}
    return next((int(name[6:]) for name, value in errors.items() if value == numbers["worst_error"]), None)


def _text(name: str, row: dict[str, Any]) -> str:
    from tuning.sweeps.columns import texts_of

    return texts_of(name)[int(row[name][0])]
