"""Impulse ledger in JAX: batched version of `rig.py` in this folder, which states the equations."""

from functools import partial
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.contact.laws import deflection
from jaxhil.lanes import safe_sqrt, select_lanes, update_lanes
from jaxhil.laws.impulse_ledger import rig, specified
from jaxhil.laws.impulse_ledger.alignment import simulation as alignment
from jaxhil.laws.impulse_ledger.alignment.simulation import align
from jaxhil.laws.impulse_ledger.contact_model import simulation as contact_model
from jaxhil.laws.impulse_ledger.contact_model.simulation import dot, features, slope
from jaxhil.laws.impulse_ledger.onset_detection import simulation as onset_detection
from jaxhil.laws.impulse_ledger.reference_trajectory import simulation as reference_trajectory
from jaxhil.laws.shared import nominal_values
from jaxhil.laws.simulation_base import Compensator, Gain, clear_lanes, rig_gain

USUAL_UNLOADING = 0.5  # lower bound of the nominal `prior_unloading_spread` [1/s^2]
VELOCITY_GAIN = 105.0  # nominal value, unless the control period requires a smaller gain [1/s]


def _from_file(name: str, nominal, factor: float, margin: float, lowest: float = 0.0) -> Gain:
    """Create a gain whose value follows from the mechanism file, so that tuning does not change it.

    The bounds are `lowest` times the nominal value, and `factor` times the nominal value plus `margin`.
    """
    bounds = (lambda m: lowest * nominal(m)), (lambda m: factor * nominal(m) + margin)
    return rig_gain(name, *bounds, nominal, tuned=lambda m: False)


def _constant(name: str, lower: float, upper: float, nominal: float, **others) -> Gain:
    """Create a gain with the same bounds and nominal value for every mechanism."""
    return rig_gain(name, lambda m: lower, lambda m: upper, lambda m: nominal, logarithmic=True, **others)


GAINS: tuple[Gain, ...] = (
    _from_file("equivalent_mass", lambda m: m.bodies.mass, 10.0, 0.0, lowest=0.1),
    _from_file("identification_delay", nominal_values.force_delay, 2.0, 0.02),
    _from_file("delay_spread", specified.delay_spread, 0.0, rig.MAX_DELAY_SPREAD),
    rig_gain(
        "force_noise", lambda m: 0.0, lambda m: m.rig.force_sensor.noise_std + nominal_values.peak_force(m),
        lambda m: m.rig.force_sensor.noise_std, tuned=lambda m: False,
    ),
    _constant("force_noise_floor", 2e-3, 10.0, 0.011, tuned=lambda m: not m.rig.force_sensor.noise_std),
    _constant("prior_stiffness", 0.1, 1e3, 10.0, tuned=lambda m: False),
    _constant("prior_stiffness_spread", 1.0, 1e3, 80.0),
    _constant("prior_slope_spread", 1.0, 1e3, 200.0),
    _constant("prior_damping_spread", 0.01, 20.0, 1.0),
    _constant("prior_depth_damping_spread", 1e-3, 20.0, 0.15),
    rig_gain(
        "prior_unloading_spread", lambda m: 0.01, lambda m: 1e3 + specified.unloading(m),
        lambda m: max(USUAL_UNLOADING, specified.unloading(m)), logarithmic=True,
        tuned=lambda m: specified.unloading(m) > 0,
    ),
    _from_file("prior_friction_spread", lambda m: specified.scaled_force(m, "contact.friction"), 1.0, 50.0),
    _from_file("prior_preload_spread", lambda m: specified.scaled_force(m, "contact.preload"), 1.0, 50.0),
    rig_gain(
        "velocity_gain", lambda m: 1.0, lambda m: 1 / m.rig.control_period,
        lambda m: min(VELOCITY_GAIN, 0.7 / m.rig.control_period), logarithmic=True,
    ),
    _constant("correction_limit", 0.01, 20.0, 0.68, begins=lambda m: 1.0),
)  # fmt: skip


class LedgerContact(NamedTuple):
    """State of the impulse ledger during one contact."""

    origin: Float[Array, "*batch"]  # position of the surface [m]
    lag: Float[Array, "*batch"]  # lag D of hardware and force behind the model [s]
    deepest: Float[Array, "*batch"]  # largest depth of the hardware, divided by the approach speed [s]
    peak: Float[Array, "*batch"]  # largest force reading so far, divided by mass and approach speed [1/s]
    outside: Float[Array, "*batch"]  # number of ticks since the hardware left the surface
    estimate: contact_model.ContactModelEstimate
    reference: reference_trajectory.ReferenceTrajectory
    delay: contact_model.DelayEstimate  # estimate from this contact, relative to that of earlier contacts


class LedgerState(NamedTuple):
    """State of the impulse ledger after a tick."""

    alignment: alignment.Alignment
    side: Float[Array, "*batch"]  # 1 or -1 if the run began in contact (with the surface at 0 or -clearance)
    flight: onset_detection.FreeFlight
    contact: LedgerContact
    delay: contact_model.DelayEstimate  # estimate from earlier contacts, relative to the specified delay


