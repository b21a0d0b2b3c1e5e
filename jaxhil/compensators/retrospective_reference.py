"""The retrospective reference: identify the contact, work out what should have happened, and pay it back.

A map from depth to force is identified on delay-aligned readings (`force_depth_map`). From it the motion that
the contact should have had since its entry is integrated over again while the map improves
(`reference_motion`), and the numerical model (x_d, v_d) is steered onto that motion (x_r, v_r) until the
hardware itself has separated. No model of the motion simulator is used. Scaled by approach speed v0 and
equivalent mass M, F_theta the map, (X, V) the measured motion aligned with the measured force y:

    f_0 = max(F_theta(x_d, v_d), 0)
    f_e = clip(gate [w^2 (x_d - x_r) + 2 z w (v_d - T f_0/2 - v_r)], -limit, limit)
    in contact:  F_c = f_0 + (y - F_theta(X, V)) + f_e
    separated:   F_c = f_e  until the hardware has left the surface for 6 ms, then 0

`gate` is the share of the prior's variance that has been learnt. Every contact starts afresh; so does one
with the other surface. Without f_e it is the published law with the map in the place of k_hat and b_hat; a
run that begins in contact has no approach speed to scale by: there F_c is the measured force, as it is.
"""

from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains
from jaxhil.compensators.delay_line import Delay, DelayLine, delayed, empty, split
from jaxhil.compensators.estimates import EQUIVALENT_MASS, FORCE_DELAY, force_delay
from jaxhil.compensators.force_depth_map import (
    PARAMETERS,
    Map,
    Prior,
    elastic,
    features,
    learnt,
    positive_damping,
    prior,
    update,
)
from jaxhil.compensators.reference_motion import (
    History,
    Reference,
    entry,
    follow,
    no_history,
    remember,
)
from jaxhil.contact import deflection
from jaxhil.ring import tie

FAREWELL = 0.006
LONGEST_LAG = 0.1  # s for which it waits for hardware that has not touched yet


def _fact(mechanism) -> bool:
    """Of gains that are known beforehand or chosen, not tuned."""
    return False


class Aligned(NamedTuple):
    """Measured position [m] delayed by tau and by tau + T, of the tick before."""

    middle: Float[Array, "*batch"]
    last: Float[Array, "*batch"]


class Episode(NamedTuple):
    """One contact: side (1 or -1; 0: none), approach speed [m/s] (0: unusable), time [s] from the entry to
    the first tick, ticks since that one, whether (1) the hardware has touched, ticks since it left, where
    between two ticks its samples fall on the reference's grid; of the tick before, what was measured
    (y, X, V), y moved to that grid and its integral [ticks/s]."""

    side: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]
    first: Float[Array, "*batch"]
    elapsed: Int[Array, "*batch"]
    touched: Float[Array, "*batch"]
    gone: Float[Array, "*batch"]
    fraction: Float[Array, "*batch"]
    sample: Float[Array, "3 *batch"]
    moved: Float[Array, "*batch"]
    impulse: Float[Array, "*batch"]


class RetrospectiveState(NamedTuple):
    """Delay line and aligned readings; sum of squares [N^2] and number of forces before contact; the contact
    under way, its map, reference and history."""

    line: DelayLine
    aligned: Aligned
    noise: tuple[Array, Array]
    episode: Episode
    map: Map
    reference: Reference
    history: History


class Prepared(NamedTuple):
    """Gains, constants, prior of the map, delay tau - T (or 0) of the line, share of the sample before."""

    gains: Gains
    constants: Constants
    prior: Prior
    delay: Delay
    share: Float[Array, "*batch"]


