"""Response-error compensation of Qi et al. with phase lead and real-time identification of the contact.

    F_c = lead(F) + gate (g k_hat (x_d - x_a) + g_b b_hat (v_d - v_a))

x_d and v_d are the motion of the numerical model, x_a and v_a the measured motion. The phase lead compensates
for the delay of the force measurement. The response error compensates for the dynamics of the motion
simulator without a model of the simulator (Qi et al. 2016; notebooks/guide/model.md section 5). k_hat and
b_hat are a recursive least-squares fit of the measured force to the measured position. For the fit, the
position is delayed like the force (`identification_delay`); without this alignment, k_hat and b_hat are
biased (section 6, item 6). v_a is a filtered difference, s/(1 + T_v s) by Tustin's rule.

`gate` is 1 while the position, delayed like the force, is in contact, and otherwise 0. It opens and closes
smoothly within two periods, as a function of the time (between two ticks) at which the position crosses the
surface (`jaxhil.laws.shared.gates`). The weight of a reading in the identification is this gate times a gate
of the force above `contact_threshold`. F_c is therefore a continuous function of the delays."""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.contact.laws import deflection
from jaxhil.laws.shared.delay_line import (
    DelayInPeriods,
    DelayLine,
    empty_delay_line,
    read_delayed,
    split_delay,
)
from jaxhil.laws.shared.gates.simulation import gate, share_beyond
from jaxhil.laws.shared.lead_filter import (
    LEAD_FILTER,
    PHASE_LEAD,
    LeadFilter,
    LeadState,
    apply_lead_filter,
    build_lead_filter,
    lead_amplification,
)
from jaxhil.laws.shared.nominal_values import (
    FORCE_DELAY,
    critical_damping,
    force_delay,
    is_damped,
    noise_bound,
    peak_force,
    typical_stiffness,
)
from jaxhil.laws.shared.recursive_least_squares.simulation import ContactEstimate, update_estimate
from jaxhil.laws.simulation_base import Compensator, Gain, Gains, clear_lanes, rig_gain


def _stiffness_covariance(mechanism) -> float:
    """Return the initial covariance of the stiffness [1/m^2].

    With this covariance, a first sample at 3 % of the peak depth has the weight 1/2 in the estimate.
    """
    return 1 / (0.03 * peak_force(mechanism) / typical_stiffness(mechanism)) ** 2


def _damping_covariance(mechanism) -> float:
    """Return the initial covariance of the damping [s^2/m^2].

    With this covariance, a first sample at the approach speed has the weight 1/2 in the estimate.
    """
    return 1 / mechanism.approach.velocity**2


def _never_tuned(mechanism) -> bool:
    """Return False: tuning the gain would reduce the error by less than 20 % and make the search harder."""
    return False


class ResponseErrorState(NamedTuple):
    """State of the response-error compensator after a tick."""

    lead: LeadState
    position: Float[Array, "*batch"]  # measured position [m]
    velocity: Float[Array, "*batch"]  # filtered rate of `position` [m/s]
    aligned: Float[Array, "*batch"]  # measured position, delayed like the force [m]
    aligned_velocity: Float[Array, "*batch"]  # filtered rate of `aligned` [m/s]
    contact_share: Float[Array, "*batch"]  # share of the last period in contact [1]
    force_share: Float[Array, "*batch"]  # share of the last period with a force above the threshold [1]
    identified: ContactEstimate  # identified stiffness and damping
    line: DelayLine  # delay line of the measured positions


class PreparedResponseError(NamedTuple):
    """Gains and filter coefficients of the response-error compensator, computed once per run."""

    gains: Gains
    period: Float[Array, "*batch"]  # control period [s]
    clearance: Float[Array, "*batch"]  # clearance of a two-sided contact [m]
    lead: LeadFilter
    # coefficients [1] and [1/s] of the velocity filter v(n) = rate_pole v(n-1) + rate_gain (x(n) - x(n-1))
    rate_pole: Float[Array, "*batch"]
    rate_gain: Float[Array, "*batch"]
    delay: DelayInPeriods  # delay that aligns the measured positions with the force


