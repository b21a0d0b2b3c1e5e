"""The retrospective reference: identify the contact, work out the motion it should have had, pay back what is
missing.

A map from depth to force is identified on delay-aligned readings (`force_depth_map`). From it the motion that
the contact should have had since its entry is integrated over again while the map improves
(`reintegration`), and the numerical model's speed v_d is led to that motion's, v_r, until the hardware itself
has separated. No model of the motion simulator is used. Scaled by approach speed v0 and equivalent mass M,
F the map, (X, V) the measured motion aligned with the measured force y, p the peak force that the map
predicts, t the time left of 2/p since the hardware's entry:

    f_0 = clip(F(x_d, v_d), 0, MOST p), separated 0
    f_e = clip((v_d - T f_0/2 - v_r)/(1/c + s t), -limit p, (1 + limit) p - f_0)
    no contact:  F_c = 0, until the force tells of one, and of where its surface is
    in contact:  F_c = f_0 + (y - F(X, V)) + f_e
    separated:   F_c = f_e  until the hardware has left the surface for 6 ms, then 0

Every contact starts afresh, but for what is known of where the surfaces are. A run that begins in contact has
no approach speed to scale by: there F_c is the measured force (notebooks/guide/retrospective_reference.md).
"""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, cleared
from jaxhil.compensators.contact_plane import Plane
from jaxhil.compensators.delay_line import Delay, DelayLine, delayed, empty, split
from jaxhil.compensators.estimates import DEAD_ZONE, EQUIVALENT_MASS, FORCE_DELAY, FORCE_NOISE
from jaxhil.compensators.force_depth_map import (
    SURFACE,
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
from jaxhil.compensators.history import History, no_history, reading_at, recall, take
from jaxhil.compensators.meeting import Meeting, meet, search
from jaxhil.compensators.onset import Onset, no_onset, nothing_found, watch
from jaxhil.compensators.readings import Aligned, Noise, align, force_noise, take_noise
from jaxhil.compensators.reintegration import (
    Measured,
    Reintegration,
    Scales,
    begin,
    depth_of,
    follow,
    longest_step,
    unentered,
)
from jaxhil.compensators.retrospective_gains import GAINS, GENTLE, SHARP, map_prior
from jaxhil.contact.laws import deflection

FAREWELL = 0.006  # s for which it goes on after the hardware has left the surface
MOST = 1.2  # of the peak force, that the model is to feel of the map
LEAST_WEIGHT = 1e-9  # kg m/s, mass times approach speed: at less nothing is scaled by it
READINGS = 2  # that are learnt from in a tick at most
MISFIT_TIME = 0.001  # s, over which a force may be off by the law's `misfit`


class Episode(NamedTuple):
    """The contact under way, if the surface's side is not 0; without an approach speed it is of no use."""

    scales: Scales  # what it is scaled by
    gone: Float[Array, "*batch"]  # ticks since the hardware left
    deepest: Float[Array, "*batch"]  # point of the numerical model so far [s]
    hardware_deepest: Float[Array, "*batch"]  # point of the hardware so far [s]
    learnt_deepest: Float[Array, "*batch"]  # of what has been learnt from [s]
    next: Int[Array, "*batch"]  # tick of the run, of the reading to learn from next


class RetrospectiveState(NamedTuple):
    """What the law carries from tick to tick."""

    line: DelayLine  # delay line of the measured position
    aligned: Aligned  # measured positions as old as the force
    noise: Noise  # of the force
    history: History  # samples that were measured
    onset: Onset  # readings of the flight to a surface
    planes: Plane  # where the surfaces are expected
    episode: Episode  # the contact under way
    learnt: Any  # of that contact: its map, or its bank of them
    reference: Reintegration  # motion that the contact should have had


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
    is_large: ClassVar[bool] = True
    finds_plane: ClassVar[bool] = True
    misfit: ClassVar[float] = 0.003  # of a force, by which a map may be wrong
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
        counts = jnp.zeros(zeros.shape, jnp.int32)
        unknown = prior(*[zeros] * 8)
        spread = jnp.stack([zeros + gains["plane_spread"]] * 2)
        return RetrospectiveState(
            line=empty(ring, zeros),
            aligned=Aligned(zeros, zeros),
            noise=Noise(zeros, zeros),
            history=no_history(zeros),
            onset=no_onset(zeros),
            planes=Plane(0 * spread, spread),
            episode=Episode(Scales(*[zeros] * 6), zeros, zeros, zeros, zeros, counts),
            learnt=self.unlearnt(unknown),
            reference=unentered(zeros, curve(unknown)),
        )

    def unlearnt(self, prior: Map) -> Any:
        """What is known before the first contact: the map's prior."""
        return prior

    def moved(self, learnt: Any) -> tuple[Array, Array] | None:
        """By how much the force is older than the law assumes, and the surface deeper than it was met [s];
        None: neither is."""
        return None

    def begin(
        self, prepared: Prepared, learnt: Any, meeting: Meeting, history: History, variance: Array
    ) -> tuple[Any, Int[Array, "*batch"]]:
        """What is known where a contact begins; from how many ticks before it on to learn from readings. The
        force's variance is in N^2."""
        found = meeting.found
        mean = jnp.where(found[None], prepared.prior.mean, learnt.mean)
        covariance = jnp.where(found[None, None], prepared.prior.covariance, learnt.covariance)
        return Map(mean, covariance), jnp.zeros_like(meeting.index)

    def learn(self, prepared: Prepared, learnt: Any, reading: Reading, deepest: Array) -> tuple[Any, Curve]:
        """What is known with one reading more, and what counts of it."""
        hardware = reading.depth, reading.rate, deepest
        more = force(curve(learnt), *hardware) > reading.zone
        now = update(
            learnt,
            features(*hardware),
            jnp.where(reading.hidden, 0.5 * reading.zone, reading.force),
            reading.variance + jnp.where(reading.hidden, reading.zone**2 / 12, 0),
            reading.counts & (reading.depth > 0) & (~reading.hidden | more),
            reading.rate > 0,
        )
        return now, curve(now)

    def restart(self, gains, state, begins, fresh):
        episode = state.episode
        nowhere = episode.scales._replace(side=jnp.where(begins, 0, episode.scales.side))
        watched = jnp.where(begins, 0, state.onset.watched)
        sums = jnp.where(begins[None], 0, state.onset.sums)
        return state._replace(
            noise=cleared(state.noise, begins),
            onset=state.onset._replace(watched=watched, sums=sums),
            episode=episode._replace(scales=nowhere, gone=jnp.where(begins, 0, episode.gone)),
        )

    def step(self, prepared, state, signals, tick):
        gains, period = prepared.gains, prepared.constants.control_period
        newest, line = delayed(prepared.delay, state.line, signals, tick)
        position, velocity, aligned = align(state.aligned, newest, prepared.share, signals, period)
        force_read = signals.force_measured + jnp.sign(signals.force_measured) * gains["dead_zone"]
        begins = signals.age == 0
        # A run's first reading counts as none: the sensor's delay line may not have been filled.
        shown = ~begins & ~((gains["dead_zone"] > 0) & (signals.force_measured == 0))
        before = state.history._replace(reading=jnp.where(begins[None], 0, state.history.reading))
        noise = take_noise(gains, state.noise, before, force_read, shown, state.episode.scales.side == 0)
        history = take(state.history, tick, signals.age, force_read, shown, position, velocity)
        read = _Read(position, velocity, force_read, shown, force_noise(gains, noise))
        onset, learnt, planes, episode, reference = self._fly(prepared, state, signals, history, read, tick)

        def meets():
            return self._contact(prepared, episode, learnt, reference, history, signals, read)

        def passes():
            return jnp.zeros_like(period), episode, learnt, reference

        # Where no lane is in contact, the effort is spared.
        command, episode, learnt, reference = lax.cond(jnp.any(episode.scales.side != 0), meets, passes)
        return command, RetrospectiveState(
            line, aligned, noise, history, onset, planes, episode, learnt, reference
        )

    def contact_plane(self, state):
        scales, moved = state.episode.scales, self.moved(state.learnt)
        if moved is None:
            return scales.plane
        met = scales.speed > 0
        return scales.plane + jnp.where(met, moved[1] * scales.speed / jnp.where(met, scales.pace, 1), 0)

    def _fly(self, prepared, state, signals, history, read, tick):
        """The readings of the flight to a surface, and where one is found the contact that begins with it:
        what is known of it, where surfaces are expected, the contact under way and its reference."""
        gains, constants = prepared.gains, prepared.constants
        period, clearance = constants.control_period, constants.clearance
        begins, old = signals.age == 0, state.episode.scales
        reach = jnp.sign(deflection(signals.position_desired, clearance))
        scales = old._replace(side=jnp.where(begins, reach, old.side), speed=jnp.where(begins, 0, old.speed))
        way = jnp.where((signals.velocity_desired > 0) | jnp.isinf(clearance), 1, -1)
        speed = way * signals.velocity_desired
        flies = (scales.side == 0) & (gains["equivalent_mass"] * speed > LEAST_WEIGHT)
        speed = jnp.where(flies, speed, 1)
        force_then = way * read.force / (gains["equivalent_mass"] * speed)
        onset = watch(state.onset, tick, flies, force_then, read.shown)
        episode = state.episode._replace(scales=scales)

        def finds():
            found = search(gains, constants, state.planes, onset, history, way, speed, read.variance, tick)
            return found._replace(detected=found.detected & flies)

        def begun():
            meeting = meet(gains, clearance, scales, state.planes, history, way, speed, found)
            safe = _safe(meeting.scales, meeting.found)
            learnt, earlier = self.begin(prepared, state.learnt, meeting, history, read.variance)
            depth = depth_of(safe, clearance, signals.position_desired)
            moved = self.moved(learnt)
            depth = depth if moved is None else depth - moved[1]
            reference = begin(
                state.reference,
                meeting.found,
                meeting.index,
                meeting.start,
                meeting.since,
                jnp.where(depth > 0, depth, 0),
                period * safe.pace,
            )
            return learnt, meeting.planes, _begun(state.episode, meeting, earlier), reference

        found = lax.cond(jnp.any(flies), finds, lambda: nothing_found(period))
        met = lax.cond(
            jnp.any(found.detected), begun, lambda: (state.learnt, state.planes, episode, state.reference)
        )
        return onset, *met

    def _contact(self, prepared, old, learnt, reference, history, signals, read):
        """F_c [N], and the contact under way, what is learnt of it and its reference with one tick more."""
        gains, constants = prepared.gains, prepared.constants
        period, clearance = constants.control_period, constants.clearance
        side, usable = old.scales.side, (old.scales.side != 0) & (old.scales.speed > 0)
        scales = _safe(old.scales, usable)
        slow = period * scales.pace
        moved = self.moved(learnt)
        x = depth_of(scales, clearance, signals.position_desired)
        v = side * signals.velocity_desired / scales.speed
        rate = side * read.velocity / scales.speed
        depth = depth_of(scales, clearance, read.position)
        if moved is not None:
            x, depth = x - moved[1], depth - (moved[0] * rate + moved[1])
        depth = jnp.where((depth > SURFACE) | (depth < -SURFACE), depth, 0)
        deepest, hardware_deepest = _deepest(old.deepest, x), _deepest(old.hardware_deepest, depth)

        zone = gains["dead_zone"] / scales.weight
        spread = read.variance / scales.weight**2
        teaching = _Teaching(
            history, scales, clearance, gains["force_noise_floor"] ** 2 + spread, slow, zone, usable
        )
        before = learnt, reference.curve
        learnt, known, next_, learnt_deepest = self._catch_up(prepared, before, teaching, old)
        expected = force(known, depth, rate, hardware_deepest)
        guess = jnp.where(expected > zone, zone, jnp.where(expected > 0, expected, 0))
        seen = jnp.where(read.shown, side * (read.force - scales.bias) / scales.weight, guess)
        strength = gains["replay_noise"] ** 2
        replay = gains["force_replay"] * strength / (strength + spread)
        reference = follow(
            reference, known, Measured(history, scales, clearance, replay, slow, longest_step(period), moved)
        )

        own = force(known, x, v, deepest)
        separated = (x <= 0) | ((v < 0) & (own <= 0))
        since = (history.age - reference.entry.tick).astype(slow.dtype) * slow
        command = _command(
            gains, v, known, own, separated, seen, expected, reference, since, scales.pace, slow
        )
        command = side * scales.weight * command
        bent = side * deflection(read.position, clearance)
        out = ~(side * deflection(signals.position_desired, clearance) > 0)
        command = jnp.where(usable, command, jnp.where(out | (bent < 0), 0, read.force))
        separated = jnp.where(usable, separated, out)
        gone = jnp.where(jnp.where(usable, depth, bent) > 0, 0, old.gone + 1)
        over = separated & (gone * period > FAREWELL * (1 + 1e-9))
        episode = Episode(
            old.scales._replace(side=jnp.where(over, 0, side)),
            gone,
            deepest,
            hardware_deepest,
            learnt_deepest,
            next_,
        )
        return jnp.where((side != 0) & ~over, command, 0), episode, learnt, reference

    def _catch_up(self, prepared, before, teaching, old):
        """What is known with up to two of the readings since the surface was met more, and what counts of it,
        as they were `before`; the reading to learn from next, and the deepest point of those learnt from."""
        history, scales = teaching.history, teaching.scales

        def goes_on(carry):
            return carry[0] & (carry[1] < READINGS)

        def read(carry):
            _, number, learnt, _, index, farthest = carry
            counts = teaching.usable & (index <= history.age)
            at = jnp.minimum(index, history.age)
            sample, (force_then, shown) = recall(history, at), reading_at(history, at)
            depth = depth_of(scales, teaching.clearance, sample.position)
            farthest = jnp.where(counts & (depth > farthest), depth, farthest)
            seen = scales.side * (force_then - scales.bias) / scales.weight
            reading = Reading(
                depth,
                scales.side * sample.velocity / scales.speed,
                seen,
                teaching.variance + (self.misfit * seen) ** 2 * (MISFIT_TIME / teaching.period),
                ~shown,
                teaching.zone,
                counts,
            )
            learnt, known = self.learn(prepared, learnt, reading, farthest)
            index = index + jnp.where(counts, 1, 0)
            behind = jnp.any(teaching.usable & (index <= history.age))
            return behind, number + 1, learnt, known, index, farthest

        # Where no lane has to catch up, the effort is spared. A loop, because it is compiled but once.
        begin = jnp.array(True), jnp.array(0), *before, old.next, old.learnt_deepest
        return lax.while_loop(goes_on, read, begin)[2:]


class _Read(NamedTuple):
    """What is read at a tick."""

    position: Array  # of the hardware, as old as the force [m]
    velocity: Array  # likewise [m/s]
    force: Array  # [N]
    shown: Array  # whether the sensor shows it
    variance: Array  # of its noise [N^2]


class _Teaching(NamedTuple):
    """What there is to learn from."""

    history: History  # of readings
    scales: Scales  # of the contact
    clearance: Array  # [m]
    variance: Array  # of a reading [1/s^2]
    period: Array  # of a tick, in the contact's own time [s]
    zone: Array  # dead zone [1/s]
    usable: Array  # whether there is a contact


def _begun(old: Episode, meeting: Meeting, earlier: Array) -> Episode:
    """The contact under way, the one that is found where one is; learnt from so many ticks earlier on."""
    found = meeting.found
    fresh = {name: jnp.where(found, 0, getattr(old, name)) for name in Episode._fields[1:-1]}
    first = meeting.index + 1 - jnp.minimum(earlier, meeting.index)
    return Episode(meeting.scales, **fresh, next=jnp.where(found, first, old.next))


def _safe(scales: Scales, usable: Array) -> Scales:
    """1 in the place of what nothing can be scaled by."""
    by = {name: jnp.where(usable, getattr(scales, name), 1) for name in ("speed", "pace", "weight")}
    return scales._replace(**by)


def _deepest(before, depth):
    """The deepest point of this contact so far [s]."""
    return jnp.where(depth > before, depth, before)


def _command(gains, v, known, own, separated, read, expected, reference, since, pace, period):
    """F_c/(M v0) [1/s], of the module's text; `own` is the map's force on the numerical model, the hardware's
    entry so long `since` [s]."""
    peak = peak_force(known)
    own = jnp.where(own > 0, jnp.where(own > MOST * peak, MOST * peak, own), 0)
    least = -gains["correction_limit"] * peak
    most = (1 + gains["correction_limit"]) * peak - jnp.where(separated, 0, own)
    # Elastic contact of this peak lasts no less.
    left = 2 / peak - since
    gain = gains["velocity_gain"] / pace
    slower = 1 + gain * gains["repayment_time"] * jnp.where(left > 0, left, 0)
    wanted = gain * (v - 0.5 * period * own - reference.live.speed) / slower
    correction = jnp.where(wanted > most, most, jnp.where(wanted < least, least, wanted))
    return jnp.where(separated, correction, own + (read - expected) + correction)
