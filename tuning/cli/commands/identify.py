"""`jaxhil identify`: from a rig's logs to a mechanism file, or a mechanism file against a rig's logs."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import write_whole, writing
from jaxhil.mechanism.conversion import KeyProblem
from jaxhil.mechanism.file import from_builtins, load
from jaxhil.mechanism.overrides import parse_override
from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.rig import digest
from jaxhil.simulation.sources import versions
from tuning import terminal
from tuning.cli.commands import checks, identify_design
from tuning.cli.commands.resuming import pieces_in, say_of_pieces
from tuning.cli.options_identify import Identify
from tuning.front_door import arguments
from tuning.identification.records import UNNAMED, Campaign

SCHEMA = "jaxhil/identification/1"
MOST_ORDER = 4
MECHANISM, DOCUMENT = "mechanism.toml", "identification.json"
PICTURES = ("bode.png", "delay.png", "contacts.png", "residuals.png", "compare.png")


def run(options: Identify) -> int:
    """Identify, write and report; 0, or 1 where the model does not explain the rig. Or draft a mapping: 0."""
    logs = [Path(log) for log in options.logs]
    if options.guess:
        return _guess(options, logs)
    if options.design:
        return identify_design.run(options)
    _check_options(options)
    if options.check:
        return _check(options, logs)
    fixed, order = _fixed(options), _order(options)
    prior = None if options.prior is None else load(options.prior).mechanism
    folder = Path(options.output)
    checks.output(folder)
    name = UNNAMED if prior is None else prior.name
    earlier = checks.own_results(folder / DOCUMENT, "estimates", (MECHANISM, *PICTURES), [name])
    from tuning.identification.bootstrap import FITS
    from tuning.identification.estimate import STAGES, Options, identify

    kept = pieces_in(options.output, options.resume)
    asked = Options(
        order=order,
        law=options.law,
        fixed=fixed,
        bayes=options.bayes,
        hold_out=options.hold_out,
        bootstrap=options.bootstrap,
        limit=options.limit,
        seed=options.seed,
        scheduler=options.scheduler,
        kept=kept,
    )
    with terminal.stages(STAGES + 2 + -(-options.bootstrap // FITS)) as stages:
        stages.turn_to("reading the logs")
        campaign = _of_stage(read_logs(logs, options.map, prior), options.stage)
        if prior is None:
            _refuse_other_logs(folder / DOCUMENT, earlier, campaign)
        found = identify(campaign, prior, asked, stages.turn_to)
        document = _document(options, campaign, prior, found)
        if found.mechanism is not None:
            _write(found.mechanism, found.verdict, document, folder)
            stages.turn_to("drawing")
            _draw(found, document, folder)
        kept.remove()
    say_of_pieces(kept)
    terminal.warn([*campaign.notes, *found.notes])
    if options.json:
        terminal.emit_json(document)
    else:
        _print(document, None if found.mechanism is None else folder)
    return 0 if found.good else 1


def _check_options(options: Identify) -> None:
    """Check numbers and combinations of options. Raise `InputError` for what cannot be."""
    arguments.limit(options.limit)
    arguments.integers(0, seed=options.seed, bootstrap=options.bootstrap)
    if not 0.0 <= options.hold_out < 1.0:
        raise InputError(f"--hold-out: found {options.hold_out}, allowed a share from 0 to below 1")
    if options.bayes and options.prior is None:
        raise InputError("--bayes: found no prior, allowed --prior with a normal entry in [uncertainty]")
    for name in ("scheduler", "resume"):
        if getattr(options, name) and not options.bootstrap:
            raise InputError(
                f"--{name}: found no --bootstrap, allowed beside one: its fits are what takes long"
            )


def _write(mechanism: dict[str, Any], verdict: str, document: dict[str, Any], folder: Path) -> None:
    """Write the mechanism and the document; the document first, which tells the next run that the mechanism
    beside it is its own."""
    from tuning.identification.mechanism_file import to_toml

    from_builtins(mechanism, "identified mechanism")
    with writing(folder / DOCUMENT):
        write_whole(folder / DOCUMENT, terminal.as_json(document).encode("ascii"))
    with writing(folder / MECHANISM):
        write_whole(folder / MECHANISM, to_toml(mechanism, verdict).encode())


def _refuse_other_logs(path: Path, earlier: dict[str, Any], campaign: Campaign) -> None:
    """Raise `InputError` if earlier results are those of other logs: no name of a prior tells rigs apart."""
    sources = earlier.get("sources")
    if not isinstance(sources, dict) or not sources or {*sources.values()} & {*campaign.sources.values()}:
        return
    log, others = next(iter(sources)), f" and {len(sources) - 1} more" if len(sources) > 1 else ""
    raise InputError(
        f"{one_line(str(path))}: found results of other logs ({shown(log)}{others}), expected those of the "
        "same logs, or none: name another folder by --output, or the mechanism by --prior"
    )


def _guess(options: Identify, logs: list[Path]) -> int:
    from tuning.identification.logs.guess import draft

    text = draft(logs)
    if options.json:
        terminal.emit_json({"mapping": text})
    else:
        print(text, end="", flush=True)
    return 0


def _check(options: Identify, logs: list[Path]) -> int:
    for name in ("order", "law", "fix", "bayes"):
        if getattr(options, name) != getattr(Identify(), name):
            raise InputError(f"--check: found --{name} beside it, allowed none: nothing is estimated")
    last = options.prior
    if last is None:
        if len(logs) < 2:
            raise InputError("--check: found no mechanism, allowed one after the logs, or --prior")
        last = str(logs.pop())
    mechanism = load(last).mechanism
    from tuning.identification.check import check

    with terminal.stages(2) as stages:
        stages.turn_to("reading the logs")
        campaign = _of_stage(read_logs(logs, options.map, mechanism), options.stage)
        stages.turn_to("setting them against the mechanism")
        found = check(campaign, mechanism, options.limit)
    document = _document(options, campaign, mechanism, found)
    terminal.warn(campaign.notes)
    if options.json:
        terminal.emit_json(document)
    else:
        runs = ", ".join(f"{number} {kind}" for kind, number in document["runs"].items())
        terminal.emit(
            _left(document, f"What {mechanism.name} leaves of runs: {runs}"), f"{document['reason']}."
        )
    return 0 if found.good else 1


def _draw(found, document: dict[str, Any], folder: Path) -> None:
    """Pictures beside the file; one that an earlier run drew, and this one cannot, goes."""
    from jaxhil.simulation.contact_plot import save
    from tuning.identification import pictures

    drawn = pictures.draw(found, document["estimates"])
    for name in PICTURES:
        with writing(folder / name):
            if name in drawn:
                save(drawn[name], folder / name)
            else:
                (folder / name).unlink(missing_ok=True)


def read_logs(logs: list[Path], mapping: str | None, prior: Mechanism | None) -> Campaign:
    """The campaign of log files; `mapping` is the file that says what their columns mean."""
    from tuning.identification.logs.campaign import read_campaign
    from tuning.identification.logs.mapping import load_mapping

    if mapping is not None:
        return read_campaign(logs, load_mapping(mapping), prior)
    try:
        return read_campaign(logs, None, prior)
    except InputError as error:
        raise InputError(f"{error} (--map says what columns mean; --guess drafts one)") from None


def _of_stage(campaign: Campaign, stage: str | None) -> Campaign:
    """The runs of one kind, and those at rest."""
    if stage is None:
        return campaign
    runs = tuple(run for run in campaign.runs if run.kind in (stage, "rest"))
    kinds = sorted({run.kind for run in campaign.runs} - {"rest"})
    if stage not in kinds:
        raise InputError(
            f"--stage: found {shown(stage)}, allowed a kind that the logs have: {', '.join(kinds)}"
        )
    return replace(campaign, runs=runs)


def _order(options: Identify) -> int | None:
    if options.order == "auto":
        return None
    if not options.order.isdecimal() or int(options.order) > MOST_ORDER:
        raise InputError(f"--order: found {shown(options.order)}, allowed auto, or 0 to {MOST_ORDER}")
    return int(options.order)


def _fixed(options: Identify) -> dict[str, Any]:
    fixed: dict[str, Any] = {}
    for text in options.fix:
        try:
            path, value = parse_override(text)
        except KeyProblem as problem:
            raise InputError(f"--fix {one_line(text, 60)}: {problem}") from None
        if not _numbers(value):
            allowed = "a number, or a list of them"
            raise InputError(f"--fix {one_line(text, 60)}: found {shown(value)}, allowed {allowed}")
        fixed[".".join(map(str, path))] = value
    return fixed


def _numbers(value: Any) -> bool:
    """Whether it is a finite number, or a list of them."""
    if isinstance(value, list):
        return bool(value) and all(map(_numbers, value))
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _document(options: Identify, campaign: Campaign, prior: Mechanism | None, found) -> dict[str, Any]:
    kinds = [one.kind for one in campaign.runs]
    clock = campaign.timing.clock
    content = {
        "schema": SCHEMA,
        "estimates": [_entry(one, prior) for one in found.estimates],
        "combinations": [_entry(one, None) for one in found.combinations],
        "confounded": [
            dict(zip(("one", "other", "correlation", "experiment"), pair, strict=True))
            for pair in found.confounded
        ],
        "checks": [
            {
                **{name: getattr(one, name) for name in ("name", "finding", "where")},
                "there": bool(one.there),
                "counts": one.counts,
                "effect": float(one.effect),
                "effect_on_error": float(one.effect if one.on_error is None else one.on_error),
            }
            for one in found.lines
        ],
        "effect": found.effect,
        "effect_on_error": found.effect_on_error,
        "limit": found.limit,
        "verdict": "good" if found.good else "bad",
        "reason": found.verdict,
        "notes": [*campaign.notes, *found.notes],
        "runs": {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)},
        "clock": None if clock is None else {**vars(clock)},
        "sources": campaign.sources,
        "mechanism": found.mechanism,
        "seed": options.seed,
        "versions": versions(),
    }
    plain = terminal.finite(content)
    return {**plain, "sha256": digest(plain)}


def _entry(one, prior: Mechanism | None) -> dict[str, Any]:
    """An estimate, with what the prior says and by how many standard deviations it is off that."""
    told = _told(prior, one.key)
    return {
        "key": one.key,
        "value": one.value,
        "std": one.std,
        "low": one.low,
        "high": one.high,
        "unit": one.unit,
        "known": one.told,
        "prior": told,
        "deviation": None if told is None or not one.std else (one.value - told) / one.std,
    }


def _told(prior: Mechanism | None, key: str) -> float | None:
    """The prior's value of a key; the last entry of a list repeats."""
    if prior is None:
        return None
    path, _, place = key.rpartition(".")
    try:
        value = value_at(prior, path if place.isdigit() else key)
    except AttributeError:
        return None
    if isinstance(value, list):
        value = value[min(int(place or 0), len(value) - 1)] if value and place.isdigit() else None
    return float(value) if isinstance(value, (int, float)) else None


