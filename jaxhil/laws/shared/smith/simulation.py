"""Base of `smith_predictor` and `smith_hybrid`: a phase lead, followed by a prediction of the force."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.laws.shared.lead_filter import (
    LEAD_FILTER,
    PHASE_LEAD,
    LeadFilter,
    LeadState,
    apply_lead_filter,
    build_lead_filter,
)
from jaxhil.laws.shared.nominal_values import FORCE_DELAY, SIMULATOR_LAG, simulator_lag
from jaxhil.laws.simulation_base import Compensator, Gain, Gains, KnownConstants, rig_gain

# An ideal simulator with a zero-order hold has a lag of minus half a period; a negative lag counts as 0.
SIMULATOR_LAG_GAIN = rig_gain(
    "simulator_lag",
    lower=lambda mechanism: 0.0,
    upper=lambda mechanism: 2 * max(0.0, simulator_lag(mechanism)) + 0.02,
    nominal=lambda mechanism: max(0.0, simulator_lag(mechanism)),
    neutral=0.0,
)


class Cascade(NamedTuple):
    """Lead filter and predictor in series: their coefficients, or their states."""

    lead: Any  # 1 + T_l s, filtered as in `PhaseLead`
    predictor: Any  # (1 + (3/2) T_s s)/(1 + T_s s/2)


class Smith(Compensator):
    """Base class that computes the force command F_c from the lead-filtered and the predicted force."""

    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY, SIMULATOR_LAG)
    reads_position: ClassVar[bool] = False
    gains: ClassVar[tuple[Gain, ...]] = (PHASE_LEAD, LEAD_FILTER, SIMULATOR_LAG_GAIN)
    # A/(T_s/2), where (1 + A s)/(1 + T_s s/2) is the transfer function from the lead-filtered force to F_c.
    excess: eqx.AbstractClassVar[float]

    @abc.abstractmethod
    def combined(self, led: Array, predicted: Array) -> Array:
        """Return F_c [N] from the lead-filtered force `led` and the predicted force `predicted` [N]."""

    def prepare(self, gains, constants):
        period, lag = constants.control_period, gains["simulator_lag"]
        scale = 1 / (lag + period)
        predictor = LeadFilter((lag - period) * scale, (3 * lag + period) * scale, (period - 3 * lag) * scale)
        return Cascade(build_lead_filter(gains, constants), predictor)

    def noise_amplification(self, gains, constants):
        return cascade_amplification(gains, constants, self.excess)

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        return Cascade(LeadState(zeros, zeros), LeadState(zeros, zeros))

    def step(self, prepared, state, signals, tick):
        led, lead_state = apply_lead_filter(prepared.lead, state.lead, signals.force_measured)
        predicted, predictor = apply_lead_filter(prepared.predictor, state.predictor, led)
        return self.combined(led, predicted), Cascade(lead_state, predictor)


def cascade_amplification(gains: Gains, constants: KnownConstants, excess: float) -> Float[Array, "*batch"]:
    """Return the noise amplification [1] of the lead filter in series with (1 + A s)/(1 + C s).

    C = T_s/2 and A = excess C, with the gain T_s = simulator_lag. Tustin's rule maps the unit circle to the
    imaginary axis. The variance of filtered white noise is therefore T times the integral
    (1/2 pi) int |H(j w)/(1 + j w E)|^2 dw, with the control period T, E = T/2 and the continuous filter H.
    For the numerator 1 + b_1 s + b_2 s^2 and the denominator 1 + a_1 s + a_2 s^2 + a_3 s^3, the integral is
    (b_2^2 a_1/a_3 + b_1^2 - 2 b_2 + a_2)/(2 (a_1 a_2 - a_3)) (James, Nichols and Phillips 1947, I_3).
    A factor C cancels in b_2^2/a_3, so that T_s = 0 is allowed.
    """
    period, pole = constants.control_period, gains["lead_filter"]
    zero = pole + gains["phase_lead"]
    half, lag = period / 2, gains["simulator_lag"] / 2
    b_1, b_2 = zero + excess * lag, zero * excess * lag
    a_1, a_2 = pole + half + lag, pole * half + lag * (pole + half)
    steepest = excess**2 * lag * zero**2 / (pole * half)
    variance = period * (steepest * a_1 + b_1**2 - 2 * b_2 + a_2)
    return jnp.sqrt(variance / (2 * (lag + pole) * (pole + half) * (half + lag)))
