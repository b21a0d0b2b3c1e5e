"""Command `jaxhil identify`: estimates a mechanism file from a rig's logs, or compares one with the logs."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import report_write_errors, write_atomically
from jaxhil.mechanism.conversion import KeyProblem
from jaxhil.mechanism.file import from_plain_data, load
from jaxhil.mechanism.overrides import parse_override
from jaxhil.mechanism.structs import Mechanism
from tuning import terminal
from tuning.api import arguments
from tuning.cli.commands import checks, identify_design
from tuning.cli.commands.checkpoints import open_checkpoints, warn_about_checkpoints
from tuning.cli.commands.identify_tables import (
    DOCUMENT_FILE,
    MECHANISM_FILE,
    build_check_table,
    build_document,
    print_estimates,
)
from tuning.cli.options_identify import IdentifyOptions
from tuning.identification.records import DEFAULT_MECHANISM_NAME, Campaign

MAX_ORDER = 4  # highest order of a motion simulator that `--order` accepts
# Comment at the head of the mechanism file, below the comment with the verdict.
SPREAD_COMMENT = """\
[uncertainty] is the uncertainty of the estimate from these logs, of one rig on one day.
It does not include variation with temperature, wear or specimen."""
PLOTS = ("bode.png", "delay.png", "contacts.png", "residuals.png", "compare.png")


def run(options: IdentifyOptions) -> int:
    """Identify the mechanism from logs, and write and print the result.

    `--guess`, `--design` and `--check` replace the identification: they draft a mapping, design rig commands,
    or check a mechanism. Return exit code 1 if the model does not explain the logs, else 0.
    """
    logs = [Path(log) for log in options.logs]
    if options.guess:
        return _print_draft_mapping(options, logs)
    if options.design:
        return identify_design.run(options)
    _check_options(options)
    if options.check:
        return _check_mechanism(options, logs)
    fixed, order = _parse_fixed_values(options), _parse_order(options)
    prior = None if options.prior is None else load(options.prior).mechanism
    folder = Path(options.output)
    checks.prepare_output_folder(folder)
    name = DEFAULT_MECHANISM_NAME if prior is None else prior.name
    earlier = checks.check_earlier_results(
        folder / DOCUMENT_FILE, "estimates", (MECHANISM_FILE, *PLOTS), [name]
    )
    from tuning.identification.bootstrap import FITS_PER_CHUNK
    from tuning.identification.identify import STAGE_COUNT, IdentificationOptions, identify

    checkpoints = open_checkpoints(options.output, options.resume)
    settings = IdentificationOptions(
        order=order,
        law=options.law,
        fixed=fixed,
        bayes=options.bayes,
        hold_out=options.hold_out,
        bootstrap=options.bootstrap,
        limit=options.limit,
        seed=options.seed,
        scheduler=options.scheduler,
        checkpoints=checkpoints,
    )
    with terminal.show_stages(STAGE_COUNT + 2 + -(-options.bootstrap // FITS_PER_CHUNK)) as stages:
        stages.turn_to("reading the logs")
        campaign = _select_stage(read_logs(logs, options.map, prior), options.stage)
        if prior is None:
            _reject_other_logs(folder / DOCUMENT_FILE, earlier, campaign)
        result = identify(campaign, prior, settings, stages.turn_to)
        document = build_document(options, campaign, prior, result)
        if result.mechanism is not None:
            _write(result.mechanism, result.verdict, document, folder)
            stages.turn_to("drawing")
            _draw(result, document, folder)
        checkpoints.remove()
    warn_about_checkpoints(checkpoints)
    terminal.warn([*campaign.notes, *result.notes])
    if options.json:
        terminal.emit_json("identify", document)
    else:
        print_estimates(document, None if result.mechanism is None else folder)
        if result.mechanism is not None:
            # After a bad result, the next step is to design commands for new runs, which determine the
            # parameters better.
            step = ("tune",) if result.good else ("identify", "--design")
            terminal.suggest(*step, str(folder / MECHANISM_FILE))
    return 0 if result.good else 1


def _check_options(options: IdentifyOptions) -> None:
    arguments.check_limit(options.limit)
    arguments.check_integers(0, seed=options.seed, bootstrap=options.bootstrap)
    if not 0.0 <= options.hold_out < 1.0:
        raise InputError(f"--hold-out: found {options.hold_out}, expected a share >= 0 and < 1")
    if options.bayes and options.prior is None:
        raise InputError(
            "--bayes: found no prior, expected --prior with a normal distribution in [uncertainty]"
        )
    for name in ("scheduler", "resume"):
        if getattr(options, name) and not options.bootstrap:
            raise InputError(f"--{name}: found no --bootstrap, expected --bootstrap, whose fits it concerns")


def _write(mechanism: dict[str, Any], verdict: str, document: dict[str, Any], folder: Path) -> None:
    """Write the JSON document, then the mechanism file.

    The order matters: a later run overwrites the mechanism file only if the JSON document exists.
    """
    from tuning.identification.mechanism_file import to_toml

    from_plain_data(mechanism, "identified mechanism")
    with report_write_errors(folder / DOCUMENT_FILE):
        write_atomically(folder / DOCUMENT_FILE, terminal.format_json(document).encode("ascii"))
    with report_write_errors(folder / MECHANISM_FILE):
        write_atomically(folder / MECHANISM_FILE, to_toml(mechanism, f"{verdict}\n{SPREAD_COMMENT}").encode())


def _reject_other_logs(path: Path, earlier: dict[str, Any], campaign: Campaign) -> None:
    """Raise `InputError` if the earlier results in the folder come from none of the campaign's logs.

    Without a prior mechanism, all results have the same default name, so comparing names is not enough.
    """
    sources = earlier.get("sources")
    if not isinstance(sources, dict) or not sources or {*sources.values()} & {*campaign.sources.values()}:
        return
    log, others = next(iter(sources)), f" and {len(sources) - 1} more" if len(sources) > 1 else ""
    raise InputError(
        f"{to_one_line(str(path))}: found results of other logs ({format_value(log)}{others}), expected "
        "an empty folder or results of the same logs: choose another folder with --output, or name the "
        "mechanism with --prior"
    )


def _print_draft_mapping(options: IdentifyOptions, logs: list[Path]) -> int:
    """Print a draft of the file that maps the logs' columns; return exit code 0."""
    from tuning.identification.logs.mapping import TextFormat, load_text_format
    from tuning.identification.logs.mapping_draft import draft_mapping

    text = draft_mapping(logs, TextFormat() if options.map is None else load_text_format(options.map))
    if options.json:
        terminal.emit_json("identify", {"mapping": text})
    else:
        print(text, end="", flush=True)
    return 0


