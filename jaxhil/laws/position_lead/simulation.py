"""Position lead (Chang et al.): the position command leads the model by the motion simulator's lag.

    F_c = F,     position command = x + a_1 v + a_2 a

Position x, velocity v and acceleration a = -F_c/M come from the numerical model, so that no signal is
differentiated. With a_1 and a_2 of the simulator's inverse, 1/G(s) = 1 + a_1 s + a_2 s^2 + ..., the simulator
follows the model. For a second-order simulator without transport delay, the inverse has no further terms. The
remaining error is of first order in the control period, because v and a are half a period old.

The nominal gains are the first two coefficients of the series of e^(s tau)/G(s), where tau is the transport
delay plus the delay of the command. The compensator does not correct the delay of the force measurement.
"""

from typing import ClassVar

from jaxhil.laws.shared.nominal_values import SIMULATOR_DYNAMICS, simulator_inverse
from jaxhil.laws.simulation_base import Compensator, Gain, rig_gain


class PositionLead(Compensator):
    """Compensator F_c = F with a lead of the position command; see the module's docstring."""

    name: ClassVar[str] = "position_lead"
    knows: ClassVar[tuple[str, ...]] = (SIMULATOR_DYNAMICS,)
    waits_for_contact: ClassVar[bool] = True
    reads_position: ClassVar[bool] = False
    # The coefficients are negative for an ideal simulator with zero-order hold, and may be for one with
    # zeros.
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
