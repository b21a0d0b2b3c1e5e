"""Pareto fronts of `tuning.tune`: gains that trade off the restitution error against a second cost."""

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
    """Raise `InputError` unless a Pareto front with these options can be computed.

    Args:
        number: number of points; 0 for no front.
        against: name of the cost; None for the compensator's default.
        compensator: name of the compensator.
    """
    arguments.check_integers(0, pareto=number)
    if number == 0:
        return
    if number < 2:
        raise ArgumentError("pareto", str(number), "0 or an integer >= 2")
    from tuning.gains.pareto_search import PARETO_CRITERIA

    if against is not None:
        arguments.check_choice(tuple(PARETO_CRITERIA), pareto_against=against)
    axes = 1 if compensator in arguments.compensator_names() else 6
    if select_cost_axis(against, compensator, axes) is None:
        reason = "its amplification of sensor noise does not depend on its gains"
        raise ArgumentError("pareto", str(number), f"0 for {compensator}: {reason}")


def check_six_axis_cost(against: Any) -> None:
    """Raise `InputError` if `against`, the cost of a Pareto front, does not exist for six axes."""
    if against not in (None, "peak"):
        raise ArgumentError("pareto_against", str(against), "peak, the only cost in six axes")


def select_cost_axis(against: str | None, compensator: str, axes: int = 1) -> "ParetoCriterion | None":
    """Return the cost that a Pareto front trades off against the error; None if no gain affects the cost."""
    from tuning.gains.pareto_search import (
        NOISE_CRITERION,
        PARETO_CRITERIA,
        choose_default_criterion,
        has_noise_trade_off,
    )

    if against is None:
        return choose_default_criterion(compensator, axes)
    axis = PARETO_CRITERIA[against]
    return None if axis == NOISE_CRITERION and not has_noise_trade_off(compensator) else axis


def compute_fronts(
    tuned: Sequence[TunedGains],
    number: int,
    against: str | None,
    bar: Progress,
    checkpoints: "Checkpoints | None" = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, list[TradedGains]]]:
    """Compute the Pareto front of each tuning, and yield each front as soon as it is finished.

    Args:
        tuned: results of `tune`, one per mechanism.
        number: number of points of a front.
        against: name of the cost that is traded off against the error; None for the compensator's default.
        bar: progress display.
        checkpoints: results of finished work, which is not repeated; new results are added.
        scheduler: address of a cluster's scheduler, whose workers compute the fronts; None for this process.

    Yields:
        Index into `tuned`, and the points of the front.
    """
    from jaxhil.laws.compensators import axes_of
    from tuning.caches.checkpoints import NO_CHECKPOINTS
    from tuning.gains.pareto import compute_fronts
    from tuning.gains.search_progress import SearchProgress

    results = [gains.tune_result for gains in tuned]
    axis: Any = None
    if tuned:
        axis = select_cost_axis(against, tuned[0].compensator, axes_of(tuned[0].mechanism))
    work = SearchProgress(
        lambda text, share, before: bar.tell(text, share * len(results), before * len(results))
    )
    checkpoints = checkpoints or NO_CHECKPOINTS
    for index, front in compute_fronts(results, number, work, axis, checkpoints, scheduler):
        yield index, [TradedGains(tuned[index], front, point) for point in front.points]
