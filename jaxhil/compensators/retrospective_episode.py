"""A tick of a contact as the retrospective references see it: which contact, on what scale, how far it is.

Signals are aligned with the force that is read, and scaled by the contact's approach speed v0 and the mass M.
What was measured is moved to the grid of the reference's samples, such that the hardware's own entry falls on
the reference's. A force that stands out of the noise before the hardware was to touch is the hardware, met
too early: its surface is nearer than expected, and is taken to be where the first of them was read.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxhil.compensators.base import Constants, Gains, Signals
from jaxhil.compensators.force_depth_map import SURFACE
from jaxhil.compensators.reintegration import History
from jaxhil.contact.laws import deflection

SEEN = 8  # readings out of contact that show how noisy the force is
OUTSTANDING = 16.0  # times the noise's variance: what hardly is noise
EARLY = 2  # such readings before the hardware is to touch, that its surface is nearer than expected


class Aligned(NamedTuple):
    """Measured positions of the tick before."""

    middle: Float[Array, "*batch"]  # delayed by tau [m]
    last: Float[Array, "*batch"]  # delayed by tau + T [m]


class Noise(NamedTuple):
    """Of the forces read out of contact."""

    squares: Float[Array, "*batch"]  # their sum [N^2]
    number: Float[Array, "*batch"]  # how many they are


class Sample(NamedTuple):
    """What was measured at a tick."""

    measured: Float[Array, "4 *batch"]  # force y [1/s], depth X [s], speed V [1], deepest point X_m [s]
    shown: Float[Array, "*batch"]  # whether (1) the force could be read


class Early(NamedTuple):
    """Readings that stood out of the noise before the hardware was to touch."""

    number: Int[Array, "*batch"]  # how many they are
    surface: Float[Array, "*batch"]  # how much nearer the surface was at the first of them [s]
    plane: Float[Array, "*batch"]  # how much nearer it is taken to be [s]


class Moved(NamedTuple):
    """A sample on the reference's grid."""

    force: Float[Array, "*batch"]  # y there [1/s]
    shown: Float[Array, "*batch"]  # whether (1) it could be read
    impulse: Float[Array, "*batch"]  # integral since the entry of those that could [ticks/s]
    read: Float[Array, "*batch"]  # over how many ticks that is


class Episode(NamedTuple):
    """One contact."""

    side: Float[Array, "*batch"]  # of the surface, 1 or -1; 0 for no contact
    velocity: Float[Array, "*batch"]  # approach speed [m/s]; 0 if unusable
    first: Float[Array, "*batch"]  # time from the entry to the first tick [s]
    elapsed: Int[Array, "*batch"]  # ticks since that one
    touched: Float[Array, "*batch"]  # whether (1) the hardware has touched
    gone: Float[Array, "*batch"]  # ticks since it left
    fraction: Float[Array, "*batch"]  # where between two ticks its samples fall on the reference's grid
    deepest: Float[Array, "*batch"]  # point of the numerical model so far [s]
    hardware_deepest: Float[Array, "*batch"]  # point of the hardware so far [s]
    sample: Sample  # measured at the tick before
    moved: Moved  # what that made on the grid
    early: Early  # what was read too early


class Now(NamedTuple):
    """A tick on the scales of its contact; the hardware is that of the time when the force acted."""

    enters: Bool[Array, "*batch"]  # whether the contact begins
    side: Float[Array, "*batch"]  # of the surface, 1 or -1
    speed: Float[Array, "*batch"]  # approach speed v0 [m/s]
    usable: Bool[Array, "*batch"]  # whether there is one to scale by
    weight: Float[Array, "*batch"]  # M v0 [kg m/s]
    x: Float[Array, "*batch"]  # depth of the numerical model [s]
    v: Float[Array, "*batch"]  # its speed [1]
    aligned: Float[Array, "*batch"]  # depth of the hardware by the delay that is a gain [s]
    depth: Float[Array, "*batch"]  # of the hardware, by the delay as it is estimated [s]
    rate: Float[Array, "*batch"]  # speed of the hardware [1]
    away: Bool[Array, "*batch"]  # whether the hardware is away from both surfaces
    force: Float[Array, "*batch"]  # as read [1/s]
    hidden: Bool[Array, "*batch"]  # whether the dead zone hides it
    first: Float[Array, "*batch"]  # time from the entry to the first tick [s]
    elapsed: Int[Array, "*batch"]  # ticks since that one


class Entry(NamedTuple):
    """The hardware's entry."""

    touched: Bool[Array, "*batch"]  # whether it has touched
    fraction: Float[Array, "*batch"]  # where between two ticks its samples fall on the reference's grid
    history: History  # that begins there


def no_episode(like: Float[Array, "*batch"]) -> Episode:
    """Before the first contact."""
    zeros, counts = jnp.zeros_like(like), jnp.zeros(like.shape, jnp.int32)
    return Episode(
        side=zeros,
        velocity=zeros,
        first=zeros,
        elapsed=counts,
        touched=zeros,
        gone=zeros,
        fraction=zeros,
        deepest=zeros,
        hardware_deepest=zeros,
        sample=Sample(jnp.stack([zeros] * 4), zeros + 1),
        moved=Moved(zeros, zeros + 1, zeros, zeros),
        early=Early(counts, zeros, zeros),
    )


def align(
    old: Aligned, newest: Array, share: Array, signals: Signals, period: Array
) -> tuple[Array, Array, Aligned]:
    """Measured position [m] and velocity [m/s] as old as the force that is read, `newest` being the position
    a tick less than the delay ago; what is kept."""
    begins = signals.age == 0
    stride = period * signals.velocity_desired
    middle = jnp.where(begins, newest - stride, old.middle)
    last = jnp.where(begins, newest - 2 * stride, old.last)
    position = newest + share * (middle - newest)
    return position, (newest - last) / (2 * period), Aligned(newest, middle)


