"""Command `jaxhil tune`: tunes gains for each mechanism file, and evaluates them on fresh scenarios."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import make_folder, remove_stale, report_write_errors
from jaxhil.mechanism.file import AnyMechanism, LoadedAnyMechanism, load_any, to_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.jax_environment import prepare_jax, program_folder
from tuning import terminal
from tuning.api import mechanism_summary
from tuning.api.tune import tune_each
from tuning.api.tuned_gains import TunedGains
from tuning.cli.commands import checks, tune_pareto
from tuning.cli.commands.checkpoints import open_checkpoints, warn_about_checkpoints
from tuning.cli.commands.checks import make_folder_name
from tuning.cli.commands.tune_tables import print_overview, print_result
from tuning.cli.options import Tune

if TYPE_CHECKING:
    from tuning.caches.checkpoints import Checkpoints

PLOTS = ("one_contact.png", "errors.png", "contact.png", "loss.png", "pareto.png")
OVERVIEW_FILE = "overview.png"
MAX_PLOTTED_MECHANISMS = 4  # if there are more, all share an overview plot


def run(options: Tune) -> int:
    """Tune the mechanisms of all files, and return the exit code.

    The results of a mechanism are written as soon as its tuning is finished. With `--resume`, finished work
    is not repeated. The exit code is 0 if all verdicts are good, 1 if a verdict is bad, 2 if a file is
    unusable, and 130 after an interruption.
    """
    if options.pareto:
        prepare_jax()
    options.check()
    if options.start or options.setting is not None:
        # Errors in these options are reported before errors in the mechanism files.
        prepare_jax()
        options.settings()
        options.load_start_gains()
    loaded, problems = _load(options)
    entries, interrupted = [], False
    if loaded:
        # The folder is checked before tuning, because the results would be lost if it were not writable.
        _check_output(Path(options.output), [entry.mechanism for entry in loaded])
        loaded = _check_mechanisms(options, loaded, problems)
    if loaded:
        checkpoints = open_checkpoints(options.output, options.resume)
        try:
            entries = _tune_all(options, loaded, problems, checkpoints)
        except _TuningInterrupted as interruption:
            entries, interrupted = interruption.entries, True
        warn_about_checkpoints(checkpoints)
    if options.json and problems and not entries and not interrupted:
        terminal.emit_json_error("tune", terminal.UNUSABLE_INPUT, problems)
    elif options.json:
        terminal.emit_json(
            "tune",
            {
                "compensator": options.compensator,
                "limit": entries[0]["limit"] if entries else options.limit,
                "mechanisms": entries,
                "problems": problems,
                "interrupted": interrupted,
                "verdict": _verdict(entries, problems, interrupted),
            },
        )
    elif entries:
        _suggest_next(options, entries)
    if interrupted:
        finished = f"{len(entries)} of {len(loaded)} mechanisms finished and saved"
        terminal.note(f"jaxhil: interrupted, {finished}; to continue, repeat the command with --resume")
        return 130
    if problems:
        if entries:
            # The problems are printed again, because their first output is far above.
            terminal.note(f"jaxhil: {len(problems)} {'problem' if len(problems) == 1 else 'problems'}:")
            for problem in problems:
                terminal.note(f"jaxhil: {problem}")
        return 2
    return 0 if all(entry["verdict"] == "good" for entry in entries) else 1


def _suggest_next(options: Tune, entries: list[dict[str, Any]]) -> None:
    """Print the next command: a sweep of the first good gains; if none are good, a comparison."""
    good = [entry["gain_file"] for entry in entries if entry["verdict"] == "good"]
    if good:
        terminal.suggest("sweep", good[0])
        return
    changes = [("--set", change) for change in options.overrides]
    changes += [("--unset", change) for change in options.unset]
    terminal.suggest("compare", *options.files[:1], *(word for change in changes for word in change))


def _check_output(output: Path, mechanisms: list[AnyMechanism]) -> None:
    """Raise `InputError` if a file that is not a result for these mechanisms would be overwritten.

    Print a warning if the earlier results are for a different mechanism with the same name.
    """
    checks.prepare_output_folder(output)
    for mechanism in mechanisms:
        path = output / make_folder_name(mechanism.name) / "gains.json"
        earlier = checks.check_earlier_results(path, "compensator", PLOTS, [mechanism.name])
        if earlier and earlier.get("mechanism") != to_plain_data(mechanism):
            name = format_value(mechanism.name)
            terminal.warn(
                [f"{to_one_line(str(path))}: replaced; it was for a different mechanism with the name {name}"]
            )
    if len(mechanisms) > MAX_PLOTTED_MECHANISMS and not any(output.glob("*/gains.json")):
        checks.check_earlier_results(output / "gains.json", "compensator", [OVERVIEW_FILE])


class _TuningInterrupted(Exception):
    """Exception for an interrupted tuning, with the JSON entries of the finished mechanisms."""

    def __init__(self, entries: list[dict[str, Any]]):
        self.entries = entries


def _load(options: Tune) -> tuple[list[LoadedAnyMechanism], list[str]]:
    """Load the mechanism files; return the usable mechanisms, and a message for each unusable file."""
    loaded, problems, folders = [], [], {}
    for file in _expand_folders(options.files, problems):
        try:
            entry = load_any(file, options.overrides, options.unset)
            options.check_mechanism(entry.mechanism)
            folder = make_folder_name(entry.mechanism.name)
            if (first_label := folders.get(folder.casefold())) is not None:
                raise InputError(
                    f"{entry.label}: name: found {format_value(entry.mechanism.name)}, whose folder "
                    f"{to_one_line(folder)} is also that of {first_label}, expected a name with a different "
                    "folder, even without distinction of upper and lower case"
                )
            folders[folder.casefold()] = entry.label
            loaded.append(entry)
        except InputError as error:
            problem = getattr(error, "option", str(error))
            problems.append(problem)
            terminal.note(f"jaxhil: {problem}")
    return loaded, problems


def _check_mechanisms(
    options: Tune, loaded: list[LoadedAnyMechanism], problems: list[str]
) -> list[LoadedAnyMechanism]:
    """Return the mechanisms that can be simulated, and print their summaries.

    For each of the others, add a message to `problems` and print it.
    """
    prepare_jax()
    options.settings()
    usable = []
    for entry in loaded:
        try:
            mechanism_summary.check_can_be_simulated(entry.mechanism, entry.label)
        except InputError as error:
            problems.append(str(error))
            terminal.note(f"jaxhil: {error}")
        else:
            mechanism_summary.report_summary(entry.mechanism, None if options.json else terminal.emit)
            usable.append(entry)
    return usable


def _expand_folders(files: tuple[str, ...], problems: list[str]) -> list[str | None]:
    """Return the files, with each folder replaced by its .toml files; [None] if `files` is empty.

    For a folder without .toml files, add a message to `problems` and print it.
    """
    expanded: list[str | None] = []
    for file in files:
        if not Path(file).is_dir():
            expanded.append(file)
            continue
        inside = sorted(str(path) for path in Path(file).glob("*.toml"))
        if not inside:
            problems.append(
                f"{to_one_line(file)}: found no mechanism file, expected a folder with .toml files"
            )
            terminal.note(f"jaxhil: {problems[-1]}")
        expanded.extend(inside)
    return expanded if files else [None]


def _tune_all(
    options: Tune,
    loaded: list[LoadedAnyMechanism],
    problems: list[str],
    checkpoints: "Checkpoints",
) -> list[dict[str, Any]]:
    """Tune all mechanisms, write and print the results, and return the JSON entries of the mechanisms.

    Raise `_TuningInterrupted` after an interruption.
    """
    prepare_jax()
    entries, done, fronts = {}, {}, {}
    drawn = len(loaded) <= MAX_PLOTTED_MECHANISMS
    try:
        with terminal.show_progress(len(loaded), "mechanisms") as bar, ThreadPoolExecutor(1) as meanwhile:
            if drawn and program_folder() is not None:
                first = loaded[0].mechanism
                if isinstance(first, Mechanism):
                    meanwhile.submit(_prepare_drawing, first, options.compensator)
            for index, result in tune_each(loaded, options, bar, checkpoints, terminal.note):
                try:
                    entries[index] = _write_result(options, loaded[index], result, drawn, bar.say)
                except InputError as error:
                    problems.append(str(error))
                    terminal.note(f"jaxhil: {error}")
                    continue
                done[index] = result
                terminal.warn(f"{result.mechanism.name}: {text}" for text in result.warnings)
                if not options.json and drawn:
                    print_result(options, result.tune_result, entries[index])
        if options.pareto and done:
            with terminal.show_progress(len(done), "fronts") as bar:
                fronts = tune_pareto.compute_fronts(options, done, entries, problems, bar, checkpoints)
    except KeyboardInterrupt:
        raise _TuningInterrupted(_sort_by_index(entries)) from None
    if len(loaded) > 1 and done:
        _show_overview(
            options,
            [gains.tune_result for gains in _sort_by_index(done)],
            _sort_by_index(entries),
            drawn,
        )
    if not options.json and drawn:
        for index in sorted(fronts):
            tune_pareto.print_front(options, done[index].tune_result, fronts[index], entries[index])
    elif not options.json and fronts:
        terminal.emit(
            f"wrote {options.output}/NAME/pareto/NN/gains.json and {options.output}/NAME/pareto.png", ""
        )
    return _sort_by_index(entries)


def _show_overview(options: Tune, results: list[Any], entries: list[dict[str, Any]], drawn: bool) -> None:
    """Print the table of all mechanisms; unless each mechanism has its own plots, write a common plot."""
    if not drawn:
        from jaxhil.simulation.contact_plot import save_figure
        from tuning.plots.tuning_results import overview_plot

        save_figure(overview_plot(results, entries[0]["limit"]), Path(options.output) / OVERVIEW_FILE)
    if not options.json:
        print_overview(options, results, entries, drawn)


def _sort_by_index(by_index: dict[int, Any]) -> list[Any]:
    return [by_index[index] for index in sorted(by_index)]


def _write_result(
    options: Tune, loaded: LoadedAnyMechanism, result: TunedGains, drawn: bool, say: Callable[[str], None]
) -> dict[str, Any]:
    """Write the gain file and, if `drawn`, the plots of one mechanism; return its JSON entry."""
    from tuning.gains.tasks import has_sensor_noise

    folder = Path(options.output) / make_folder_name(loaded.mechanism.name)
    with report_write_errors(folder):
        make_folder(folder)
        remove_stale(folder)
    result.save(folder / "gains.json")
    tuned, plots = result.tune_result, []
    if drawn:
        say(f"{loaded.mechanism.name}: drawing")
        plots = _draw(tuned, options, result.limit, folder)
    return {
        "mechanism": loaded.mechanism.name,
        "file": loaded.label,
        "compensator": options.compensator,
        "limit": result.limit,
        "meaning": result.summary,
        "gain_file": str(folder / "gains.json"),
        "plots": plots,
        "gains": result.document["gains"],
        "literature": tuned.literature,
        "figures": tuned.figures,
        **result.parts,
        "nominal": tuned.nominal,
        "without_noise": result.without_noise,
        **result.command._asdict(),
        "quietest_within_limit": tuned.quiet,
        "warnings": result.warnings,
        "tuned_intervals": tuned.intervals.plain() if tuned.intervals else None,
        "honesty": tuned.transparency,
        "starts": [_start_entry(start) for start in tuned.starts],
        "carried_over": _starts_from_earlier_gains(tuned),
        "freedom": {name: tolerance._asdict() for name, tolerance in tuned.tolerances.items()},
        "certified": tuned.global_comparison._asdict() if tuned.global_comparison else None,
        "timings": tuned.timings,
        "sensor_noise": has_sensor_noise(loaded.mechanism),
        "better_than_literature": is_better(tuned.figures["tuned"], tuned.figures["literature"]),
        "verdict": result.verdict,
    }


def _start_entry(start) -> dict[str, Any]:
    """Return the JSON entry of one start of the solver: status, steps and history of the objective."""
    return {
        name: value for name, value in start._asdict().items() if name not in ("coordinates", "curvature")
    }


def _starts_from_earlier_gains(result) -> list[dict[str, Any]]:
    """Return a JSON entry for each start from earlier tuned gains.

    The entry contains the number of the start, and the source of its gains. It names the mechanism for which
    these gains were tuned, and states the distance of that mechanism from the tuned one.
    """
    from tuning.gains.transfer import compute_mechanism_distance

    return [
        {
            "start": result.usual_starts + number,
            "source": earlier.source,
            "mechanism": earlier.mechanism.name,
            "distance": compute_mechanism_distance(result.mechanism, earlier.mechanism),
        }
        for number, earlier in enumerate(result.first, start=1)
    ]


def _prepare_drawing(mechanism, compensator: str) -> None:
    """Import and compile the code for the plots while the solver is compiled.

    The function simulates one motion and discards it, because the gains are not tuned yet.
    """
    from jaxhil.laws.compensators import literature_gains
    from jaxhil.simulation.motion_curves import compute_nominal_motion
    from tuning.gains.tune import remove_compensation
    from tuning.plots import tuning_results  # noqa: F401

    gains = literature_gains(mechanism, compensator)
    compute_nominal_motion(
        mechanism, {"before": remove_compensation(compensator, gains), "tuned": (compensator, gains)}
    )


def is_better(metrics, other) -> bool:
    """Return whether `metrics` has fewer failed contacts than `other` or, if equally many, a smaller rms."""
    return metrics.failed < other.failed or (metrics.failed == other.failed and metrics.rms < other.rms)


def _draw(result, options: Tune, limit: float, folder: Path) -> list[str]:
    """Write the plots of one mechanism's tuning to a folder, and return their paths."""
    from jaxhil.simulation.contact_plot import plot_contacts, save_figure
    from jaxhil.simulation.motion_curves import compute_nominal_motion
    from tuning.gains.tune import remove_compensation
    from tuning.plots.one_contact import describe_contact, plot_one_contact
    from tuning.plots.tuning_results import errors_plot, loss_plot, six_axis_errors_plot

    name, compensator = result.mechanism.name, options.compensator
    if isinstance(result.mechanism, Mechanism):
        before, tuned = remove_compensation(compensator, result.literature), (compensator, result.gains)
        motion = compute_nominal_motion(result.mechanism, {"before": before, "tuned": tuned})
        figures = {
            "errors.png": errors_plot(result, limit),
            "contact.png": plot_contacts(motion, f"{name}: nominal run, {compensator}"),
        }
        if describe_contact(motion[0]) is not None:
            figures["one_contact.png"] = plot_one_contact(motion[0], name)
    else:
        figures = {"errors.png": six_axis_errors_plot(result, limit)}
    if result.starts:
        figures["loss.png"] = loss_plot(result)
    for file, figure in figures.items():
        save_figure(figure, folder / file)
    return [str(folder / file) for file in figures]


def _verdict(entries, problems, interrupted) -> str:
    """Return the verdict: "good" if the gains of every mechanism are good, else "bad".

    After an interruption or with an unusable file, return that reason instead of a verdict.
    """
    if interrupted:
        return terminal.INTERRUPTED
    if problems:
        return terminal.UNUSABLE_INPUT
    return "good" if all(entry["verdict"] == "good" for entry in entries) else "bad"
