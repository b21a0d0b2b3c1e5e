"""Balance of impulses in JAX: onset, reference trajectory, prediction to the present, and command."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import safe_sqrt, select_lanes
from jaxhil.laws.impulse_ledger.six_axes import constants as fixed
from jaxhil.laws.impulse_ledger.six_axes.simulation import dot, look_back, product
from jaxhil.laws.impulse_ledger.six_axes.state import (
    MODEL,
    LedgerState,
    PreparedLedger,
    Reading,
    SixAxisContact,
)
from jaxhil.laws.impulse_ledger.six_axes.tangent_model.simulation import (
    Estimate,
    Tangent,
    bridge,
    compute_force_change,
    learn,
    turn,
)
from jaxhil.laws.six_axis_base import Six, SixAxisSignals


def onset(
    prepared: PreparedLedger, state: LedgerState, reading: Reading, signals: SixAxisSignals
) -> SixAxisContact:
    """Return the state of a contact that begins with this reading (equation b of README.md).

    The impulse of the reference trajectory is 0 here; `follow` sets it from the delay line.
    """
    period, mass = prepared.constants.control_period, prepared.constants.mass_matrix
    flight, last = state.flight, state.contact
    has_flown = flight.ticks > 0
    lag = jnp.where(has_flown[None], flight.lag, signals.pose_desired - reading.pose)
    twist = jnp.where(has_flown[None], flight.twist, signals.twist_desired)
    direction = reading.wrench / _norm(prepared, reading.wrench)[None]
    closing, whole = -dot(direction, twist), dot(twist, product(mass, twist))
    least = fixed.MIN_SHARE * safe_sqrt(whole) + fixed.MIN_TWIST
    is_closing = closing > least
    slowest = fixed.MIN_SPEED * safe_sqrt(whole) + fixed.MIN_TWIST
    # If the contact's direction is perpendicular to the motion, use the mean delay of all directions.
    mean = dot(lag, product(mass, twist)) / (whole + fixed.MIN_TWIST**2)
    delay = jnp.where(is_closing, -dot(direction, lag) / jnp.where(is_closing, closing, 1), mean) / period
    longest = len(state.ring) - 2.0
    delay = jnp.clip(delay, prepared.gains["identification_delay"] / period, longest)
    is_recent = flight.ticks_since_contact * period < fixed.RECENT
    zeros = jnp.zeros_like(lag)
    return SixAxisContact(
        delay=jnp.where(is_recent, last.delay, delay),
        speed=jnp.where(is_recent, last.speed, jnp.maximum(closing, slowest)),
        impulse=zeros,
        drift=zeros,
        direction=reading.wrench,
        modelled=direction,
        path=jnp.zeros_like(delay),
        peak=jnp.zeros_like(delay),
        tool=jnp.where(is_recent, last.tool, 0),
    )


def follow(
    prepared: PreparedLedger,
    state: LedgerState,
    reading: Reading,
    contact: tuple[SixAxisContact, Estimate, Bool[Array, "*batch"]],
    tick: Int[Array, ""],
) -> tuple[Six, SixAxisContact, Estimate]:
    """Process one reading of a contact.

    Args:
        prepared: gains and constants.
        state: state of the compensator, with this tick in the delay line.
        reading: readings of this tick.
        contact: contact and estimate before this reading, and whether the contact begins with this reading.
        tick: number of this tick.

    Returns:
        Command wrench about the chaser's origin C [N, N m], contact, and estimate of the tangent model.
    """
    contact_now, estimate, begins = contact
    gains, period = prepared.gains, prepared.constants.control_period
    inverse_mass, is_contact = prepared.constants.inverse_mass, reading.is_contact
    recalled = look_back(state.ring, MODEL, tick, contact_now.delay)
    desired, twist, impulse = recalled[:6], recalled[6:12], recalled[12:]
    old = contact_now._replace(impulse=jnp.where(begins[None], impulse, contact_now.impulse))
    direction, mixed = _direction(prepared, old, reading, begins)
    # If the direction turns, the contact is at a different surface.
    along = dot(old.modelled, product(inverse_mass, direction))
    turns = begins | (is_contact & (along < fixed.TURNED))
    modelled = jnp.where(turns[None], direction, old.modelled)
    force = dot(reading.wrench, product(inverse_mass, direction))
    turned = turn(estimate, prepared.prior, old.path / old.speed, force / old.speed)
    estimate = select_lanes(begins, prepared.prior, select_lanes(turns, turned, estimate))
    path = jnp.where(turns, 0, old.path - dot(direction, reading.pose_change))
    estimate, tangent = _update_estimate(prepared, old, reading, estimate, (direction, path, force))

    # Advance the reference, which is at the time t - D (equation c of README.md).
    missing = product(inverse_mass, impulse - old.impulse)
    drift = old.drift + period[None] * missing
    deeper = -dot(direction, reading.pose - (desired - drift))
    faster = -dot(direction, reading.twist - (twist - missing))
    least = jnp.minimum(force, 0)
    corrected = jnp.maximum(force + compute_force_change(tangent, -deeper) - tangent.damping * faster, least)
    corrected = jnp.where(is_contact, corrected, force)
    booked = old.impulse + period[None] * (reading.wrench + (corrected - force)[None] * direction)

    # Predict from t - D to the middle of the command's period (equation d).
    velocity = -dot(direction, twist - product(inverse_mass, impulse - booked))
    ahead = (old.delay + fixed.AHEAD) * period
    touches = is_contact & (corrected != 0)
    bridged, last_force = bridge(tangent, corrected, least, deeper, velocity, ahead)
    stiffness = jnp.maximum(tangent.stiffness, fixed.MIN_STIFFNESS)
    peak = jnp.maximum(old.peak, jnp.abs(force))
    expected = jnp.maximum(jnp.sqrt(stiffness) * old.speed, peak)
    last_force = jnp.minimum(last_force, fixed.HIGHEST * expected)
    bridged, last_force = (jnp.where(touches, value, 0) for value in (bridged, last_force))
    rest = jnp.where(is_contact[None], reading.wrench - force[None] * direction, 0)
    unpaid = state.impulse - booked - bridged[None] * direction - ahead[None] * rest

    # Compute the command wrench (equation e).
    pulled = unpaid + jnp.where(touches, gains["position_gain"], 0)[None] * product(
        prepared.constants.mass_matrix, drift
    )
    command = last_force[None] * direction + rest + _correction(prepared, pulled, stiffness, old.speed)
    share = product(prepared.constants.tool_correction, reading.wrench) - reading.wrench
    tool = jnp.maximum(old.tool, dot(share, product(inverse_mass, share)))
    later = old._replace(
        impulse=booked, drift=drift, direction=mixed, modelled=modelled, path=path, peak=peak, tool=tool
    )
    return command, later, estimate


def _correction(
    prepared: PreparedLedger, unpaid: Six, stiffness: Float[Array, "*batch"], speed: Float[Array, "*batch"]
) -> Six:
    """Return the wrench, limited in norm, that reduces the impulse error `unpaid` [N s, N m s]."""
    wrench = -prepared.gains["velocity_gain"][None] * unpaid
    limit = prepared.gains["correction_limit"] * jnp.sqrt(stiffness) * speed
    large = safe_sqrt(dot(wrench, product(prepared.constants.inverse_mass, wrench)))
    return wrench * jnp.where(large > limit, limit / jnp.where(large > 0, large, 1), 1)[None]


def _norm(prepared: PreparedLedger, wrench: Six) -> Float[Array, "*batch"]:
    """Return the norm |W| = sqrt(W . M^-1 W) of a wrench W, with the mass matrix M; 1 if W is 0."""
    square = dot(wrench, product(prepared.constants.inverse_mass, wrench))
    return jnp.where(square > 0, safe_sqrt(square), 1)


def _direction(
    prepared: PreparedLedger, contact: SixAxisContact, reading: Reading, begins: Bool[Array, "*batch"]
) -> tuple[Six, Six]:
    """Return the contact's direction as a unit wrench, and the low-pass filtered wrench that defines it.

    A pulling force, for example of a latch, does not reverse the direction.
    """
    old, pole = contact.direction, prepared.gains["direction_pole"][None]
    along = dot(old, product(prepared.constants.inverse_mass, reading.wrench))
    wrench = jnp.where((along < 0)[None], -1, 1) * reading.wrench
    mixed = jnp.where((reading.is_contact & ~begins)[None], wrench + pole * (old - wrench), old)
    return mixed / _norm(prepared, mixed)[None], mixed


def _update_estimate(
    prepared: PreparedLedger,
    contact: SixAxisContact,
    reading: Reading,
    estimate: Estimate,
    along: tuple[Six, Float[Array, "*batch"], Float[Array, "*batch"]],
) -> tuple[Estimate, Tangent]:
    """Update the estimate with one reading; return the estimate and the tangent model.

    `along` contains the contact's direction, the depth along this direction, and the force per unit mass.
    """
    direction, path, force = along
    gains, period, speed = prepared.gains, prepared.constants.control_period, contact.speed
    growth = gains["forgetting"] ** (-period / 1e-3)
    rate = -dot(direction, reading.twist)
    learned = learn(
        estimate,
        prepared.prior,
        path / speed,
        rate / speed,
        force / speed,
        reading.variance / speed**2,
        growth,
    )
    mean = jnp.where(reading.is_contact[None], learned.mean, estimate.mean)
    covariance = jnp.where(reading.is_contact[None, None], learned.covariance, estimate.covariance)
    tangent = Tangent(
        stiffness=jnp.maximum(mean[0], 0),
        curvature=mean[3] / fixed.BEND,
        damping=jnp.clip(mean[1], 0, fixed.MAX_DAMPING / period),
        path=path / speed,
        speed=speed,
    )
    return Estimate(mean, covariance), tangent