def scaled(
    gains: Gains,
    constants: Constants,
    old: Episode,
    signals: Signals,
    position: Array,
    velocity: Array,
    older: Array | None,
) -> Now:
    """Which contact it is, and its numbers on that contact's scales; the force is `older` [s] than
    assumed."""
    period, clearance = constants.control_period, constants.clearance
    touching = deflection(signals.position_desired, clearance)
    side_now = jnp.sign(touching)
    enters = (side_now != 0) & (side_now != old.side)
    side = jnp.where(enters, side_now, old.side)
    approach = side_now * signals.velocity_desired
    sound = (approach > 0) & (jnp.abs(touching) <= 2 * period * approach)
    speed = jnp.where(enters, jnp.where(sound, approach, 0), old.velocity)
    usable = (side != 0) & (speed > 0)
    scale = jnp.where(usable, speed, 1)

    def depth_of(measured):
        return jnp.where(side < 0, -clearance - measured, measured) / scale

    x, v = depth_of(signals.position_desired), side * signals.velocity_desired / scale
    aligned = depth_of(position) + jnp.where(enters, 0, old.early.plane)
    rate = side * velocity / scale
    depth = aligned if older is None else aligned - older * rate
    bent = deflection(position, clearance)
    elsewhere = jnp.sign(bent) == -side
    weight = gains["equivalent_mass"] * scale
    reading = signals.force_measured + jnp.sign(signals.force_measured) * gains["dead_zone"]
    return Now(
        enters=enters,
        side=side,
        speed=speed,
        usable=usable,
        weight=weight,
        x=x,
        v=v,
        aligned=aligned,
        depth=jnp.where((depth > SURFACE) | (depth < -SURFACE), depth, 0),
        rate=rate,
        away=bent == 0,
        force=jnp.where(elsewhere, 0, side * reading / weight),
        hidden=(gains["dead_zone"] > 0) & (signals.force_measured == 0) & ~elsewhere,
        first=jnp.where(enters, jnp.where(usable, x, 0), old.first),
        elapsed=jnp.where(enters, 0, old.elapsed + 1),
    )


def enter_grid(old: Episode, history: History, now: Now, period: Array, tick: Array) -> Entry:
    """The hardware's entry: sample 0 of the history is the first one after the reference's."""
    touched_before = jnp.where(now.enters, 0, old.touched) > 0
    onset = now.usable & ~touched_before & (now.depth > 0)
    since = now.depth / jnp.where(onset & (now.rate > 0), now.rate, 1)
    since = jnp.where(now.rate > 0, jnp.minimum(since, period), 0.5 * period)
    shift = (now.first - since) / period
    whole = jnp.floor(shift)
    origin = jnp.where(onset, tick + 1 + whole.astype(jnp.int32), history.origin)
    number = jnp.where(touched_before, history.number, 0)
    fraction = jnp.where(onset, shift - whole, old.fraction)
    return Entry(touched_before | onset, fraction, history._replace(origin=origin, number=number))


def sort_out(
    gains: Gains, noise: Noise, old: Early, now: Now, force: Array, touched: Array
) -> tuple[Noise, Early]:
    """A force [N] that is read out of contact is noise, or one that came too early."""
    square = force**2
    usual = force_noise(gains, noise) + (gains["force_noise_floor"] * now.weight) ** 2
    under_way = now.side != 0
    free = (~under_way | ~touched) & now.away
    stands = free & under_way & (noise.number >= SEEN) & (square > OUTSTANDING * usual)
    number = jnp.where(now.enters, 0, old.number) + jnp.where(stands, 1, 0)
    surface = jnp.where(stands & (number == 1), -now.aligned, old.surface)
    plane = jnp.where(now.enters, 0, old.plane)
    plane = jnp.where(stands & (number > EARLY), surface, plane)
    free = free & ~stands
    more = Noise(noise.squares + jnp.where(free, square, 0), noise.number + jnp.where(free, 1, 0))
    return more, Early(number, surface, plane)


def force_noise(gains: Gains, seen: Noise) -> Float[Array, "*batch"]:
    """The force's variance [N^2]: what the gains say, or what readings out of contact show if that is
    more."""
    known = gains["force_noise"] ** 2
    shown = seen.squares / jnp.where(seen.number > 0, seen.number, 1)
    return jnp.where(shown > known, shown, known)


def move(
    old: Episode, sample: Sample, now: Now, entry: Entry, period: Array, tick: Array
) -> tuple[Moved, Float[Array, "3 *batch"], Int[Array, "*batch"]]:
    """The tick's sample on the reference's grid; depth, speed and deepest point there; samples in the history
    with it."""
    force, depth, rate, _ = sample.measured
    before = jnp.stack([force, depth - period * rate, rate, jnp.zeros_like(rate)])
    before = jnp.where(now.enters[None], before, old.sample.measured)
    moved = before + entry.fraction[None] * (sample.measured - before)
    arrived = tick - entry.history.origin + 1
    begins = arrived == 1
    shown = sample.shown * jnp.where(now.enters, sample.shown, old.sample.shown)
    ticks = jnp.where(begins, shown * (now.first / period), shown * old.moved.shown)
    mean = jnp.where(begins, 0.5 * moved[0], 0.5 * (old.moved.force + moved[0]))
    impulse = jnp.where(begins, 0, old.moved.impulse) + ticks * mean
    read = jnp.where(begins, 0, old.moved.read) + ticks
    number = jnp.where(entry.touched, jnp.where(arrived > 0, arrived, 0), 0)
    return Moved(moved[0], shown, impulse, read), moved[1:], number
