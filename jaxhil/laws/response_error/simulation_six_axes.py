"""Response-error compensation of Qi et al. along the docking axis, with phase lead on all six channels.

    F_c = lead(F)                                                 all channels, out of contact
    F_c = lead(F) + g k_hat (x_d - x_a) + g_b b_hat (v_d - v_a)   along the docking axis, in contact

The literature states the method for one axis with a known surface (`simulation.py` in this folder). Here x is
the travel along the docking axis. The surface is at the travel at which the force exceeds
`contact_threshold`.
"""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.laws.phase_lead.simulation_six_axes import SIX_AXIS_PHASE_LEAD
from jaxhil.laws.shared.delay_line import (
    DelayInPeriods,
    DelayLine,
    empty_delay_line,
    read_delayed,
    split_delay,
)
from jaxhil.laws.shared.lead_filter import (
    LEAD_FILTER,
    LeadFilter,
    LeadState,
    apply_lead_filter,
    build_lead_filter,
)
from jaxhil.laws.shared.nominal_values import BIAS_WALK_TIME, FORCE_DELAY, force_delay
from jaxhil.laws.shared.recursive_least_squares.simulation import ContactEstimate, update_estimate
from jaxhil.laws.simulation_base import Gain, Gains, Signals, rig_gain
from jaxhil.laws.six_axis_base import COORDINATES, SixAxisCompensator, lag_leads

AXIS = 2  # index of the docking axis z
USUAL_SPEED = 0.02  # approach speed if the mechanism file has none [m/s]
FIRST_SAMPLE_DEPTH = 1e-3  # depth / approach speed at which a first sample has weight 1/2 in k_hat [s]


class ResponseErrorState(NamedTuple):
    """State of the six-axis response-error compensator after a tick."""

    leads: tuple[LeadState, ...]
    line: DelayLine  # delay line of the measured travel
    position: Float[Array, "*batch"]  # measured travel [m]
    velocity: Float[Array, "*batch"]  # filtered rate of `position` [m/s]
    aligned: Float[Array, "*batch"]  # measured travel, delayed like the force [m]
    aligned_velocity: Float[Array, "*batch"]  # filtered rate of `aligned` [m/s]
    surface: Float[Array, "*batch"]  # `aligned` on the last tick before contact [m]
    in_contact: Bool[Array, "*batch"]
    identified: ContactEstimate  # identified stiffness and damping


class PreparedResponseError(NamedTuple):
    """Gains and filter coefficients of the six-axis response-error compensator, computed once per run."""

    gains: Gains
    period: Float[Array, "*batch"]  # control period [s]
    lead: LeadFilter
    # coefficients [1] and [1/s] of the velocity filter v(n) = rate_pole v(n-1) + rate_gain (x(n) - x(n-1))
    rate_pole: Float[Array, "*batch"]
    rate_gain: Float[Array, "*batch"]
    delay: DelayInPeriods  # delay that aligns the measured travel with the force


def approach_speed(mechanism: Any) -> float:
    """Return the nominal approach speed along the docking axis [m/s]."""
    if mechanism.approach is None or not mechanism.approach.velocity[AXIS]:
        return USUAL_SPEED
    return abs(mechanism.approach.velocity[AXIS])


def noise_level(mechanism: Any) -> float:
    """Return a force [N] above the sensor noise along the docking axis: 4 sigma plus bias and quantum."""
    sensor = mechanism.rig.force_sensor
    drift = sensor.bias_random_walk[AXIS] * BIAS_WALK_TIME**0.5
    return 4 * (sensor.noise_std[AXIS] + drift) + abs(sensor.bias[AXIS]) + sensor.quantum[AXIS]


def _never(mechanism: Any) -> bool:
    return False


def _covariance(name: str, size: Any) -> Gain:
    """Create the gain `name` that sets an initial covariance; `size(mechanism)` is its nominal value."""
    return rig_gain(
        name, lambda m: 1e-3 * size(m), lambda m: 1e1 * size(m), size, logarithmic=True, tuned=_never
    )


