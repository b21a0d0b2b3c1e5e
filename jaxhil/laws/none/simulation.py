"""No compensation: the measured force acts on the numerical model."""

from typing import ClassVar

from jaxhil.laws.simulation_base import Compensator, Gain


class NoCompensator(Compensator):
    """Compensator F_c = F, the baseline."""

    name: ClassVar[str] = "none"
    knows: ClassVar[tuple[str, ...]] = ()
    waits_for_contact: ClassVar[bool] = True
    reads_position: ClassVar[bool] = False
    gains: ClassVar[tuple[Gain, ...]] = ()

    def step(self, prepared, state, signals, tick):
        return signals.force_measured, state


COMPENSATOR = NoCompensator()
