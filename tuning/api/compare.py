"""Function `tuning.compare`, which tunes compensators and compares them on the same fresh scenarios."""

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
    from tuning.benchmark.comparison import CompensatorMetrics
    from tuning.caches.checkpoints import Checkpoints


class ComparedMetric(float):
    """Number with its 95 % confidence interval.

    Attributes:
        low: lower end of the interval, in the unit of the number.
        high: upper end of the interval, in the unit of the number.
    """

    low: float
    high: float

    def __new__(cls, value: float, low: float, high: float) -> "ComparedMetric":
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
        figures: metrics by compensator, then by set of gains ("literature", "tuned", or the name of a
            setting). The metrics are the attributes rms, p99, worst, early, late, slope, peak [1] and more;
            each is a `ComparedMetric`.
        gains: gains [SI units] by compensator, then by set of gains as in `figures`, then by the gain's name.
        winners: for each metric, the compensator that is better than all others by more than the confidence
            intervals, or None if there is no such compensator.
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
        text_option(None, "Do not tune: evaluate the literature's gains and the compensators' settings."),
    ] = False
    scenarios: Annotated[int, number_option("Scenarios to tune on."), AllowedValues(1)] = 32
    judged: Annotated[int, number_option("Fresh scenarios for the evaluation."), AllowedValues(2)] = 256
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Restitution error above which a scenario fails."), LimitRange
    ] = 0.01
    seed: Annotated[int, number_option("Seed of scenarios, starts and resampling."), SeedRange] = 0
    scheduler: Scheduler = None

    def check(self) -> None:
        """Raise `InputError` if the value of an option is not allowed."""
        check_options(self)
        arguments.check_compensators(self.laws, "compensators")

    @property
    def laws(self) -> tuple[str, ...]:
        """Return the names of the compensators to compare, each once; by default all built-in ones."""
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
    """Tune compensators for a mechanism, and compare their errors on the same fresh scenarios.

    The metrics equal those of `jaxhil compare`. This function computes them in the current process, whereas
    the command starts a process for each core.

    Args:
        mechanism: result of `jaxhil.load`, or a name or path that `jaxhil.load` accepts; or a list of these.
        compensators: names of built-in or registered compensators; by default all built-in ones. A
            compensator that has settings is evaluated with each setting instead of being tuned.
        progress: report the progress on standard error.
        **options: see `CompareOptions`.

    Returns:
        A `Board` with metrics, gains and winners; for a list of mechanisms, a list of boards.

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
    results: dict[str, dict[str, CompensatorMetrics]] = {entry.mechanism.name: {} for entry in loaded}
    with jax_context(), terminal.show_progress(len(loaded) * len(settings.laws), "results", progress) as bar:
        for result in compare_each(loaded, settings, 0, bar):
            results[result.mechanism][result.compensator] = result
        boards = [build_board(entry, settings, results[entry.mechanism.name]) for entry in loaded]
    return boards if is_list else boards[0]


def compare_each(
    loaded: Sequence[LoadedMechanism],
    options: CompareOptions,
    processes: int,
    bar: terminal.Progress,
    checkpoints: "Checkpoints | None" = None,
) -> Iterator[Any]:
    """Yield the result of each compensator for each mechanism (metrics or failure) as soon as it is known.

    Args:
        loaded: mechanisms.
        options: options of the comparison.
        processes: number of processes; 0 for the current process.
        bar: progress display.
        checkpoints: results of finished work, which is not repeated; new results are added.

    Yields:
        Results of `tuning.benchmark.comparison.compare_compensators`.
    """
    from tuning.benchmark.comparison import CompareSettings, compare_compensators
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
    yield from compare_compensators(
        mechanisms,
        options.laws,
        settings,
        processes,
        bar.tell,
        checkpoints or NO_CHECKPOINTS,
        options.scheduler,
    )


def check_distinct_names(loaded: Sequence[LoadedMechanism]) -> None:
    """Raise `InputError` if two mechanisms have the same name."""
    labels: dict[str, str] = {}
    for entry in loaded:
        name = entry.mechanism.name
        if name in labels:
            raise InputError(
                f"{entry.label}: name: found {name}, expected a name that differs from that of {labels[name]}"
            )
        labels[name] = entry.label


def build_board(
    entry: LoadedMechanism, options: CompareOptions, results: "Mapping[str, CompensatorMetrics]"
) -> Board:
    """Return the comparison for one mechanism, from the results of the finished compensators."""
    from jaxhil.laws.compensators import COMPENSATORS
    from tuning.benchmark.tables import find_winners

    laws = [results[law] for law in options.laws if law in results]
    best = find_winners(laws) if laws else {}
    document = {
        "mechanism": entry.mechanism.name,
        "file": entry.label,
        "laws": [
            {
                "law": result.compensator,
                "knows": list(COMPENSATORS[result.compensator].knows),
                "gains": result.gains,
                "figures": result.figures,
            }
            for result in laws
        ],
        "winners": best,
    }
    figures = {
        result.compensator: {
            gains_name: SimpleNamespace(
                **{name: ComparedMetric(*estimate[:3]) for name, estimate in metrics.items()}
            )
            for gains_name, metrics in result.figures.items()
        }
        for result in laws
    }
    return Board(document, figures, {result.compensator: result.gains for result in laws}, best)


def _as_compensator_list(value: Any) -> list[Any]:
    """Return names of compensators as a list; raise `InputError` if a name is not a text."""
    names, _ = arguments.as_list(value, (str,))
    for name in names:
        if not isinstance(name, str):
            raise arguments.ArgumentError("compensators", format_value(name), "names of compensators")
    return names
