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

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains
from jaxhil.compensators.delay_line import Delay, DelayLine, delayed, empty, split
from jaxhil.compensators.estimates import (
    DEAD_ZONE,
    EQUIVALENT_MASS,
    FORCE_DELAY,
    FORCE_NOISE,
    force_delay,
)
from jaxhil.compensators.estimates import (
    peak_force as typical_peak,
)
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
from jaxhil.compensators.reintegration import (
    History,
    Reference,
    entry,
    follow,
    no_history,
    remember,
)
from jaxhil.contact import deflection
from jaxhil.mechanism import Mechanism
from jaxhil.ring import tie

SEEN = 8  # readings out of contact that show how noisy the force is
OUTSTANDING = 16.0  # times the noise's variance: what hardly is noise
EARLY = 2  # such readings before the hardware is to touch, that its surface is nearer than told
FAREWELL = 0.006
LONGEST_LAG = 0.1  # s for which it waits for hardware that has not touched yet

# Two sets of gains for any mechanism, each judged on linear, damped, Hertzian, hardening and layered contact
# of 1.5 to 5 Hz at once. Sharp, the nominal one, was found by CMA-ES with errors under other dissipation, of
# contact of 5 to 10 Hz and with the published rig's noise and dead zone in its objective. Gentle, by hand
# from there, commands less, at the price of twice the error with that noise.
SHARP = {
    "prior_stiffness": 9.563,
    "prior_stiffness_spread": 35.8,
    "prior_slope_spread": 29.17,
    "prior_damping_spread": 1.912,
    "prior_depth_damping_spread": 0.03103,
    "prior_unloading_spread": 0.1607,
    "force_noise_floor": 0.01091,
    "velocity_gain": 174.6,
    "correction_limit": 0.9,
    "replay_noise": 0.7679,
}
GENTLE = {
    "prior_stiffness": 9.563,
    "prior_stiffness_spread": 23.9,
    "prior_slope_spread": 29.17,
    "prior_damping_spread": 6.5,
    "prior_depth_damping_spread": 0.05,
    "prior_unloading_spread": 0.1607,
    "force_noise_floor": 0.02,
    "velocity_gain": 200.0,
    "correction_limit": 0.48,
    "replay_noise": 0.6,
}


def _fact(mechanism) -> bool:
    """Of gains that are known beforehand or chosen, not tuned."""
    return False


def _prior(
    name: str, unit: str, lower: float, upper: float, tuned: Callable[[Mechanism], bool] = lambda m: True
) -> Gain:
    """A gain that no mechanism's numbers enter: what it scales is scaled by approach speed and mass."""
    return Gain(name, unit, lambda m: lower, lambda m: upper, lambda m: SHARP[name], True, tuned=tuned)


def _shows(*laws: str) -> Callable[[Mechanism], bool]:
    """Of what only such contacts show: on others it would be tuned away."""
    return lambda m: m.contact.law in laws


class Aligned(NamedTuple):
    """Measured position [m] delayed by tau and by tau + T, of the tick before."""

    middle: Float[Array, "*batch"]
    last: Float[Array, "*batch"]


class Episode(NamedTuple):
    """One contact: side (1 or -1; 0: none), approach speed [m/s] (0: unusable), time [s] from the entry to
    the first tick, ticks since that one, whether (1) the hardware has touched, ticks since it left, where
    between two ticks its samples fall on the reference's grid; deepest points so far [s] of the numerical
    model and of the hardware; of the tick before, what was measured (y, X, V, X_m), y moved to that grid, its
    integral [ticks/s] over those that could be read and how many ticks that is, whether (1) the tick's own
    force and that moved one could; readings that stood out of the noise too early, how much nearer [s] the
    surface was at the first of them, and is taken to be."""

    side: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]
    first: Float[Array, "*batch"]
    elapsed: Int[Array, "*batch"]
    touched: Float[Array, "*batch"]
    gone: Float[Array, "*batch"]
    fraction: Float[Array, "*batch"]
    deepest: Float[Array, "*batch"]
    hardware_deepest: Float[Array, "*batch"]
    sample: Float[Array, "4 *batch"]
    moved: Float[Array, "*batch"]
    impulse: Float[Array, "*batch"]
    read: Float[Array, "*batch"]
    shown: Float[Array, "2 *batch"]
    early: Int[Array, "*batch"]
    surface: Float[Array, "*batch"]
    plane: Float[Array, "*batch"]


