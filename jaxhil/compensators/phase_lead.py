"""Phase-lead force compensation (Shimoji): F + T_lead dF/dt, the first-order inverse of a force delay.

Realised as (1 + T_1 s)/(1 + T_2 s) by Tustin's rule at the control period, T_1 = T_lead + T_2, so that the
net lead is T_lead. The literature's rule: T_lead is the delay of the force measurement, T_2 one period.
"""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, rig_gain
from jaxhil.compensators.estimates import FORCE_DELAY, force_delay

PHASE_LEAD = rig_gain(
    "phase_lead",
    lower=lambda mechanism: 0.0,
    upper=lambda mechanism: 2 * force_delay(mechanism) + 0.02,
    nominal=force_delay,
    neutral=0.0,
)
LEAD_FILTER = rig_gain(
    "lead_filter",
    lower=lambda mechanism: 0.5 * mechanism.rig.control_period,
    upper=lambda mechanism: 10 * mechanism.rig.control_period,
    nominal=lambda mechanism: mechanism.rig.control_period,
    logarithmic=True,
)


class LeadState(NamedTuple):
    """The tick before."""

    force: Float[Array, "*batch"]  # at the input [N]
    output: Float[Array, "*batch"]  # [N]


class LeadFilter(NamedTuple):
    """Coefficients of y(n) = pole y(n-1) + now F(n) + before F(n-1)."""

    pole: Array  # of the output before
    now: Array  # of the force
    before: Array  # of the force before


def lead_filter(gains: Gains, constants: Constants) -> LeadFilter:
    """(1 + T_1 s)/(1 + T_2 s) with T_1 = phase_lead + lead_filter, T_2 = lead_filter, by Tustin's rule."""
    period = constants.control_period
    slow = 2 * gains["lead_filter"]
    fast = slow + 2 * gains["phase_lead"]
    scale = 1 / (slow + period)
    return LeadFilter((slow - period) * scale, (fast + period) * scale, (period - fast) * scale)


def lead(filter_: LeadFilter, state: LeadState, force: Array) -> tuple[Array, LeadState]:
    """One tick of the lead filter."""
    output = filter_.pole * state.output + filter_.now * force + filter_.before * state.force
    return output, LeadState(force, output)


def lead_amplification(filter_: LeadFilter) -> Array:
    """Standard deviation of the filter's output over that of white noise at its input.

    The variance of y(n) = p y(n-1) + a F(n) + b F(n-1) for F of unit variance, stationary:
    (a^2 + b^2 + 2 a b p)/(1 - p^2), the sum of the squares of its impulse response a, pa + b, p(pa + b), ...
    """
    pole, now, before = filter_
    return jnp.sqrt((now**2 + before**2 + 2 * now * before * pole) / (1 - pole**2))


class PhaseLead(Compensator):
    """F_c = F + T_lead dF/dt, filtered."""

    name: ClassVar[str] = "phase_lead"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY,)
    waits_for_contact: ClassVar[bool] = True
    reads_position: ClassVar[bool] = False
    gains: ClassVar[tuple[Gain, ...]] = (PHASE_LEAD, LEAD_FILTER)

    def prepare(self, gains, constants):
        return lead_filter(gains, constants)

    def noise_amplification(self, gains, constants):
        return lead_amplification(self.prepare(gains, constants))

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        return LeadState(zeros, zeros)

    def step(self, prepared, state, signals, tick):
        return lead(prepared, state, signals.force_measured)
