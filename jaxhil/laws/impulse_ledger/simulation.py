"""Impulse ledger in JAX: batched version of `rig.py` in this folder, which states the equations."""

from functools import partial
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.contact.laws import deflection
from jaxhil.lanes import safe_sqrt, select_lanes, update_lanes
from jaxhil.laws.impulse_ledger import rig, specified
from jaxhil.laws.impulse_ledger.alignment.simulation import Aligned, align
from jaxhil.laws.impulse_ledger.contact_model import simulation as contact_model
from jaxhil.laws.impulse_ledger.contact_model.rig import HINGES
from jaxhil.laws.impulse_ledger.contact_model.simulation import ContactModelEstimate, dot, features
from jaxhil.laws.impulse_ledger.onset_detection import simulation as onset_detection
from jaxhil.laws.impulse_ledger.onset_detection.rig import LEVEL, SETTLING
from jaxhil.laws.impulse_ledger.onset_detection.simulation import FreeFlight
from jaxhil.laws.impulse_ledger.reference_trajectory import simulation as reference_trajectory
from jaxhil.laws.impulse_ledger.reference_trajectory.simulation import ReferenceTrajectory
from jaxhil.laws.shared import nominal_values
from jaxhil.laws.shared.delay_line import (
    DelayInPeriods,
    DelayLine,
    empty_delay_line,
    read_delayed,
    split_delay,
)
from jaxhil.laws.simulation_base import Compensator, Gain, Gains, KnownConstants, clear_lanes, rig_gain

USUAL_UNLOADING = 0.5  # lower bound of the nominal `prior_unloading_spread` [1/s^2]
VELOCITY_GAIN = 105.0  # nominal value, unless the control period requires a smaller gain [1/s]


def _from_file(name: str, upper, nominal, lower=lambda m: 0.0) -> Gain:
    """Create a gain whose value follows from the mechanism file, so that tuning does not change it."""
    return rig_gain(name, lower, upper, nominal, tuned=lambda m: False)


def _prior(name: str, lower: float, upper: float, nominal: float, tuned=lambda m: True) -> Gain:
    """Create a gain with the same bounds and nominal value for every mechanism."""
    return rig_gain(name, lambda m: lower, lambda m: upper, lambda m: nominal, logarithmic=True, tuned=tuned)


GAINS: tuple[Gain, ...] = (
    _from_file(
        "equivalent_mass", lambda m: 10 * m.bodies.mass, lambda m: m.bodies.mass,
        lambda m: 0.1 * m.bodies.mass,
    ),
    _from_file(
        "identification_delay", lambda m: 2 * nominal_values.force_delay(m) + 0.02, nominal_values.force_delay
    ),
    _from_file("delay_spread", lambda m: rig.MAX_DELAY_SPREAD, specified.delay_spread),
    _from_file(
        "force_noise", lambda m: m.rig.force_sensor.noise_std + nominal_values.peak_force(m),
        lambda m: m.rig.force_sensor.noise_std,
    ),
    _prior("force_noise_floor", 2e-3, 10.0, 0.011, lambda m: not m.rig.force_sensor.noise_std),
    _prior("prior_stiffness", 0.1, 1e3, 10.0, lambda m: False),
    _prior("prior_stiffness_spread", 1.0, 1e3, 80.0),
    _prior("prior_slope_spread", 1.0, 1e3, 200.0),
    _prior("prior_damping_spread", 0.01, 20.0, 1.0),
    _prior("prior_depth_damping_spread", 1e-3, 20.0, 0.15),
    rig_gain(
        "prior_unloading_spread", lambda m: 0.01, lambda m: 1e3 + specified.unloading(m),
        lambda m: max(USUAL_UNLOADING, specified.unloading(m)), logarithmic=True,
        tuned=lambda m: specified.unloading(m) > 0,
    ),
    _from_file("prior_friction_spread", lambda m: 50.0 + specified.friction(m), specified.friction),
    _from_file("prior_preload_spread", lambda m: 50.0 + specified.preload(m), specified.preload),
    rig_gain(
        "velocity_gain", lambda m: 1.0, lambda m: 1 / m.rig.control_period,
        lambda m: min(VELOCITY_GAIN, 0.7 / m.rig.control_period), logarithmic=True,
    ),
    rig_gain(
        "correction_limit", lambda m: 0.01, lambda m: 20.0, lambda m: 0.68, logarithmic=True,
        begins=lambda m: 1.0,
    ),
)  # fmt: skip


