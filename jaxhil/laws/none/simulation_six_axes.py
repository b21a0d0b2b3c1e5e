"""No compensation in six axes: the measured wrench acts on the numerical model."""

from typing import ClassVar

from jaxhil.laws.simulation_base import Gain
from jaxhil.laws.six_axis_base import SixAxisCompensator


class NoCompensation(SixAxisCompensator):
    """Compensator that returns the measured wrench, the baseline."""

    name: ClassVar[str] = "none"
    knows: ClassVar[tuple[str, ...]] = ()
    gains: ClassVar[tuple[Gain, ...]] = ()

    def step(self, prepared, state, signals, tick):
        return signals.wrench, state


COMPENSATOR = NoCompensation()
