"""Tables of a comparison: one of every mechanism, and the leaderboard of all."""

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
UNBOUNDED = 10_000  # characters
MARK = "*"  # of what is better than all others by more than its interval


def winners(found: Sequence[LawFigures], which: str = TUNED) -> dict[str, str | None]:
    """Of every figure the law that wins on one mechanism, each with the gains `best` of it."""
    figures = {one.law: best(one, which) for one in found}
    return {name: winner(name, {law: own[name] for law, own in figures.items()}) for name in HEADINGS}


def best(found: LawFigures, which: str = TUNED) -> dict[str, Estimate]:
    """Its figures with tuned gains; of a law without gains to tune, the only ones there are."""
    return found.figures.get(which) or found.figures[LITERATURE]


def mechanism_table(name: str, found: Sequence[LawFigures]) -> Table:
    """Every law with the literature's and with tuned gains."""
    won = winners(found)
    rows = []
    for one in found:
        for which, figures in one.figures.items():
            own = figures is best(one)
            rows.append(
                [
                    one.law if which == LITERATURE else f"  {which}",
                    *(shown(key, figures[key], own and won[key] == one.law) for key in HEADINGS),
                ]
            )
    tuned = ", then tuned, but for those with settings" * _tuned(found)
    title = f"{name}: each law with the literature's gains{tuned}"
    return _unfolded(terminal.table(title, ["law", *HEADINGS.values()], rows))


def leaderboard(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]]) -> Table:
    """rms error [%] of every law, tuned if any is, on every mechanism; a column for each of its settings."""
    every = [one for name in names for one in found[name]]
    laws = list(dict.fromkeys(one.law for one in every))
    columns = dict.fromkeys((one.law, which) for one in every for which in ("", *one.settings))
    columns = sorted(columns, key=lambda column: laws.index(column[0]))
    won = {name: winners(found[name])["rms"] for name in names}
    rows = []
    for name in names:
        cells = []
        by_law = {one.law: one for one in found[name]}
        for law, which in columns:
            own = by_law.get(law)
            figures = own and (own.figures.get(which) if which else best(own))
            cells.append(shown("rms", figures["rms"], won[name] == law and not which) if figures else "-")
        rows.append([name.removeprefix("suite-"), *cells])
    headings = ["", *("\n".join(filter(None, [*law.split("_"), which])) for law, which in columns)]
    tuned = any(map(_tuned, found.values()))
    how = "each law tuned, but for those with settings" if tuned else "each law with the literature's gains"
    made = _unfolded(terminal.table(f"Leaderboard: restitution error, rms [%], {how}", headings, rows))
    made.padding = (0, 0)
    made.width = Console(width=UNBOUNDED).measure(made).maximum
    return made


def least(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]]) -> str:
    """Which law has the least rms error, mechanism by mechanism, by more than the intervals or not."""
    led: dict[str, list[str]] = {}
    for name in names:
        errors = {one.law: best(one)["rms"].value for one in found[name]}
        known = {law: value for law, value in errors.items() if np.isfinite(value)}
        if len(known) > 1:
            led.setdefault(min(known, key=lambda law: known[law]), []).append(name.removeprefix("suite-"))
    texts = (
        f"{law} ({', '.join(names)})" for law, names in sorted(led.items(), key=lambda one: -len(one[1]))
    )
    return f"Least rms error: {'; '.join(texts)}." if led else ""


def _tuned(found: Sequence[LawFigures]) -> bool:
    return any(TUNED in one.figures for one in found)


def _unfolded(made: Table) -> Table:
    """Names in one piece, columns close together."""
    made.columns[0].no_wrap = True
    made.padding = (0, 1, 0, 0)
    return made


def shown(key: str, figure: Estimate, wins: bool = False) -> str:
    """A figure in three digits, with a mark where it wins."""
    value = 100 * figure.value if key in PERCENT else figure.value
    return terminal.figure(value, 3) + MARK * wins
