"""The retrospective reference: identify the contact, work out the motion it should have had, pay back what is
missing.

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

Every contact starts afresh; so does one with the other surface. A run that begins in contact has no approach
speed to scale by: there F_c is the measured force, as it is. How noise, a dead zone and a surface that is
nearer than expected are met: notebooks/guide/retrospective_reference.md.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, cleared
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
from jaxhil.compensators.reintegration import (
    History,
    Measured,
    Reintegration,
    entry,
    follow,
    no_history,
    remember,
)
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
from jaxhil.compensators.ring_buffer import depend_on

FAREWELL = 0.006  # s for which it goes on after the hardware has left the surface
LONGEST_LAG = 0.1  # s for which it waits for hardware that has not come into contact


class RetrospectiveState(NamedTuple):
    """What the law carries from tick to tick."""

    line: DelayLine  # delay line of the measured position
    aligned: Aligned  # measured positions as old as the force
    noise: Noise  # of the force
    episode: Episode  # the contact under way
    learnt: Any  # of that contact: its map, or its bank of them
    reference: Reintegration  # motion that the contact should have had
    history: History  # samples that were measured


class Prepared(NamedTuple):
    """What is worked out once per run."""

    gains: Gains  # of the batch shape
    constants: Constants  # what the controller knows of the rig
    prior: Map  # of the map
    delay: Delay  # of the delay line: tau - T, at least 0
    share: Float[Array, "*batch"]  # of the sample before, for what is left of tau


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
            map_prior(full),
            split(jnp.where(whole, delay - period, 0), period),
            jnp.where(whole, 1, delay / period),
        )

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        nowhere = jnp.full(zeros.shape, -1, jnp.int32)
        unknown = prior(*[zeros] * 6)
        return RetrospectiveState(
            line=empty(ring, zeros),
            aligned=Aligned(zeros, zeros),
            noise=Noise(zeros, zeros),
            episode=no_episode(zeros),
            learnt=self.unlearnt(unknown),
            reference=Reintegration(entry(zeros), entry(zeros), nowhere, curve(unknown)),
            history=no_history(zeros),
        )

    def unlearnt(self, prior: Map) -> Any:
        """What is known before the first contact: the map's prior."""
        return prior

    def delay_shift(self, learnt: Any) -> Float[Array, "*batch"] | None:
        """By how much [s] the force is older than the law assumes; None: as old as that."""
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
            noise=cleared(state.noise, begins),
            episode=episode._replace(side=jnp.where(begins, 0, episode.side)),
        )

    def step(self, prepared, state, signals, tick):
        gains, period = prepared.gains, prepared.constants.control_period
        old = state.episode
        newest, line = delayed(prepared.delay, state.line, signals, tick)
        position, velocity, aligned = align(state.aligned, newest, prepared.share, signals, period)
        older = self.delay_shift(state.learnt)
        now = scaled(gains, prepared.constants, old, signals, position, velocity, older)
        met = enter_grid(old, state.history, now, period, tick)
        noise, early = sort_out(gains, state.noise, old.early, now, signals.force_measured, met.touched)

        deepest = _deepest(old.deepest, now.enters, now.x)
        hardware_deepest = _deepest(old.hardware_deepest, now.enters, now.depth)
        zone = gains["dead_zone"] / now.weight
        spread = force_noise(gains, noise) / now.weight**2
        variance = gains["force_noise_floor"] ** 2 + spread
        reading = Reading(now.aligned, now.rate, now.force, variance, now.hidden, zone, now.usable)
        learnt, known = self.learn(prepared, state.learnt, now.enters, reading, hardware_deepest)
        expected = force(known, now.depth, now.rate, hardware_deepest)
        guess = jnp.where(expected > zone, zone, jnp.where(expected > 0, expected, 0))
        read = jnp.where(now.hidden & now.usable, guess, now.force)
        strength = gains["replay_noise"] ** 2
        replay = gains["force_replay"] * strength / (strength + spread)
        measured = Measured(met.history, replay, period, older)
        reference = follow(state.reference, known, measured, now.first, now.elapsed)

        own = force(known, now.x, now.v, deepest)
        separated = (now.x <= 0) | (now.usable & (now.v < 0) & (own <= 0))
        command = _command(gains, now, known, own, separated, read, expected, reference.live.speed, period)
        gone = jnp.where(now.enters | (now.depth > 0), 0, old.gone + 1)
        patience = jnp.where(met.touched | ~now.usable, FAREWELL, LONGEST_LAG)
        over = separated & (gone * period > patience * (1 + 1e-9))
        command = jnp.where((now.side != 0) & ~over, now.side * now.weight * command, 0)

        sampled = jnp.stack([read, now.aligned, now.rate, hardware_deepest])
        sample = Sample(sampled, (~now.hidden).astype(period.dtype))
        moved, hardware, number = move(old, sample, now, met, period, tick)
        ring = _remembered(met.history, reference, moved, hardware, tick)
        episode = Episode(
            side=jnp.where(over, 0, now.side),
            velocity=now.speed,
            first=now.first,
            elapsed=now.elapsed,
            touched=met.touched.astype(period.dtype),
            gone=gone,
            fraction=met.fraction,
            deepest=deepest,
            hardware_deepest=hardware_deepest,
            sample=sample,
            moved=moved,
            early=early,
        )
        history = met.history._replace(ring=ring, number=number)
        return command, RetrospectiveState(line, aligned, noise, episode, learnt, reference, history)


def map_prior(gains: Gains) -> Map:
    """The map before the first reading of a contact, of the gains called `prior_...`."""
    return prior(
        stiffness=gains["prior_stiffness"],
        common=gains["prior_stiffness_spread"],
        wandering=gains["prior_slope_spread"],
        damping=gains["prior_damping_spread"],
        depth_damping=gains["prior_depth_damping_spread"],
        unloading=gains["prior_unloading_spread"],
    )


def _deepest(before, enters, depth):
    """The deepest point of this contact so far [s]."""
    before = jnp.where(enters, 0, before)
    return jnp.where(depth > before, depth, before)


def _command(gains, now, known, own, separated, read, expected, reference_speed, period):
    """F_c/(M v0) [1/s], of the module's text; `own` is the map's force on the numerical model."""
    own = jnp.where(own > 0, own, 0)
    limit = gains["correction_limit"] * peak_force(known.slopes)
    wanted = gains["velocity_gain"] * (now.v - 0.5 * period * own - reference_speed)
    correction = jnp.where(wanted > limit, limit, jnp.where(wanted < -limit, -limit, wanted))
    command = jnp.where(separated, correction, own + (read - expected) + correction)
    return jnp.where(now.usable, command, jnp.where(separated, 0, read))


def _remembered(history, reference, moved, hardware, tick):
    """The ring of measured samples with this tick's; written after it is read, it is updated in place."""
    live = reference.live.depth
    impulse = depend_on(moved.impulse, jnp.where(jnp.isfinite(live), live, 0))
    return remember(history, tick, jnp.concatenate([jnp.stack([impulse, moved.read]), hardware]))
