"""`jaxhil compare`: every compensator, each tuned to its own best, on the same scenarios."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from jaxhil.mechanism.file import LoadedMechanism, load, suite_names
from jaxhil.runtime.laws import LAWS, PUBLISHED
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import Compare
from tuning.environment import prepare, usable_cores


def run(options: Compare) -> int:
    """Compare; what is finished is reported and written, also when interrupted. 0, 1 if a law failed, or
    130."""
    checks.limit(options.limit)
    checks.at_least(1, scenarios=options.scenarios)
    checks.at_least(2, judged=options.judged)
    checks.at_least(0, seed=options.seed)
    laws = tuple(dict.fromkeys(options.compensators or PUBLISHED))
    for law in laws:
        checks.one_of(LAWS, compensators=law)
    loaded = _load(options)
    Path(options.output).mkdir(parents=True, exist_ok=True)
    prepare()
    from tuning.benchmark.study import CompareSettings, Failed, compare

    settings = CompareSettings(
        options.scenarios,
        judged=options.judged,
        limit=options.limit,
        seed=options.seed,
        tuned=not options.untuned,
    )
    names = [one.mechanism.name for one in loaded]
    found: dict[str, dict[str, Any]] = {name: {} for name in names}
    interrupted, problems = False, []
    with terminal.stages(len(names) * len(laws)) as stages:
        try:
            mechanisms = [one.mechanism for one in loaded]
            for one in compare(mechanisms, laws, settings, usable_cores(), stages.say):
                if isinstance(one, Failed):
                    problems.append(f"{one.law}: {one.reason}")
                    terminal.note(f"jaxhil: {problems[-1]}")
                else:
                    found[one.mechanism][one.law] = one
                    stages.finish()
        except KeyboardInterrupt:
            interrupted = True
    ordered = {name: [found[name][law] for law in laws if law in found[name]] for name in names}
    done = [name for name in names if ordered[name]]
    document = {**_document(options, loaded, ordered), "problems": problems, "interrupted": interrupted}
    (Path(options.output) / "compare.json").write_text(terminal.as_json(document), encoding="utf-8")
    if done and not interrupted:
        _draw(options, done, ordered)
    if options.json:
        terminal.emit_json(document)
    else:
        _print(options, done, ordered, document)
    if interrupted:
        finished = sum(len(own) for own in ordered.values())
        terminal.note(
            f"jaxhil: interrupted, {finished} of {len(names) * len(laws)} results finished and kept"
        )
        return 130
    return 1 if problems else 0


def _load(options: Compare) -> list[LoadedMechanism]:
    files: list[str | None] = [*options.files, *(suite_names() if options.suites else [])]
    loaded = [load(file, options.overrides) for file in files or [None]]
    known: dict[str, str] = {}
    for one in loaded:
        name = one.mechanism.name
        if name in known:
            raise InputError(
                f"{one.label}: name: found {name}, allowed a name other than that of {known[name]}"
            )
        known[name] = one.label
    return loaded


def _document(
    options: Compare,
    loaded: Sequence[LoadedMechanism],
    ordered: Mapping[str, Sequence[Any]],
) -> dict[str, Any]:
    from jaxhil.compensators import COMPENSATORS
    from tuning.benchmark.tables import winners

    return {
        "limit": options.limit,
        "seed": options.seed,
        "scenarios": options.scenarios,
        "judged": options.judged,
        "tuned": not options.untuned,
        "mechanisms": [
            {
                "mechanism": one.mechanism.name,
                "file": one.label,
                "laws": [
                    {
                        "law": own.law,
                        "knows": list(COMPENSATORS[own.law].knows),
                        "gains": own.gains,
                        "figures": own.figures,
                    }
                    for own in ordered[one.mechanism.name]
                ],
                "winners": winners(ordered[one.mechanism.name]) if ordered[one.mechanism.name] else {},
            }
            for one in loaded
        ],
        "timings": {"microseconds_per_tick": _costs(loaded[0], ordered)},
    }


def _costs(loaded: LoadedMechanism, ordered: Mapping[str, Sequence[Any]]) -> dict[str, float]:
    """Of every law with the first mechanism's gains."""
    from tuning.benchmark.cost import microseconds_per_tick
    from tuning.benchmark.study import LITERATURE

    mechanism = loaded.mechanism
    period, clearance = mechanism.rig.control_period, mechanism.contact.clearance
    return {
        own.law: microseconds_per_tick(
            own.law, own.gains[LITERATURE], period, clearance, mechanism.approach.velocity
        )
        for own in ordered[mechanism.name]
    }


def _draw(options: Compare, names: Sequence[str], ordered: Mapping[str, Sequence[Any]]) -> None:
    from tuning.benchmark.plots import errors_plot, transparency_plot
    from tuning.pictures.plots import save

    save(errors_plot(names, ordered, options.limit), Path(options.output) / "errors.png")
    save(transparency_plot(names, ordered), Path(options.output) / "honesty.png")


def _print(
    options: Compare, names: Sequence[str], ordered: Mapping[str, Sequence[Any]], document: dict[str, Any]
) -> None:
    from jaxhil.compensators import COMPENSATORS
    from tuning.benchmark.tables import leaderboard, mechanism_table

    for name in names:
        terminal.emit(mechanism_table(name, ordered[name]))
    if len(names) > 1:
        terminal.emit(leaderboard(names, ordered))
    costs = document["timings"]["microseconds_per_tick"]
    rows = [[law, ", ".join(COMPENSATORS[law].knows) or "nothing", cost] for law, cost in costs.items()]
    terminal.emit(
        terminal.table(
            "What a law must know beforehand, and what it costs",
            ["law", "known beforehand", "Python [us per tick]"],
            rows,
            texts=(0, 1),
        ),
        f"rms, p99, worst: |e - e*|. fail: scenarios beyond {100 * options.limit:g} %, or that do not end.",
        "early, late: transparency to a push on the hardware at 25 and 75 % of the contact (1: perfect, 0: "
        "blind).",
        "slope: of e against e* over damped twins. peak: command over the reference, 99th percentile.",
        "path: x_d off the reference. noise: amplification. *: better than every other law, tuned, by more",
        "than the 95 % intervals.",
        f"wrote {options.output}/compare.json" + (" and pictures" if names else ""),
        "",
    )
