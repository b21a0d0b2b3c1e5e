"""Impulse ledger in JAX: the law of `jaxhil.runtime.laws.impulse_ledger`, for batches.

A force reading tells what the numerical model should have felt D ago. The law fits a contact model to the
readings, advances a reference trajectory at their time, bridges the D seconds to now with the fitted model,
and steers the numerical model's velocity onto the result. The equations stand there.
"""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.compensators import contact_model, onset_detection, reference_trajectory
from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, rig_gain
from jaxhil.compensators.contact_model import Estimate, dot, features
from jaxhil.compensators.delay_line import Delay, DelayLine, delayed, empty, split
from jaxhil.compensators.estimates import (
    EQUIVALENT_MASS,
    FORCE_DELAY,
    FORCE_NOISE,
    force_delay,
    friction,
    peak_force,
    preload,
    unloading,
)
from jaxhil.compensators.onset_detection import FreeFlight
from jaxhil.compensators.readings import Aligned, align
from jaxhil.compensators.reference_trajectory import Reference
from jaxhil.contact.laws import deflection
from jaxhil.runtime.laws.contact_model import HINGES
from jaxhil.runtime.laws.impulse_ledger import (
    HIGHEST,
    HOLD_TIME,
    LEAST_MOMENTUM,
    LEAST_STIFFNESS,
    LONGEST_LAG,
    MISFIT,
    MISFIT_TIME,
    ONSET_PLACE,
    OUTLYING,
    RELEASE_TIME,
    SHALLOW,
    SLOWEST,
    SPREADS,
)
from jaxhil.runtime.laws.onset_detection import LEVEL, SETTLING

USUAL_PRELOAD = 1.0  # 1/s; prior spread of the preload where the mechanism has less
USUAL_UNLOADING = 0.5  # 1/s^2; prior spread of the unloading parameter, likewise
VELOCITY_GAIN = 105.0  # 1/s


def _known(mechanism) -> bool:
    """Tell that a gain is known beforehand: tuning does not move it."""
    return False


def _prior(name: str, lower: float, upper: float, nominal: float, tuned=lambda m: True) -> Gain:
    """Return a gain that is the same for every mechanism."""
    return rig_gain(name, lambda m: lower, lambda m: upper, lambda m: nominal, logarithmic=True, tuned=tuned)


GAINS: tuple[Gain, ...] = (
    rig_gain(
        "equivalent_mass", lambda m: 0.1 * m.bodies.mass, lambda m: 10 * m.bodies.mass,
        lambda m: m.bodies.mass, logarithmic=True, tuned=_known,
    ),
    rig_gain(
        "identification_delay", lambda m: 0.0, lambda m: 2 * force_delay(m) + 0.02, force_delay, tuned=_known
    ),
    rig_gain(
        "force_noise", lambda m: 0.0, lambda m: m.rig.force_sensor.noise_std + peak_force(m),
        lambda m: m.rig.force_sensor.noise_std, tuned=_known,
    ),
    _prior("force_noise_floor", 1e-3, 10.0, 0.011, lambda m: not m.rig.force_sensor.noise_std),
    _prior("prior_stiffness", 0.1, 1e3, 10.0, _known),
    _prior("prior_stiffness_spread", 1.0, 1e3, 80.0),
    _prior("prior_slope_spread", 1.0, 1e3, 120.0),
    _prior("prior_damping_spread", 0.01, 20.0, 1.0),
    _prior("prior_depth_damping_spread", 1e-3, 20.0, 0.12),
    rig_gain(
        "prior_unloading_spread", lambda m: 0.01, lambda m: 1e3 + unloading(m),
        lambda m: max(USUAL_UNLOADING, unloading(m)), logarithmic=True, tuned=lambda m: unloading(m) > 0,
    ),
    rig_gain("prior_friction_spread", lambda m: 0.0, lambda m: 50.0 + friction(m), friction, tuned=_known),
    rig_gain(
        "prior_preload_spread", lambda m: 0.0, lambda m: 50.0 + preload(m),
        lambda m: max(USUAL_PRELOAD, preload(m)), tuned=_known,
    ),
    rig_gain(
        "velocity_gain", lambda m: 1.0, lambda m: 1 / m.rig.control_period,
        lambda m: min(VELOCITY_GAIN, 0.7 / m.rig.control_period), logarithmic=True,
    ),
    rig_gain(
        "correction_limit", lambda m: 0.01, lambda m: 20.0, lambda m: 0.75, logarithmic=True,
        begins=lambda m: 1.0,
    ),
)  # fmt: skip


class Contact(NamedTuple):
    """State that belongs to one contact."""

    side: Float[Array, "*batch"]  # direction in which the surface is approached, 1 or -1
    speed: Float[Array, "*batch"]  # approach speed [m/s]; 0: nothing can be scaled
    origin: Float[Array, "*batch"]  # position of the surface, along the side [m]
    lag: Float[Array, "*batch"]  # D [s]
    deepest: Float[Array, "*batch"]  # of the hardware [s]
    misfit: Float[Array, "*batch"]  # low-passed y - f(X, V) [1/s]
    peak: Float[Array, "*batch"]  # largest reading so far [1/s]
    outside: Float[Array, "*batch"]  # ticks since the hardware left the surface