class ResponseError(SixAxisCompensator):
    """Compensator: phase lead on all channels, and correction of the simulator's lag on the docking axis."""

    name: ClassVar[str] = "response_error"
    knows: ClassVar[tuple[str, ...]] = (FORCE_DELAY,)
    reads_pose: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = (
        SIX_AXIS_PHASE_LEAD,
        LEAD_FILTER._replace(tuned=_never),
        rig_gain("response_error", lambda m: 0.0, lambda m: 2.0, lambda m: 1.0, neutral=0.0),
        rig_gain("response_error_damping", lambda m: 0.0, lambda m: 2.0, lambda m: 1.0, neutral=0.0),
        _covariance("stiffness_covariance", lambda m: 1 / (FIRST_SAMPLE_DEPTH * approach_speed(m)) ** 2),
        _covariance("damping_covariance", lambda m: 1 / approach_speed(m) ** 2),
        rig_gain("forgetting", lambda m: 0.8, lambda m: 1.0, lambda m: 0.98, tuned=_never),
        rig_gain(
            "velocity_filter", lambda m: 0.5 * m.rig.control_period, lambda m: 20 * m.rig.control_period,
            lambda m: 2 * m.rig.control_period, tuned=_never,
        ),
        rig_gain(
            "identification_delay", lambda m: 0.0, lambda m: 2 * force_delay(m) + 0.02, force_delay,
            tuned=_never,
        ),
        rig_gain(
            "contact_threshold", lambda m: 0.0, lambda m: 10 + 10 * noise_level(m),
            lambda m: max(0.1, noise_level(m)), tuned=_never,
        ),
        *lag_leads(equalise=False),
    )  # fmt: skip

    def prepare(self, gains, constants):
        period, filter_time = constants.control_period, gains["velocity_filter"]
        scale = 1 / (2 * filter_time + period)
        return PreparedResponseError(
            gains=gains,
            period=period,
            lead=build_lead_filter(gains, constants.of_channel),
            rate_pole=(2 * filter_time - period) * scale,
            rate_gain=2 * scale,
            delay=split_delay(gains["identification_delay"], period),
        )

    def init(self, prepared, constants, start, ring):
        zero = jnp.zeros_like(constants.control_period)
        variances = (prepared.gains[f"{name}_covariance"] for name in ("stiffness", "damping"))
        identified = ContactEstimate(zero, zero, zero, *variances)
        leads = tuple(LeadState(zero, zero) for _ in COORDINATES)
        return ResponseErrorState(
            leads=leads,
            line=empty_delay_line(ring, zero),
            position=zero,
            velocity=zero,
            aligned=zero,
            aligned_velocity=zero,
            surface=zero,
            in_contact=zero > 0,
            identified=identified,
        )

    def step(self, prepared, state, signals, tick):
        gains, period = prepared.gains, prepared.period
        assert signals.pose_measured is not None
        pairs = [
            apply_lead_filter(prepared.lead, old, force)
            for old, force in zip(state.leads, signals.wrench, strict=True)
        ]
        commands, leads = zip(*pairs, strict=True)
        force, desired = signals.wrench[AXIS], -signals.pose_desired[AXIS]
        speed, measured = -signals.twist_desired[AXIS], -signals.pose_measured[AXIS]
        travel = Signals(force, desired, speed, measured, signals.age)
        begins = signals.age == 0
        aligned, line = read_delayed(prepared.delay, state.line, travel, tick)

        def rate(position: Array, before: Array, velocity: Array) -> Array:
            before = jnp.where(begins, position - period * speed, before)
            velocity = jnp.where(begins, speed, velocity)
            return prepared.rate_pole * velocity + prepared.rate_gain * (position - before)

        velocity = rate(measured, state.position, state.velocity)
        aligned_velocity = rate(aligned, state.aligned, state.aligned_velocity)
        in_contact = jnp.abs(force) > gains["contact_threshold"]
        surface = jnp.where(state.in_contact, state.surface, jnp.where(begins, aligned, state.aligned))
        covariances = gains["stiffness_covariance"], gains["damping_covariance"]
        identified = update_estimate(
            state.identified,
            gains["forgetting"],
            covariances,
            aligned - surface,
            aligned_velocity,
            force,
            in_contact.astype(force.dtype),
        )
        stiffness, damping = jnp.maximum(identified.stiffness, 0), jnp.maximum(identified.damping, 0)
        response = gains["response_error"] * stiffness * (desired - measured)
        response = response + gains["response_error_damping"] * damping * (speed - velocity)
        commands = list(commands)
        commands[AXIS] = commands[AXIS] + jnp.where(in_contact, response, 0)
        return tuple(commands), ResponseErrorState(
            leads=leads,
            line=line,
            position=measured,
            velocity=velocity,
            aligned=aligned,
            aligned_velocity=aligned_velocity,
            surface=surface,
            in_contact=in_contact,
            identified=identified,
        )


COMPENSATOR = ResponseError()
