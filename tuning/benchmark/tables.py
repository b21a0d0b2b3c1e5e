"""Tables of a comparison: one per mechanism, and the leaderboard of all."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from tuning import terminal
from tuning.benchmark.study import LITERATURE, TUNED, LawFigures
from tuning.statistics.intervals import Estimate
from tuning.transparency.figures import winner

PERCENT = ("rms", "p99", "worst", "failures", "trajectory")
HEADINGS = {
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
UNBOUNDED = 10_000  # console width [characters] that does not limit a table
MARK = "*"  # marks a metric whose interval is better than those of all other laws


def winners(found: Sequence[LawFigures], which: str = TUNED) -> dict[str, str | None]:
    """Return for every metric the law that wins on one mechanism, each law with its `best` gains."""
    by_law = {result.law: best(result, which) for result in found}
    return {name: winner(name, {law: m[name] for law, m in by_law.items()}) for name in HEADINGS}


def best(found: LawFigures, which: str = TUNED) -> dict[str, Estimate]:
    """Return the metrics with tuned gains or, if there are none, with the literature's."""
    return found.figures.get(which) or found.figures[LITERATURE]


def mechanism_table(name: str, found: Sequence[LawFigures]) -> Table:
    """Return the table of every law with the literature's gains, settings and tuned gains."""
    winning = winners(found)
    rows = []
    for result in found:
        for which, metrics in result.figures.items():
            is_best = metrics is best(result)
            rows.append(
                [
                    result.law if which == LITERATURE else f"  {which}",
                    *(shown(key, metrics[key], is_best and winning[key] == result.law) for key in HEADINGS),
                ]
            )
    tuned = ", then tuned, but for those with settings" * _tuned(found)
    title = f"{name}: each law with the literature's gains{tuned}"
    return _unfolded(terminal.table(title, ["law", *HEADINGS.values()], rows))


def leaderboard(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]]) -> Table:
    """Return the table of rms errors [%] of every law and setting (columns) on every mechanism (rows)."""
    results = [result for name in names for result in found[name]]
    laws = list(dict.fromkeys(result.law for result in results))
    columns = dict.fromkeys((result.law, which) for result in results for which in ("", *result.settings))
    columns = sorted(columns, key=lambda column: laws.index(column[0]))
    winning = {name: winners(found[name])["rms"] for name in names}
    rows = []
    for name in names:
        cells = []
        by_law = {result.law: result for result in found[name]}
        for law, which in columns:
            result = by_law.get(law)
            metrics = result and (result.figures.get(which) if which else best(result))
            cells.append(shown("rms", metrics["rms"], winning[name] == law and not which) if metrics else "-")
        rows.append([name.removeprefix("suite-"), *cells])
    headings = ["", *("\n".join(filter(None, [*law.split("_"), which])) for law, which in columns)]
    tuned = any(map(_tuned, found.values()))
    how = "each law tuned, but for those with settings" if tuned else "each law with the literature's gains"
    table = _unfolded(terminal.table(f"Leaderboard: restitution error, rms [%], {how}", headings, rows))
    table.padding = (0, 0)
    table.width = Console(width=UNBOUNDED).measure(table).maximum
    return table


def least(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]]) -> str:
    """Return a sentence with the law of least rms error per mechanism, regardless of the intervals."""
    led: dict[str, list[str]] = {}
    for name in names:
        errors = {result.law: best(result)["rms"].value for result in found[name]}
        finite = {law: value for law, value in errors.items() if np.isfinite(value)}
        if len(finite) > 1:
            led.setdefault(min(finite, key=lambda law: finite[law]), []).append(name.removeprefix("suite-"))
    ordered = sorted(led.items(), key=lambda item: -len(item[1]))
    texts = (f"{law} ({', '.join(names)})" for law, names in ordered)
    return f"Least rms error: {'; '.join(texts)}." if led else ""


def _tuned(found: Sequence[LawFigures]) -> bool:
    return any(TUNED in result.figures for result in found)


def _unfolded(table: Table) -> Table:
    """Keep names of a table on one line and its columns close together."""
    table.columns[0].no_wrap = True
    table.padding = (0, 1, 0, 0)
    return table


def shown(key: str, figure: Estimate, wins: bool = False) -> str:
    """Return a metric with three digits, and with a mark if it wins."""
    value = 100 * figure.value if key in PERCENT else figure.value
    return terminal.figure(value, 3) + MARK * wins