class LedgerState(NamedTuple):
    """State from tick to tick."""

    line: DelayLine  # of the measured position
    aligned: Aligned  # measured positions as old as the force
    flight: FreeFlight  # readings in free flight
    in_contact: Bool[Array, "*batch"]
    contact: Contact
    estimate: Estimate  # of the contact model
    reference: Reference


class Prepared(NamedTuple):
    """Numbers computed once per run."""

    gains: Gains  # of the batch shape
    constants: Constants
    prior: tuple[Array, Array]  # mean and variances of the contact model's parameters
    delay: Delay  # of the delay line
    share: Float[Array, "*batch"]  # of the sample before, for the rest of the delay


class Reading(NamedTuple):
    """One tick's readings, as old as the force."""

    force: Float[Array, "*batch"]  # [N]
    position: Float[Array, "*batch"]  # [m]
    velocity: Float[Array, "*batch"]  # [m/s]


class ImpulseLedger(Compensator):
    """Compensator with contact model, reference trajectory and bridge; see the module's text."""

    name: ClassVar[str] = "impulse_ledger"
    knows: ClassVar[tuple[str, ...]] = (EQUIVALENT_MASS, FORCE_DELAY, FORCE_NOISE)
    anticipates: ClassVar[bool] = True
    is_large: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = GAINS

    def prepare(self, gains, constants):
        period = constants.control_period
        full = {name: jnp.zeros_like(period) + value for name, value in gains.items()}
        delay = full["identification_delay"]
        whole = delay > period
        prior = contact_model.prior(full["prior_stiffness"], tuple(full[name] for name in SPREADS))
        line = split(jnp.where(whole, delay - period, 0), period)
        return Prepared(full, constants, prior, line, jnp.where(whole, 1, delay / period))

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        none = zeros > 0
        parameters = jnp.zeros((contact_model.PARAMETERS, *zeros.shape), zeros.dtype)
        return LedgerState(
            line=empty(ring, zeros),
            aligned=Aligned(zeros, zeros),
            flight=FreeFlight(*[zeros] * len(FreeFlight._fields)),
            in_contact=none,
            contact=Contact(*[zeros] * len(Contact._fields)),
            estimate=Estimate(parameters, jnp.stack([parameters] * len(parameters)), parameters),
            reference=Reference(
                depth=zeros,
                speed=zeros,
                force=zeros,
                deepest=zeros,
                released=none,
                depths=parameters,
                speeds=parameters,
            ),
        )

    def restart(self, gains, state, begins, fresh):
        flight = FreeFlight(*(jnp.where(begins, 0, leaf) for leaf in state.flight))
        return state._replace(flight=flight, in_contact=state.in_contact & ~begins)

    def step(self, prepared, state, signals, tick):
        period, clearance = prepared.constants
        newest, line = delayed(prepared.delay, state.line, signals, tick)
        position, velocity, aligned = align(state.aligned, newest, prepared.share, signals, period)
        reading = Reading(signals.force_measured, position, velocity)
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
        mean, variances = prepared.prior
        estimate = contact_model.restarted(state.estimate, mean, variances, fresh)
        depth = (contact.side * position - contact.origin) / jnp.where(contact.speed > 0, contact.speed, 1)
        reference = reference_trajectory.restarted(state.reference, depth, fresh)
        acts = in_contact | (flight.total > LEVEL)
        follows = (in_contact & ~passes) | (flight.total > 0)

        usable = contact.speed > 0
        scaled = contact._replace(speed=jnp.where(usable, contact.speed, 1))
        command, later, estimate, reference = self._follow(
            prepared, scaled, estimate, reference, signals, reading, flight, follows & usable
        )
        over = acts & follows & reference.released & (later.outside * period > RELEASE_TIME)

        side = contact.side
        inside = side * deflection(signals.position_desired, clearance) > 0
        bent = side * deflection(position, clearance)
        passed_outside = jnp.where(bent > 0, 0, contact.outside + 1)
        over = jnp.where(passes, ~inside & (passed_outside * period > RELEASE_TIME), over)
        passed = jnp.where(inside & ~(bent < 0), signals.force_measured, 0)
        command = jnp.where(acts & ~over, jnp.where(passes, passed, command), 0)
        outside = jnp.where(passes, passed_outside, later.outside)
        contact = later._replace(speed=contact.speed, outside=outside)
        flight = flight._replace(total=jnp.where(over, 0, flight.total))
        return command, LedgerState(line, aligned, flight, acts & ~over, contact, estimate, reference)

    def _approach(self, prepared, flight, contact, signals, reading, in_contact):
        """Watch a reading of free flight; where it shows no contact, contact begins anew after it.

        Returns:
            What free flight shows, the contact, and where it begins anew.
        """
        gains, (period, clearance) = prepared.gains, prepared.constants
        side = jnp.where((signals.velocity_desired > 0) | jnp.isinf(clearance), 1, -1)
        speed = side * signals.velocity_desired
        approaches = gains["equivalent_mass"] * speed > LEAST_MOMENTUM
        sigma = _sqrt(onset_detection.variance(flight, gains["force_noise"]))
        sigma = sigma + gains["force_noise_floor"] * (gains["equivalent_mass"] * speed)
        sigma = jnp.where(approaches, sigma, 1)
        # What comes after a reading of free flight, at a speed and towards a side that it is known for.
        settled = ~(signals.age.astype(period.dtype) * period < SETTLING)
        settled = settled & approaches & (contact.speed > 0) & (side == contact.side)
        deviation = side * (reading.force - flight.bias) / sigma
        total = onset_detection.watch(flight, deviation, settled)
        flight = flight._replace(total=jnp.where(in_contact, flight.total, total))
        free = ~in_contact & ~(total > 0)
        fresh = free & approaches
        divisor = jnp.where(approaches, speed, 1)
        lag = side * (signals.position_desired - reading.position) / divisor
        lag = jnp.where(lag < 0, 0, jnp.where(lag > LONGEST_LAG, LONGEST_LAG, lag))
        origin = side * reading.position - ONSET_PLACE * (period * speed)
        zeros = jnp.zeros_like(speed)
        new = Contact(side, speed, origin, lag, zeros, zeros, zeros, zeros)
        contact = Contact(*(jnp.where(fresh, a, b) for a, b in zip(new, contact, strict=True)))
        contact = contact._replace(
            side=jnp.where(free, side, contact.side), speed=jnp.where(free & ~approaches, 0, contact.speed)
        )
        return onset_detection.learn(flight, reading.force, free), contact, fresh

    def _follow(self, prepared, contact, estimate, reference, signals, reading, flight, follows):
        """Return command [N], contact, estimate and reference after a reading, where the law `follows`."""
        gains, period = prepared.gains, prepared.constants.control_period
        side, speed = contact.side, contact.speed
        weight = gains["equivalent_mass"] * speed
        depth = (side * reading.position - contact.origin) / speed
        rate = side * reading.velocity / speed
        force = side * (reading.force - flight.bias) / weight
        deepest = jnp.where(depth > contact.deepest, depth, contact.deepest)
        phi = features(depth, rate, deepest)
        off = MISFIT * force
        noise = onset_detection.variance(flight, gains["force_noise"])
        variance = noise / (weight * weight) + gains["force_noise_floor"] ** 2
        variance = variance + off * off * (MISFIT_TIME / period)
        tells = (rate > SLOWEST) | (dot(phi, estimate.mean) > 0) | (force * force > OUTLYING * variance)
        learns = follows & tells & (depth > period)
        mean, covariance = contact_model.learn(estimate, phi, force, variance, learns)
        theta = contact_model.conclude(mean, covariance, prepared.prior[1])
        theta = jnp.where(learns[None], theta, estimate.theta)
        moved = reference_trajectory.correct(reference, theta - estimate.theta)
        moved = reference_trajectory.advance(moved, theta, period, force, phi)
        misfit = contact.misfit + period / (period + HOLD_TIME) * (force - dot(theta, phi) - contact.misfit)
        push, ahead = reference_trajectory.bridge(moved, theta, contact.lag + 0.5 * period, misfit)

        secant = dot(phi[:HINGES], mean[:HINGES]) / jnp.where(depth > SHALLOW, depth, SHALLOW)
        known = jnp.where(secant > LEAST_STIFFNESS, secant, LEAST_STIFFNESS) - _sqrt(covariance[0, 0])
        likely = jnp.sqrt(jnp.where(known > LEAST_STIFFNESS, known, LEAST_STIFFNESS))
        largest = jnp.where(force > contact.peak, force, contact.peak)
        largest = jnp.where(largest > 1, largest, 1)
        peak = jnp.where((rate > SLOWEST) & (likely > largest), likely, largest)
        push = jnp.where(push < HIGHEST * peak, push, HIGHEST * peak)
        desired = side * signals.velocity_desired / speed
        wanted = gains["velocity_gain"] * (desired - 0.5 * period * push - ahead)
        least = -gains["correction_limit"] * peak
        most = (1 + gains["correction_limit"]) * peak - push
        correction = jnp.where(wanted > most, most, jnp.where(wanted < least, least, wanted))
        command = side * weight * (push + correction)

        outside = jnp.where(depth > 0, 0, contact.outside + 1)
        later = contact._replace(deepest=deepest, misfit=misfit, peak=largest, outside=outside)

        def kept(new, old):
            wide = {0: follows, 1: follows[None]}
            pairs = zip(new, old, strict=True)
            return type(old)(*(jnp.where(wide[a.ndim - follows.ndim], a, b) for a, b in pairs))

        return command, kept(later, contact), Estimate(mean, covariance, theta), kept(moved, reference)


def _sqrt(value: Array) -> Array:
    """Return the square root, with derivative 0 where the value is not positive."""
    return jnp.where(value > 0, jnp.sqrt(jnp.where(value > 0, value, 1)), 0)
