"""No compensation in six axes: the measured wrench."""

from typing import ClassVar

from jaxhil.laws.simulation_base import Gain
from jaxhil.laws.six_axis_base import SixAxisCompensator


class NoCompensation(SixAxisCompensator):
    """Wrench as measured."""

    name: ClassVar[str] = "none"
    knows: ClassVar[tuple[str, ...]] = ()
    gains: ClassVar[tuple[Gain, ...]] = ()

    def step(self, prepared, state, signals, tick):
        return signals.wrench, state


COMPENSATOR = NoCompensation()