def _print(document: dict[str, Any], folder: Path | None) -> None:
    runs = ", ".join(f"{number} {kind}" for kind, number in document["runs"].items())
    rows = [_row(one) for one in (*document["estimates"], *document["combinations"])]
    headings = ["number", "estimate", "95 % from", "to", "unit", "prior", "off the prior"]
    things: list[Any] = [terminal.table(f"Identified from runs: {runs}", headings, rows, texts=(0, 4))]
    things.append(_left(document, "What the model leaves"))
    things += [
        f"{pair['one']} and {pair['other']} are hardly told apart (correlation {pair['correlation']:.3f}): "
        f"{pair['experiment']} would."
        for pair in document["confounded"]
    ]
    wrote = (
        []
        if folder is None
        else [f"Wrote {folder / MECHANISM}, {folder / DOCUMENT} and pictures beside them"]
    )
    terminal.emit(*things, f"{document['reason']}.", *wrote)


def _left(document: dict[str, Any], title: str) -> Any:
    """The checks as a table."""
    rows = []
    for one in document["checks"]:
        found = ", ".join(filter(None, (one["finding"], one["where"])))
        effects = [
            terminal.figure(one[name] * one["there"], 2) if one["counts"] else "-"
            for name in ("effect", "effect_on_error")
        ]
        rows.append([one["name"], found, *effects])
    return terminal.table(title, ["check", "found", "effect on e", "on e-e*"], rows, (0, 1))


def _row(one: dict[str, Any]) -> list[Any]:
    """Numbers in so many digits as they are known to; how many standard deviations they are off the prior."""
    digits = 4
    if one["std"] and one["value"]:
        digits = min(max(1 + math.ceil(math.log10(abs(one["value"]) / one["std"])), 2), 9)
    off = one["deviation"]
    return [
        one["key"],
        *(terminal.figure(float(one[name]), digits) for name in ("value", "low", "high")),
        one["unit"],
        one["prior"],
        "-" if off is None else f"{off:+.1f} std",
    ]
