"""The retrospective reference where the force delay is hardly known: a bank of delays, weighed as one goes.

`retrospective_reference` with a `delay_bank` in the place of its one map: hypotheses lie evenly within
`delay_spread` of `identification_delay`, or the force sensor lags (`hypotheses`). What was learnt of the
delay, and of whether there is any damping, is carried from contact to contact; maps are not. With d the mean
of the hypotheses' delays and lags on the tick before, the depth as old as the force is X - d V.
"""

from collections.abc import Mapping
from typing import ClassVar

from ..bounds import TIMES
from ..registry import GainSpecification, register
from .contact_plane import Meeting
from .delay_bank import DelayBank
from .force_depth_map import Prior
from .lagged_onset import newest
from .retrospective import Retrospective


@register("retrospective_delay_bank")
class RetrospectiveDelayBank(Retrospective):
    """Bank of delays, reference and repayment."""

    __slots__ = ("_bank", "_given_delay")

    misfit: ClassVar[float] = 0.01
    gains: ClassVar[Mapping[str, GainSpecification]] = {
        **Retrospective.gains,
        "delay_spread": GainSpecification("s", 0.0, 0.004),
        "sensor_lag": GainSpecification("s", *TIMES),
    }

    @property
    def force_delay(self) -> float:
        """The estimated delay [s] of the force measurement."""
        return self._given_delay + self._bank.shift

    def reset(self) -> None:
        """Forget everything, what was learnt of the delay as well."""
        super().reset()
        self._bank.reset()
        self._shift = 0.0
        self._deeper = 0.0

    def _prepare(self, gains: Mapping[str, float], prior: Prior) -> None:
        self._given_delay = gains["identification_delay"]
        told = gains["delay_spread"], gains["sensor_lag"], gains["plane_spread"]
        self._bank = DelayBank(*told, prior, self._period)
        self._curve = self._bank.curve

    def _begin(self, meeting: Meeting) -> int:
        scales = self._scales
        readings = newest(self._history, scales, meeting.place)
        noise = self._noise.variance / (scales.weight * scales.weight)
        earlier = self._bank.begin(meeting, *readings, self._floor * self._floor + noise)
        self._take_means(meeting.pace)
        return earlier

    def _learn(self, depth, rate, deepest, force, variance, hidden, zone) -> None:
        self._bank.learn(depth, rate, force, variance, hidden, zone)
        self._take_means(self._pace)

    def _take_means(self, pace: float) -> None:
        self._shift = self._bank.shift * pace
        self._deeper = self._bank.deeper

    def _variance(self) -> float:
        return self._bank.variance

    def _open(self, peak: float) -> bool:
        return self._bank.leaves_open(peak)
