"""Lead filter (1 + T_1 s)/(1 + T_2 s) by Tustin's rule in JAX, and its two gains.

T_1 = phase_lead + lead_filter and T_2 = lead_filter, so that the net lead is `phase_lead`. The rule of the
literature sets `phase_lead` to the delay of the force measurement, and `lead_filter` to one control period.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.laws.shared.nominal_values import force_delay
from jaxhil.laws.simulation_base import Gains, KnownConstants, rig_gain

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
    """State of the lead filter after a tick."""

    force: Float[Array, "*batch"]  # input of the last tick [N]
    output: Float[Array, "*batch"]  # output of the last tick [N]


class LeadFilter(NamedTuple):
    """Lead filter y(n) = `pole` y(n-1) + `now` F(n) + `before` F(n-1), with these coefficients [1]."""

    pole: Array
    now: Array
    before: Array


def build_lead_filter(gains: Gains, constants: KnownConstants) -> LeadFilter:
    """Compute the lead filter's coefficients from the gains `phase_lead` and `lead_filter`."""
    period = constants.control_period
    slow = 2 * gains["lead_filter"]
    fast = slow + 2 * gains["phase_lead"]
    scale = 1 / (slow + period)
    return LeadFilter((slow - period) * scale, (fast + period) * scale, (period - fast) * scale)


def apply_lead_filter(filter_: LeadFilter, state: LeadState, force: Array) -> tuple[Array, LeadState]:
    """Filter the force [N] of one tick; return the output [N] and the filter's next state."""
    output = filter_.pole * state.output + filter_.now * force + filter_.before * state.force
    return output, LeadState(force, output)


def lead_amplification(filter_: LeadFilter) -> Array:
    """Return the filter's noise amplification [1]: the output's standard deviation for unit white noise.

    For y(n) = p y(n-1) + a F(n) + b F(n-1) with F of unit variance, the stationary variance is the sum of the
    squared impulse response a, p a + b, p (p a + b), ..., which is (a^2 + b^2 + 2 a b p)/(1 - p^2).
    """
    pole, now, before = filter_
    return jnp.sqrt((now**2 + before**2 + 2 * now * before * pole) / (1 - pole**2))
