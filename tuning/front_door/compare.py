"""`tuning.compare`: several compensators, each tuned to its own best, judged on the same fresh scenarios."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, arg

from jaxhil.errors import InputError, shown
from jaxhil.laws import names
from jaxhil.mechanism.file import LoadedMechanism
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments, meaning
from tuning.front_door.options import Allowed, AnyLimit, Scheduler, Seed, check_options, number, takes, text

if TYPE_CHECKING:
    from tuning.benchmark.study import LawFigures
    from tuning.caches.pieces import Pieces


class Estimated(float):
    """A number with an interval of 95 %, from `low` to `high`."""

    low: float
    high: float

    def __new__(cls, value: float, low: float, high: float) -> "Estimated":
        made = super().__new__(cls, value)
        made.low, made.high = low, high
        return made

    @property
    def value(self) -> float:
        """The number alone."""
        return float(self)


@dataclass(frozen=True)
class Board:
    """What `compare` returns of one mechanism.

    document: all that is known of it, as in `jaxhil compare --json` under `mechanisms`.
    figures: by law, then by its gains ("literature", "tuned", or a setting's name), with rms, p99, worst,
        early, late, slope, peak and more, each a number with `low` and `high`.
    gains: by law, then by name as in `figures`: the gains [SI units].
    winners: of each figure the law that is better than every other by more than the intervals, or None.
    """

    document: dict[str, Any]
    figures: dict[str, dict[str, Any]]
    gains: dict[str, dict[str, dict[str, float]]]
    winners: dict[str, str | None]


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Options of `compare`."""

    compensators: Annotated[
        tuple[str, ...],
        text("NAME [NAME ...]", "Compensators to compare; by default all that are published and our own."),
    ] = ()
    untuned: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Tune nothing: judge the literature's gains, and a compensator's settings, as they are."),
    ] = False
    scenarios: Annotated[int, number("Scenarios to tune on."), Allowed(1)] = 32
    judged: Annotated[int, number("Fresh scenarios to judge on."), Allowed(2)] = 256
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Restitution error that counts as a failure."), AnyLimit
    ] = 0.01
    seed: Annotated[int, number("Seed of scenarios, starts and resampling."), Seed] = 0
    scheduler: Scheduler = None

    def check(self) -> None:
        """Check all options. Raises `InputError`."""
        check_options(self)
        arguments.compensators(self.laws, "compensators")

    @property
    def laws(self) -> tuple[str, ...]:
        """Return the compensators to compare, each once; all built-in ones if none is named."""
        return tuple(dict.fromkeys(self.compensators or names()))


@arguments.entry
@takes(CompareOptions)
def compare(
    mechanism: Any,
    compensators: Sequence[str] = CompareOptions.compensators,
    *,
    progress: bool = False,
    **options: Any,
) -> Any:
    """Compensators for a mechanism, each tuned to its best, on the same fresh scenarios, with intervals.

    The figures are those of `jaxhil compare`. They are computed in this process, where that command starts
    one for each core.

    Args:
        mechanism: what `jaxhil.load` returns, or a name or path for it; or a list of those.
        compensators: names of laws, built in or registered; by default all that are published and our own.
            Laws with settings are judged with these, the others tuned.
        progress: say on standard error what is going on.
    OPTIONS

    Returns:
        A `Board`; a list of them for a list of mechanisms.

    Raises:
        InputError: one line, for an argument that will not do.
    """
    loaded, several = arguments.mechanisms(mechanism)
    asked = CompareOptions(compensators=tuple(_names(compensators)), **options)
    asked.check()
    arguments.flags(progress=progress)
    check_names(loaded)
    found: dict[str, dict[str, LawFigures]] = {one.mechanism.name: {} for one in loaded}
    with computing(), terminal.progress(len(loaded) * len(asked.laws), "results", progress) as bar:
        for one in compare_each(loaded, asked, 0, bar):
            found[one.mechanism][one.law] = one
        boards = [board(one, asked, found[one.mechanism.name]) for one in loaded]
    return boards if several else boards[0]


def compare_each(
    loaded: Sequence[LoadedMechanism],
    options: CompareOptions,
    processes: int,
    bar: terminal.Progress,
    pieces: "Pieces | None" = None,
) -> Iterator[Any]:
    """What `tuning.benchmark.study.compare` finds, as it is done. What is among the `pieces` is taken from
    there, and the rest kept there."""
    from tuning.benchmark.study import CompareSettings, compare
    from tuning.caches.pieces import NOTHING_KEPT

    settings = CompareSettings(
        options.scenarios,
        judged=options.judged,
        limit=options.limit,
        seed=options.seed,
        tuned=not options.untuned,
    )
    for one in loaded:
        meaning.check(one.mechanism, one.label)
    mechanisms = [one.mechanism for one in loaded]
    kept = pieces or NOTHING_KEPT
    yield from compare(mechanisms, options.laws, settings, processes, bar.tell, kept, options.scheduler)


def check_names(loaded: Sequence[LoadedMechanism]) -> None:
    """Mechanisms are told apart by their names. Raises `InputError` where two have one."""
    known: dict[str, str] = {}
    for one in loaded:
        name = one.mechanism.name
        if name in known:
            raise InputError(
                f"{one.label}: name: found {name}, allowed a name other than that of {known[name]}"
            )
        known[name] = one.label


def board(one: LoadedMechanism, options: CompareOptions, found: "Mapping[str, LawFigures]") -> Board:
    """What is said of one mechanism, of the laws that are done."""
    from jaxhil.laws.compensators import COMPENSATORS
    from tuning.benchmark.tables import winners

    laws = [found[law] for law in options.laws if law in found]
    won = winners(laws) if laws else {}
    document = {
        "mechanism": one.mechanism.name,
        "file": one.label,
        "laws": [
            {
                "law": own.law,
                "knows": list(COMPENSATORS[own.law].knows),
                "gains": own.gains,
                "figures": own.figures,
            }
            for own in laws
        ],
        "winners": won,
    }
    figures = {
        own.law: {
            which: SimpleNamespace(**{name: Estimated(*each[:3]) for name, each in several.items()})
            for which, several in own.figures.items()
        }
        for own in laws
    }
    return Board(document, figures, {own.law: own.gains for own in laws}, won)


def _names(given: Any) -> list[Any]:
    names, _ = arguments.several(given, (str,))
    for name in names:
        if not isinstance(name, str):
            raise arguments.ArgumentError("compensators", shown(name), "names of compensators")
    return names
