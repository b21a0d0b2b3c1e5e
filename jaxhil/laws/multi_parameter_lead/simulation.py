"""Multi-parameter phase lead (Osaki, Konno): a F + b dF/dt, by pole placement at the contact frequency.

The filter is a + b s/(1 + T_2 s) by Tustin's rule at the control period; phase lead is the special case
a = 1, b = T_lead. A contact with the delay tau has the characteristic equation
s^2 + omega^2 (a + b s) e^(-s tau) = 0. The rule of the literature places one of its roots at the root of a
damped oscillation with the desired restitution (notebooks/guide/model.md section 6, item 16).

For the nominal gains, the desired restitution is 1, and tau is the delay of the force measurement plus the
lag of the motion simulator. These gains compensate for the delay of the loop. The mechanism's damping still
acts, because the equation does not contain this damping.
"""

import cmath
import math
from typing import ClassVar

from jaxhil.errors import InputError
from jaxhil.laws.phase_lead.simulation import PhaseLead
from jaxhil.laws.shared.lead_filter import LEAD_FILTER, LeadFilter
from jaxhil.laws.shared.nominal_values import (
    CONTACT_FREQUENCY,
    FORCE_DELAY,
    SIMULATOR_LAG,
    contact_frequency,
    force_delay,
    simulator_lag,
)
from jaxhil.laws.simulation_base import Gain, Gains, KnownConstants, rig_gain
from jaxhil.mechanism.structs import Mechanism


def pole_placement(frequency: float, delay: float, restitution: float) -> tuple[float, float]:
    """Compute the gains a [1] and b [s] that give a delayed contact the desired restitution.

    The gains solve a + b s_d = -(s_d^2/omega^2) e^(s_d tau), where s_d is the root of a damped oscillation
    with the desired restitution.

    Args:
        frequency: angular frequency omega of the contact [rad/s], above 0.
        delay: delay tau of the loop [s].
        restitution: desired restitution [1], above 0.

    Raises:
        InputError: if an argument is not finite or not above its lower bound.
    """
    for name, value, least in (
        ("frequency", frequency, 0.0),
        ("delay", delay, -math.inf),
        ("restitution", restitution, 0.0),
    ):
        if not least < value < math.inf:
            raise InputError(f"pole_placement: {name}: found {value!r}, expected finite numbers > {least!r}")
    decrement = -math.log(restitution)
    ratio = decrement / math.hypot(math.pi, decrement)
    root = frequency * complex(-ratio, math.sqrt(1 - ratio**2))
    wanted = -((root / frequency) ** 2) * cmath.exp(root * delay)
    rate = wanted.imag / root.imag
    return wanted.real - rate * root.real, rate


def _nominal_gains(mechanism: Mechanism) -> tuple[float, float]:
    delay = force_delay(mechanism) + simulator_lag(mechanism)
    return pole_placement(contact_frequency(mechanism), delay, 1.0)


def multi_parameter_filter(gains: Gains, constants: KnownConstants) -> LeadFilter:
    """Compute the discrete coefficients of a + b s/(1 + T_2 s), T_2 = lead_filter, by Tustin's rule."""
    period = constants.control_period
    slow = 2 * gains["lead_filter"]
    scale = 1 / (slow + period)
    constant, rate = gains["force_gain"], 2 * gains["force_rate_gain"]
    return LeadFilter(
        (slow - period) * scale,
        (constant * (slow + period) + rate) * scale,
        (constant * (period - slow) - rate) * scale,
    )


class MultiParameterLead(PhaseLead):
    """Compensator F_c = a F + b s/(1 + T_2 s) F; see the module's docstring."""

    name: ClassVar[str] = "multi_parameter_lead"
    knows: ClassVar[tuple[str, ...]] = (CONTACT_FREQUENCY, FORCE_DELAY, SIMULATOR_LAG)
    waits_for_contact: ClassVar[bool] = True
    # a is negative for delays above a quarter of the oscillation period, b for delays above half of the
    # period.
    gains: ClassVar[tuple[Gain, ...]] = (
        rig_gain(
            "force_gain",
            lower=lambda mechanism: min(0.0, 2 * _nominal_gains(mechanism)[0]),
            upper=lambda mechanism: 2.0,
            nominal=lambda mechanism: _nominal_gains(mechanism)[0],
            neutral=1.0,
        ),
        rig_gain(
            "force_rate_gain",
            lower=lambda mechanism: min(0.0, 2 * _nominal_gains(mechanism)[1]),
            upper=lambda mechanism: 2 * max(0.0, _nominal_gains(mechanism)[1]) + 0.02,
            nominal=lambda mechanism: _nominal_gains(mechanism)[1],
            neutral=0.0,
        ),
        LEAD_FILTER,
    )

    def prepare(self, gains, constants):
        return multi_parameter_filter(gains, constants)


COMPENSATOR = MultiParameterLead()
