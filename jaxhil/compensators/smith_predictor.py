"""Smith predictor of the force: (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F.

The second factor is phase lead against the force delay T_l, filtered as there. The first makes up for the lag
T_s of the motion simulator: on the model of a contact at the frequency omega, where the undelayed force would
be F_0 and the one behind the lag F_0 e^(-s T_s), a Smith predictor adds the difference F_0 - F_0 e^(-s T_s);
with e^(-s T_s) by Pade's first order, (1 - s T_s/2)/(1 + s T_s/2), that is T_s s/(1 + T_s s/2) F_0, and what
is measured stands for F_0.

The source's typography admits another reading, F + T_s s/(1 + T_s s/2) (1 + T_l s) F. Behind a pure delay
T_s = 10 ms and a force delay T_l = 8 ms a contact of 3 Hz is left with e = 1.014 by this one and 1.267 by the
other, of the roots of s^2 + omega^2 C(s) e^(-s (T_s + T_l)) = 0 (model.md section 5).
"""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, rig_gain
from jaxhil.compensators.estimates import FORCE_DELAY, SIMULATOR_LAG, simulator_lag
from jaxhil.compensators.phase_lead import (
    LEAD_FILTER,
    PHASE_LEAD,
    LeadFilter,
    LeadState,
    lead,
    lead_filter,
)

# An ideal simulator under commands held in jumps is half a period ahead: a lag below 0 is none to predict.
LAG = rig_gain(
    "simulator_lag",
    lower=lambda mechanism: 0.0,
    upper=lambda mechanism: 2 * max(0.0, simulator_lag(mechanism)) + 0.02,
    nominal=lambda mechanism: max(0.0, simulator_lag(mechanism)),
    neutral=0.0,
)


class SmithState(NamedTuple):
    """Of the lead, and of the predictor behind it."""

    lead: LeadState
    predictor: LeadState


class SmithFilters(NamedTuple):
    """Lead, and the predictor behind it."""

    lead: LeadFilter
    predictor: LeadFilter


def smith_filters(gains: Gains, constants: Constants) -> SmithFilters:
    """Both factors by Tustin's rule: the lead's, and (1 + (3/2) T_s s)/(1 + T_s s/2)."""
    period, lag = constants.control_period, gains["simulator_lag"]
    scale = 1 / (lag + period)
    predictor = LeadFilter((lag - period) * scale, (3 * lag + period) * scale, (period - 3 * lag) * scale)
    return SmithFilters(lead_filter(gains, constants), predictor)


def smith_start(constants: Constants) -> SmithState:
    """No force so far."""
    zeros = jnp.zeros_like(constants.control_period)
    return SmithState(LeadState(zeros, zeros), LeadState(zeros, zeros))


def smith_restart(state: SmithState, begins: Array) -> SmithState:
    """No force so far, on the lanes where a run begins."""
    return SmithState(*(LeadState(*(jnp.where(begins, 0, leaf) for leaf in one)) for one in state))


def smith_forces(filters: SmithFilters, state: SmithState, force: Array) -> tuple[Array, Array, SmithState]:
    """One tick: the force [N] led, and predicted behind that."""
    led, lead_state = lead(filters.lead, state.lead, force)
    predicted, predictor = lead(filters.predictor, state.predictor, led)
    return led, predicted, SmithState(lead_state, predictor)


def cascade_amplification(gains: Gains, constants: Constants, excess: float) -> Float[Array, "*batch"]:
    """Standard deviation of white noise behind the lead and (1 + A s)/(1 + C s), C = T_s/2, A = excess C.

    Tustin's rule maps the unit circle on the imaginary axis: the variance is T times the integral
    (1/2 pi) int |H(j w)/(1 + j w E)|^2 dw, E = T/2, of the filter H before it was made discrete. With
    numerator 1 + b_1 s + b_2 s^2 and denominator 1 + a_1 s + a_2 s^2 + a_3 s^3 that is (James, Nichols and
    Phillips 1947, I_3) (b_2^2 a_1/a_3 + b_1^2 - 2 b_2 + a_2)/(2 (a_1 a_2 - a_3)); in b_2^2/a_3 a factor C
    cancels, and T_s = 0 leaves the lead alone.
    """
    period, pole = constants.control_period, gains["lead_filter"]
    zero = pole + gains["phase_lead"]
    half, lag = period / 2, gains["simulator_lag"] / 2
    b_1, b_2 = zero + excess * lag, zero * excess * lag
    a_1, a_2 = pole + half + lag, pole * half + lag * (pole + half)
    steepest = excess**2 * lag * zero**2 / (pole * half)
    variance = period * (steepest * a_1 + b_1**2 - 2 * b_2 + a_2)
    return jnp.sqrt(variance / (2 * (lag + pole) * (pole + half) * (half + lag)))


class SmithPredictor(Compensator):
    """F_c = (1 + T_s s/(1 + T_s s/2)) (1 + T_l s) F; see the module's text."""

    name: ClassVar[str] = "smith_predictor"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY, SIMULATOR_LAG)
    gains: ClassVar[tuple[Gain, ...]] = (PHASE_LEAD, LEAD_FILTER, LAG)

    def prepare(self, gains, constants):
        return smith_filters(gains, constants)

    def noise_amplification(self, gains, constants):
        return cascade_amplification(gains, constants, 3.0)

    def init(self, gains, constants, ring):
        return smith_start(constants)

    def restart(self, gains, state, begins, fresh):
        return smith_restart(state, begins)

    def step(self, prepared, state, signals, tick):
        _, predicted, state = smith_forces(prepared, state, signals.force_measured)
        return predicted, state
