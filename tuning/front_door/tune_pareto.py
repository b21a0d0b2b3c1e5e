"""The part of `tuning.tune` that trades the error for something else: a front of gains for each mechanism."""

import functools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tuning.front_door import arguments
from tuning.front_door.arguments import ArgumentError
from tuning.terminal import Progress

if TYPE_CHECKING:
    from tuning.caches.pieces import Pieces
    from tuning.front_door.tune import TunedGains
    from tuning.gains.pareto import Front, Point
    from tuning.gains.pareto_search import Axis
    from tuning.gains.tune import ErrorFigures

# Names in files that stand for those that the objective uses.
IN_FILES = {"transparency_weight": "honesty_weight"}


@dataclass(frozen=True)
class TradedGains:
    """One point of a front.

    tuned: what was tuned without a trade-off.
    front: the whole front (`tuning.gains.pareto.Front`).
    point: this point of it (`tuning.gains.pareto.Point`).
    """

    tuned: "TunedGains"
    front: "Front"
    point: "Point"

    @property
    def gains(self) -> dict[str, float]:
        """By name [SI units]."""
        return self.point.gains

    @property
    def figures(self) -> "ErrorFigures":
        """Errors on fresh scenarios."""
        return self.point.figures

    @property
    def traded(self) -> dict[str, Any]:
        """The weight of what is traded, its cost, the error [1], and whether no other point beats it."""
        axis = self.front.axis
        return {
            IN_FILES.get(axis.weight, axis.weight): self.point.weight,
            axis.cost: self.point.cost,
            "error": self.point.error,
            "on_front": self.point.on_front,
        }

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """The content of the gain file."""
        from tuning.gain_file import build_document, validity_envelope

        found, point = self.tuned.found, self.point
        mechanism: Any = found.mechanism
        figures: dict[str, Any] = {
            "nominal": {**found.nominal, "tuned": point.nominal},
            "robust": {**found.figures, "tuned": point.figures},
            "tuned_intervals": point.intervals.plain(),
        }
        if point.transparency is not None:
            figures["honesty"] = {**found.transparency, "tuned": point.transparency}
        return build_document(
            found.compensator,
            point.gains,
            found.mechanism,
            self.tuned.mechanism_sha256,
            validity_envelope(mechanism, found.scenarios),
            {**figures, "pareto": self.traded},
            found.settings.seed,
            {},
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file. Raises `InputError` when it cannot be written."""
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.folder("path", path), self.document)


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
    tuned: "Sequence[TunedGains]",
    number: int,
    against: str | None,
    bar: Progress,
    pieces: "Pieces | None" = None,
    scheduler: str | None = None,
) -> "Iterator[tuple[int, list[TradedGains]]]":
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
