"""Impulse ledger in JAX: the batched compensator of `jaxhil.laws.impulse_ledger.rig`.

A force reading is the force that should have acted on the numerical model D ago. The compensator fits a
contact model to the readings, advances a reference trajectory at their time, bridges the D seconds to the
present with the fitted model, and controls the numerical model's velocity towards the result. `rig.py` states
the equations.
"""

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.contact.laws import deflection
from jaxhil.laws.impulse_ledger import rig, specified
from jaxhil.laws.impulse_ledger.alignment.simulation import Aligned, align
from jaxhil.laws.impulse_ledger.contact_model import simulation as contact_model
from jaxhil.laws.impulse_ledger.contact_model.rig import HINGES
from jaxhil.laws.impulse_ledger.contact_model.simulation import Estimate, dot, features
from jaxhil.laws.impulse_ledger.onset_detection import simulation as onset_detection
from jaxhil.laws.impulse_ledger.onset_detection.rig import LEVEL, SETTLING
from jaxhil.laws.impulse_ledger.onset_detection.simulation import FreeFlight
from jaxhil.laws.impulse_ledger.reference_trajectory import simulation as reference_trajectory
from jaxhil.laws.impulse_ledger.reference_trajectory.simulation import Reference
from jaxhil.laws.shared import nominal_values
from jaxhil.laws.shared.delay_line import (
    DelayInPeriods,
    DelayLine,
    empty_delay_line,
    read_delayed,
    split_delay,
)
from jaxhil.laws.simulation_base import Compensator, Gain, Gains, KnownConstants, rig_gain

USUAL_UNLOADING = 0.5  # 1/s^2; prior spread of the unloading parameter where the mechanism has less
VELOCITY_GAIN = 105.0  # 1/s


def _from_file(name: str, upper, nominal, lower=lambda m: 0.0) -> Gain:
    """Return a gain that follows from the mechanism file; tuning does not change it."""
    return rig_gain(name, lower, upper, nominal, tuned=lambda m: False)


def _prior(name: str, lower: float, upper: float, nominal: float, tuned=lambda m: True) -> Gain:
    """Return a gain with the same bounds and nominal value for every mechanism."""
    return rig_gain(name, lambda m: lower, lambda m: upper, lambda m: nominal, logarithmic=True, tuned=tuned)