class LedgerContact(NamedTuple):
    """State of the impulse ledger during one contact."""

    side: Float[Array, "*batch"]  # direction of the approach, 1 or -1
    speed: Float[Array, "*batch"]  # approach speed [m/s]; 0 if unknown
    origin: Float[Array, "*batch"]  # position of the surface, multiplied by `side` [m]
    lag: Float[Array, "*batch"]  # lag D of hardware and force behind the model [s]
    deepest: Float[Array, "*batch"]  # largest depth of the hardware, divided by `speed` [s]
    peak: Float[Array, "*batch"]  # largest force reading so far, divided by mass and `speed` [1/s]
    outside: Float[Array, "*batch"]  # number of ticks since the hardware left the surface
    estimate: ContactModelEstimate
    reference: ReferenceTrajectory
    delay: Float[Array, "*batch"]  # mean of the delay that this contact estimates [s]
    variance: Float[Array, "*batch"]  # variance of this delay [s^2]


class LedgerState(NamedTuple):
    """State of the impulse ledger after a tick."""

    line: DelayLine  # delay line of the measured position
    aligned: Aligned  # measured positions, delayed like the force
    flight: FreeFlight  # statistics of the force readings in free flight
    in_contact: Bool[Array, "*batch"]
    contact: LedgerContact
    delay: Float[Array, "*batch"]  # estimated minus specified force delay [s]
    variance: Float[Array, "*batch"]  # variance of the force delay [s^2]