def _check_mechanism(options: IdentifyOptions, logs: list[Path]) -> int:
    """Compare the logs with a mechanism file, and print the result.

    Return the exit code: 1 if the mechanism does not explain the logs, else 0.
    """
    for name in ("order", "law", "fix", "bayes"):
        if getattr(options, name) != getattr(IdentifyOptions(), name):
            raise InputError(
                f"--{name}: found together with --check, expected without it: --check estimates nothing"
            )
    path = options.prior
    if path is None:
        if len(logs) < 2:
            raise InputError("--check: found no mechanism, expected a mechanism after the logs, or --prior")
        path = str(logs.pop())
    mechanism = load(path).mechanism
    from tuning.identification.mechanism_check import check_against_mechanism

    with terminal.show_stages(2) as stages:
        stages.turn_to("reading the logs")
        campaign = _select_stage(read_logs(logs, options.map, mechanism), options.stage)
        stages.turn_to("comparing the logs with the mechanism")
        result = check_against_mechanism(campaign, mechanism, options.limit)
    document = build_document(options, campaign, mechanism, result)
    terminal.warn(campaign.notes)
    if options.json:
        terminal.emit_json("identify", document)
    else:
        runs = ", ".join(f"{number} {kind}" for kind, number in document["runs"].items())
        terminal.emit(
            build_check_table(document, f"What {mechanism.name} does not explain in runs: {runs}"),
            f"{document['reason']}.",
        )
        if result.good:
            terminal.suggest("tune", path)
        else:
            terminal.suggest("identify", *map(str, logs), "--prior", path)
    return 0 if result.good else 1


