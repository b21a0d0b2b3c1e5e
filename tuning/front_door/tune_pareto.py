"""The part of `tuning.tune` that trades the error for something else: a front of gains for each mechanism."""

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
    """There is a front to find, if one is asked for. Raises `InputError`; imports jax where one is."""
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
    """What the error is traded against; None: nothing."""
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
    """Place and front of every result, as they are done; the `bar` shows how far it is. What is among the
    `pieces` is taken from there, and the rest kept there. With a `scheduler`, a cluster's workers compute
    them."""
    from tuning.caches.pieces import NOTHING_KEPT
    from tuning.gains.pareto import fronts
    from tuning.gains.work import Work

    found = [one.found for one in tuned]
    axis: Any = axis_of(against, tuned[0].compensator) if tuned else None
    work = Work(lambda text, share, before: bar.tell(text, share * len(found), before * len(found)))
    for place, front in fronts(found, number, work, axis, pieces or NOTHING_KEPT, scheduler):
        yield place, [TradedGains(tuned[place], front, point) for point in front.points]