class ImpulseLedger(Compensator):
    """Compensator that follows a predicted reference trajectory; see `rig.py` in this folder."""

    name: ClassVar[str] = "impulse_ledger"
    knows: ClassVar[tuple[str, ...]] = (
        nominal_values.EQUIVALENT_MASS,
        nominal_values.FORCE_DELAY,
        nominal_values.FORCE_NOISE,
    )
    anticipates: ClassVar[bool] = True
    estimates_delay: ClassVar[bool] = True
    is_large: ClassVar[bool] = True
    tuned_without_derivatives: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = GAINS

    def prepare(self, gains, constants):
        """Return the gains as arrays of the batch shape, and the constants."""
        zeros = jnp.zeros_like(constants.control_period)
        return {name: zeros + value for name, value in gains.items()}, constants

    def init(self, gains, constants, ring):
        zeros, (full, _) = jnp.zeros_like(constants.control_period), self.prepare(gains, constants)
        delay = contact_model.DelayEstimate(zeros, full["delay_spread"] ** 2)
        return LedgerState(
            alignment=alignment.begin(ring, zeros),
            side=zeros,
            flight=onset_detection.FreeFlight(*[zeros] * len(onset_detection.FreeFlight._fields)),
            contact=_begin_contact(full, zeros, zeros, zeros, zeros + 1, delay),
            delay=delay,
        )

    def restart(self, gains, state, begins, fresh):
        return state._replace(flight=clear_lanes(state.flight, begins))

    def force_delay(self, gains, state):
        return gains["identification_delay"] + state.delay.mean

    def step(self, prepared, state, signals, tick):
        gains, (period, clearance) = prepared
        force_delay = gains["identification_delay"]
        position, velocity, aligned = align(state.alignment, force_delay, period, signals, tick)
        position = position - state.delay.mean * velocity
        reach = deflection(signals.position_desired, clearance)
        depth = deflection(position, clearance)
        side = jnp.where(signals.age == 0, jnp.sign(reach), state.side)
        inside = side * reach > 0
        stays = inside | (side * depth > 0)
        flies = (side == 0) & ~(state.flight.total > rig.LEVEL)
        state = self._approach(prepared, state, signals, position, depth, flies)
        # All lanes of a tile have contact at about the same time: on most ticks, no lane needs `_follow`.
        follow = partial(self._follow, prepared, state, signals, position, velocity)
        command = jnp.zeros_like(position)
        command, contact = update_lanes(state.flight.total > 0, follow, (command, state.contact))
        acts = state.flight.total > rig.LEVEL
        over = acts & contact.reference.released & (contact.outside * period > rig.RELEASE_TIME)
        limit = rig.MAX_SPREADS * gains["delay_spread"]
        mean = jnp.clip(state.delay.mean + contact.delay.mean, -limit, limit)
        command = jnp.where(acts & ~over, command, jnp.where(inside, signals.force_measured, 0))
        return command, LedgerState(
            alignment=aligned,
            side=jnp.where(stays, side, 0),
            flight=state.flight._replace(
                total=jnp.where(over, 0, state.flight.total),
                velocity=jnp.where(over, 0, state.flight.velocity),
            ),
            contact=contact,
            delay=select_lanes(over, contact.delay._replace(mean=mean), state.delay),
        )

    def _approach(self, prepared, state, signals, position, depth, flies):
        """Test the force readings of the lanes `flies` for contact; in free flight, prepare for a contact."""
        gains, (period, clearance) = prepared
        flight, force, velocity = state.flight, signals.force_measured, signals.velocity_desired
        speed = jnp.where(jnp.isinf(clearance), velocity, jnp.abs(velocity))
        weight = gains["equivalent_mass"] * speed
        approaches = weight > rig.MIN_MOMENTUM
        # The bias is known only after a reading of free flight during an approach in this direction.
        settled = ~(signals.age.astype(period.dtype) * period < rig.SETTLING)
        settled = settled & approaches & (flight.velocity * velocity > 0)
        sigma = safe_sqrt(onset_detection.variance(flight, gains["force_noise"]))
        sigma = sigma + gains["force_noise_floor"] * weight
        inside = jnp.sign(velocity) * depth > 0
        push, sigma = jnp.sign(velocity) * (force - flight.bias), jnp.where(approaches, sigma, 1)
        flight = select_lanes(
            flies, onset_detection.update(flight, push, sigma, settled, inside, position), flight
        )
        free, begun = flies & ~(flight.total > 0), flight.early > rig.LEVEL
        divisor = jnp.where(approaches, velocity, 1)
        origin = jnp.where(begun, flight.start, position) - rig.ONSET_PLACE * (period * velocity)
        missed = jnp.where(begun, period * flight.missed / jnp.where(approaches, weight, 1), 0)
        lag = jnp.clip((signals.position_desired - position) / divisor, 0, rig.MAX_LAG)
        begin = partial(
            _begin_contact, gains, origin, lag, (position - origin) / divisor, 1 - missed, state.delay
        )
        # Behind the specified surface, the force of a soft contact would be learned as bias.
        flight = select_lanes(free & (depth == 0), onset_detection.learn(flight, force), flight)
        return state._replace(
            flight=flight._replace(
                velocity=jnp.where(free, jnp.where(approaches, velocity, 0), flight.velocity)
            ),
            contact=update_lanes(free & approaches, begin, state.contact),
        )

    def _follow(self, prepared, state, signals, position, velocity):
        """Process one reading during a contact; return the force command [N] and the contact."""
        gains, (period, _) = prepared
        flight, contact, estimate = state.flight, state.contact, state.contact.estimate
        prior_mean, prior_variances = _prior(gains, state.delay)
        approach_velocity = jnp.where(flight.velocity != 0, flight.velocity, 1)
        weight = gains["equivalent_mass"] * approach_velocity
        depth = (position - contact.origin) / approach_velocity
        rate = velocity / approach_velocity
        deepest = jnp.maximum(contact.deepest, depth)
        phi = features(depth, rate, deepest, slope(estimate.mean, depth) * (1 - rate))
        reading = (signals.force_measured - flight.bias) / weight
        noise = onset_detection.variance(flight, gains["force_noise"]) / (weight * weight)
        model_error = rig.MISFIT**2 * (rig.MISFIT_TIME / period) * reading**2
        variance = noise + gains["force_noise_floor"] ** 2 + model_error
        learns = (depth > period) & ((rate > rig.MIN_SCALED_SPEED) | (dot(phi, estimate.mean) > 0))
        estimate = contact_model.learn(estimate, phi, reading, variance, learns)

        onset = rig.ONSET_TICKS * period * slope(estimate.mean, deepest)
        onset = onset + gains["force_noise_floor"] + safe_sqrt(noise)
        spread = jnp.sqrt(gains["prior_preload_spread"] ** 2 + (rig.ONSET_SPREAD * onset) ** 2)
        is_outside = ~(depth > 0)
        prior = prior_mean, prior_variances, rig.ONSET_MEAN * onset, spread
        estimate_delay = partial(contact_model.estimate_delay, estimate, *prior)
        delay = update_lanes(is_outside & (state.delay.variance > 0), estimate_delay, contact.delay)
        ended = is_outside & (rate < 0)
        theta = contact_model.conclude(estimate, prior_variances, jnp.where(ended, delay.mean, 0))
        theta = jnp.where((learns | ended)[None], theta, estimate.theta)
        reference = reference_trajectory.correct(contact.reference, theta - estimate.theta)
        reference = reference_trajectory.advance(reference, theta, period, reading, phi)
        push, ahead = reference_trajectory.bridge(reference, theta, contact.lag + 0.5 * period)

        secant = dot(phi[: rig.HINGES], estimate.mean) / jnp.maximum(depth, rig.MIN_CONTACT_DEPTH)
        predicted = safe_sqrt(secant - safe_sqrt(estimate.covariance[0, 0]))
        largest = jnp.maximum(contact.peak, reading)
        peak = jnp.maximum(largest, jnp.where(rate > rig.MIN_SCALED_SPEED, predicted, 0))
        desired = signals.velocity_desired / approach_velocity
        unlimited = gains["velocity_gain"] * (desired - 0.5 * period * push - ahead)
        limit = gains["correction_limit"] * peak
        correction = jnp.minimum(jnp.maximum(unlimited, -limit), peak + limit - push)
        return weight * (push + correction), contact._replace(
            deepest=deepest,
            peak=largest,
            outside=jnp.where(is_outside, contact.outside + 1, 0),
            estimate=estimate._replace(theta=theta),
            reference=reference,
            delay=delay,
        )


def _prior(gains, delay):
    """Return prior means and variances of the contact model, for the delay's estimate before the contact."""
    spreads = [gains[name] for name in rig.SPREADS]
    spreads[-1] = jnp.sqrt(spreads[-1] ** 2 + rig.USUAL_PRELOAD**2)
    return contact_model.prior(gains["prior_stiffness"], spreads, delay.variance)


def _begin_contact(gains, origin, lag, depth, speed, delay) -> LedgerContact:
    """Return a contact before its first reading, at the scaled `depth` [s] and `speed` [1]."""
    zeros, prior = jnp.zeros_like(depth), _prior(gains, delay)
    reference = reference_trajectory.begin(depth, speed, prior[0])
    peak, estimate = zeros + rig.MIN_PEAK, contact_model.begin(*prior)
    return LedgerContact(origin, lag, zeros, peak, zeros, estimate, reference, delay._replace(mean=zeros))


COMPENSATOR = ImpulseLedger()
