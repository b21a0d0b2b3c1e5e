"""Command `jaxhil tune`: tunes gains for every mechanism file and evaluates them on fresh scenarios."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import make_folder, remove_stale, writing
from jaxhil.mechanism.file import AnyMechanism, LoadedAny, load_any, to_builtins
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.environment import prepare, program_folder
from tuning import terminal
from tuning.cli.commands import checks, tune_pareto
from tuning.cli.commands.checks import folder_name
from tuning.cli.commands.resuming import pieces_in, say_of_pieces
from tuning.cli.commands.tune_tables import print_one, print_overview
from tuning.cli.options import Tune
from tuning.front_door import meaning
from tuning.front_door.tune import tune_each
from tuning.front_door.tuned_gains import TunedGains

if TYPE_CHECKING:
    from tuning.caches.pieces import Pieces

PLOTS = ("errors.png", "contact.png", "loss.png", "pareto.png")
OVERVIEW = "overview.png"
MOST_DRAWN = 4  # largest number of mechanisms with plots each; more mechanisms share one plot


def run(options: Tune) -> int:
    """Tune the mechanisms of all files, and return the exit code.

    The results of a mechanism are written as soon as it is finished. With `--resume`, finished work is not
    repeated.
    """
    if options.pareto:
        prepare()
    options.check()
    if options.start or options.setting is not None:
        # Errors in these options are reported before errors in the files.
        prepare()
        options.settings()
        options.known()
    loaded, problems = _load(options)
    entries, interrupted = [], False
    if loaded:
        # This is checked before jax starts, so that no tuning is lost if the folder cannot be written.
        _check_output(Path(options.output), [entry.mechanism for entry in loaded])
        loaded = _understood(options, loaded, problems)
    if loaded:
        pieces = pieces_in(options.output, options.resume)
        try:
            entries = _tune_all(options, loaded, problems, pieces)
        except _Interrupted as stop:
            entries, interrupted = stop.entries, True
        say_of_pieces(pieces)
    if options.json:
        terminal.emit_json(
            {
                "compensator": options.compensator,
                "limit": options.limit,
                "mechanisms": entries,
                "problems": problems,
                "interrupted": interrupted,
                "verdict": _verdict(entries, problems, interrupted),
            }
        )
    if interrupted:
        finished = f"{len(entries)} of {len(loaded)} mechanisms finished and kept"
        terminal.note(f"jaxhil: interrupted, {finished}; the same with --resume goes on")
        return 130
    if problems:
        if entries:
            # The problems are repeated, because the first notes have scrolled away.
            terminal.note(f"jaxhil: {len(problems)} could not be done:")
            for problem in problems:
                terminal.note(f"jaxhil: {problem}")
        return 2
    return 0 if all(entry["verdict"] == "good" for entry in entries) else 1


def _check_output(output: Path, mechanisms: list[AnyMechanism]) -> None:
    """Raise `InputError` if the output folder holds files that are not results for these mechanisms.

    Warn if only the name of a mechanism is the same.
    """
    checks.output(output)
    for mechanism in mechanisms:
        path = output / folder_name(mechanism.name) / "gains.json"
        earlier = checks.own_results(path, "compensator", PLOTS, [mechanism.name])
        if earlier and earlier.get("mechanism") != to_builtins(mechanism):
            name = shown(mechanism.name)
            terminal.warn([f"{one_line(str(path))}: replaced: it is of another mechanism of the name {name}"])
    if len(mechanisms) > MOST_DRAWN and not any(output.glob("*/gains.json")):
        checks.own_results(output / "gains.json", "compensator", [OVERVIEW])


class _Interrupted(Exception):
    """Error that carries the entries of the mechanisms that were finished before an interruption."""

    def __init__(self, entries: list[dict[str, Any]]):
        self.entries = entries


def _load(options: Tune) -> tuple[list[LoadedAny], list[str]]:
    """Load the mechanism files, and return the usable ones and the problems with the others."""
    loaded, problems, folders = [], [], {}
    for file in _expand(options.files, problems):
        try:
            entry = load_any(file, options.overrides, options.unset)
            options.fits(entry.mechanism)
            folder = folder_name(entry.mechanism.name)
            if (first_label := folders.get(folder.casefold())) is not None:
                raise InputError(
                    f"{entry.label}: name: found {shown(entry.mechanism.name)}, allowed a name whose folder, "
                    f"{one_line(folder)}, differs by more than capitals from that of {first_label}"
                )
            folders[folder.casefold()] = entry.label
            loaded.append(entry)
        except InputError as error:
            problem = getattr(error, "option", str(error))
            problems.append(problem)
            terminal.note(f"jaxhil: {problem}")
    return loaded, problems


def _understood(options: Tune, loaded: list[LoadedAny], problems: list[str]) -> list[LoadedAny]:
    """Return the mechanisms that can be simulated, and print a summary of each; report the others."""
    prepare()
    options.settings()
    usable = []
    for entry in loaded:
        try:
            meaning.check(entry.mechanism, entry.label)
        except InputError as error:
            problems.append(str(error))
            terminal.note(f"jaxhil: {error}")
        else:
            meaning.say(entry.mechanism, None if options.json else terminal.emit_line)
            usable.append(entry)
    return usable


def _expand(files: tuple[str, ...], problems: list[str]) -> list[str | None]:
    """Return every file, a folder replaced by its .toml files; [None] for the default mechanism."""
    expanded: list[str | None] = []
    for file in files:
        if not Path(file).is_dir():
            expanded.append(file)
            continue
        inside = sorted(str(path) for path in Path(file).glob("*.toml"))
        if not inside:
            problems.append(f"{one_line(file)}: found no mechanism file, allowed a folder with .toml files")
            terminal.note(f"jaxhil: {problems[-1]}")
        expanded.extend(inside)
    return expanded if files else [None]


def _tune_all(
    options: Tune,
    loaded: list[LoadedAny],
    problems: list[str],
    pieces: "Pieces",
) -> list[dict[str, Any]]:
    """Tune all mechanisms, write and print the results, and return their entries in order."""
    prepare()
    entries, done, fronts = {}, {}, {}
    drawn = len(loaded) <= MOST_DRAWN
    try:
        with terminal.progress(len(loaded), "mechanisms") as bar, ThreadPoolExecutor(1) as meanwhile:
            if drawn and program_folder() is not None:
                first = loaded[0].mechanism
                if isinstance(first, Mechanism):
                    meanwhile.submit(_prepare_drawing, first, options.compensator)
            for index, result in tune_each(loaded, options, bar, pieces):
                try:
                    entries[index] = _finish(options, loaded[index], result, drawn, bar.say)
                except InputError as error:
                    problems.append(str(error))
                    terminal.note(f"jaxhil: {error}")
                    continue
                done[index] = result
                terminal.warn(f"{result.mechanism.name}: {text}" for text in result.warnings)
                if not options.json and drawn:
                    print_one(options, result.found, entries[index])
        if options.pareto and done:
            with terminal.progress(len(done), "fronts") as bar:
                fronts = tune_pareto.trade(options, done, entries, problems, bar, pieces)
    except KeyboardInterrupt:
        raise _Interrupted(_in_order(entries)) from None
    if len(loaded) > 1 and done:
        _overview(options, [gains.found for gains in _in_order(done)], _in_order(entries), drawn)
    if not options.json and drawn:
        for index in sorted(fronts):
            tune_pareto.print_front(options, done[index].found, fronts[index], entries[index]["pareto"])
    elif not options.json and fronts:
        terminal.emit(
            f"wrote {options.output}/NAME/pareto/NN/gains.json and {options.output}/NAME/pareto.png", ""
        )
    return _in_order(entries)


def _overview(options: Tune, results: list[Any], entries: list[dict[str, Any]], drawn: bool) -> None:
    """Print the table of all mechanisms, and draw one common plot if they have no plots each."""
    if not drawn:
        from jaxhil.simulation.contact_plot import save
        from tuning.plots.tuning_results import overview_plot

        save(overview_plot(results, options.limit), Path(options.output) / OVERVIEW)
    if not options.json:
        print_overview(options, results, entries, drawn)


def _in_order(by_index: dict[int, Any]) -> list[Any]:
    """Return the values of a dictionary, sorted by index."""
    return [by_index[index] for index in sorted(by_index)]


def _finish(
    options: Tune, loaded: LoadedAny, result: TunedGains, drawn: bool, say: Callable[[str], None]
) -> dict[str, Any]:
    """Write the gain file and the plots of one mechanism, and return its entry."""
    from tuning.gains.tasks import has_sensor_noise

    folder = Path(options.output) / folder_name(loaded.mechanism.name)
    with writing(folder):
        make_folder(folder)
        remove_stale(folder)
    result.save(folder / "gains.json")
    tuned, plots = result.found, []
    if drawn:
        say(f"{loaded.mechanism.name}: drawing")
        plots = _draw(tuned, options, folder)
    return {
        "mechanism": loaded.mechanism.name,
        "file": loaded.label,
        "compensator": options.compensator,
        "meaning": result.meaning,
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
        "starts": [_start(start) for start in tuned.starts],
        "carried_over": _carried_over(tuned),
        "freedom": {name: tolerance._asdict() for name, tolerance in tuned.freedom.items()},
        "certified": tuned.global_comparison._asdict() if tuned.global_comparison else None,
        "timings": tuned.timings,
        "sensor_noise": has_sensor_noise(loaded.mechanism),
        "better_than_literature": is_better(tuned.figures["tuned"], tuned.figures["literature"]),
        "verdict": result.verdict,
    }


def _start(start) -> dict[str, Any]:
    """Return the JSON entry of a start of the solver."""
    return {
        name: value for name, value in start._asdict().items() if name not in ("coordinates", "curvature")
    }


def _carried_over(result) -> list[dict[str, Any]]:
    """Return the starts that began at earlier tuned gains, with their mechanisms and distances."""
    from tuning.gains.transfer import distance

    return [
        {
            "start": result.usual_starts + number,
            "source": earlier.source,
            "mechanism": earlier.mechanism.name,
            "distance": distance(result.mechanism, earlier.mechanism),
        }
        for number, earlier in enumerate(result.first, start=1)
    ]


def _prepare_drawing(mechanism, compensator: str) -> None:
    """Import and compile the code for the plots while the solver compiles on another core."""
    from jaxhil.laws.compensators import literature_gains
    from jaxhil.simulation.motion import prepare_motion
    from tuning.gains.tune import uncompensated
    from tuning.plots import tuning_results  # noqa: F401

    gains = literature_gains(mechanism, compensator)
    prepare_motion(mechanism, {"before": uncompensated(compensator, gains), "tuned": (compensator, gains)})


def is_better(figures, other) -> bool:
    """Return whether `figures` have fewer failed contacts or, if equal, a smaller rms error."""
    return figures.failed < other.failed or (figures.failed == other.failed and figures.rms < other.rms)


def _draw(result, options: Tune, folder: Path) -> list[str]:
    """Draw the plots of one mechanism, and return their paths."""
    from jaxhil.simulation.contact_plot import contact_plot, save
    from jaxhil.simulation.motion import nominal_motion
    from tuning.gains.tune import uncompensated
    from tuning.plots.tuning_results import errors_plot, loss_plot, two_errors_plot

    name, compensator = result.mechanism.name, options.compensator
    if isinstance(result.mechanism, Mechanism):
        before, tuned = uncompensated(compensator, result.literature), (compensator, result.gains)
        motion = nominal_motion(result.mechanism, {"before": before, "tuned": tuned})
        figures = {
            "errors.png": errors_plot(result, options.limit),
            "contact.png": contact_plot(motion, f"{name}: nominal run, {compensator}"),
        }
    else:
        figures = {"errors.png": two_errors_plot(result, options.limit)}
    if result.starts:
        figures["loss.png"] = loss_plot(result)
    for file, figure in figures.items():
        save(figure, folder / file)
    return [str(folder / file) for file in figures]


def _verdict(entries, problems, interrupted) -> str:
    """Return the verdict on all mechanisms."""
    if interrupted:
        return "interrupted"
    if problems:
        return "unusable input"
    return "good" if all(entry["verdict"] == "good" for entry in entries) else "bad"
