"""Pareto fronts of `tuning.tune`: gains that trade the error for another cost."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from tuning.api import arguments
from tuning.api.arguments import ArgumentError
from tuning.api.tuned_gains import TradedGains, TunedGains
from tuning.terminal import Progress

if TYPE_CHECKING:
    from tuning.caches.checkpoints import Checkpoints
    from tuning.gains.pareto_search import ParetoCriterion


def check_pareto_options(number: Any, against: Any, compensator: str) -> None:
    """Raise `InputError` unless the options describe a possible front.

    This imports jax if `number` is at least 2.
    """
    arguments.check_integers(0, pareto=number)
    if number == 0:
        return
    if number < 2:
        raise ArgumentError("pareto", str(number), "0 or an integer >= 2")
    from tuning.gains.pareto_search import PARETO_CRITERIA

    if against is not None:
        arguments.check_choice(tuple(PARETO_CRITERIA), pareto_against=against)
    if select_cost_axis(against, compensator) is None:
        reason = "there is no trade-off, it passes sensor noise on as it is whatever its gains"
        raise ArgumentError("pareto", str(number), f"0 for {compensator}: {reason}")


def select_cost_axis(against: str | None, compensator: str) -> "ParetoCriterion | None":
    """Return the cost that the error is traded for, or None if there is no trade-off."""
    from tuning.gains.pareto_search import (
        NOISE_CRITERION,
        PARETO_CRITERIA,
        choose_default_criterion,
        has_noise_trade_off,
    )

    if against is None:
        return choose_default_criterion(compensator)
    axis = PARETO_CRITERIA[against]
    return None if axis == NOISE_CRITERION and not has_noise_trade_off(compensator) else axis


def compute_fronts(
    tuned: Sequence[TunedGains],
    number: int,
    against: str | None,
    bar: Progress,
    pieces: "Checkpoints | None" = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, list[TradedGains]]]:
    """Yield the index and the front of every result, as they are finished.

    The `bar` shows the progress. Work stored in the checkpoints `pieces` is not repeated, and new work is
    stored there. With a `scheduler`, the workers of a cluster compute the fronts.
    """
    from tuning.caches.checkpoints import NO_CHECKPOINTS
    from tuning.gains.pareto import compute_fronts
    from tuning.gains.search_progress import SearchProgress

    results = [gains.found for gains in tuned]
    axis: Any = select_cost_axis(against, tuned[0].compensator) if tuned else None
    work = SearchProgress(
        lambda text, share, before: bar.tell(text, share * len(results), before * len(results))
    )
    for index, front in compute_fronts(results, number, work, axis, pieces or NO_CHECKPOINTS, scheduler):
        yield index, [TradedGains(tuned[index], front, point) for point in front.points]
