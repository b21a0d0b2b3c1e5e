"""Function `tuning.compare`: compares compensators, each tuned, on the same fresh scenarios."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, arg

from jaxhil.errors import InputError, format_value
from jaxhil.laws import built_in_compensators
from jaxhil.mechanism.file import LoadedMechanism
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments, mechanism_summary
from tuning.api.options import (
    AllowedValues,
    LimitRange,
    Scheduler,
    SeedRange,
    add_options,
    check_options,
    number_option,
    text_option,
)

if TYPE_CHECKING:
    from tuning.benchmark.comparison import LawMetrics
    from tuning.caches.checkpoints import Checkpoints


class IntervalEstimate(float):
    """Number with a 95 % confidence interval from `low` to `high`."""

    low: float
    high: float

    def __new__(cls, value: float, low: float, high: float) -> "IntervalEstimate":
        """Create a number with its interval."""
        number = super().__new__(cls, value)
        number.low, number.high = low, high
        return number

    @property
    def value(self) -> float:
        """Return the number without its interval."""
        return float(self)


@dataclass(frozen=True)
class Board:
    """Result of `compare` for one mechanism.

    Attributes:
        document: all results, as `jaxhil compare --json` prints them under `mechanisms`.
        figures: metrics by compensator, then by its gains ("literature", "tuned", or a setting's name), with
            rms, p99, worst, early, late, slope, peak and more, each a number with `low` and `high`.
        gains: gains [SI units] by compensator, by the same names as in `figures`, then by gain.
        winners: for each metric the compensator that is better than all others by more than the confidence
            intervals, or None.
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
        text_option("NAME [NAME ...]", "Compensators to compare; by default all built-in ones."),
    ] = ()
    untuned: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Tune nothing: evaluate the literature's gains and the compensators' settings."),
    ] = False
    scenarios: Annotated[int, number_option("Scenarios to tune on."), AllowedValues(1)] = 32
    judged: Annotated[int, number_option("Fresh scenarios for the evaluation."), AllowedValues(2)] = 256
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Restitution error that counts as a failure."), LimitRange
    ] = 0.01
    seed: Annotated[int, number_option("SeedRange of scenarios, starts and resampling."), SeedRange] = 0
    scheduler: Scheduler = None

    def check(self) -> None:
        """Check all options. Raise `InputError`."""
        check_options(self)
        arguments.check_compensators(self.laws, "compensators")

    @property
    def laws(self) -> tuple[str, ...]:
        """Return the compensators to compare, each once; all built-in ones if none is named."""
        return tuple(dict.fromkeys(self.compensators or built_in_compensators()))


@arguments.convert_os_errors
@add_options(CompareOptions)
def compare(
    mechanism: Any,
    compensators: Sequence[str] = CompareOptions.compensators,
    *,
    progress: bool = False,
    **options: Any,
) -> Any:
    """Compare compensators for a mechanism, each tuned, on the same fresh scenarios, with intervals.

    The metrics equal those of `jaxhil compare`. They are computed in this process; the command starts a
    process for each core.

    Args:
        mechanism: result of `jaxhil.load`, or a name or path that it accepts; or a list of these.
        compensators: names of compensators, built in or registered; by default all built-in ones.
            Compensators with settings use these, the others are tuned.
        progress: report the progress on standard error.
        **options: OPTIONS

    Returns:
        A `Board`, or a list of them for a list of mechanisms.

    Raises:
        InputError: If an argument is unusable; the message has one line.

    Example:
        >>> import tuning
        >>> board = tuning.compare("rig-300kg", ["none", "phase_lead"], untuned=True, judged=8)
        >>> sorted(board.figures)
        ['none', 'phase_lead']
    """
    loaded, is_list = arguments.load_mechanisms(mechanism)
    settings = CompareOptions(compensators=tuple(_as_compensator_list(compensators)), **options)
    settings.check()
    arguments.check_booleans(progress=progress)
    check_distinct_names(loaded)
    results: dict[str, dict[str, LawMetrics]] = {entry.mechanism.name: {} for entry in loaded}
    with jax_context(), terminal.show_progress(len(loaded) * len(settings.laws), "results", progress) as bar:
        for result in compare_each(loaded, settings, 0, bar):
            results[result.mechanism][result.law] = result
        boards = [build_board(entry, settings, results[entry.mechanism.name]) for entry in loaded]
    return boards if is_list else boards[0]


def compare_each(
    loaded: Sequence[LoadedMechanism],
    options: CompareOptions,
    processes: int,
    bar: terminal.Progress,
    pieces: "Checkpoints | None" = None,
) -> Iterator[Any]:
    """Yield the results of `tuning.benchmark.comparison.compare`, as they are finished.

    Work stored in the checkpoints `pieces` is not repeated, and new work is stored there.
    """
    from tuning.benchmark.comparison import CompareSettings, compare_laws
    from tuning.caches.checkpoints import NO_CHECKPOINTS

    settings = CompareSettings(
        options.scenarios,
        judged=options.judged,
        limit=options.limit,
        seed=options.seed,
        tuned=not options.untuned,
    )
    for entry in loaded:
        mechanism_summary.check_can_be_simulated(entry.mechanism, entry.label)
    mechanisms = [entry.mechanism for entry in loaded]
    checkpoints = pieces or NO_CHECKPOINTS
    yield from compare_laws(
        mechanisms, options.laws, settings, processes, bar.tell, checkpoints, options.scheduler
    )


def check_distinct_names(loaded: Sequence[LoadedMechanism]) -> None:
    """Raise `InputError` if two mechanisms have the same name."""
    labels: dict[str, str] = {}
    for entry in loaded:
        name = entry.mechanism.name
        if name in labels:
            raise InputError(
                f"{entry.label}: name: found {name}, expected a name other than that of {labels[name]}"
            )
        labels[name] = entry.label


def build_board(
    entry: LoadedMechanism, options: CompareOptions, results: "Mapping[str, LawMetrics]"
) -> Board:
    """Return the result for one mechanism, from the compensators that are finished."""
    from jaxhil.laws.compensators import COMPENSATORS
    from tuning.benchmark.tables import find_winners

    laws = [results[law] for law in options.laws if law in results]
    best = find_winners(laws) if laws else {}
    document = {
        "mechanism": entry.mechanism.name,
        "file": entry.label,
        "laws": [
            {
                "law": result.law,
                "knows": list(COMPENSATORS[result.law].knows),
                "gains": result.gains,
                "figures": result.figures,
            }
            for result in laws
        ],
        "winners": best,
    }
    figures = {
        result.law: {
            gains_name: SimpleNamespace(
                **{name: IntervalEstimate(*estimate[:3]) for name, estimate in metrics.items()}
            )
            for gains_name, metrics in result.figures.items()
        }
        for result in laws
    }
    return Board(document, figures, {result.law: result.gains for result in laws}, best)


def _as_compensator_list(value: Any) -> list[Any]:
    """Return the names of compensators as a list. Raise `InputError` if one is not a text."""
    names, _ = arguments.as_list(value, (str,))
    for name in names:
        if not isinstance(name, str):
            raise arguments.ArgumentError("compensators", format_value(name), "names of compensators")
    return names
