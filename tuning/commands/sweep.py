"""`jaxhil sweep`: many scenarios, a failure probability with its interval, and the worst of them."""

from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line
from tuning import report
from tuning.cli import Sweep
from tuning.commands import checks
from tuning.environment import prepare
from tuning.sweeps import LARGEST_CHUNK, LARGEST_SEED, MOST, PRECISIONS, SAMPLINGS


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

    choices = Choices(**{name: getattr(options, name) for name in Choices._fields})
    manifest = build_manifest(load_gain_file(path), choices)
    folder = Path(options.output)
    with locked(folder):
        store = open_store(folder, manifest, options.resume)
        with report.progress(manifest.scenarios, "scenarios") as progress:

            def told(tally) -> str:
                known = failure_probability(tally)
                return f"failed {known.value:.3g} ({known.low:.2g} to {known.high:.2g})"

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
    if options.json:
        report.emit_json(document)
    else:
        _print(document)
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
    if options.acceptable is not None and not 0 <= options.acceptable <= 1:
        raise InputError(f"--acceptable: found {options.acceptable}, allowed a probability, 0 to 1")


def _document(options: Sweep, store, sweep, tally, rate) -> dict[str, Any]:
    from tuning.sweeps.run import describe_outcomes
    from tuning.sweeps.store import read_row
    from tuning.sweeps.tally import failure_probability

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
        **{key: getattr(manifest, key) for key in ("scenarios", "seed", "sampling", "precision", "limit")},
        "failed": tally.failed,
        "failure_probability": probability._asdict(),
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


def _print(document: dict[str, Any]) -> None:
    probability, number = document["failure_probability"], document["scenarios"]
    limit = document["limit"]
    title = f"{document['mechanism']}, compensation: {document['compensator']}, {number} scenarios"
    outcomes = report.table(
        f"{title} ({document['sampling']}, {document['precision']})",
        ["outcome", "scenarios", "share"],
        [(name, count, count / number) for name, count in document["outcomes"].items()],
    )
    # All inputs beside each other would not fit; `replay` and the store have them.
    worst = report.table(
        "Worst scenarios",
        ["index", "outcome", "error", "contact"],
        [
            (one["index"], one["outcome"], _signed(one["worst_error"]), report.figure(one["worst_contact"]))
            for one in document["worst"]
        ],
        texts=(1,),
    )
    within = "nothing" if limit is None else f"{limit:g}"
    lines = [
        f"Failure probability {probability['value']:.4g}, 95 % interval {probability['low']:.3g} to "
        f"{probability['high']:.3g} ({probability['method']}); {document['failed']} of {number} failed, "
        f"restitution error allowed {within}."
    ]
    if (compared := document.get("float32")) is not None:
        lines.append(
            f"float32 beside float64 on {compared['scenarios']} scenarios: errors differ by at most "
            f"{report.figure(compared['largest_difference'], 2)}, {compared['changed_outcomes']} outcomes "
            f"changed, {compared['failed_float32']} and {compared['failed_float64']} failed."
        )
    if document["scenarios_per_second"]:
        lines.append(f"{document['scenarios_per_second']:.0f} scenarios per second.")
    acceptable = document["acceptable"]
    wanted = "no scenario may fail" if acceptable is None else f"acceptable up to {acceptable:g}"
    lines.append(f"{document['verdict'].capitalize()}: {wanted}. Wrote {one_line(document['store'])}")
    lines += [f"Wrote {one_line(path)}" for path in document["plots"]]
    report.emit(outcomes, worst, *lines)


def _signed(value: float | None) -> str:
    return "-" if value is None or value != value else f"{value:+.4f}"
