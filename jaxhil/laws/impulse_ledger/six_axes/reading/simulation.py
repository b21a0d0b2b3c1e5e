"""Sensor readings of a tick in JAX: pose filter, alignment, tool correction and contact detection."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.impulse_ledger.six_axes import constants as fixed
from jaxhil.laws.impulse_ledger.six_axes.simulation import (
    dot,
    look_back,
    product,
    running_mean,
    wrench_at_chaser,
)
from jaxhil.laws.impulse_ledger.six_axes.state import (
    POSE,
    FreeFlightState,
    LedgerState,
    PreparedLedger,
    Reading,
)
from jaxhil.laws.shared.ring_buffer import write_sample
from jaxhil.laws.six_axis_base import Six, SixAxisSignals


def record(
    prepared: PreparedLedger, state: LedgerState, signals: SixAxisSignals, tick: Int[Array, ""]
) -> LedgerState:
    """Filter the measured pose and write the signals of this tick to the delay line."""
    assert signals.pose_measured is not None
    begins = (signals.age == 0)[None]
    measured, pole = signals.pose_measured, prepared.pole[None]
    # Start in steady state: in uniform motion, the filter lags by pole/(1 - pole) ticks.
    stride = prepared.constants.control_period[None] * signals.twist_desired
    before = jnp.where(begins, measured - stride * (1 / (1 - pole)), state.filtered)
    filtered = measured + pole * (before - measured)
    rows = jnp.concatenate([filtered, signals.pose_desired, signals.twist_desired, state.impulse])
    return state._replace(
        ring=write_sample(state.ring, tick, rows),
        filtered=filtered,
        first=jnp.where(begins, filtered, state.first),
    )


def read(
    prepared: PreparedLedger, state: LedgerState, signals: SixAxisSignals, tick: Int[Array, ""]
) -> tuple[Reading, LedgerState]:
    """Return this tick's corrected readings, and the state with updated mean values of free flight."""
    constants, gains = prepared.constants, prepared.gains
    period, inverse_mass = constants.control_period, constants.inverse_mass
    pose = _aligned(prepared, state, signals, tick)
    last = jnp.where((signals.age == 0)[None], pose - period[None] * signals.twist_desired, state.aligned)
    wrench = wrench_at_chaser(jnp.stack(_computed_once(signals.wrench, tick)), pose)
    # The hardware accelerates by M^-1 W, and the sensor reads (1 - M_t M^-1) W (equation a of README.md).
    corrected = product(constants.tool_correction, wrench)
    unbiased = corrected - state.flight.bias
    variance = noise_variance(prepared, pose)
    settles = signals.age.astype(period.dtype) * period < gains["settle"]
    is_recent = state.flight.ticks_since_contact * period < fixed.RECENT
    least = fixed.MIN_RATE**2 * dot(
        signals.twist_desired, product(constants.mass_matrix, signals.twist_desired)
    )
    tool = jnp.where(state.in_contact | is_recent, state.contact.tool, 0)
    gate = fixed.ONSET_SIGMAS**2 * variance + least + tool
    is_contact = (dot(unbiased, product(inverse_mass, unbiased)) > gate) & ~settles
    reading = Reading(
        wrench=unbiased,
        variance=variance,
        pose=pose,
        twist=(pose - last) / period[None],
        pose_change=pose - last,
        is_contact=is_contact,
    )
    free = ~state.in_contact & ~is_contact
    flight = _update_free_flight(state.flight, corrected, signals, pose, free, free & ~is_recent, period)
    return reading, state._replace(aligned=pose, flight=flight)


def _computed_once(components: tuple[Array, ...], tick: Int[Array, ""]) -> tuple[Array, ...]:
    """Return the components inside the condition `tick >= 0`, so that they are computed only once.

    The condition always holds, but the compiler cannot know it and does not merge operations across it.
    Without the condition, it would repeat the hundreds of operations of the force sensor for each entry of a
    matrix product.
    """
    return lax.cond(tick >= 0, lambda values: values, lambda values: tuple(-v for v in values), components)


def noise_variance(prepared: PreparedLedger, pose: Six) -> Float[Array, "*batch"]:
    """Return the mean squared norm [N^2/kg] of the wrench noise if the chaser's frame C is at `pose`."""
    gains, metric, position = prepared.gains, prepared.noise_metric, pose[:3]
    linear, angular = (sum(metric[i, i] for i in part) for part in (range(3), range(3, 6)))
    coupling = jnp.stack(
        [metric[2, 4] - metric[1, 5], metric[0, 5] - metric[2, 3], metric[1, 3] - metric[0, 4]]
    )
    # The noise f of one force channel is the wrench (f, -p x f) about C's origin at p.
    moment = angular * dot(position, position) - dot(position, product(metric[3:, 3:], position))
    force = linear + 2 * dot(coupling, position) + moment
    return gains["force_noise"] ** 2 * force + gains["torque_noise"] ** 2 * angular


def _aligned(
    prepared: PreparedLedger, state: LedgerState, signals: SixAxisSignals, tick: Int[Array, ""]
) -> Six:
    """Return the hardware's filtered pose, delayed like the force; before the run, assume uniform motion."""
    back = prepared.back
    recalled = look_back(state.ring, POSE, tick, back)
    ago = back - signals.age.astype(back.dtype)
    uniform = state.first - (prepared.constants.control_period * ago)[None] * signals.twist_desired
    return jnp.where((ago > 0)[None], uniform, recalled)


def _update_free_flight(
    flight: FreeFlightState,
    wrench: Six,
    signals: SixAxisSignals,
    pose: Six,
    free: Bool[Array, "*batch"],
    uniform: Bool[Array, "*batch"],
    period: Float[Array, "*batch"],
) -> FreeFlightState:
    """Update the mean wrench (bias) on the lanes `free`, and mean lag and twist on the lanes `uniform`."""
    readings = jnp.minimum(flight.readings + free.astype(period.dtype), fixed.MAX_MEAN)
    ticks = jnp.minimum(flight.ticks + 1, fixed.MAX_FLIGHT / period)
    ticks = jnp.where(uniform, ticks, jnp.where(free, 0, flight.ticks))
    lag, twist = (
        running_mean(mean, value, ticks, uniform)
        for mean, value in ((flight.lag, signals.pose_desired - pose), (flight.twist, signals.twist_desired))
    )
    return flight._replace(
        bias=running_mean(flight.bias, wrench, readings, free),
        readings=readings,
        lag=lag,
        twist=twist,
        ticks=ticks,
    )
