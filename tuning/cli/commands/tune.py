"""`jaxhil tune`: gains for every mechanism file, judged on scenarios that tuning never saw."""

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

PICTURES = ("errors.png", "contact.png", "loss.png", "pareto.png")
OVERVIEW = "overview.png"
MOST_DRAWN = 4  # mechanisms whose plots are drawn; of more there is one picture of all


def run(options: Tune) -> int:
    """Tune file by file. What is finished is written at once and stays, whatever happens to the rest; to
    resume, it is not tuned again."""
    if options.pareto:
        prepare()
    options.check()
    if options.start or options.setting is not None:
        # What is wrong with these is reported before what is wrong with the files.
        prepare()
        options.settings()
        options.known()
    loaded, problems = _load(options)
    entries, interrupted = [], False
    if loaded:
        # Before jax starts: a folder that cannot be written costs no tuning.
        _check_output(Path(options.output), [one.mechanism for one in loaded])
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
            # What was said of them at once has scrolled away.
            terminal.note(f"jaxhil: {len(problems)} could not be done:")
            for problem in problems:
                terminal.note(f"jaxhil: {problem}")
        return 2
    return 0 if all(entry["verdict"] == "good" for entry in entries) else 1


def _check_output(output: Path, mechanisms: list[AnyMechanism]) -> None:
    """What is to be replaced there is of an earlier run for the same mechanisms. Raises `InputError`.

    Warn where only the name is the same.
    """
    checks.output(output)
    for one in mechanisms:
        path = output / folder_name(one.name) / "gains.json"
        found = checks.own_results(path, "compensator", PICTURES, [one.name])
        if found and found.get("mechanism") != to_builtins(one):
            terminal.warn(
                [f"{one_line(str(path))}: replaced: it is of another mechanism of the name {shown(one.name)}"]
            )
    if len(mechanisms) > MOST_DRAWN and not any(output.glob("*/gains.json")):
        checks.own_results(output / "gains.json", "compensator", [OVERVIEW])


class _Interrupted(Exception):
    def __init__(self, entries: list[dict[str, Any]]):
        self.entries = entries


def _load(options: Tune) -> tuple[list[LoadedAny], list[str]]:
    """The files that can be used, and what is wrong with the others."""
    loaded, problems, folders = [], [], {}
    for file in _expand(options.files, problems):
        try:
            one = load_any(file, options.overrides, options.unset)
            options.fits(one.mechanism)
            folder = folder_name(one.mechanism.name)
            if (other := folders.get(folder.casefold())) is not None:
                raise InputError(
                    f"{one.label}: name: found {shown(one.mechanism.name)}, allowed a name whose folder, "
                    f"{one_line(folder)}, differs by more than capitals from that of {other}"
                )
            folders[folder.casefold()] = one.label
            loaded.append(one)
        except InputError as error:
            problem = getattr(error, "option", str(error))
            problems.append(problem)
            terminal.note(f"jaxhil: {problem}")
    return loaded, problems


def _understood(options: Tune, loaded: list[LoadedAny], problems: list[str]) -> list[LoadedAny]:
    """The mechanisms that can be run; of each it is said what it means."""
    prepare()
    options.settings()
    kept = []
    for one in loaded:
        try:
            meaning.check(one.mechanism, one.label)
        except InputError as error:
            problems.append(str(error))
            terminal.note(f"jaxhil: {error}")
        else:
            meaning.say(one.mechanism, None if options.json else terminal.emit_line)
            kept.append(one)
    return kept


def _expand(files: tuple[str, ...], problems: list[str]) -> list[str | None]:
    """Every file, a directory standing for its .toml files; the default mechanism if nothing is given."""
    expanded: list[str | None] = []
    for file in files:
        if not Path(file).is_dir():
            expanded.append(file)
            continue
        found = sorted(str(path) for path in Path(file).glob("*.toml"))
        if not found:
            problems.append(f"{one_line(file)}: found no mechanism file, allowed a folder with .toml files")
            terminal.note(f"jaxhil: {problems[-1]}")
        expanded.extend(found)
    return expanded if files else [None]


