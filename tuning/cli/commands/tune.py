"""`jaxhil tune`: gains for every mechanism file, judged on scenarios that tuning never saw."""

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line
from jaxhil.mechanism.file import LoadedMechanism, load
from tuning import terminal
from tuning.cli.commands import checks, tune_pareto
from tuning.cli.commands.tune_tables import print_one, print_overview
from tuning.cli.options import Tune
from tuning.environment import prepare, program_folder

MOST_DRAWN = 4  # mechanisms whose plots are drawn; of more there is one picture of all


def run(options: Tune) -> int:
    """Tune file by file. What is finished is written at once and stays, whatever happens to the rest."""
    checks.limit(options.limit)
    checks.at_least(1, starts=options.starts, steps=options.steps, validation=options.validation)
    if options.scenarios is not None:
        checks.at_least(1, scenarios=options.scenarios)
    checks.at_least(0, seed=options.seed)
    checks.compensator(options.compensator)
    tune_pareto.check(options)
    known = _known(options)
    if options.setting is not None:
        prepare()
        checks.setting(options.compensator, options.setting)
    loaded, problems = _load(options)
    entries, interrupted = [], False
    if loaded:
        # Before jax starts: a folder that cannot be written costs no tuning.
        Path(options.output).mkdir(parents=True, exist_ok=True)
        try:
            entries = _tune_all(options, loaded, problems, known)
        except _Interrupted as stop:
            entries, interrupted = stop.entries, True
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
        terminal.note(f"jaxhil: interrupted, {len(entries)} of {len(loaded)} mechanisms finished and kept")
        return 130
    if problems:
        return 2
    return 0 if all(entry["verdict"] == "good" for entry in entries) else 1


class _Interrupted(Exception):
    def __init__(self, entries: list[dict[str, Any]]):
        self.entries = entries


def _known(options: Tune) -> list[Any]:
    """What the gain files to begin at hold, as `tuning.gains.transfer.Tuned`. Raises `InputError`."""
    if not options.start:
        return []
    prepare()
    from tuning.gain_file import load_gain_file
    from tuning.gains.transfer import Tuned

    known = []
    for given in options.start:
        path = Path(given) / "gains.json" if Path(given).is_dir() else given
        found = load_gain_file(path)
        if found.compensator != options.compensator:
            raise InputError(
                f"--start: {one_line(given)}: found gains of {found.compensator}, allowed gains of "
                f"{options.compensator}"
            )
        known.append(Tuned(found.mechanism, found.gains, str(given)))
    return known


def _load(options: Tune) -> tuple[list[LoadedMechanism], list[str]]:
    """The files that can be used, and what is wrong with the others."""
    loaded, problems, folders = [], [], {}
    for file in _expand(options.files, problems):
        try:
            one = load(file, options.overrides)
            folder = folder_name(one.mechanism.name)
            if folder in folders:
                raise InputError(
                    f"{one.label}: name: found {one_line(one.mechanism.name, 60)}, allowed a name whose "
                    f"folder {folder} is not that of {folders[folder]}"
                )
            folders[folder] = one.label
            loaded.append(one)
        except InputError as error:
            problems.append(str(error))
            terminal.note(f"jaxhil: {error}")
    return loaded, problems


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


def folder_name(name: str) -> str:
    """A mechanism's name as the name of a folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "mechanism"


def _tune_all(
    options: Tune, loaded: list[LoadedMechanism], problems: list[str], known: list[Any]
) -> list[dict[str, Any]]:
    prepare()
    from tuning.gains.settings import TuneSettings
    from tuning.gains.tune import tune_all

    settings = TuneSettings(
        options.scenarios,
        options.starts,
        options.steps,
        options.validation,
        options.seed,
        _objective(options),
        global_search=options.certify,
        setting=options.setting,
        judge_transparency=options.pareto_against == "honesty",
    )
    mechanisms = [one.mechanism for one in loaded]
    entries, done, traded = {}, {}, {}
    drawn = len(loaded) <= MOST_DRAWN
    with (
        terminal.stages(len(loaded) * (2 if options.pareto else 1)) as stages,
        ThreadPoolExecutor(1) as meanwhile,
    ):
        if drawn and program_folder() is not None:
            meanwhile.submit(_prepare_drawing, mechanisms[0], options.compensator)
        try:
            for index, result in tune_all(mechanisms, options.compensator, settings, stages.say, known):
                try:
                    entries[index] = _finish(options, loaded[index], result, drawn, stages.say)
                except InputError as error:
                    problems.append(str(error))
                    terminal.note(f"jaxhil: {error}")
                    continue
                done[index] = result
                stages.finish()
                if not options.json and drawn:
                    print_one(options, result, entries[index])
            if options.pareto and done:
                traded = tune_pareto.trade(options, loaded, done, entries, problems, stages)
        except KeyboardInterrupt:
            raise _Interrupted(_in_order(entries)) from None
    if len(loaded) > 1 and done:
        results, finished = _in_order(done), _in_order(entries)
        if not drawn:
            from tuning.pictures.plots import overview_plot, save

            save(overview_plot(results, options.limit), Path(options.output) / "overview.png")
        if not options.json:
            print_overview(options, results, finished, drawn)
    if not options.json and drawn:
        for index in sorted(traded):
            tune_pareto.print_front(options, done[index], traded[index], entries[index]["pareto"])
    elif not options.json and traded:
        terminal.emit(
            f"wrote {options.output}/NAME/pareto/NN/gains.json and {options.output}/NAME/pareto.png", ""
        )
    return _in_order(entries)


def _objective(options: Tune):
    """What is asked for and, where nothing is, what the compensator's kind calls for."""
    from tuning.gains.objective import WEIGHTS, Objective
    from tuning.transparency.probes import default_weights

    given = {name: getattr(options, name) for name in WEIGHTS}
    stated = {name: weight for name, weight in given.items() if weight is not None}
    return Objective(options.objective, **{**default_weights(options.compensator), **stated})


