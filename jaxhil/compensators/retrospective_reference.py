"""The retrospective reference: identify the contact, work out what should have happened, and pay it back.

A map from depth to force is identified on delay-aligned readings (`force_depth_map`). From it the motion that
the contact should have had since its entry is integrated over again while the map improves
(`reintegration`), and the numerical model's speed v_d is led to that motion's, v_r, until the hardware itself
has separated. No model of the motion simulator is used. Scaled by approach speed v0 and equivalent mass M,
F the map, (X, V) the measured motion aligned with the measured force y, p the peak force that the map
predicts:

    f_0 = max(F(x_d, v_d), 0)
    f_e = clip(c (v_d - T f_0/2 - v_r), -limit p, limit p)
    in contact:  F_c = f_0 + (y - F(X, V)) + f_e
    separated:   F_c = f_e  until the hardware has left the surface for 6 ms, then 0

It is the momentum that is paid back: what the numerical model was late by stays as an offset of its position,
which no force has to make up for. Every contact starts afresh; so does one with the other surface. Without
f_e it is the published law with the map in the place of k_hat and b_hat: that is what remains while nothing
is identified. A run that begins in contact has no approach speed to scale by: there F_c is the measured
force, as it is.

A sensor's known dead zone is added to what it reads. What it hides (a reading of 0 in contact) counts as
half of it, with the variance of a uniform distribution, and only where the map expects more; nothing of it
is replayed. Where forces stand out of the noise before the hardware was to touch, its surface is nearer than
told: it is taken to be where the first of them was read. Where the noise's standard deviation s is not
small, less of the bracket of `reintegration` is replayed: rho = force_replay/(1 + (s/replay_noise)^2).
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains
from jaxhil.compensators.delay_line import Delay, DelayLine, delayed, empty, split
from jaxhil.compensators.estimates import DEAD_ZONE, EQUIVALENT_MASS, FORCE_DELAY, FORCE_NOISE
from jaxhil.compensators.force_depth_map import (
    Curve,
    Map,
    Reading,
    curve,
    features,
    force,
    peak_force,
    prior,
    update,
)
from jaxhil.compensators.reintegration import History, Reference, entry, follow, no_history, remember
from jaxhil.compensators.retrospective_episode import (
    Aligned,
    Episode,
    Noise,
    Sample,
    align,
    enter_grid,
    force_noise,
    move,
    no_episode,
    scaled,
    sort_out,
)
from jaxhil.compensators.retrospective_gains import GAINS, GENTLE, SHARP
from jaxhil.ring_buffer import depend_on
from jaxhil.runtime.laws.retrospective import PRIOR

FAREWELL = 0.006  # s for which it goes on after the hardware has left the surface
LONGEST_LAG = 0.1  # s for which it waits for hardware that has not touched yet


class RetrospectiveState(NamedTuple):
    """Delay line and aligned readings; the force's noise; the contact under way, what was learnt of it (its
    map), its reference and history."""

    line: DelayLine
    aligned: Aligned
    noise: Noise
    episode: Episode
    learnt: Any
    reference: Reference
    history: History


class Prepared(NamedTuple):
    """Gains, constants, prior of the map, delay tau - T (or 0) of the line, share of the sample before."""

    gains: Gains
    constants: Constants
    prior: Map
    delay: Delay
    share: Float[Array, "*batch"]


class RetrospectiveReference(Compensator):
    """Force-depth map, reference and repayment; see the module's text."""

    name: ClassVar[str] = "retrospective_reference"
    knows: ClassVar[tuple[str, ...]] = (EQUIVALENT_MASS, FORCE_DELAY, FORCE_NOISE, DEAD_ZONE)
    settings: ClassVar[Mapping[str, Mapping[str, float]]] = {"sharp": SHARP, "gentle": GENTLE}
    anticipates: ClassVar[bool] = True
    gains: ClassVar[tuple[Gain, ...]] = GAINS

    def prepare(self, gains, constants):
        period = constants.control_period
        like = jnp.zeros_like(period)
        full = {name: like + value for name, value in gains.items()}
        delay, whole = full["identification_delay"], full["identification_delay"] > period
        return Prepared(
            full,
            constants,
            prior(*(full[name] for name in PRIOR)),
            split(jnp.where(whole, delay - period, 0), period),
            jnp.where(whole, 1, delay / period),
        )

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        nowhere = jnp.full(zeros.shape, -1, jnp.int32)
        unknown = prior(*(zeros for _ in PRIOR))
        return RetrospectiveState(
            line=empty(ring, zeros),
            aligned=Aligned(zeros, zeros),
            noise=Noise(zeros, zeros),
            episode=no_episode(zeros),
            learnt=self.unlearnt(unknown),
            reference=Reference(entry(zeros), entry(zeros), nowhere, curve(unknown)),
            history=no_history(zeros),
        )

    def unlearnt(self, prior: Map) -> Any:
        """What is known before the first contact: the map's prior."""
        return prior

    def delay_shift(self, learnt: Any) -> Float[Array, "*batch"] | None:
        """By how much [s] the force is older than the law was told; None: as old as that."""
        return None

    def learn(
        self, prepared: Prepared, learnt: Any, enters: Array, reading: Reading, deepest: Array
    ) -> tuple[Any, Curve]:
        """What is known with one reading more, and what counts of it; from the prior on where a contact
        `enters`."""
        before = Map(
            jnp.where(enters[None], prepared.prior.mean, learnt.mean),
            jnp.where(enters[None, None], prepared.prior.covariance, learnt.covariance),
        )
        hardware = reading.depth, reading.rate, deepest
        more = force(curve(before), *hardware) > reading.zone
        now = update(
            before,
            features(*hardware),
            jnp.where(reading.hidden, 0.5 * reading.zone, reading.force),
            reading.variance + jnp.where(reading.hidden, reading.zone**2 / 12, 0),
            reading.counts & (reading.depth > 0) & (~reading.hidden | more),
        )
        return now, curve(now)

    def restart(self, gains, state, begins, fresh):
        episode = state.episode
        return state._replace(
            noise=Noise(*(jnp.where(begins, 0, leaf) for leaf in state.noise)),
            episode=episode._replace(side=jnp.where(begins, 0, episode.side)),
        )

    def step(self, prepared, state, signals, tick):
        gains, period = prepared.gains, prepared.constants.control_period
        old = state.episode
        newest, line = delayed(prepared.delay, state.line, signals, tick)
        position, velocity, aligned = align(state.aligned, newest, prepared.share, signals, period)
        older = self.delay_shift(state.learnt)
        now = scaled(gains, prepared.constants, old, signals, position, velocity, older)
        x, v, depth, rate = now.x, now.v, now.depth, now.rate
        met = enter_grid(old, state.history, now, period, tick)
        noise, early = sort_out(gains, state.noise, old.early, now, signals.force_measured, met.touched)

        deepest = jnp.where(now.enters, 0, old.deepest)
        deepest = jnp.where(x > deepest, x, deepest)
        hardware_deepest = jnp.where(now.enters, 0, old.hardware_deepest)
        hardware_deepest = jnp.where(depth > hardware_deepest, depth, hardware_deepest)
        zone = gains["dead_zone"] / now.weight
        spread = force_noise(gains, noise) / now.weight**2
        variance = gains["force_noise_floor"] ** 2 + spread
        reading = Reading(now.told, rate, now.force, variance, now.hidden, zone, now.usable)
        learnt, known = self.learn(prepared, state.learnt, now.enters, reading, hardware_deepest)
        expected = force(known, depth, rate, hardware_deepest)
        guess = jnp.where(expected > zone, zone, jnp.where(expected > 0, expected, 0))
        measured = jnp.where(now.hidden & now.usable, guess, now.force)
        strength = gains["replay_noise"] ** 2
        replay = gains["force_replay"] * strength / (strength + spread)
        reference = follow(state.reference, known, met.history, replay, now.first, period, now.elapsed, older)

        own = force(known, x, v, deepest)
        separated = (x <= 0) | (now.usable & (v < 0) & (own <= 0))
        own = jnp.where(own > 0, own, 0)
        limit = gains["correction_limit"] * peak_force(known.slopes)
        wanted = gains["velocity_gain"] * (v - 0.5 * period * own - reference.live.speed)
        correction = jnp.where(wanted > limit, limit, jnp.where(wanted < -limit, -limit, wanted))
        command = jnp.where(separated, correction, own + (measured - expected) + correction)
        command = jnp.where(now.usable, command, jnp.where(separated, 0, measured))

        gone = jnp.where(now.enters | (depth > 0), 0, old.gone + 1)
        patience = jnp.where(met.touched | ~now.usable, FAREWELL, LONGEST_LAG)
        over = separated & (gone * period > patience * (1 + 1e-9))
        command = jnp.where((now.side != 0) & ~over, now.side * now.weight * command, 0)

        measured = jnp.stack([measured, now.told, rate, hardware_deepest])
        sample = Sample(measured, (~now.hidden).astype(depth.dtype))
        moved, hardware, number = move(old, sample, now, met, period, tick)
        # Written after it is read: only then the ring is updated in place.
        live = reference.live.depth
        impulse = depend_on(moved.impulse, jnp.where(jnp.isfinite(live), live, 0))
        stored = jnp.concatenate([jnp.stack([impulse, moved.read]), hardware])
        return command, RetrospectiveState(
            line=line,
            aligned=aligned,
            noise=noise,
            episode=Episode(
                side=jnp.where(over, 0, now.side),
                velocity=now.speed,
                first=now.first,
                elapsed=now.elapsed,
                touched=met.touched.astype(depth.dtype),
                gone=gone,
                fraction=met.fraction,
                deepest=deepest,
                hardware_deepest=hardware_deepest,
                sample=sample,
                moved=moved,
                early=early,
            ),
            learnt=learnt,
            reference=reference,
            history=met.history._replace(ring=remember(met.history, tick, stored), number=number),
        )
