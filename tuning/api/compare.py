"""Function `tuning.compare`, which tunes compensators and compares them on the same fresh scenarios."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, Self

from tyro.conf import FlagCreatePairsOff

from jaxhil.errors import InputError, format_value
from jaxhil.laws import built_in_compensators
from jaxhil.mechanism.file import LoadedAnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments, mechanism_summary
from tuning.api.options import (
    AllowedValues,
    OptionalLimit,
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
            setting). The metrics are the attributes rms, p99, worst, early, late, slope, peak [1] and more
            (see `tuning.transparency.metrics`); each is a `ComparedMetric`. For six axes, rms, p99 and worst
            are those of the twist error; energy_rms (rms energy error) and not_ended (number of episodes that
            did not end) are added, and early, late, slope, trajectory and noise do not exist.
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
        text_option(
            "NAME [NAME ...]", "Compensators to compare; by default all built-in ones for the number of axes."
        ),
    ] = ()
    untuned: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Do not tune: evaluate the literature's gains and the compensators' settings."),
    ] = False
    scenarios: Annotated[int, number_option("Scenarios to tune on."), AllowedValues(1)] = 32
    judged: Annotated[
        int, number_option("Fresh scenarios for the evaluation.", name="evaluated"), AllowedValues(2)
    ] = 256
    limit: OptionalLimit = None
    seed: Annotated[int, number_option("Seed of scenarios, starts and resampling."), SeedRange] = 0
    scheduler: Scheduler = None

    def check(self) -> None:
        """Raise `InputError` if the value of an option is not allowed."""
        check_options(self)
        for name in self.compensators:
            arguments.check_supports_mechanism(name, None, "compensators")

    def with_defaults(self, loaded: Sequence[LoadedAnyMechanism]) -> Self:
        """Return the options with the defaults of compensators and limit, which depend on the number of axes.

        Raise `InputError` if two mechanisms have the same name or different numbers of axes, or if a
        compensator does not support the number of axes.
        """
        check_mechanisms(loaded)
        mechanism = loaded[0].mechanism
        names = self.compensators or built_in_compensators(6 if _has_six_axes(loaded[0]) else 1)
        for name in names:
            arguments.check_supports_mechanism(name, mechanism, "compensators")
        limit = arguments.choose_limit(self.limit, mechanism)
        return replace(self, compensators=tuple(dict.fromkeys(names)), limit=limit)


@arguments.convert_os_errors
@add_options(CompareOptions)
def compare(
    mechanism: Any,
    compensators: Sequence[str] = CompareOptions.compensators,
    *,
    progress: bool = False,
    **options: Any,
) -> Any:
    """Tune compensators for a mechanism, and compare their errors in the same, newly drawn scenarios.

    The metrics equal those of `jaxhil compare`. This function computes them in the current process, whereas
    the command starts a process for each core.

    Args:
        mechanism: result of `jaxhil.load`, or a name or path that `jaxhil.load` accepts; or a list of these,
            all with the same number of axes.
        compensators: names of built-in or registered compensators; by default all built-in ones for the
            mechanism's number of axes. A compensator that has settings (named sets of gains) is evaluated
            with each setting instead of being tuned.
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
    loaded, is_list = arguments.load_any_mechanisms(mechanism)
    settings = CompareOptions(compensators=tuple(_as_compensator_list(compensators)), **options)
    settings.check()
    arguments.check_booleans(progress=progress)
    settings = settings.with_defaults(loaded)
    results: dict[str, dict[str, CompensatorMetrics]] = {entry.mechanism.name: {} for entry in loaded}
    number = len(loaded) * len(settings.compensators)
    with jax_context(), terminal.show_progress(number, "results", progress) as bar:
        for result in compare_each(loaded, settings, 0, bar):
            results[result.mechanism][result.compensator] = result
        boards = [build_board(entry, settings, results[entry.mechanism.name]) for entry in loaded]
    return boards if is_list else boards[0]


def compare_each(
    loaded: Sequence[LoadedAnyMechanism],
    options: CompareOptions,
    processes: int,
    bar: terminal.Progress,
    checkpoints: "Checkpoints | None" = None,
) -> Iterator[Any]:
    """Yield the result of each compensator for each mechanism (metrics or failure) as soon as it is known.

    Args:
        loaded: mechanisms.
        options: options of the comparison, from `CompareOptions.with_defaults`.
        processes: number of processes; 0 for the current process.
        bar: progress display.
        checkpoints: cache of finished results, which are not computed again; new results are added.

    Yields:
        Results of `tuning.benchmark.comparison.compare_compensators`.
    """
    from tuning.benchmark.comparison import CompareSettings, compare_compensators
    from tuning.caches.checkpoints import NO_CHECKPOINTS

    assert options.limit is not None
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
        options.compensators,
        settings,
        processes,
        bar.tell,
        checkpoints or NO_CHECKPOINTS,
        options.scheduler,
    )


def check_mechanisms(loaded: Sequence[LoadedAnyMechanism]) -> None:
    """Raise `InputError` if two mechanisms have the same name or different numbers of axes."""
    labels: dict[str, str] = {}
    for entry in loaded:
        if (has_six := _has_six_axes(entry)) != _has_six_axes(loaded[0]):
            axes = ("six axes", "one axis") if has_six else ("one axis", "six axes")
            raise InputError(
                f"{entry.label}: found a mechanism with {axes[0]}, expected one with {axes[1]}, as "
                f"{loaded[0].label}: their errors cannot be compared"
            )
        name = entry.mechanism.name
        if name in labels:
            raise InputError(
                f"{entry.label}: name: found {name}, expected a name that differs from that of {labels[name]}"
            )
        labels[name] = entry.label


def _has_six_axes(entry: LoadedAnyMechanism) -> bool:
    return isinstance(entry.mechanism, SixAxisMechanism)


def build_board(
    entry: LoadedAnyMechanism, options: CompareOptions, results: "Mapping[str, CompensatorMetrics]"
) -> Board:
    """Build the `Board` of one mechanism from the results of the compensators that are finished."""
    from jaxhil.laws.compensators import axes_of, get_compensator
    from tuning.benchmark.tables import find_winners

    axes = axes_of(entry.mechanism)
    laws = [results[law] for law in options.compensators if law in results]
    best = find_winners(laws) if laws else {}
    document = {
        "mechanism": entry.mechanism.name,
        "axes": axes,
        "file": entry.label,
        "laws": [
            {
                "law": result.compensator,
                "knows": list(get_compensator(result.compensator, axes).knows),
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
