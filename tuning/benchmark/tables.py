"""Tables of a comparison: one table for each mechanism, and a leaderboard of all mechanisms."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from tuning import terminal
from tuning.benchmark.comparison import LITERATURE_GAINS, TUNED_GAINS, CompensatorMetrics
from tuning.statistics.intervals import IntervalEstimate
from tuning.transparency.metrics import find_winner

PERCENT_METRICS = ("rms", "p99", "worst", "failures", "trajectory", "energy_rms")
METRIC_HEADINGS = {
    "rms": "rms %",
    "p99": "p99 %",
    "worst": "worst %",
    "failures": "fail %",
    "early": "early",
    "late": "late",
    "slope": "slope",
    "peak": "peak",
    "trajectory": "path %",
    "noise": "noise",
}
SIX_AXIS_METRIC_HEADINGS = {
    "energy_rms": "E rms %",
    "rms": "V rms %",
    "p99": "V p99 %",
    "worst": "V worst %",
    "failures": "fail %",
    "peak": "peak",
    "not_ended": "not ended",
}
ERROR_NAMES = {1: "restitution error", 6: "twist error"}  # error that is compared, by number of axes
UNLIMITED_WIDTH = 10_000  # console width [characters] that does not limit a table
WINNER_MARK = "*"  # marks the metric of a compensator that is significantly better than all others


def choose_metric_headings(axes: int) -> dict[str, str]:
    """Return the metrics of a table, with their headings, for mechanisms with 1 or 6 axes."""
    return SIX_AXIS_METRIC_HEADINGS if axes == 6 else METRIC_HEADINGS


def find_winners(results: Sequence[CompensatorMetrics]) -> dict[str, str | None]:
    """Return for each metric the compensator that is significantly the best on one mechanism, or None."""
    by_law = {result.compensator: choose_best_metrics(result) for result in results}
    headings = choose_metric_headings(results[0].axes)
    return {name: find_winner(name, {law: m[name] for law, m in by_law.items()}) for name in headings}


def choose_best_metrics(result: CompensatorMetrics) -> dict[str, IntervalEstimate]:
    """Return the metrics with the tuned gains or, if there are none, with the literature's gains."""
    return result.figures.get(TUNED_GAINS) or result.figures[LITERATURE_GAINS]


def build_mechanism_table(name: str, results: Sequence[CompensatorMetrics]) -> Table:
    """Build the table of one mechanism: one row for each compensator and set of gains."""
    winners, headings = find_winners(results), choose_metric_headings(results[0].axes)
    rows = []
    for result in results:
        for which, metrics in result.figures.items():
            is_best = metrics is choose_best_metrics(result)
            rows.append(
                [
                    result.compensator if which == LITERATURE_GAINS else f"  {which}",
                    *(
                        format_metric(key, metrics[key], is_best and winners[key] == result.compensator)
                        for key in headings
                    ),
                ]
            )
    tuned = ", then tuned, except those with settings" * _has_tuned_gains(results)
    title = f"{name}: each compensator with the literature's gains{tuned}"
    return _set_compact_style(terminal.build_table(title, ["compensator", *headings.values()], rows))


def build_leaderboard(names: Sequence[str], results: Mapping[str, Sequence[CompensatorMetrics]]) -> Table:
    """Build the table of the rms restitution or twist errors [%], with a row for each mechanism.

    Each compensator has one column, and a further one for each of its settings (named sets of gains).
    """
    flat = [result for name in names for result in results[name]]
    laws = list(dict.fromkeys(result.compensator for result in flat))
    columns = dict.fromkeys(
        (result.compensator, which) for result in flat for which in ("", *result.settings)
    )
    columns = sorted(columns, key=lambda column: laws.index(column[0]))
    winners = {name: find_winners(results[name])["rms"] for name in names}
    rows = []
    for name in names:
        cells = []
        by_law = {result.compensator: result for result in results[name]}
        for law, which in columns:
            result = by_law.get(law)
            metrics = result and (result.figures.get(which) if which else choose_best_metrics(result))
            cells.append(
                format_metric("rms", metrics["rms"], winners[name] == law and not which) if metrics else "-"
            )
        rows.append([name.removeprefix("suite-"), *cells])
    headings = ["", *("\n".join(filter(None, [*law.split("_"), which])) for law, which in columns)]
    tuned = any(map(_has_tuned_gains, results.values()))
    how = (
        "each compensator tuned, except those with settings"
        if tuned
        else "each compensator with the literature's gains"
    )
    table = _set_compact_style(
        terminal.build_table(f"Leaderboard: {ERROR_NAMES[flat[0].axes]}, rms [%], {how}", headings, rows)
    )
    table.padding = (0, 0)
    table.width = Console(width=UNLIMITED_WIDTH).measure(table).maximum
    return table


def describe_least_errors(names: Sequence[str], results: Mapping[str, Sequence[CompensatorMetrics]]) -> str:
    """Return a sentence that names the compensator with the smallest rms error on each mechanism.

    The sentence ignores the intervals, so that a difference may not be significant.
    """
    leading: dict[str, list[str]] = {}
    for name in names:
        errors = {result.compensator: choose_best_metrics(result)["rms"].value for result in results[name]}
        finite = {law: value for law, value in errors.items() if np.isfinite(value)}
        if len(finite) > 1:
            best = min(finite, key=lambda law: finite[law])
            leading.setdefault(best, []).append(name.removeprefix("suite-"))
    ordered = sorted(leading.items(), key=lambda item: -len(item[1]))
    texts = (f"{law} ({', '.join(names)})" for law, names in ordered)
    return f"Least rms error: {'; '.join(texts)}." if leading else ""


def _has_tuned_gains(results: Sequence[CompensatorMetrics]) -> bool:
    return any(TUNED_GAINS in result.figures for result in results)


def _set_compact_style(table: Table) -> Table:
    table.columns[0].no_wrap = True
    table.padding = (0, 1, 0, 0)
    return table


def format_metric(key: str, metric: IntervalEstimate, wins: bool = False) -> str:
    """Return a metric as text with three digits, followed by `WINNER_MARK` if it `wins`."""
    value = 100 * metric.value if key in PERCENT_METRICS else metric.value
    return terminal.format_number(value, 3) + WINNER_MARK * wins
