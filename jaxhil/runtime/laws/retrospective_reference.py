"""The retrospective reference with one force-depth map: the force is as old as the given delay says."""

from collections.abc import Mapping

from ..registry import register
from .contact_plane import Meeting
from .force_depth_map import ForceDepthMap, Prior
from .lag_check import LIKELIER, LagCheck
from .lagged_onset import newest
from .retrospective import READINGS, Retrospective


@register("retrospective_reference")
class RetrospectiveReference(Retrospective):
    """Force-depth map, reference and repayment; what a lag of the force sensor would explain is doubted."""

    __slots__ = ("_check", "_checked", "_map", "_surprise")

    def _prepare(self, gains: Mapping[str, float], prior: Prior) -> None:
        self._map = ForceDepthMap(prior)
        self._curve = self._map.curve
        self._check = LagCheck(prior, self._period)

    def _begin(self, meeting: Meeting) -> int:
        self._map.restart()
        scales = self._scales
        noise = self._noise.variance / (scales.weight * scales.weight)
        readings = newest(self._history, scales, meeting.place)
        self._check.begin(meeting, *readings, self._floor * self._floor + noise)
        self._checked = 0  # readings
        self._surprise = 0.0  # what the map is charged
        return 0

    def _learn(self, depth, rate, deepest, force, variance, hidden, zone) -> None:
        if not hidden:
            if depth > 0.0:
                self._surprise += self._map.update(depth, rate, deepest, force, variance)
            else:
                self._miss(depth, force, variance)
        elif depth > 0.0 and self._curve.force(depth, rate, deepest) > zone:
            self._map.update(depth, rate, deepest, 0.5 * zone, variance + zone * zone / 12.0)

    def _catch_up(self, variance: float, zone: float) -> None:
        super()._catch_up(variance, zone)
        for _ in range(READINGS):
            tick = self._unchecked
            if tick > self._history.newest:
                break
            self._checked += 1
            if tick < 0:
                continue
            depth, rate, force, noise, shown = self._reading(tick, variance)
            self._check.take(depth, rate, force, noise, shown)
            if shown and tick <= self._reference.entry:
                self._miss(depth, force, noise)

    def _miss(self, depth: float, force: float, variance: float) -> None:
        """A reading out of contact, for which the map is charged: the surface is known to a tick."""
        if depth <= -self._reference.period:
            self._surprise += force * force / variance

    def _variance(self) -> float:
        return self._map.variance

    def _open(self, peak: float) -> bool:
        likelier = self._unchecked > self._history.newest and self._surprise - self._check.surprise > LIKELIER
        return likelier and self._check.matters(peak)

    @property
    def _unchecked(self) -> int:
        """The tick whose reading is to be checked next."""
        return self._reference.entry + 1 - self._check.earlier + self._checked
