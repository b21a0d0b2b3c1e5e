"""Position lead (Chang et al.): the motion simulator is sent ahead of the model by what it follows late.

    F_c = F,  command (1 + a_1 s + a_2 s^2) x_d = x + a_1 v + a_2 a,

with velocity v and acceleration a = -F_c/M of the numerical model: nothing is differentiated. With a_1 and
a_2 of the simulator's inverse, 1/G(s) = 1 + a_1 s + a_2 s^2 + ..., x_a follows x_d. Of a second-order one
without transport delay that is all of the inverse, and what is left is of first order in the control period:
v and a are those of the step just made, half a period late.

Nominal are the first two terms of the series of e^(s tau)/G(s), tau the transport delay and what the command
waits. The delay of the force measurement stays: this law does nothing about it.
"""

from typing import ClassVar

from jaxhil.laws.shared.estimates import SIMULATOR_DYNAMICS, simulator_inverse
from jaxhil.laws.simulation_base import Compensator, Gain, rig_gain


class PositionLead(Compensator):
    """F_c = F, and the position command led; see the module's text."""

    name: ClassVar[str] = "position_lead"
    knows: ClassVar[tuple[str, ...]] = (SIMULATOR_DYNAMICS,)
    waits_for_contact: ClassVar[bool] = True
    reads_position: ClassVar[bool] = False
    # Of an ideal simulator under commands held in jumps, or of one with zeros, either may be below 0.
    gains: ClassVar[tuple[Gain, ...]] = (
        rig_gain(
            "position_lead",
            lower=lambda mechanism: min(0.0, 2 * simulator_inverse(mechanism)[0]),
            upper=lambda mechanism: 2 * max(0.0, simulator_inverse(mechanism)[0]) + 0.02,
            nominal=lambda mechanism: simulator_inverse(mechanism)[0],
            neutral=0.0,
        ),
        rig_gain(
            "acceleration_lead",
            lower=lambda mechanism: min(0.0, 2 * simulator_inverse(mechanism)[1]),
            upper=lambda mechanism: 2 * max(0.0, simulator_inverse(mechanism)[1]) + 0.02**2 / 2,
            nominal=lambda mechanism: simulator_inverse(mechanism)[1],
            neutral=0.0,
        ),
    )

    def step(self, prepared, state, signals, tick):
        return signals.force_measured, state

    def position_command(self, gains, state, position, velocity, acceleration):
        led = gains["position_lead"] * velocity + gains["acceleration_lead"] * acceleration
        return position + led, state


COMPENSATOR = PositionLead()
