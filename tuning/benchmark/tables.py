"""Tables of a comparison: one per mechanism, and the leaderboard of all."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from tuning import terminal
from tuning.benchmark.comparison import LITERATURE_GAINS, TUNED_GAINS, LawMetrics
from tuning.statistics.intervals import Estimate
from tuning.transparency.metrics import find_winner

PERCENT_METRICS = ("rms", "p99", "worst", "failures", "trajectory")
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
UNLIMITED_WIDTH = 10_000  # console width [characters] that does not limit a table
WINNER_MARK = "*"  # marks a metric whose interval is better than those of all other laws


def find_winners(found: Sequence[LawMetrics], which: str = TUNED_GAINS) -> dict[str, str | None]:
    """Return the best law for every metric on one mechanism, each with its `choose_best_metrics` gains."""
    by_law = {result.law: choose_best_metrics(result, which) for result in found}
    return {name: find_winner(name, {law: m[name] for law, m in by_law.items()}) for name in METRIC_HEADINGS}


def choose_best_metrics(found: LawMetrics, which: str = TUNED_GAINS) -> dict[str, Estimate]:
    """Return the metrics with tuned gains or, if there are none, with the literature's."""
    return found.figures.get(which) or found.figures[LITERATURE_GAINS]


def build_mechanism_table(name: str, found: Sequence[LawMetrics]) -> Table:
    """Return the table of every law with the literature's gains, settings and tuned gains."""
    winning = find_winners(found)
    rows = []
    for result in found:
        for which, metrics in result.figures.items():
            is_best = metrics is choose_best_metrics(result)
            rows.append(
                [
                    result.law if which == LITERATURE_GAINS else f"  {which}",
                    *(
                        format_metric(key, metrics[key], is_best and winning[key] == result.law)
                        for key in METRIC_HEADINGS
                    ),
                ]
            )
    tuned = ", then tuned, but for those with settings" * _has_tuned_gains(found)
    title = f"{name}: each law with the literature's gains{tuned}"
    return _set_compact_style(terminal.build_table(title, ["law", *METRIC_HEADINGS.values()], rows))


def build_leaderboard(names: Sequence[str], found: Mapping[str, Sequence[LawMetrics]]) -> Table:
    """Return the table of rms errors [%] of every law and setting (columns) on every mechanism (rows)."""
    results = [result for name in names for result in found[name]]
    laws = list(dict.fromkeys(result.law for result in results))
    columns = dict.fromkeys((result.law, which) for result in results for which in ("", *result.settings))
    columns = sorted(columns, key=lambda column: laws.index(column[0]))
    winning = {name: find_winners(found[name])["rms"] for name in names}
    rows = []
    for name in names:
        cells = []
        by_law = {result.law: result for result in found[name]}
        for law, which in columns:
            result = by_law.get(law)
            metrics = result and (result.figures.get(which) if which else choose_best_metrics(result))
            cells.append(
                format_metric("rms", metrics["rms"], winning[name] == law and not which) if metrics else "-"
            )
        rows.append([name.removeprefix("suite-"), *cells])
    headings = ["", *("\n".join(filter(None, [*law.split("_"), which])) for law, which in columns)]
    tuned = any(map(_has_tuned_gains, found.values()))
    how = "each law tuned, but for those with settings" if tuned else "each law with the literature's gains"
    table = _set_compact_style(
        terminal.build_table(f"Leaderboard: restitution error, rms [%], {how}", headings, rows)
    )
    table.padding = (0, 0)
    table.width = Console(width=UNLIMITED_WIDTH).measure(table).maximum
    return table


def describe_least_errors(names: Sequence[str], found: Mapping[str, Sequence[LawMetrics]]) -> str:
    """Return a sentence with the law of least rms error per mechanism, regardless of the intervals."""
    led: dict[str, list[str]] = {}
    for name in names:
        errors = {result.law: choose_best_metrics(result)["rms"].value for result in found[name]}
        finite = {law: value for law, value in errors.items() if np.isfinite(value)}
        if len(finite) > 1:
            led.setdefault(min(finite, key=lambda law: finite[law]), []).append(name.removeprefix("suite-"))
    ordered = sorted(led.items(), key=lambda item: -len(item[1]))
    texts = (f"{law} ({', '.join(names)})" for law, names in ordered)
    return f"Least rms error: {'; '.join(texts)}." if led else ""


def _has_tuned_gains(found: Sequence[LawMetrics]) -> bool:
    return any(TUNED_GAINS in result.figures for result in found)


def _set_compact_style(table: Table) -> Table:
    """Keep names of a table on one line and its columns close together."""
    table.columns[0].no_wrap = True
    table.padding = (0, 1, 0, 0)
    return table


def format_metric(key: str, figure: Estimate, wins: bool = False) -> str:
    """Return a metric with three digits, and with a mark if it wins."""
    value = 100 * figure.value if key in PERCENT_METRICS else figure.value
    return terminal.format_number(value, 3) + WINNER_MARK * wins
