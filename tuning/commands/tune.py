"""`jaxhil tune`: gains for every mechanism file, judged on scenarios that tuning never saw."""

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line
from jaxhil.mechanism_file import LoadedMechanism, load
from tuning import report
from tuning.cli import Tune
from tuning.commands import checks
from tuning.environment import prepare

STAGES = 3  # of one mechanism: tune, judge, draw


def run(options: Tune) -> int:
    """Tune file by file. What is finished is written at once and stays, whatever happens to the rest."""
    checks.limit(options.limit)
    checks.at_least(1, scenarios=options.scenarios, starts=options.starts, steps=options.steps)
    checks.at_least(1, validation=options.validation)
    checks.at_least(0, seed=options.seed)
    checks.compensator(options.compensator)
    loaded, problems = _load(options)
    entries, interrupted = [], False
    if loaded:
        # Before jax starts: a folder that cannot be written costs no tuning.
        Path(options.output).mkdir(parents=True, exist_ok=True)
        try:
            entries = _tune_all(options, loaded, problems)
        except _Interrupted as stop:
            entries, interrupted = stop.entries, True
    if options.json:
        report.emit_json(
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
        report.note(f"jaxhil: interrupted, {len(entries)} of {len(loaded)} mechanisms finished and kept")
        return 130
    if problems:
        return 2
    return 0 if all(entry["verdict"] == "good" for entry in entries) else 1


class _Interrupted(Exception):
    def __init__(self, entries: list[dict[str, Any]]):
        self.entries = entries


def _load(options: Tune) -> tuple[list[LoadedMechanism], list[str]]:
    """The files that can be used, and what is wrong with the others."""
    loaded, problems, folders = [], [], {}
    for file in options.files or (None,):
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
            report.note(f"jaxhil: {error}")
    return loaded, problems


def folder_name(name: str) -> str:
    """A mechanism's name as the name of a folder."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "mechanism"


def _tune_all(options: Tune, loaded: list[LoadedMechanism], problems: list[str]) -> list[dict[str, Any]]:
    prepare()
    entries = []
    with report.stages(STAGES * len(loaded)) as stages:
        for one in loaded:
            name = one.mechanism.name
            try:
                result, entry = _tune_one(
                    options, one, lambda text, name=name: stages.begin(f"{name}: {text}")
                )
            except KeyboardInterrupt:
                raise _Interrupted(entries) from None
            except InputError as error:
                problems.append(str(error))
                report.note(f"jaxhil: {error}")
                continue
            entries.append(entry)
            if not options.json:
                _print(options, result, entry)
    return entries


def _tune_one(options: Tune, loaded: LoadedMechanism, begin) -> tuple[Any, dict[str, Any]]:
    from tuning.gain_file import build_document, validity_envelope, write_gain_file
    from tuning.tune import Settings, tune

    settings = Settings(options.scenarios, options.starts, options.steps, options.validation, options.seed)
    # Drawing needs a program and a library of its own; the solver's program leaves a core idle meanwhile.
    with ThreadPoolExecutor(1) as meanwhile:
        meanwhile.submit(_prepare_drawing, loaded.mechanism, options.compensator)
        result = tune(loaded.mechanism, options.compensator, settings, begin)
    folder = Path(options.output) / folder_name(loaded.mechanism.name)
    folder.mkdir(exist_ok=True)
    document = build_document(
        options.compensator,
        result.gains,
        loaded.mechanism,
        loaded.sha256,
        validity_envelope(loaded.mechanism, result.scenarios),
        {"nominal": result.nominal, "robust": result.figures},
        options.seed,
        result.timings,
    )
    write_gain_file(folder / "gains.json", document)
    begin("drawing")
    plots = _draw(result, options, folder)
    tuned = result.figures["tuned"]
    good = tuned.failed == 0 and tuned.rms <= options.limit
    entry = {
        "mechanism": loaded.mechanism.name,
        "file": loaded.label,
        "compensator": options.compensator,
        "gain_file": str(folder / "gains.json"),
        "plots": plots,
        "gains": document["gains"],
        "literature": result.literature,
        "figures": result.figures,
        "nominal": result.nominal,
        "starts": result.starts,
        "timings": result.timings,
        "better_than_literature": is_better(result.figures["tuned"], result.figures["literature"]),
        "verdict": "good" if good else "bad",
    }
    return result, entry


def _prepare_drawing(mechanism, compensator: str) -> None:
    from jaxhil.compensators import COMPENSATORS
    from tuning import plots  # noqa: F401
    from tuning.motion import nominal_motion

    literature = {gain.name: float(gain.nominal(mechanism)) for gain in COMPENSATORS[compensator].gains}
    nominal_motion(mechanism, compensator, {"before": literature, "tuned": literature})


def is_better(figures, other) -> bool:
    """Fewer contacts that fail or, as many failing, a smaller rms error."""
    return figures.failed < other.failed or (figures.failed == other.failed and figures.rms < other.rms)


def _draw(result, options: Tune, folder: Path) -> list[str]:
    from tuning.motion import nominal_motion
    from tuning.plots import contact_plot, errors_plot, loss_plot, save
    from tuning.tune import neutral_gains

    name, compensator = result.mechanism.name, options.compensator
    gains = {"before": neutral_gains(compensator, result.literature), "tuned": result.gains}
    motion = nominal_motion(result.mechanism, compensator, gains)
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


def _print(options: Tune, result, entry) -> None:
    from jaxhil.compensators import COMPENSATORS

    law, mechanism = COMPENSATORS[options.compensator].gains, result.mechanism
    names = {"before": "before (no compensation)", "literature": "literature's rule", "tuned": "tuned"}
    rows = []
    for key, label in names.items():
        one = result.figures[key]
        if key == "tuned" and not entry["better_than_literature"]:
            label = "tuned (NOT better than the literature's)"
        rows.append(
            (
                *(label, one.rms, one.p99, one.max, f"{one.mean:+.4f}", f"{100 * one.diverging:.0f} %"),
                *(f"{one.peak_ratio:.3f}", one.failed),
            )
        )
    count = int(result.outcomes["tuned"].wanted.sum())
    errors = report.table(
        f"{mechanism.name}: errors e - e* of {count} contacts in {options.validation} fresh scenarios",
        ["gains", "rms", "99th pct", "max", "mean", "e > e*", "peak ratio", "not ended"],
        rows,
    )
    gains = report.table(
        f"Gains of {options.compensator}",
        ["gain", "unit", "lower", "upper", "literature", "tuned"],
        [
            (
                *(gain.name, gain.unit, float(gain.lower(mechanism)), float(gain.upper(mechanism))),
                result.literature[gain.name],
                result.gains[gain.name] if gain.tuned(mechanism) else "(not tuned)",
            )
            for gain in law
        ],
        texts=(0, 1),
    )
    starts = report.table(
        "Starts",
        ["start", "status", "steps", "rms on training scenarios"],
        [[n, s.status, s.steps, s.rms] for n, s in enumerate(result.starts, start=1)],
        texts=(1,),
    )
    tuned = result.figures["tuned"]
    if entry["verdict"] == "good":
        verdict = f"Good: the tuned rms error {tuned.rms:.2g} is within {options.limit:g}."
    elif tuned.failed:
        verdict = f"Bad: {tuned.failed} contacts did not end with the tuned gains."
    else:
        verdict = f"Bad: the tuned rms error {tuned.rms:.2g} exceeds {options.limit:g}."
    seconds = ", ".join(f"{stage} {time:.1f} s" for stage, time in result.timings.items())
    written = [entry["gain_file"], *entry["plots"]]
    tables = [errors] + ([gains] if law else []) + ([starts] if result.starts else [])
    report.emit(*tables, *(f"wrote {path}" for path in written), f"took: {seconds}", verdict, "")
