"""Virtual contact (EPOS; Zebenay, Boge): a virtual spring and damper act on the numerical model.

    F_c = F + k_v d + b_v d'  while d > 0,     otherwise F_c = F

d is the penetration of the numerical model, and d' its rate. The virtual forces have no delay. The operators
of the EPOS rig chose k_v and b_v by experiment. The nominal b_v is the stability limit
(notebooks/guide/model.md section 6, item 15), at which the contact neither gains nor loses energy; damping of
the mechanism is neglected.
"""

import math
from typing import ClassVar

import jax.numpy as jnp

from jaxhil.contact.laws import deflection
from jaxhil.laws.shared.nominal_values import (
    CONTACT_FREQUENCY,
    FORCE_DELAY,
    SIMULATOR_LAG,
    STIFFNESS,
    contact_frequency,
    critical_damping,
    force_delay,
    simulator_lag,
    typical_stiffness,
)
from jaxhil.laws.simulation_base import Compensator, Gain, Gains, KnownConstants, rig_gain
from jaxhil.mechanism.structs import Mechanism


def damping_at_the_limit(stiffness: float, frequency: float, delay: float) -> tuple[float, float]:
    """Compute b_v [N s/m] and omega_c [rad/s] at the stability limit of M s^2 + b_v s + k e^(-s tau) = 0.

    If there are several limits, return the limit with the lowest frequency. Contact is stable for every
    larger b_v.

    Args:
        stiffness: k [N/m], above 0.
        frequency: sqrt(k/M) [rad/s], above 0.
        delay: tau [s], at least 0.
    """
    angle = frequency * delay
    # The function cos(u angle) - u^2 decreases and is concave from u = 0 to this initial share, where it is
    # not positive. Newton's method therefore approaches the root from above, and passes the root only by
    # rounding.
    share = min(1.0, math.pi / 2 / angle) if angle > 0 else 1.0
    for _ in range(100):
        excess = math.cos(share * angle) - share**2
        if excess >= 0:
            break
        share += excess / (angle * math.sin(share * angle) + 2 * share)
    critical = share * frequency
    return stiffness * math.sin(critical * delay) / critical, critical


def _nominal_damping(mechanism: Mechanism) -> float:
    delay = max(force_delay(mechanism) + simulator_lag(mechanism), 0.0)
    return damping_at_the_limit(typical_stiffness(mechanism), contact_frequency(mechanism), delay)[0]


class VirtualContact(Compensator):
    """Compensator F_c = F + k_v d + b_v d' for the penetration d of the model; see the module's docstring."""

    name: ClassVar[str] = "virtual_contact"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY, SIMULATOR_LAG, STIFFNESS, CONTACT_FREQUENCY)
    reads_position: ClassVar[bool] = False
    gains: ClassVar[tuple[Gain, ...]] = (
        rig_gain(
            "virtual_stiffness", lambda m: -typical_stiffness(m), typical_stiffness, lambda m: 0.0,
            neutral=0.0,
        ),
        rig_gain(
            "virtual_damping", lambda m: 0.0,
            lambda m: critical_damping(m) + 2 * _nominal_damping(m), _nominal_damping, neutral=0.0,
        ),
    )  # fmt: skip

    def prepare(self, gains: Gains, constants: KnownConstants):
        return gains, constants.clearance

    def step(self, prepared, state, signals, tick):
        gains, clearance = prepared
        depth = deflection(signals.position_desired, clearance)
        virtual = gains["virtual_stiffness"] * depth + gains["virtual_damping"] * signals.velocity_desired
        return signals.force_measured + jnp.where(depth != 0, virtual, 0), state


COMPENSATOR = VirtualContact()
