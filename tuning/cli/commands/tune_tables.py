"""Tables that `jaxhil tune` prints: details of one mechanism, or an overview of many mechanisms."""

import math
from typing import Any

from tuning import terminal
from tuning.api.tune_verdict import describe_verdict
from tuning.cli.options import Tune

# Names of the stages in `TuneResult.timings`, for readers.
STAGE_NAMES = {"judge": "evaluate", "certify": "search globally"}


def print_overview(options: Tune, results: list[Any], entries: list[dict[str, Any]], drawn: bool) -> None:
    """Print a table with one row per mechanism: errors, best start and verdict."""
    rows = []
    # The column is omitted if no contact failed, so that the names have more space.
    some_failed = any(result.figures["tuned"].failed for result in results)
    for result, entry in zip(results, entries, strict=True):
        tuned = result.figures["tuned"]
        best = min(result.starts, key=lambda start: start.rms).status if result.starts else "nothing to tune"
        verdict = entry["verdict"] if entry["better_than_literature"] else "NOT better than by rule"
        rms = (result.figures[key].rms for key in ("before", "literature", "tuned"))
        above = [f"{100 * result.global_comparison.above:+.1f} %"] if result.global_comparison else []
        failed = [tuned.failed] if some_failed else []
        rows.append((entry["mechanism"], *rms, tuned.p99, tuned.peak_ratio, *failed, *above, best, verdict))
    headings = ["mechanism", "before", "by rule", "tuned", "99th pct", "peak ratio"]
    headings += ["not ended"] if some_failed else []
    headings += ["above best"] if results[0].global_comparison else []
    error = (
        "e - e*, or of the twist error in six axes,"
        if any("energy_error" in entry for entry in entries)
        else "e - e*"
    )
    terminal.emit(
        terminal.build_table(
            f"rms of {error} on {options.validation} fresh scenarios each, {options.compensator}",
            [*headings, "best start", "verdict"],
            rows,
            texts=(0, len(headings), len(headings) + 1),
        )
    )
    if not drawn:
        terminal.emit(f"wrote {options.output}/NAME/gains.json and {options.output}/overview.png", "")


def print_result(options: Tune, result: Any, entry: dict[str, Any]) -> None:
    """Print the tuning of one mechanism: tables of errors, gains and starts, and the verdict."""
    if "energy_error" in entry:
        tables = [_six_axis_error_table(options, result, entry)]
    else:
        tables = [_error_table(options, result, entry["better_than_literature"])]
    tables += [_transparency_table(result)] if result.transparency else []
    tables += [*_gain_tables(options, result), *([_start_table(options, result)] if result.starts else [])]
    closing = [*_describe_aim(entry["limit"], result)]
    closing += [f"wrote {path}" for path in (entry["gain_file"], *entry["plots"])]
    if not entry["sensor_noise"]:
        noise = "'{force=0.5,torque=0.05}'" if "energy_error" in entry else "2.67"
        closing.append(
            f"The mechanism has no sensor noise; to add noise: --set rig.force_sensor.noise_std={noise}"
        )
    stages = [(STAGE_NAMES.get(stage, stage), time) for stage, time in result.timings.items()]
    closing.append("took: " + ", ".join(f"{stage} {time:.1f} s" for stage, time in stages))
    terminal.emit(
        *tables, *_describe_confidence(result), *closing, describe_verdict(result, entry["limit"]), ""
    )


def _error_table(options: Tune, result: Any, better: bool) -> Any:
    """Return the table of restitution errors: uncompensated, with the literature's gains, and tuned."""
    names = {"before": "before (uncompensated)", "literature": "literature's rule", "tuned": "tuned"}
    metrics_by_gains, rows = {**result.figures}, []
    if result.without_noise is not None:
        names["without noise"] = "tuned, without noise"
        metrics_by_gains["without noise"] = result.without_noise
    for key, label in names.items():
        metrics = metrics_by_gains[key]
        if key == "tuned" and not better:
            label = "tuned (NOT better than the literature's)"
        peaks = f"{metrics.peak_ratio:.3f}", f"{metrics.chatter:.3f}"
        rows.append((label, *_cells(metrics), *peaks, metrics.failed))
    count = int(result.outcomes["tuned"].is_scheduled.sum())
    return terminal.build_table(
        f"{result.mechanism.name}: errors e - e* of {count} contacts in {options.validation} fresh scenarios",
        ["gains", "rms", "99th pct", "max", "mean", "peak ratio", "chatter", "not ended"],
        rows,
    )


def _six_axis_error_table(options: Tune, result: Any, entry: dict[str, Any]) -> Any:
    """Return the table of a six-axis mechanism's energy and twist errors, before and after tuning."""
    names = {"before": "before (uncompensated)", "literature": "literature's rule", "tuned": "tuned"}
    if not entry["better_than_literature"]:
        names["tuned"] = "tuned (NOT better than the literature's)"
    rows = []
    for key, label in names.items():
        for error in ("energy_error", "twist_error"):
            metrics = entry[error][key]
            cells = *_cells(metrics), f"{metrics.peak_ratio:.3f}", metrics.failed
            rows.append((label if error == "energy_error" else "", error.replace("_", " "), *cells))
    count = int(result.outcomes["tuned"].is_scheduled.sum()) // 2
    return terminal.build_table(
        f"{result.mechanism.name}: errors of {count} episodes in {options.validation} fresh scenarios",
        ["gains", "error", "rms", "99th pct", "max", "mean", "peak ratio", "not ended"],
        rows,
        texts=(0, 1),
    )