GAINS: tuple[Gain, ...] = (
    _from_file(
        "equivalent_mass", lambda m: 10 * m.bodies.mass, lambda m: m.bodies.mass,
        lambda m: 0.1 * m.bodies.mass,
    ),
    _from_file(
        "identification_delay", lambda m: 2 * nominal_values.force_delay(m) + 0.02, nominal_values.force_delay
    ),
    _from_file("delay_spread", lambda m: rig.LARGEST_DELAY_SPREAD, specified.delay_spread),
    _from_file(
        "force_noise", lambda m: m.rig.force_sensor.noise_std + nominal_values.peak_force(m),
        lambda m: m.rig.force_sensor.noise_std,
    ),
    _prior("force_noise_floor", 2e-3, 10.0, 0.011, lambda m: not m.rig.force_sensor.noise_std),
    _prior("prior_stiffness", 0.1, 1e3, 10.0, lambda m: False),
    _prior("prior_stiffness_spread", 1.0, 1e3, 80.0),
    _prior("prior_slope_spread", 1.0, 1e3, 120.0),
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


class Contact(NamedTuple):
    """State of one contact."""

    side: Float[Array, "*batch"]  # direction in which the surface is approached, 1 or -1
    speed: Float[Array, "*batch"]  # approach speed [m/s]; 0 if unknown
    origin: Float[Array, "*batch"]  # position of the surface, in the direction of `side` [m]
    lag: Float[Array, "*batch"]  # D [s]
    deepest: Float[Array, "*batch"]  # largest depth of the hardware [s]
    misfit: Float[Array, "*batch"]  # low-pass of y - f(X, V) [1/s]
    peak: Float[Array, "*batch"]  # largest reading so far [1/s]
    outside: Float[Array, "*batch"]  # ticks since the hardware left the surface


class LedgerState(NamedTuple):
    """State of the impulse ledger from tick to tick."""

    line: DelayLine  # of the measured position
    aligned: Aligned  # measured positions as old as the force
    flight: FreeFlight  # readings in free flight
    in_contact: Bool[Array, "*batch"]
    contact: Contact
    estimate: Estimate  # of the contact model
    reference: Reference
    delay: Float[Array, "*batch"]  # estimated delay of the force beyond the specified one [s]
    variance: Float[Array, "*batch"]  # of the delay [s^2]


class Prepared(NamedTuple):
    """Gains and constants, computed once per run."""

    gains: Gains  # of the batch shape
    constants: KnownConstants
    delay: DelayInPeriods  # of the delay line
    share: Float[Array, "*batch"]  # weight of the previous sample, for the rest of the delay [1]


class Reading(NamedTuple):
    """Readings of one tick, as old as the force."""

    force: Float[Array, "*batch"]  # [N]
    position: Float[Array, "*batch"]  # [m]
    velocity: Float[Array, "*batch"]  # [m/s]


class ImpulseLedger(Compensator):
    """Compensator with contact model, reference trajectory and bridge; see the module's docstring."""

    name: ClassVar[str] = "impulse_ledger"
    knows: ClassVar[tuple[str, ...]] = (
        nominal_values.EQUIVALENT_MASS,
        nominal_values.FORCE_DELAY,
        nominal_values.FORCE_NOISE,
    )
    anticipates: ClassVar[bool] = True
    estimates_delay: ClassVar[bool] = True
    is_large: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = GAINS

    def prepare(self, gains, constants):
        period = constants.control_period
        full = {name: jnp.zeros_like(period) + value for name, value in gains.items()}
        delay = full["identification_delay"]
        whole = delay > period
        line = split_delay(jnp.where(whole, delay - period, 0), period)
        return Prepared(full, constants, line, jnp.where(whole, 1, delay / period))

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        prior = contact_model.prior(zeros, tuple([zeros] * len(rig.SPREADS)), zeros)
        estimate = contact_model.begin(*prior)
        return LedgerState(
            line=empty_delay_line(ring, zeros),
            aligned=Aligned(zeros, zeros),
            flight=FreeFlight(*[zeros] * len(FreeFlight._fields)),
            in_contact=zeros > 0,
            contact=Contact(*[zeros] * len(Contact._fields)),
            estimate=estimate,
            reference=reference_trajectory.begin(zeros, estimate.theta),
            delay=zeros,
            variance=zeros + gains["delay_spread"] ** 2,
        )

    def restart(self, gains, state, begins, fresh):
        flight = jax.tree.map(lambda leaf: jnp.where(begins, 0, leaf), state.flight)
        return state._replace(flight=flight, in_contact=state.in_contact & ~begins)

    def force_delay(self, gains, state):
        return gains["identification_delay"] + state.delay

    def step(self, prepared, state, signals, tick):
        gains, (period, clearance) = prepared.gains, prepared.constants
        newest, line = read_delayed(prepared.delay, state.line, signals, tick)
        position, velocity, aligned = align(state.aligned, newest, prepared.share, signals, period)
        reading = Reading(signals.force_measured, position - state.delay * velocity, velocity)
        begins = signals.age == 0
        reach = deflection(signals.position_desired, clearance)
        contact = state.contact
        contact = contact._replace(
            side=jnp.where(begins, jnp.where(reach > 0, 1, -1), contact.side),
            speed=jnp.where(begins, 0, contact.speed),
            outside=jnp.where(begins, 0, contact.outside),
        )
        in_contact = jnp.where(begins, reach != 0, state.in_contact)
        passes = in_contact & ~(contact.speed > 0)

        flight, contact, fresh = self._approach(prepared, state.flight, contact, signals, reading, in_contact)
        usable = contact.speed > 0
        scaled = contact._replace(speed=jnp.where(usable, contact.speed, 1))
        spreads = [gains[name] for name in rig.SPREADS]
        spreads[-1] = jnp.sqrt(spreads[-1] ** 2 + rig.USUAL_PRELOAD**2)
        before = contact_model.prior(gains["prior_stiffness"], tuple(spreads), state.variance)
        depth = (scaled.side * reading.position - scaled.origin) / scaled.speed
        estimate = _select(fresh, contact_model.begin(*before), state.estimate)
        reference = _select(fresh, reference_trajectory.begin(depth, before[0]), state.reference)
        acts = in_contact | (flight.total > LEVEL)
        follows = ((in_contact & ~passes) | (flight.total > 0)) & usable
        command, *later, delay = self._follow(
            prepared, scaled, estimate, reference, signals, reading, flight, before
        )
        later, estimate, reference = _select(follows, tuple(later), (contact, estimate, reference))
        over = acts & follows & reference.released & (later.outside * period > rig.RELEASE_TIME)
        limit = rig.MOST_SPREADS * gains["delay_spread"]
        shift = jnp.where(over & ~passes, delay[0], 0)
        variance = jnp.where(over & ~passes, delay[1], state.variance)

        side = contact.side
        inside = side * deflection(signals.position_desired, clearance) > 0
        bent = side * deflection(reading.position, clearance)
        passed_outside = jnp.where(bent > 0, 0, contact.outside + 1)
        over = jnp.where(passes, ~inside & (passed_outside * period > rig.RELEASE_TIME), over)
        passed = jnp.where(inside & ~(bent < 0), signals.force_measured, 0)
        command = jnp.where(acts & ~over, jnp.where(passes, passed, jnp.where(follows, command, 0)), 0)
        outside = jnp.where(passes, passed_outside, later.outside)
        contact = later._replace(speed=jnp.where(over, 0, contact.speed), outside=outside)
        flight = flight._replace(total=jnp.where(over, 0, flight.total))
        return command, LedgerState(
            line=line,
            aligned=aligned,
            flight=flight,
            in_contact=acts & ~over,
            contact=contact,
            estimate=estimate,
            reference=reference,
            delay=jnp.clip(state.delay + shift, -limit, limit),
            variance=variance,
        )

    def _approach(self, prepared, flight, contact, signals, reading, in_contact):
        """Test a reading of free flight for contact; where there is none, let contact begin after it.

        Returns:
            Statistics of free flight, contact, and the lanes where contact begins after this reading.
        """
        gains, (period, clearance) = prepared.gains, prepared.constants
        side = jnp.where((signals.velocity_desired > 0) | jnp.isinf(clearance), 1, -1)
        speed = side * signals.velocity_desired
        approaches = gains["equivalent_mass"] * speed > rig.LEAST_MOMENTUM
        sigma = _sqrt(onset_detection.variance(flight, gains["force_noise"]))
        sigma = sigma + gains["force_noise_floor"] * (gains["equivalent_mass"] * speed)
        sigma = jnp.where(approaches, sigma, 1)
        # The bias is known only after a reading of free flight, at an approach speed towards this side.
        settled = ~(signals.age.astype(period.dtype) * period < SETTLING)
        settled = settled & approaches & (contact.speed > 0) & (side == contact.side)
        deviation = side * (reading.force - flight.bias) / sigma
        total = onset_detection.watch(flight, deviation, settled)
        flight = flight._replace(total=jnp.where(in_contact, flight.total, total))
        free = ~in_contact & ~(total > 0)
        fresh = free & approaches
        lag = side * (signals.position_desired - reading.position) / jnp.where(approaches, speed, 1)
        lag = jnp.where(lag < 0, 0, jnp.where(lag > rig.LONGEST_LAG, rig.LONGEST_LAG, lag))
        origin = side * reading.position - rig.ONSET_PLACE * (period * speed)
        zeros = jnp.zeros_like(speed)
        contact = _select(fresh, Contact(side, speed, origin, lag, zeros, zeros, zeros, zeros), contact)
        contact = contact._replace(
            side=jnp.where(free, side, contact.side), speed=jnp.where(free & ~approaches, 0, contact.speed)
        )
        return onset_detection.learn(flight, reading.force, free), contact, fresh

    def _follow(self, prepared, contact, estimate, reference, signals, reading, flight, before):
        """Return command [N], contact, estimate, reference, and mean and variance of the delay.

        They follow a reading; the delay is that of a contact that ends here. `before` is the prior of the
        contact model.
        """
        gains, period = prepared.gains, prepared.constants.control_period
        side, speed = contact.side, contact.speed
        weight = gains["equivalent_mass"] * speed
        depth = (side * reading.position - contact.origin) / speed
        rate = side * reading.velocity / speed
        deepest = jnp.where(depth > contact.deepest, depth, contact.deepest)
        phi = features(depth, rate, deepest, contact_model.slope(estimate.mean, depth) * (1 - rate))
        force = side * (reading.force - flight.bias) / weight
        model_error = rig.MISFIT * force
        noise = onset_detection.variance(flight, gains["force_noise"]) / (weight * weight)
        variance = (
            noise + gains["force_noise_floor"] ** 2 + model_error * model_error * (rig.MISFIT_TIME / period)
        )
        informs = (
            (rate > rig.SLOWEST) | (dot(phi, estimate.mean) > 0) | (force * force > rig.OUTLYING * variance)
        )
        learns = informs & (depth > period)
        estimate = contact_model.learn(estimate, phi, force, variance, learns)

        stiffness = contact_model.slope(estimate.mean, deepest)
        onset = rig.ONSET_TICKS * period * stiffness + gains["force_noise_floor"] + _sqrt(noise)
        spread = jnp.sqrt(gains["prior_preload_spread"] ** 2 + (rig.ONSET_SPREAD * onset) ** 2)
        delay = contact_model.estimate_delay(estimate, before[0], before[1], rig.ONSET_MEAN * onset, spread)
        ended = ~(depth > 0) & (rate < 0)
        theta = contact_model.conclude(estimate, before[1], jnp.where(ended, delay[0], 0))
        theta = jnp.where((learns | ended)[None], theta, estimate.theta)
        reference = reference_trajectory.correct(reference, theta - estimate.theta)
        reference = reference_trajectory.advance(reference, theta, period, force, phi)
        residual = force - dot(theta, phi) - contact.misfit
        misfit = contact.misfit + period / (period + rig.HOLD_TIME) * residual
        push, ahead = reference_trajectory.bridge(reference, theta, contact.lag + 0.5 * period, misfit)

        mean = estimate.mean
        secant = dot(phi[:HINGES], mean[:HINGES]) / jnp.where(depth > rig.SHALLOW, depth, rig.SHALLOW)
        secure = jnp.maximum(secant, rig.LEAST_STIFFNESS) - _sqrt(estimate.covariance[0, 0])
        predicted = jnp.sqrt(jnp.maximum(secure, rig.LEAST_STIFFNESS))
        largest = jnp.maximum(jnp.maximum(force, contact.peak), 1)
        peak = jnp.where((rate > rig.SLOWEST) & (predicted > largest), predicted, largest)
        push = jnp.minimum(push, rig.HIGHEST * peak)
        desired = side * signals.velocity_desired / speed
        wanted = gains["velocity_gain"] * (desired - 0.5 * period * push - ahead)
        least = -gains["correction_limit"] * peak
        most = (1 + gains["correction_limit"]) * peak - push
        correction = jnp.where(wanted > most, most, jnp.where(wanted < least, least, wanted))
        outside = jnp.where(depth > 0, 0, contact.outside + 1)
        contact = contact._replace(deepest=deepest, misfit=misfit, peak=largest, outside=outside)
        return side * weight * (push + correction), contact, estimate._replace(theta=theta), reference, delay


def _select(condition: Bool[Array, "*batch"], new: Any, old: Any) -> Any:
    """Return the new leaves where the condition holds, else the old ones."""

    def select(new: Array, old: Array) -> Array:
        return jnp.where(jnp.expand_dims(condition, range(new.ndim - condition.ndim)), new, old)

    return jax.tree.map(select, new, old)


def _sqrt(value: Array) -> Array:
    """Return the square root, with derivative 0 where the value is not positive."""
    return jnp.where(value > 0, jnp.sqrt(jnp.where(value > 0, value, 1)), 0)


COMPENSATOR = ImpulseLedger()
