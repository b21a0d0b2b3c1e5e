"""Command `jaxhil compare`: tunes compensators, and compares them on the same scenarios."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from jaxhil.files import report_write_errors, write_atomically
from jaxhil.mechanism.file import LoadedAnyMechanism, load_any, suite_names
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.rig import digest
from jaxhil.simulation.jax_environment import count_usable_cores, prepare_jax
from tuning import terminal
from tuning.api.compare import build_board, compare_each
from tuning.cli.commands import checks
from tuning.cli.commands.checkpoints import open_checkpoints, warn_about_checkpoints
from tuning.cli.options import Compare

PLOTS = ("errors.png", "transparency.png")  # for six axes, only the first plot exists


def run(options: Compare) -> int:
    """Compare the compensators, and write and print the results.

    After an interruption, the finished results are written and printed. With `--resume`, finished work is not
    repeated. Return the exit code: 130 after an interruption, 1 if the evaluation of a compensator failed,
    else 0.
    """
    options.check()
    loaded = _load(options)
    options = options.with_defaults(loaded)
    has_six_axes = isinstance(loaded[0].mechanism, SixAxisMechanism)
    folder = Path(options.output)
    checks.prepare_output_folder(folder)
    names = [entry.mechanism.name for entry in loaded]
    checks.check_earlier_results(folder / "compare.json", "mechanisms", PLOTS, names)
    prepare_jax()
    from tuning.benchmark.comparison import CompensatorFailure
    from tuning.transparency.pushes import PUSH_DEFINITION

    laws = options.compensators
    results: dict[str, dict[str, Any]] = {name: {} for name in names}
    interrupted, problems = False, []
    checkpoints = open_checkpoints(options.output, options.resume)
    with terminal.show_progress(len(names) * len(laws), "results") as bar:
        try:
            for result in compare_each(loaded, options, count_usable_cores(), bar, checkpoints):
                if isinstance(result, CompensatorFailure):
                    problems.append(f"{result.compensator}: {result.reason}")
                    terminal.note(f"jaxhil: {problems[-1]}")
                else:
                    results[result.mechanism][result.compensator] = result
        except KeyboardInterrupt:
            interrupted = True
    ordered = {name: [results[name][law] for law in laws if law in results[name]] for name in names}
    finished_names = [name for name in names if ordered[name]]
    verdict = "bad" if problems else "good"
    document = {
        "schema": "jaxhil/compare/1",
        "verdict": terminal.INTERRUPTED if interrupted else verdict,
        **{key: getattr(options, key) for key in ("limit", "seed", "scenarios", "judged")},
        "axes": 6 if has_six_axes else 1,
        "tuned": not options.untuned,
        "transparency": None if has_six_axes else PUSH_DEFINITION,
        "mechanisms": [
            build_board(entry, options, results[entry.mechanism.name]).document for entry in loaded
        ],
        "timings": {"microseconds_per_tick": _measure_tick_times(loaded[0], ordered)},
        "problems": problems,
        "interrupted": interrupted,
    }
    document = terminal.to_json_data(document)
    document["sha256"] = digest(document)
    path = folder / "compare.json"
    with report_write_errors(path):
        write_atomically(path, terminal.format_json(document).encode("ascii"))
    if finished_names and not interrupted:
        _draw(options, finished_names, ordered)
    if options.json:
        terminal.emit_json("compare", document)
    else:
        _print(options, finished_names, ordered, document)
        _suggest_next(options, [result for name in finished_names[:1] for result in ordered[name]])
    warn_about_checkpoints(checkpoints)
    if interrupted:
        finished = sum(len(finished_laws) for finished_laws in ordered.values())
        progress = f"{finished} of {len(names) * len(laws)} results finished and saved"
        terminal.note(f"jaxhil: interrupted, {progress}; to continue, repeat the command with --resume")
        return 130
    return 1 if problems else 0


def _suggest_next(options: Compare, results: Sequence[Any]) -> None:
    """Print the command that tunes the compensator with the smallest rms error on the first mechanism."""
    from tuning.benchmark.tables import choose_best_metrics

    errors = {result.compensator: choose_best_metrics(result)["rms"].value for result in results}
    finite = {name: rms for name, rms in errors.items() if name != "none" and rms < math.inf}
    if finite:
        best = min(finite, key=lambda name: finite[name])
        terminal.suggest("tune", *options.files[:1], "--compensator", best)


def _load(options: Compare) -> list[LoadedAnyMechanism]:
    """Load the mechanisms of the files and, with `--suites`, those of the built-in sets (suites).

    Raise `InputError` if the suites are requested together with a six-axis mechanism.
    """
    files: list[str | None] = [*options.files, *(suite_names() if options.suites else [])]
    loaded = [load_any(file, options.overrides, options.unset) for file in files or [None]]
    if options.suites and isinstance(loaded[0].mechanism, SixAxisMechanism):
        allowed = "no --suites: there are no suites of mechanisms with six axes"
        raise InputError(f"--suites: found the six-axis mechanism {loaded[0].label}, expected {allowed}")
    return loaded


def _measure_tick_times(loaded: LoadedAnyMechanism, ordered: Mapping[str, Sequence[Any]]) -> dict[str, float]:
    """Return the computing time per tick [us] of every compensator, for the first mechanism."""
    from tuning.benchmark.comparison import LITERATURE_GAINS
    from tuning.benchmark.computing_time import measure_tick_time

    mechanism = loaded.mechanism
    return {
        result.compensator: measure_tick_time(mechanism, result.compensator, result.gains[LITERATURE_GAINS])
        for result in ordered[mechanism.name]
    }


def _draw(options: Compare, names: Sequence[str], ordered: Mapping[str, Sequence[Any]]) -> None:
    from jaxhil.simulation.contact_plot import save_figure
    from tuning.plots.comparison import plot_errors, plot_transparency

    assert options.limit is not None
    figures = [plot_errors(names, ordered, options.limit)]
    if ordered[names[0]][0].axes == 1:
        figures.append(plot_transparency(names, ordered))
    for name, figure in zip(PLOTS, figures, strict=False):
        save_figure(figure, Path(options.output) / name)


def _print(
    options: Compare, names: Sequence[str], ordered: Mapping[str, Sequence[Any]], document: dict[str, Any]
) -> None:
    from jaxhil.laws.compensators import get_compensator
    from tuning.benchmark.tables import build_leaderboard, build_mechanism_table, describe_least_errors

    for name in names:
        terminal.emit(build_mechanism_table(name, ordered[name]))
    if len(names) > 1:
        terminal.emit(build_leaderboard(names, ordered), wrap=False)
    if text := describe_least_errors(names, ordered):
        terminal.emit(text)
    costs = document["timings"]["microseconds_per_tick"]
    knowledge = {law: get_compensator(law, document["axes"]).knows for law in costs}
    rows = [[law, ", ".join(knowledge[law]) or "nothing", cost] for law, cost in costs.items()]
    terminal.emit(
        terminal.build_table(
            "Prior knowledge and computing time of each compensator",
            ["compensator", "known beforehand", "Python [us per tick]"],
            rows,
            texts=(0, 1),
        ),
        *_explain_columns(document),
        f"*: better than every other{' tuned' * document['tuned']} compensator by more than the 95 % "
        "intervals.",
        f"wrote {options.output}/compare.json" + (" and plots" if names else ""),
        "",
    )


def _explain_columns(document: Mapping[str, Any]) -> list[str]:
    """Return sentences that explain the columns of the tables."""
    from jaxhil.simulation.contact_bounds import MAX_DURATION_RATIO, MAX_PEAK_FORCE_RATIO, MIN_DURATION_RATIO

    failures = (
        f"fail: scenarios with an error above {100 * document['limit']:g} %, with a contact that does not "
        f"end, or with a real contact above {MAX_PEAK_FORCE_RATIO:g} times the ideal peak force or outside "
        f"{MIN_DURATION_RATIO:g} to {MAX_DURATION_RATIO:g} times the ideal duration."
    )
    if document["axes"] == 6:
        return [
            f"E: energy error. V: twist error. {failures} peak: largest force on the numerical model divided "
            "by the ideal peak force, 99th percentile. not ended: number of contacts that did not end."
        ]
    return [
        f"rms, p99, worst: |e - e*|. {failures}",
        f"early, late: transparency to {document['transparency']} (1: perfect, 0: none). slope: of e against "
        "e* for damping perturbations. peak: peak command divided by the ideal peak force, 99th percentile. "
        "path: trajectory error of x_d. noise: amplification of the sensor noise.",
    ]
