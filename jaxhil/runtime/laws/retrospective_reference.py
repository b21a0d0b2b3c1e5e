"""The retrospective reference with one force-depth map: the force is as old as the given delay says."""

from collections.abc import Mapping

from ..registry import register
from .contact_plane import Meeting
from .force_depth_map import ForceDepthMap, Prior
from .retrospective import Retrospective


@register("retrospective_reference")
class RetrospectiveReference(Retrospective):
    """Force-depth map, reference and repayment."""

    __slots__ = ("_map",)

    def _prepare(self, gains: Mapping[str, float], prior: Prior) -> None:
        self._map = ForceDepthMap(prior)
        self._curve = self._map.curve

    def _begin(self, meeting: Meeting) -> int:
        self._map.restart()
        return 0

    def _learn(self, depth, rate, deepest, force, variance, hidden, zone) -> None:
        if depth > 0.0:
            if not hidden:
                self._map.update(depth, rate, deepest, force, variance)
            elif self._curve.force(depth, rate, deepest) > zone:
                self._map.update(depth, rate, deepest, 0.5 * zone, variance + zone * zone / 12.0)

    def _variance(self) -> float:
        return self._map.variance
