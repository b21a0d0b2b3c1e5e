"""Pareto fronts of `tuning.tune`: gains that trade the error for another cost."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from tuning.front_door import arguments
from tuning.front_door.arguments import ArgumentError
from tuning.front_door.tuned_gains import TradedGains, TunedGains
from tuning.terminal import Progress

if TYPE_CHECKING:
    from tuning.caches.pieces import Pieces
    from tuning.gains.pareto_search import Axis


def check(number: Any, against: Any, compensator: str) -> None:
    """Raise `InputError` unless the options describe a possible front.

    This imports jax if `number` is at least 2.
    """
    arguments.integers(0, pareto=number)
    if number == 0:
        return
    if number < 2:
        raise ArgumentError("pareto", str(number), "0 or an integer >= 2")
    from tuning.gains.pareto_search import AXES

    if against is not None:
        arguments.one_of(tuple(AXES), pareto_against=against)
    if axis_of(against, compensator) is None:
        reason = "there is no trade-off, it passes sensor noise on as it is whatever its gains"
        raise ArgumentError("pareto", str(number), f"0 for {compensator}: {reason}")


def axis_of(against: str | None, compensator: str) -> "Axis | None":
    """Return the cost that the error is traded for, or None if there is no trade-off."""
    from tuning.gains.pareto_search import AXES, NOISE, default_axis, has_trade_off

    if against is None:
        return default_axis(compensator)
    axis = AXES[against]
    return None if axis == NOISE and not has_trade_off(compensator) else axis


def trade(
    tuned: Sequence[TunedGains],
    number: int,
    against: str | None,
    bar: Progress,
    pieces: "Pieces | None" = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, list[TradedGains]]]:
    """Yield the index and the front of every result, as they are finished.

    The `bar` shows the progress. Work stored in the checkpoints `pieces` is not repeated, and new work is
    stored there. With a `scheduler`, the workers of a cluster compute the fronts.
    """
    from tuning.caches.pieces import NOTHING_KEPT
    from tuning.gains.pareto import fronts
    from tuning.gains.work import Work

    results = [gains.found for gains in tuned]
    axis: Any = axis_of(against, tuned[0].compensator) if tuned else None
    work = Work(lambda text, share, before: bar.tell(text, share * len(results), before * len(results)))
    for index, front in fronts(results, number, work, axis, pieces or NOTHING_KEPT, scheduler):
        yield index, [TradedGains(tuned[index], front, point) for point in front.points]