def _in_order(by_index: dict[int, Any]) -> list[Any]:
    return [by_index[index] for index in sorted(by_index)]


def _finish(options: Tune, loaded: LoadedMechanism, result, drawn: bool, say) -> dict[str, Any]:
    """Write what was found for one mechanism."""
    from tuning.gain_file import build_document, validity_envelope, write_gain_file
    from tuning.gains.tasks import has_sensor_noise

    folder = Path(options.output) / folder_name(loaded.mechanism.name)
    folder.mkdir(exist_ok=True)
    document = build_document(
        options.compensator,
        result.gains,
        loaded.mechanism,
        loaded.sha256,
        validity_envelope(loaded.mechanism, result.scenarios),
        {
            "nominal": result.nominal,
            "robust": result.figures,
            "tuned_intervals": result.intervals.plain(),
            **({"honesty": result.transparency} if result.transparency else {}),
        },
        options.seed,
        result.timings,
    )
    write_gain_file(folder / "gains.json", document)
    plots = []
    if drawn:
        say(f"{loaded.mechanism.name}: drawing")
        plots = _draw(result, options, folder)
    tuned = result.figures["tuned"]
    good = tuned.failed == 0 and tuned.rms <= options.limit
    return {
        "mechanism": loaded.mechanism.name,
        "file": loaded.label,
        "compensator": options.compensator,
        "gain_file": str(folder / "gains.json"),
        "plots": plots,
        "gains": document["gains"],
        "literature": result.literature,
        "figures": result.figures,
        "nominal": result.nominal,
        "tuned_intervals": result.intervals.plain(),
        "honesty": result.transparency,
        "starts": [_start(start) for start in result.starts],
        "carried_over": _carried_over(result),
        "freedom": {name: one._asdict() for name, one in result.freedom.items()},
        "certified": result.global_comparison._asdict() if result.global_comparison else None,
        "timings": result.timings,
        "sensor_noise": has_sensor_noise(loaded.mechanism),
        "better_than_literature": is_better(result.figures["tuned"], result.figures["literature"]),
        "verdict": "good" if good else "bad",
    }


def _start(start) -> dict[str, Any]:
    hidden = "coordinates", "curvature"
    return {name: value for name, value in start._asdict().items() if name not in hidden}


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
    from jaxhil.compensators import literature_gains
    from jaxhil.simulation.motion import prepare_motion
    from tuning.gains.tune import uncompensated
    from tuning.pictures import plots  # noqa: F401

    gains = literature_gains(mechanism, compensator)
    prepare_motion(mechanism, {"before": uncompensated(compensator, gains), "tuned": (compensator, gains)})


def is_better(figures, other) -> bool:
    """Fewer contacts that fail or, as many failing, a smaller rms error."""
    return figures.failed < other.failed or (figures.failed == other.failed and figures.rms < other.rms)


def _draw(result, options: Tune, folder: Path) -> list[str]:
    from jaxhil.simulation.motion import nominal_motion
    from tuning.gains.tune import uncompensated
    from tuning.pictures.plots import contact_plot, errors_plot, loss_plot, save

    name, compensator = result.mechanism.name, options.compensator
    before, tuned = uncompensated(compensator, result.literature), (compensator, result.gains)
    motion = nominal_motion(result.mechanism, {"before": before, "tuned": tuned})
    figures = {
        "errors.png": errors_plot(result, options.limit),
        "contact.png": contact_plot(motion, f"{name}: nominal run, {compensator}"),
    }
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