class ResponseError(Compensator):
    """Compensator: phase lead and correction of the motion simulator's lag; see the module's docstring."""

    name: ClassVar[str] = "response_error"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY,)
    waits_for_contact: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = (
        PHASE_LEAD,
        LEAD_FILTER._replace(tuned=_never_tuned),
        rig_gain("response_error", lambda m: 0.0, lambda m: 2.0, lambda m: 1.0, neutral=0.0),
        rig_gain(
            "response_error_damping", lambda m: 0.0, lambda m: 2.0, lambda m: 1.0,
            neutral=0.0, tuned=is_damped,
        ),
        rig_gain(
            "initial_stiffness", lambda m: 0.0, lambda m: 5 * typical_stiffness(m),
            lambda m: 0.0, tuned=_never_tuned,
        ),
        rig_gain("initial_damping", lambda m: 0.0, critical_damping, lambda m: 0.0, tuned=_never_tuned),
        rig_gain(
            "stiffness_covariance", lambda m: 1e-3 * _stiffness_covariance(m),
            lambda m: 1e1 * _stiffness_covariance(m), _stiffness_covariance, logarithmic=True,
        ),
        rig_gain(
            "damping_covariance", lambda m: 0.0, lambda m: 10 * _damping_covariance(m),
            lambda m: _damping_covariance(m) if is_damped(m) else 0.0, tuned=_never_tuned,
        ),
        rig_gain("forgetting", lambda m: 0.8, lambda m: 1.0, lambda m: 0.98, tuned=_never_tuned),
        rig_gain(
            "contact_threshold", lambda m: 0.0, lambda m: max(peak_force(m), noise_bound(m)),
            lambda m: max(0.01 * peak_force(m), noise_bound(m)), tuned=_never_tuned,
        ),
        rig_gain("identification_delay", lambda m: 0.0, lambda m: 2 * force_delay(m) + 0.02, force_delay),
        rig_gain(
            "velocity_filter", lambda m: 0.5 * m.rig.control_period,
            lambda m: 20 * m.rig.control_period, lambda m: 2 * m.rig.control_period,
            logarithmic=True, tuned=_never_tuned,
        ),
    )  # fmt: skip

    def prepare(self, gains, constants):
        period = constants.control_period
        smoothing = 2 * gains["velocity_filter"]
        scale = 1 / (smoothing + period)
        return PreparedResponseError(
            gains,
            period,
            constants.clearance,
            build_lead_filter(gains, constants),
            (smoothing - period) * scale,
            2 * scale,
            split_delay(gains["identification_delay"], period),
        )

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        identified = ContactEstimate(
            zeros + gains["initial_stiffness"],
            zeros + gains["initial_damping"],
            zeros,
            zeros + gains["stiffness_covariance"],
            zeros + gains["damping_covariance"],
        )
        led, line = LeadState(zeros, zeros), empty_delay_line(ring, zeros)
        return ResponseErrorState(led, zeros, zeros, zeros, zeros, zeros, zeros, identified, line)

    def restart(self, gains, state, begins, fresh):
        old = state.identified
        fresh = begins & fresh
        return state._replace(
            lead=clear_lanes(state.lead, begins),
            contact_share=jnp.where(begins, 0, state.contact_share),
            force_share=jnp.where(begins, 0, state.force_share),
            identified=old._replace(
                coupling=jnp.where(fresh, 0, old.coupling),
                stiffness_variance=jnp.where(fresh, gains["stiffness_covariance"], old.stiffness_variance),
                damping_variance=jnp.where(fresh, gains["damping_covariance"], old.damping_variance),
            ),
        )

    def step(self, prepared, state, signals, tick):
        gains, period = prepared.gains, prepared.period
        force, measured = signals.force_measured, signals.position_measured
        # Assume uniform motion before the first tick, so that every filter begins in steady state.
        begins = signals.age == 0
        stride = period * signals.velocity_desired
        before = jnp.where(begins, measured - stride, state.position)
        aligned, line = read_delayed(prepared.delay, state.line, signals, tick)
        aligned_before = jnp.where(begins, aligned - stride, state.aligned)

        def rate(position, position_before, velocity_before):
            velocity_before = jnp.where(begins, signals.velocity_desired, velocity_before)
            change = position - position_before
            return prepared.rate_pole * velocity_before + prepared.rate_gain * change

        velocity = rate(measured, before, state.velocity)
        aligned_velocity = rate(aligned, aligned_before, state.aligned_velocity)
        depth = deflection(aligned, prepared.clearance)
        depth_before = deflection(aligned_before, prepared.clearance)
        contact_share = share_beyond(depth, depth_before, aligned - aligned_before)
        contact_gate = gate(contact_share, state.contact_share)
        threshold = gains["contact_threshold"]
        size, size_before = jnp.abs(force), jnp.abs(state.lead.force)
        excess, excess_before = (jnp.where(f > threshold, f - threshold, 0) for f in (size, size_before))
        force_share = share_beyond(excess, excess_before, size - size_before)
        identified = update_estimate(
            state.identified,
            gains["forgetting"],
            (gains["stiffness_covariance"], gains["damping_covariance"]),
            depth,
            aligned_velocity,
            force,
            contact_gate * gate(force_share, state.force_share),
        )
        led, lead_state = apply_lead_filter(prepared.lead, state.lead, force)
        response = gains["response_error"] * identified.stiffness * (
            signals.position_desired - measured
        ) + gains["response_error_damping"] * identified.damping * (signals.velocity_desired - velocity)
        command = led + contact_gate * response
        return command, ResponseErrorState(
            lead_state,
            measured,
            velocity,
            aligned,
            aligned_velocity,
            contact_share,
            force_share,
            identified,
            line,
        )

    def noise_amplification(self, gains, constants):
        # Only the lead filter counts. The noise of k_hat enters F_c reduced by the factor (x_d - x_a)/depth,
        # and by the square root of the number of samples in the identification's memory. F_c is noisier only
        # at the beginning of a contact, when k_hat depends on a few samples at small depth.
        return lead_amplification(build_lead_filter(gains, constants))

    def identified(self, state):
        return state.identified.stiffness, state.identified.damping


COMPENSATOR = ResponseError()
