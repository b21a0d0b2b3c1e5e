"""Tables of a comparison: one of every mechanism, and the leaderboard of all."""

from collections.abc import Mapping, Sequence

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
    title = f"{name}: each law with the literature's gains{', then tuned' if _tuned(found) else ''}"
    return _unfolded(terminal.table(title, ["law", *HEADINGS.values()], rows))


def leaderboard(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]]) -> Table:
    """rms error [%] of every law, tuned if any is, on every mechanism."""
    laws = list(dict.fromkeys(one.law for name in names for one in found[name]))
    won = {name: winners(found[name])["rms"] for name in names}
    rows = []
    for name in names:
        by_law = {one.law: best(one)["rms"] for one in found[name]}
        cells = [shown("rms", by_law[law], won[name] == law) if law in by_law else "-" for law in laws]
        rows.append([name.removeprefix("suite-"), *cells])
    headings = ["", *(law.replace("_", "\n") for law in laws)]
    tuned = any(_tuned(found[name]) for name in names)
    how = "each law tuned" if tuned else "each law with the literature's gains"
    return _unfolded(terminal.table(f"Leaderboard: restitution error, rms [%], {how}", headings, rows))


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