class PreparedLedger(NamedTuple):
    """Gains and constants of the impulse ledger, computed once per run."""

    gains: Gains  # arrays of the batch shape
    constants: KnownConstants
    delay: DelayInPeriods  # delay of the delay line, one tick shorter than the force delay
    share: Float[Array, "*batch"]  # weight of the line's previous sample, for the remaining delay [1]


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
        period = constants.control_period
        full = {name: jnp.zeros_like(period) + value for name, value in gains.items()}
        delay = full["identification_delay"]
        line = split_delay(jnp.where(delay > period, delay - period, 0), period)
        return PreparedLedger(full, constants, line, jnp.where(delay > period, 1, delay / period))

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        full = {name: zeros + value for name, value in gains.items()}
        variance = full["delay_spread"] ** 2
        return LedgerState(
            line=empty_delay_line(ring, zeros),
            aligned=Aligned(zeros, zeros),
            flight=FreeFlight(*[zeros] * len(FreeFlight._fields)),
            in_contact=zeros > 0,
            contact=self._begin(full, zeros, zeros, zeros, zeros, zeros, variance),
            delay=zeros,
            variance=variance,
        )

    def restart(self, gains, state, begins, fresh):
        flight = clear_lanes(state.flight, begins)
        return state._replace(flight=flight, in_contact=state.in_contact & ~begins)

    def force_delay(self, gains, state):
        return gains["identification_delay"] + state.delay

    def step(self, prepared, state, signals, tick):
        gains, (period, clearance) = prepared.gains, prepared.constants
        newest, line = read_delayed(prepared.delay, state.line, signals, tick)
        position, velocity, aligned = align(state.aligned, newest, prepared.share, signals, period)
        position = position - state.delay * velocity
        begins = signals.age == 0
        reach = deflection(signals.position_desired, clearance)
        in_contact = jnp.where(begins, reach != 0, state.in_contact)
        contact = state.contact._replace(
            side=jnp.where(begins, jnp.where(reach > 0, 1, -1), state.contact.side),
            speed=jnp.where(begins, 0, state.contact.speed),
        )
        passes = in_contact & ~(contact.speed > 0)  # a run that began in contact
        inside = contact.side * reach > 0
        holds = inside | (contact.side * deflection(position, clearance) > 0)

        flight, contact = self._approach(prepared, state, contact, signals, position, in_contact)
        acts = in_contact | (flight.total > LEVEL)
        follows = (in_contact | (flight.total > 0)) & ~passes
        # All lanes of a tile have contact at about the same time: on most ticks, no lane needs `_follow`.
        follow = partial(self._follow, prepared, contact, signals, position, velocity, flight, state.variance)
        command, contact = update_lanes(follows, follow, (jnp.zeros_like(position), contact))
        over = acts & follows & contact.reference.released & (contact.outside * period > rig.RELEASE_TIME)
        limit = rig.MAX_SPREADS * gains["delay_spread"]
        shifted = jnp.clip(state.delay + contact.delay, -limit, limit)
        command = jnp.where(passes, jnp.where(inside, signals.force_measured, 0), command)
        return jnp.where(acts & ~over, command, 0), LedgerState(
            line=line,
            aligned=aligned,
            flight=flight._replace(total=jnp.where(over, 0, flight.total)),
            in_contact=jnp.where(passes, holds, acts & ~over),
            contact=contact._replace(speed=jnp.where(over, 0, contact.speed)),
            delay=jnp.where(over, shifted, state.delay),
            variance=jnp.where(over, contact.variance, state.variance),
        )

    def _prior(self, gains, variance):
        """Return prior means and variances of the contact model; `variance` is the delay's variance [s^2]."""
        spreads = [gains[name] for name in rig.SPREADS]
        spreads[-1] = jnp.sqrt(spreads[-1] ** 2 + rig.USUAL_PRELOAD**2)
        return contact_model.prior(gains["prior_stiffness"], spreads, variance)

    def _begin(self, gains, side, speed, origin, lag, depth, variance) -> LedgerContact:
        """Return a contact before its first reading.

        The arguments are fields of `LedgerContact`, and `depth`, the present depth divided by `speed` [s].
        """
        zeros, prior = jnp.zeros_like(speed), self._prior(gains, variance)
        return LedgerContact(
            side, speed, origin, lag, zeros, zeros + rig.MIN_PEAK, zeros, contact_model.begin(*prior),
            reference_trajectory.begin(depth, prior[0]), zeros, variance,
        )  # fmt: skip

    def _approach(self, prepared, state, contact, signals, position, in_contact):
        """Test the force readings for contact; on lanes in free flight, prepare a contact on the next tick.

        Return the statistics of free flight and the contact.
        """
        gains, (period, clearance), flight = prepared.gains, prepared.constants, state.flight
        side = jnp.where((signals.velocity_desired > 0) | jnp.isinf(clearance), 1, -1)
        speed = side * signals.velocity_desired
        approaches = gains["equivalent_mass"] * speed > rig.MIN_MOMENTUM
        sigma = safe_sqrt(onset_detection.variance(flight, gains["force_noise"]))
        sigma = sigma + gains["force_noise_floor"] * (gains["equivalent_mass"] * speed)
        # The bias is known only after a reading of free flight during an approach in this direction.
        settled = ~(signals.age.astype(period.dtype) * period < SETTLING)
        settled = settled & approaches & (contact.speed > 0) & (side == contact.side)
        deviation = side * (signals.force_measured - flight.bias) / jnp.where(approaches, sigma, 1)
        total = onset_detection.update(flight, deviation, settled)
        flight = flight._replace(total=jnp.where(in_contact, flight.total, total))
        free = ~in_contact & ~(total > 0)
        divisor = jnp.where(approaches, speed, 1)
        origin = side * position - rig.ONSET_PLACE * (period * speed)
        lag = jnp.clip(side * (signals.position_desired - position) / divisor, 0, rig.MAX_LAG)
        depth = (side * position - origin) / divisor
        begin = partial(self._begin, gains, side, speed, origin, lag, depth, state.variance)
        contact = update_lanes(free & approaches, begin, contact)
        contact = contact._replace(
            side=jnp.where(free, side, contact.side), speed=jnp.where(free & ~approaches, 0, contact.speed)
        )
        return select_lanes(free, onset_detection.learn(flight, signals.force_measured), flight), contact

    def _follow(self, prepared, contact, signals, position, velocity, flight, delay_variance):
        """Process one reading during a contact; return the force command [N] and the contact."""
        gains, period = prepared.gains, prepared.constants.control_period
        side, speed = contact.side, jnp.where(contact.speed > 0, contact.speed, 1)
        estimate = contact.estimate
        prior_mean, prior_variances = self._prior(gains, delay_variance)
        weight = gains["equivalent_mass"] * speed
        depth = (side * position - contact.origin) / speed
        rate = side * velocity / speed
        deepest = jnp.maximum(contact.deepest, depth)
        phi = features(depth, rate, deepest, contact_model.slope(estimate.mean, depth) * (1 - rate))
        reading = side * (signals.force_measured - flight.bias) / weight
        noise = onset_detection.variance(flight, gains["force_noise"]) / (weight * weight)
        model_error = rig.MISFIT**2 * (rig.MISFIT_TIME / period) * reading**2
        variance = noise + gains["force_noise_floor"] ** 2 + model_error
        learns = (depth > period) & ((rate > rig.MIN_SCALED_SPEED) | (dot(phi, estimate.mean) > 0))
        estimate = contact_model.learn(estimate, phi, reading, variance, learns)

        onset = rig.ONSET_TICKS * period * contact_model.slope(estimate.mean, deepest)
        onset = onset + gains["force_noise_floor"] + safe_sqrt(noise)
        spread = jnp.sqrt(gains["prior_preload_spread"] ** 2 + (rig.ONSET_SPREAD * onset) ** 2)
        is_outside = ~(depth > 0)
        estimate_delay = partial(
            contact_model.estimate_delay,
            *(estimate, prior_mean, prior_variances, rig.ONSET_MEAN * onset, spread),
        )
        mean, variance = update_lanes(
            is_outside & (delay_variance > 0), estimate_delay, (contact.delay, contact.variance)
        )
        ended = is_outside & (rate < 0)
        theta = contact_model.conclude(estimate, prior_variances, jnp.where(ended, mean, 0))
        theta = jnp.where((learns | ended)[None], theta, estimate.theta)
        reference = reference_trajectory.correct(contact.reference, theta - estimate.theta)
        reference = reference_trajectory.advance(reference, theta, period, reading, phi)
        push, ahead = reference_trajectory.bridge(reference, theta, contact.lag + 0.5 * period)

        secure = dot(phi[:HINGES], estimate.mean[:HINGES]) / jnp.maximum(depth, rig.MIN_CONTACT_DEPTH)
        predicted = safe_sqrt(secure - safe_sqrt(estimate.covariance[0, 0]))
        largest = jnp.maximum(contact.peak, reading)
        peak = jnp.maximum(largest, jnp.where(rate > rig.MIN_SCALED_SPEED, predicted, 0))
        desired = side * signals.velocity_desired / speed
        unlimited = gains["velocity_gain"] * (desired - 0.5 * period * push - ahead)
        limit = gains["correction_limit"] * peak
        correction = jnp.minimum(jnp.maximum(unlimited, -limit), peak + limit - push)
        return side * weight * (push + correction), contact._replace(
            deepest=deepest,
            peak=largest,
            outside=jnp.where(is_outside, contact.outside + 1, 0),
            estimate=estimate._replace(theta=theta),
            reference=reference,
            delay=mean,
            variance=variance,
        )


COMPENSATOR = ImpulseLedger()