def _draw(result, document: dict[str, Any], folder: Path) -> None:
    """Write the plots, and delete plots of an earlier run for which this run has no data."""
    from jaxhil.simulation.contact_plot import save_figure
    from tuning.plots.identification import draw_identification

    figures = draw_identification(result, document["estimates"])
    for name in PLOTS:
        with report_write_errors(folder / name):
            if name in figures:
                save_figure(figures[name], folder / name)
            else:
                (folder / name).unlink(missing_ok=True)


def read_logs(logs: list[Path], mapping: str | None, prior: Mechanism | None) -> Campaign:
    """Read log files into a campaign.

    Args:
        logs: paths of the log files.
        mapping: path of the TOML file that states the meaning of the columns; None for the default names.
        prior: mechanism with values that the logs do not contain.

    Returns:
        The runs of all logs, and notes on unusable parts.

    Raises:
        InputError: If a log or the mapping cannot be read.
    """
    from tuning.identification.logs.campaign import read_campaign
    from tuning.identification.logs.mapping import load_mapping

    for log in logs:
        if not log.exists():
            raise InputError(f"{to_one_line(str(log))}: found no such file, expected a log")
    if mapping is not None:
        return read_campaign(logs, load_mapping(mapping), prior)
    try:
        return read_campaign(logs, None, prior)
    except InputError as error:
        raise InputError(
            f"{error} (describe the columns in a mapping file and pass it with --map; --guess writes a draft "
            "of it)"
        ) from None


def _select_stage(campaign: Campaign, stage: str | None) -> Campaign:
    """Return the campaign with only its runs of the kind `stage` and at rest; None keeps all runs."""
    if stage is None:
        return campaign
    runs = tuple(run for run in campaign.runs if run.kind in (stage, "rest"))
    kinds = sorted({run.kind for run in campaign.runs} - {"rest"})
    if stage not in kinds:
        raise InputError(
            f"--stage: found {format_value(stage)}, expected a kind of run in the logs: {', '.join(kinds)}"
        )
    return replace(campaign, runs=runs)


def _parse_order(options: IdentifyOptions) -> int | None:
    """Return the motion simulator's order, or None for 'auto'; raise `InputError` for an invalid order."""
    if options.order == "auto":
        return None
    if not options.order.isdecimal() or int(options.order) > MAX_ORDER:
        raise InputError(f"--order: found {format_value(options.order)}, expected auto, or 0 to {MAX_ORDER}")
    return int(options.order)


def _parse_fixed_values(options: IdentifyOptions) -> dict[str, Any]:
    """Return values by key from the options `--fix KEY=VALUE`; raise `InputError` for wrong texts."""
    fixed: dict[str, Any] = {}
    for text in options.fix:
        try:
            path, value = parse_override(text)
        except KeyProblem as problem:
            raise InputError(f"--fix {to_one_line(text, 60)}: {problem}") from None
        if not _is_number_or_list(value):
            allowed = "a number or a list of numbers"
            raise InputError(
                f"--fix {to_one_line(text, 60)}: found {format_value(value)}, expected {allowed}"
            )
        fixed[".".join(map(str, path))] = value
    return fixed


def _is_number_or_list(value: Any) -> bool:
    """Return whether a value is a finite number or a non-empty list of finite numbers."""
    if isinstance(value, list):
        return bool(value) and all(map(_is_number_or_list, value))
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