def _tune_all(
    options: Tune,
    loaded: list[LoadedAny],
    problems: list[str],
    pieces: "Pieces",
) -> list[dict[str, Any]]:
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
        _overview(options, [one.found for one in _in_order(done)], _in_order(entries), drawn)
    if not options.json and drawn:
        for index in sorted(fronts):
            tune_pareto.print_front(options, done[index].found, fronts[index], entries[index]["pareto"])
    elif not options.json and fronts:
        terminal.emit(
            f"wrote {options.output}/NAME/pareto/NN/gains.json and {options.output}/NAME/pareto.png", ""
        )
    return _in_order(entries)


def _overview(options: Tune, results: list[Any], entries: list[dict[str, Any]], drawn: bool) -> None:
    """All mechanisms in one table and, where none has pictures of its own, in one picture."""
    if not drawn:
        from jaxhil.simulation.contact_plot import save
        from tuning.pictures.plots import overview_plot

        save(overview_plot(results, options.limit), Path(options.output) / OVERVIEW)
    if not options.json:
        print_overview(options, results, entries, drawn)


def _in_order(by_index: dict[int, Any]) -> list[Any]:
    return [by_index[index] for index in sorted(by_index)]


def _finish(
    options: Tune, loaded: LoadedAny, result: TunedGains, drawn: bool, say: Callable[[str], None]
) -> dict[str, Any]:
    """Write what was found for one mechanism."""
    from tuning.gains.tasks import has_sensor_noise

    folder = Path(options.output) / folder_name(loaded.mechanism.name)
    with writing(folder):
        make_folder(folder)
        remove_stale(folder)
    result.save(folder / "gains.json")
    found, plots = result.found, []
    if drawn:
        say(f"{loaded.mechanism.name}: drawing")
        plots = _draw(found, options, folder)
    return {
        "mechanism": loaded.mechanism.name,
        "file": loaded.label,
        "compensator": options.compensator,
        "meaning": result.meaning,
        "gain_file": str(folder / "gains.json"),
        "plots": plots,
        "gains": result.document["gains"],
        "literature": found.literature,
        "figures": found.figures,
        **result.parts,
        "nominal": found.nominal,
        "without_noise": result.without_noise,
        **result.command._asdict(),
        "quietest_within_limit": found.quiet,
        "warnings": result.warnings,
        "tuned_intervals": found.intervals.plain() if found.intervals else None,
        "honesty": found.transparency,
        "starts": [_start(start) for start in found.starts],
        "carried_over": _carried_over(found),
        "freedom": {name: one._asdict() for name, one in found.freedom.items()},
        "certified": found.global_comparison._asdict() if found.global_comparison else None,
        "timings": found.timings,
        "sensor_noise": has_sensor_noise(loaded.mechanism),
        "better_than_literature": is_better(found.figures["tuned"], found.figures["literature"]),
        "verdict": result.verdict,
    }


def _start(start) -> dict[str, Any]:
    return {
        name: value for name, value in start._asdict().items() if name not in ("coordinates", "curvature")
    }


def _carried_over(result) -> list[dict[str, Any]]:
    """Which starts began at gains tuned before, and for what mechanism."""
    from tuning.gains.transfer import distance

    return [
        {
            "start": result.usual_starts + number,
            "source": one.source,
            "mechanism": one.mechanism.name,
            "distance": distance(result.mechanism, one.mechanism),
        }
        for number, one in enumerate(result.first, start=1)
    ]


def _prepare_drawing(mechanism, compensator: str) -> None:
    """Import and compile what drawing needs, while the solver's program compiles on another core."""
    from jaxhil.laws.compensators import literature_gains
    from jaxhil.simulation.motion import prepare_motion
    from tuning.gains.tune import uncompensated
    from tuning.pictures import plots  # noqa: F401

    gains = literature_gains(mechanism, compensator)
    prepare_motion(mechanism, {"before": uncompensated(compensator, gains), "tuned": (compensator, gains)})


def is_better(figures, other) -> bool:
    """Fewer contacts that fail or, as many failing, a smaller rms error."""
    return figures.failed < other.failed or (figures.failed == other.failed and figures.rms < other.rms)


def _draw(result, options: Tune, folder: Path) -> list[str]:
    from jaxhil.simulation.contact_plot import contact_plot, save
    from jaxhil.simulation.motion import nominal_motion
    from tuning.gains.tune import uncompensated
    from tuning.pictures.plots import errors_plot, loss_plot, two_errors_plot

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
    if interrupted:
        return "interrupted"
    if problems:
        return "unusable input"
    return "good" if all(entry["verdict"] == "good" for entry in entries) else "bad"
