"""`jaxhil sweep`: many scenarios, a failure probability with its interval, and the worst of them."""

import math
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from tuning import report
from tuning.cli import Sweep
from tuning.commands import checks, sweep_tables
from tuning.environment import prepare
from tuning.sweeps import LARGEST_CHUNK, LARGEST_SEED, MOST, PRECISIONS, SAMPLINGS

MOST_DRIVERS = 2**20  # scenarios for each input
STAGE = 10_000  # scenarios between two lines of progress


def run(options: Sweep) -> int:
    """Run what the store lacks, report all of it; 0 if the verdict is good, else 1."""
    _check(options)
    path = checks.gain_file(options.gains)
    prepare()
    from tuning.gain_file import load_gain_file
    from tuning.sweeps.manifest import Choices, build_manifest
    from tuning.sweeps.pictures import write_pictures
    from tuning.sweeps.run import compare_precisions, run_sweep
    from tuning.sweeps.store import locked, open_store
    from tuning.sweeps.tally import failure_probability
    from tuning.verdict import scenarios_needed

    choices = Choices(**{name: getattr(options, name) for name in Choices._fields})
    manifest = build_manifest(load_gain_file(path), choices)
    folder = Path(options.output)
    with locked(folder):
        store = open_store(folder, manifest, options.resume)
        with report.progress(manifest.scenarios, "scenarios") as progress:

            def told(tally) -> str:
                known = failure_probability(tally)
                text = f"failed {known.value:.3g} ({known.low:.2g} to {known.high:.2g})"
                if options.until_width is None:
                    return text
                needed = scenarios_needed(known.value, options.until_width)
                return f"{text}, about {needed} wanted"

            sweep, tally = run_sweep(
                store,
                lambda rows, _: progress.skip(rows),
                lambda rows, tally: progress.advance(rows, told(tally)),
                options.scheduler,
            )
        rate = progress.rate
        plots = write_pictures(store, options.acceptable)
    document = _document(options, store, sweep, tally, rate) | {"plots": plots}
    if manifest.precision == "float32":
        document["float32"] = compare_precisions(sweep)._asdict()
    if options.drivers is not None:
        document["drivers"] = _drivers(options, sweep)
    if options.rare is not None:
        document["rare"] = _rare(options, sweep)
    if options.json:
        report.emit_json(document)
    else:
        sweep_tables.emit(document)
    return 0 if document["verdict"] == "good" else 1


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


def _drivers(options: Sweep, sweep) -> dict[str, Any]:
    from jaxhil.uncertainty import dimensions
    from tuning.drivers import evaluations
    from tuning.sweeps.studies import error_drivers

    number: Any = options.drivers
    # Noise, if there is any, adds an input; the bar need not know.
    with report.progress(evaluations(len(dimensions(sweep.mechanism)), number), "scenarios") as progress:
        return error_drivers(sweep, number, lambda more: progress.advance(more, "drivers"))._asdict()


def _rare(options: Sweep, sweep) -> dict[str, Any]:
    from tuning.sweeps.studies import rare_failure, spread_beyond_formula

    limit = options.rare or options.limit
    ran = 0
    with report.stages(1) as stages:
        stages.begin("subset simulation")

        def done(more: int) -> None:
            nonlocal ran
            ran += more
            if ran % STAGE == 0:
                stages.say(f"subset simulation: {ran} scenarios")

        found = rare_failure(sweep, limit, done)
    kept = ("probability", "low", "high", "coefficient_of_variation", "formula_coefficient_of_variation")
    return {
        "limit": limit,
        **{name: getattr(found, name) for name in (*kept, "evaluations")},
        "estimates": found.estimates.tolist(),
        "spread_beyond_formula": spread_beyond_formula(found),
    }


def _worst_contact(numbers: dict[str, float]) -> int | None:
    """Number of the contact with the worst error; None if none ended."""
    errors = {name: value for name, value in numbers.items() if name.startswith("error_")}
    return next((int(name[6:]) for name, value in errors.items() if value == numbers["worst_error"]), None)


def _text(name: str, row: dict[str, Any]) -> str:
    from tuning.sweeps.columns import texts_of

    return texts_of(name)[int(row[name][0])]