class RetrospectiveReference(Compensator):
    """Force-depth map, reference and repayment; see the module's text."""

    name: ClassVar[str] = "retrospective_reference"
    knows: ClassVar[tuple[str, ...]] = (EQUIVALENT_MASS, FORCE_DELAY)
    gains: ClassVar[tuple[Gain, ...]] = (
        Gain(
            "equivalent_mass", "kg", lambda m: 0.1 * m.bodies.mass, lambda m: 10 * m.bodies.mass,
            lambda m: m.bodies.mass, logarithmic=True, tuned=_fact,
        ),
        Gain(
            "identification_delay", "s", lambda m: 0.0, lambda m: 2 * force_delay(m) + 0.02,
            force_delay, tuned=_fact,
        ),
        Gain(
            "prior_stiffness", "1/s^2", lambda m: 10.0, lambda m: 5e3, lambda m: 254.0, logarithmic=True,
        ),
        Gain(
            "prior_stiffness_spread", "1", lambda m: 0.05, lambda m: 5.0, lambda m: 2.63, logarithmic=True,
        ),
        Gain(
            "prior_slope_spread", "1", lambda m: 0.01, lambda m: 5.0, lambda m: 0.979, logarithmic=True,
        ),
        Gain("prior_damping", "1/s", lambda m: 0.0, lambda m: 10.0, lambda m: 0.063, tuned=_fact),
        Gain(
            "prior_damping_spread", "1/s", lambda m: 0.01, lambda m: 20.0, lambda m: 0.879,
            logarithmic=True,
        ),
        Gain(
            "force_noise_floor", "1/s", lambda m: 1e-3, lambda m: 10.0, lambda m: 0.139, logarithmic=True,
        ),
        Gain(
            "reference_frequency", "rad/s", lambda m: 10.0, lambda m: 500.0, lambda m: 225.0,
            logarithmic=True,
        ),
        Gain(
            "reference_damping_ratio", "1", lambda m: 0.1, lambda m: 5.0, lambda m: 0.76,
            logarithmic=True,
        ),
        Gain("correction_limit", "1/s", lambda m: 1.0, lambda m: 200.0, lambda m: 40.0, tuned=_fact),
        Gain("force_replay", "1", lambda m: 0.0, lambda m: 1.0, lambda m: 1.0, tuned=_fact),
    )  # fmt: skip

    def prepare(self, gains, constants):
        period = constants.control_period
        like = jnp.zeros_like(period)
        full = {name: like + value for name, value in gains.items()}
        delay, whole = full["identification_delay"], full["identification_delay"] > period
        return Prepared(
            full,
            constants,
            prior(
                full["prior_stiffness"],
                full["prior_stiffness_spread"],
                full["prior_slope_spread"],
                full["prior_damping"],
                full["prior_damping_spread"],
            ),
            split(jnp.where(whole, delay - period, 0), period),
            jnp.where(whole, 1, delay / period),
        )

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        counts = jnp.zeros(zeros.shape, jnp.int32)
        theta = jnp.zeros((PARAMETERS, *zeros.shape), zeros.dtype)
        return RetrospectiveState(
            line=empty(ring, zeros),
            aligned=Aligned(zeros, zeros),
            noise=(zeros, zeros),
            episode=Episode(
                zeros,
                zeros,
                zeros,
                counts,
                zeros,
                zeros,
                zeros,
                jnp.stack([zeros, zeros, zeros]),
                zeros,
                zeros,
            ),
            map=Map(theta, theta[:, None] + theta[None]),
            reference=Reference(entry(zeros), entry(zeros), counts - 1, theta),
            history=no_history(zeros),
        )

    def restart(self, gains, state, begins, fresh):
        episode = state.episode
        return state._replace(
            noise=tuple(jnp.where(begins, 0, leaf) for leaf in state.noise),
            episode=episode._replace(side=jnp.where(begins, 0, episode.side)),
        )

    def step(self, prepared, state, signals, tick):
        gains, period = prepared.gains, prepared.constants.control_period
        clearance, mass = prepared.constants.clearance, gains["equivalent_mass"]
        old = state.episode

        # The measured motion as old as the force that is read.
        begins = signals.age == 0
        newest, line = delayed(prepared.delay, state.line, signals, tick)
        stride = period * signals.velocity_desired
        middle = jnp.where(begins, newest - stride, state.aligned.middle)
        last = jnp.where(begins, newest - 2 * stride, state.aligned.last)
        position = newest + prepared.share * (middle - newest)
        velocity = (newest - last) / (2 * period)

        # Which contact it is, and what it is scaled by.
        touching = deflection(signals.position_desired, clearance)
        side_now = jnp.sign(touching)
        enters = (side_now != 0) & (side_now != old.side)
        side = jnp.where(enters, side_now, old.side)
        approach = side_now * signals.velocity_desired
        sound = (approach > 0) & (jnp.abs(touching) <= 2 * period * approach)
        speed = jnp.where(enters, jnp.where(sound, approach, 0), old.velocity)
        under_way = side != 0
        usable = under_way & (speed > 0)
        scale = jnp.where(usable, speed, 1)

        def depth_of(measured):
            return jnp.where(side < 0, -clearance - measured, measured) / scale

        x, v = depth_of(signals.position_desired), side * signals.velocity_desired / scale
        depth, rate = depth_of(position), side * velocity / scale
        elsewhere = jnp.sign(deflection(position, clearance)) == -side
        weight = mass * scale
        force = jnp.where(elsewhere, 0, side * signals.force_measured / weight)
        first = jnp.where(enters, jnp.where(usable, x, 0), old.first)
        elapsed = jnp.where(enters, 0, old.elapsed + 1)

        # The hardware's entry, and where its samples fall on the reference's grid.
        touched_before = jnp.where(enters, 0, old.touched) > 0
        onset = usable & ~touched_before & (depth > 0)
        touched = touched_before | onset
        since = depth / jnp.where(onset & (rate > 0), rate, 1)
        since = jnp.where(rate > 0, jnp.minimum(since, period), 0.5 * period)
        shift = (first - since) / period
        whole = jnp.floor(shift)
        fraction = jnp.where(onset, shift - whole, old.fraction)
        origin = jnp.where(onset, tick + 1 + whole.astype(jnp.int32), state.history.origin)
        number = jnp.where(touched_before, state.history.number, 0)
        history = state.history._replace(origin=origin, number=number)

        free_readings = (~under_way | ~touched) & (deflection(position, clearance) == 0)
        squares = state.noise[0] + jnp.where(free_readings, signals.force_measured**2, 0)
        count = state.noise[1] + jnp.where(free_readings, 1, 0)
        floor = squares / (jnp.where(count > 0, count, 1) * weight**2)
        variance = gains["force_noise_floor"] ** 2 + floor

        before = Map(
            jnp.where(enters[None], prepared.prior.mean, state.map.mean),
            jnp.where(enters[None, None], prepared.prior.covariance, state.map.covariance),
        )
        now = update(before, features(depth, rate), force, variance, usable & (depth > 0))
        damping = positive_damping(now)
        theta = jnp.concatenate([now.mean[:-1], damping[None]])
        reference = follow(
            state.reference._replace(reached=jnp.where(enters, -1, state.reference.reached)),
            theta,
            history,
            gains["force_replay"],
            first,
            period,
            elapsed,
        )
        live = reference.live

        own = jnp.where(x > 0, elastic(now.mean[:-1], x) + damping * v, 0)
        expected = jnp.where(depth > 0, elastic(now.mean[:-1], depth) + damping * rate, 0)
        separated = (x <= 0) | (usable & (v < 0) & (own <= 0))
        own = jnp.where(own > 0, own, 0)
        frequency, limit = gains["reference_frequency"], gains["correction_limit"]
        gate = learnt(now, prepared.prior, x, v)
        wanted = gate * (
            frequency**2 * (x - live.depth)
            + 2 * gains["reference_damping_ratio"] * frequency * (v - 0.5 * period * own - live.speed)
        )
        correction = jnp.where(wanted > limit, limit, jnp.where(wanted < -limit, -limit, wanted))
        command = jnp.where(separated, correction, own + (force - expected) + correction)
        command = jnp.where(usable, command, jnp.where(separated, 0, force))

        gone = jnp.where(enters | (depth > 0), 0, old.gone + 1)
        patience = jnp.where(touched | ~usable, FAREWELL, LONGEST_LAG)
        over = separated & (gone * period > patience * (1 + 1e-9))
        command = jnp.where(under_way & ~over, side * weight * command, 0)

        sample = jnp.stack([force, depth, rate])
        kept = jnp.where(enters[None], jnp.stack([force, depth - period * rate, rate]), old.sample)
        moved = kept + fraction[None] * (sample - kept)
        arrived = tick - origin + 1
        begun = 0.5 * moved[0] * first / period
        impulse = jnp.where(arrived == 1, begun, old.impulse + 0.5 * (old.moved + moved[0]))
        # Written after it is read: only then the ring is updated in place.
        impulse = tie(impulse, jnp.where(jnp.isfinite(live.depth), live.depth, 0))
        stored = jnp.concatenate([impulse[None], moved[1:]])
        ring = remember(history, tick, stored)
        number = jnp.where(touched, jnp.where(arrived > 0, arrived, 0), 0)
        return command, RetrospectiveState(
            line=line,
            aligned=Aligned(newest, middle),
            noise=(squares, count),
            episode=Episode(
                side=jnp.where(over, 0, side),
                velocity=speed,
                first=first,
                elapsed=elapsed,
                touched=touched.astype(side.dtype),
                gone=gone,
                fraction=fraction,
                sample=sample,
                moved=moved[0],
                impulse=impulse,
            ),
            map=now,
            reference=reference,
            history=History(ring, origin, number),
        )