class RetrospectiveState(NamedTuple):
    """Delay line and aligned readings; sum of squares [N^2] and number of forces before contact; the contact
    under way, what was learnt of it (its map), its reference and history."""

    line: DelayLine
    aligned: Aligned
    noise: tuple[Array, Array]
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
            "force_noise", "N", lambda m: 0.0, lambda m: m.rig.force_sensor.noise_std + typical_peak(m),
            lambda m: m.rig.force_sensor.noise_std, tuned=_fact,
        ),
        Gain(
            "dead_zone", "N", lambda m: 0.0, lambda m: 2 * m.rig.force_sensor.dead_zone + typical_peak(m),
            lambda m: m.rig.force_sensor.dead_zone, tuned=_fact,
        ),
        # Next to its spread it hardly matters.
        _prior("prior_stiffness", "1/s^2", 0.1, 1e3, _fact),
        _prior("prior_stiffness_spread", "1/s^2", 1.0, 5e3),
        _prior("prior_slope_spread", "1/s^2", 0.1, 5e3),
        _prior("prior_damping_spread", "1/s", 0.01, 50.0),
        _prior("prior_depth_damping_spread", "1/s", 1e-4, 50.0, _shows("hunt_crossley", "depth_damped")),
        _prior("prior_unloading_spread", "1/s^2", 1e-4, 5e3, _shows("elastoplastic")),
        # Where there is noise, which it is told and sees, it hardly matters.
        _prior("force_noise_floor", "1/s", 1e-4, 10.0, lambda m: not m.rig.force_sensor.noise_std),
        Gain(
            "velocity_gain", "1/s", lambda m: 1.0, lambda m: 1 / m.rig.control_period,
            lambda m: min(SHARP["velocity_gain"], 0.7 / m.rig.control_period), logarithmic=True,
        ),
        # Where the limit binds, it hides from the solver what the other gains do.
        Gain(
            "correction_limit", "1", lambda m: 0.01, lambda m: 20.0, lambda m: SHARP["correction_limit"],
            logarithmic=True, begins=lambda m: 3.0,
        ),
        # Neither is tuned: what is replayed is what makes it a test of the hardware, whatever that errs by.
        Gain("force_replay", "1", lambda m: 0.0, lambda m: 1.0, lambda m: 1.0, tuned=_fact),
        _prior("replay_noise", "1/s", 0.01, 100.0, _fact),
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
                full["prior_damping_spread"],
                full["prior_depth_damping_spread"],
                full["prior_unloading_spread"],
            ),
            split(jnp.where(whole, delay - period, 0), period),
            jnp.where(whole, 1, delay / period),
        )

    def init(self, gains, constants, ring):
        zeros = jnp.zeros_like(constants.control_period)
        counts = jnp.zeros(zeros.shape, jnp.int32)
        unknown = prior(*[zeros] * 6)
        return RetrospectiveState(
            line=empty(ring, zeros),
            aligned=Aligned(zeros, zeros),
            noise=(zeros, zeros),
            episode=Episode(
                side=zeros,
                velocity=zeros,
                first=zeros,
                elapsed=counts,
                touched=zeros,
                gone=zeros,
                fraction=zeros,
                deepest=zeros,
                hardware_deepest=zeros,
                sample=jnp.stack([zeros] * 4),
                moved=zeros,
                impulse=zeros,
                read=zeros,
                shown=jnp.stack([zeros + 1] * 2),
                early=counts,
                surface=zeros,
                plane=zeros,
            ),
            learnt=self.unlearnt(unknown),
            reference=Reference(entry(zeros), entry(zeros), counts - 1, curve(unknown)),
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
        plane = jnp.where(enters, 0, old.plane)
        aligned, rate = depth_of(position) + plane, side * velocity / scale
        older = self.delay_shift(state.learnt)
        depth = aligned if older is None else aligned - older * rate
        depth = jnp.where((depth > SURFACE) | (depth < -SURFACE), depth, 0)
        elsewhere = jnp.sign(deflection(position, clearance)) == -side
        weight = mass * scale
        hides = gains["dead_zone"] > 0
        reading = signals.force_measured + jnp.sign(signals.force_measured) * gains["dead_zone"]
        hidden = hides & (signals.force_measured == 0) & ~elsewhere
        read = jnp.where(elsewhere, 0, side * reading / weight)
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

        # A force that stands out of the noise once a contact is under way is the hardware, met too early.
        square = signals.force_measured**2
        usual = _force_noise(gains, state.noise) + (gains["force_noise_floor"] * weight) ** 2
        free_readings = (~under_way | ~touched) & (deflection(position, clearance) == 0)
        stands = free_readings & under_way & (state.noise[1] >= SEEN) & (square > OUTSTANDING * usual)
        early = jnp.where(enters, 0, old.early) + jnp.where(stands, 1, 0)
        surface = jnp.where(stands & (early == 1), -aligned, old.surface)
        plane = jnp.where(stands & (early > EARLY), surface, plane)
        free_readings = free_readings & ~stands
        squares = state.noise[0] + jnp.where(free_readings, square, 0)
        count = state.noise[1] + jnp.where(free_readings, 1, 0)
        noise = _force_noise(gains, (squares, count)) / weight**2
        variance = gains["force_noise_floor"] ** 2 + noise
        strength = gains["replay_noise"] ** 2
        replay = gains["force_replay"] * strength / (strength + noise)

        deepest = jnp.where(enters, 0, old.deepest)
        deepest = jnp.where(x > deepest, x, deepest)
        hardware_deepest = jnp.where(enters, 0, old.hardware_deepest)
        hardware_deepest = jnp.where(depth > hardware_deepest, depth, hardware_deepest)
        hardware = depth, rate, hardware_deepest
        zone = gains["dead_zone"] / weight
        reading = Reading(aligned, rate, read, variance, hidden, zone, usable)
        learnt, known = self.learn(prepared, state.learnt, enters, reading, hardware_deepest)
        expected = force(known, *hardware)
        guess = jnp.where(expected > zone, zone, jnp.where(expected > 0, expected, 0))
        measured = jnp.where(hidden & usable, guess, read)
        reference = follow(
            state.reference,
            known,
            history,
            replay,
            first,
            period,
            elapsed,
            older,
        )
        live = reference.live

        own = force(known, x, v, deepest)
        separated = (x <= 0) | (usable & (v < 0) & (own <= 0))
        own = jnp.where(own > 0, own, 0)
        limit = gains["correction_limit"] * peak_force(known.slopes)
        wanted = gains["velocity_gain"] * (v - 0.5 * period * own - live.speed)
        correction = jnp.where(wanted > limit, limit, jnp.where(wanted < -limit, -limit, wanted))
        command = jnp.where(separated, correction, own + (measured - expected) + correction)
        command = jnp.where(usable, command, jnp.where(separated, 0, measured))

        gone = jnp.where(enters | (depth > 0), 0, old.gone + 1)
        patience = jnp.where(touched | ~usable, FAREWELL, LONGEST_LAG)
        over = separated & (gone * period > patience * (1 + 1e-9))
        command = jnp.where(under_way & ~over, side * weight * command, 0)

        sample = jnp.stack([measured, aligned, rate, hardware_deepest])
        kept = jnp.stack([measured, aligned - period * rate, rate, jnp.zeros_like(rate)])
        kept = jnp.where(enters[None], kept, old.sample)
        moved = kept + fraction[None] * (sample - kept)
        arrived = tick - origin + 1
        shown_now = jnp.where(hidden, 0.0, 1.0)
        shown_moved = shown_now * jnp.where(enters, shown_now, old.shown[0])
        ticks = jnp.where(arrived == 1, shown_moved * (first / period), shown_moved * old.shown[1])
        mean = jnp.where(arrived == 1, 0.5 * moved[0], 0.5 * (old.moved + moved[0]))
        impulse = jnp.where(arrived == 1, 0, old.impulse) + ticks * mean
        read = jnp.where(arrived == 1, 0, old.read) + ticks
        # Written after it is read: only then the ring is updated in place.
        impulse = tie(impulse, jnp.where(jnp.isfinite(live.depth), live.depth, 0))
        stored = jnp.concatenate([jnp.stack([impulse, read]), moved[1:]])
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
                deepest=deepest,
                hardware_deepest=hardware_deepest,
                sample=sample,
                moved=moved[0],
                impulse=impulse,
                read=read,
                shown=jnp.stack([shown_now, shown_moved]),
                early=early,
                surface=surface,
                plane=plane,
            ),
            learnt=learnt,
            reference=reference,
            history=History(ring, origin, number),
        )


def _force_noise(gains: Gains, seen: tuple[Array, Array]) -> Float[Array, "*batch"]:
    """The force's variance [N^2]: what it is told, or what readings out of contact show if that is more."""
    squares, count = seen
    told, shown = gains["force_noise"] ** 2, squares / jnp.where(count > 0, count, 1)
    return jnp.where(shown > told, shown, told)