def _cells(figures: Any) -> tuple[Any, ...]:
    """Return the table cells of restitution errors: rms, 99th percentile, maximum and mean."""
    return figures.rms, figures.p99, figures.max, f"{figures.mean:+.4f}"


def _gain_tables(options: Tune, result: Any) -> list[Any]:
    """Return a list with the table of gains; the list is empty if the compensator has no gains."""
    from jaxhil.laws.compensators import axes_of, get_compensator

    mechanism = result.mechanism
    columns = ["alone [%]", "together [%]"] if result.tolerances else []
    rows = [
        (
            *(gain.name, gain.unit),
            *(_format_compactly(float(bound(mechanism))) for bound in (gain.lower, gain.upper)),
            _format_compactly(result.literature[gain.name]),
            _format_compactly(result.gains[gain.name], 4) if gain.tuned(mechanism) else "fixed",
            *(
                [f"{100 * share:.1f}" for share in result.tolerances.get(gain.name, ())]
                or [""] * len(columns)
            ),
        )
        for gain in get_compensator(options.compensator, axes_of(mechanism)).gains
    ]
    headings = ["gain", "unit", "lower", "upper", "by rule", "tuned", *columns]
    return (
        [terminal.build_table(f"Gains of {options.compensator}", headings, rows, texts=(0, 1))]
        if rows
        else []
    )


def _format_compactly(value: float, digits: int = 3) -> str:
    """Return a number as text with `digits` significant digits and a short exponent, such as 1.2e6."""
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa


def _describe_aim(limit: float, result: Any) -> list[str]:
    """Return a list with a sentence on the aim of the tuning, least noise or least error.

    The list is empty if the user's options determine the aim.
    """
    from tuning.gains.noise import has_noise_trade_off

    is_sought = result.settings.quiet and has_noise_trade_off(result.compensator)
    if not is_sought or result.without_noise is None or not result.starts:
        return []
    if result.quiet:
        return [
            f"These are the quietest gains within the limit {limit:g}. For the gains with the smallest "
            "error: --noise-weight 0."
        ]
    return [
        f"These are the gains with the smallest error: no gains are clearly within the limit {limit:g}, so "
        "that none could be chosen for little noise."
    ]


def _describe_confidence(result: Any) -> list[str]:
    """Return sentences on the tolerances of the gains, the spread of the starts, and the global search."""
    lines = []
    if result.tolerances:
        lines.append(
            "Tolerance of a gain: its change, in percent of its range, that raises the objective by 1 %: "
            "alone, or together with the other gains readjusted."
        )
    errors = sorted(start.rms for start in result.starts if math.isfinite(start.rms))
    if result.settings.probed and len(errors) > 1:
        above = 100 * (errors[-1] / errors[0] - 1)
        lines.append(
            f"Starts: {len(errors)} of {len(result.starts)} ended; the worst is {above:.1f} % above the best."
        )
    if result.global_comparison:
        search = result.global_comparison
        lines.append(
            f"Global search with {search.evaluations} evaluations: {search.best:.4g}. Tuning with "
            f"{search.spent} evaluations: {search.tuned:.4g}, "
            f"{100 * abs(search.above):.1f} % {'higher' if search.above > 0 else 'lower'}."
        )
    return lines


def _transparency_table(result: Any) -> Any:
    """Return the table of transparency metrics with the literature's and the tuned gains."""
    labels = {"literature": "literature's rule", "tuned": "tuned"}
    rows = [
        [label, *(_format_with_interval(metric) for metric in result.transparency[key].values())]
        for key, label in labels.items()
    ]
    return terminal.build_table(
        "Transparency to an early and a late push, slope of e against e*, peak command (95 %)",
        ["gains", *result.transparency["tuned"]],
        rows,
    )


def _format_with_interval(metric: Any) -> str:
    """Return a metric, given as (value, low, high), with its confidence interval as text."""
    value, low, high = (terminal.format_number(float(number), 3) for number in metric)
    return f"{value} ({low} to {high})"


def _start_table(options: Tune, result: Any) -> Any:
    """Return the table of the solver's starts, with a column for their origin if earlier gains were used."""
    objective_name = "objective" if result.settings.probed else options.objective
    headings = ["start", "status", "steps", f"{objective_name} on training scenarios"]
    rows: list[list[Any]] = [[n, s.status, s.steps, s.rms] for n, s in enumerate(result.starts, start=1)]
    if not result.first:
        return terminal.build_table("Starts", headings, rows, texts=(1,))
    origins = ["literature", *["spread"] * (len(rows) - 1)]
    for number, earlier in enumerate(result.first, start=result.usual_starts):
        origins[number] = f"gains of {earlier.source}"
    rows = [[*row, origin] for row, origin in zip(rows, origins, strict=True)]
    return terminal.build_table("Starts", [*headings, "begins at"], rows, texts=(1, 4))
