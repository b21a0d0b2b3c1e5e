"""A contact as the retrospective references find it: when its surface was met, where that is, on what scale.

Signals are aligned with the force that is read, and scaled by the contact's approach speed v0 and the mass M.
Where a surface is expected is carried from contact to contact, as each finds it anew.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxhil.compensators.base import Constants, Gains, Signals
from jaxhil.compensators.history import History, Samples, positions_before, recall
from jaxhil.compensators.onset import AGES, Found, Onset, find, rarity
from jaxhil.compensators.reintegration import Scales, beyond

SEEN = 8  # differences between readings that show how noisy the force is
OUTSTANDING = 32.0  # times the noise's variance: what hardly is noise
LATE = 0.25  # how uncertain the surface is, of the ticks until it was found
DRIFT = 1e-6  # m, of the surface from contact to contact
USUAL_PACE = 14.0  # 1/s: slower contact is followed on a slower scale of time
SLOWEST = 0.01  # of that
MARGIN = 0.0625  # of the stretch between two samples, that the surface is off its end
ELSEWHERE = 25.0  # times the variance of where the surface is expected


class Aligned(NamedTuple):
    """Measured positions of the tick before."""

    middle: Float[Array, "*batch"]  # delayed by tau [m]
    last: Float[Array, "*batch"]  # delayed by tau + T [m]


class Noise(NamedTuple):
    """Of the forces read out of contact."""

    squares: Float[Array, "*batch"]  # sum of half the squares of differences between successive ones [N^2]
    number: Float[Array, "*batch"]  # how many they are


class Plane(NamedTuple):
    """Where the surfaces of the sides 1 and -1 are expected."""

    place: Float[Array, "2 *batch"]  # by how much they are deeper than told [m]
    spread: Float[Array, "2 *batch"]  # of that [m]


class Meeting(NamedTuple):
    """The surface, where one is found."""

    found: Bool[Array, "*batch"]  # whether it is
    scales: Scales  # of the contact
    planes: Plane  # as expected from now on
    start: Samples  # last sample before the hardware met it
    index: Array  # tick of the run, of that sample
    since: Float[Array, "*batch"]  # from the meeting to the next sample [ticks]


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


def take_noise(gains: Gains, old: Noise, history: History, force: Array, shown: Array, free: Array) -> Noise:
    """A reading [N] after those of the history: where the hardware is `free`, the difference tells how noisy
    the force is."""
    before, shown_before = history.reading
    step = force - before
    stands = (old.number >= SEEN) & (step * step > OUTSTANDING * force_noise(gains, old))
    taken = free & shown & (shown_before > 0) & ~stands
    return Noise(old.squares + jnp.where(taken, 0.5 * (step * step), 0), old.number + jnp.where(taken, 1, 0))


def force_noise(gains: Gains, seen: Noise) -> Float[Array, "*batch"]:
    """The force's variance [N^2]: what the gains say, or what readings out of contact show if that is
    more."""
    known = gains["force_noise"] ** 2
    shown = seen.squares / jnp.where(seen.number > 0, seen.number, 1)
    return jnp.where(shown > known, shown, known)


def search(
    gains: Gains,
    constants: Constants,
    planes: Plane,
    onset: Onset,
    history: History,
    side: Array,
    speed: Array,
    noise: Array,
    tick: Array,
) -> Found:
    """The surface on this `side`, if the force tells that it was met, at this speed [m/s]; `noise` is the
    force's variance [N^2]."""
    weight = gains["equivalent_mass"] * speed
    variance = gains["force_noise_floor"] ** 2 + noise / (weight * weight)
    unknown = (gains["bias_spread"] / weight) ** 2
    place, spread = (jnp.where(side < 0, both[1], both[0]) for both in planes)
    away = beyond(side, constants.clearance, positions_before(history, tick, AGES)) - place
    rare = rarity(away, spread, constants.control_period * speed)
    args = (onset, tick, constants.control_period, variance, unknown, rare)
    # What is compared alone moves nothing that is differentiated.
    return find(*lax.stop_gradient(args))


def meet(
    gains: Gains,
    clearance: Array,
    old: Scales,
    planes: Plane,
    history: History,
    side: Array,
    speed: Array,
    found: Found,
) -> Meeting:
    """The surface met between two samples: between them it lies where it was most expected."""
    index = history.age - found.age
    start = recall(history, index)
    low = beyond(side, clearance, start.position)
    high = beyond(side, clearance, recall(history, index + 1).position)
    row = jnp.where(side < 0, 1, 0)
    expected = Plane(*(jnp.take_along_axis(both, row[None], axis=0)[0] for both in planes))
    now = learn_plane(expected, low, high, found.age)
    end = high - MARGIN * (high - low)
    place = jnp.where(now.place < low, low, jnp.where(now.place > end, end, now.place))
    wide = high > low
    since = jnp.where(wide, (high - place) / jnp.where(wide, high - low, 1), 0.5)
    weight = gains["equivalent_mass"] * speed
    pace = jnp.sqrt(jnp.where(found.stiffness > 0, found.stiffness, 0)) / USUAL_PACE
    pace = jnp.clip(pace, SLOWEST, 1)
    scales = Scales(side, place, speed, pace, weight * pace, side * found.bias * weight)
    detected = found.detected
    chosen = Scales(*(jnp.where(detected, new, before) for new, before in zip(scales, old, strict=True)))
    here = detected[None] & (row[None] == jnp.arange(2).reshape(2, *[1] * row.ndim))
    carried = Plane(*(jnp.where(here, new[None], both) for new, both in zip(now, planes, strict=True)))
    return Meeting(detected, chosen, carried, start, index, since)


def learn_plane(old: Plane, low: Array, high: Array, age: Array) -> Plane:
    """Where a surface is expected, one with `old.place` and `old.spread` of shape (*batch), that was met
    between two places [m], so many ticks before that was found."""
    width = high - low
    late = LATE * age.astype(width.dtype)
    found = width * width * (1 / 12 + late * late)
    known = old.spread * old.spread
    middle = 0.5 * (low + high)
    away = middle - old.place
    elsewhere = away * away > ELSEWHERE * (known + found)
    share = known / (known + found)
    place = jnp.where(elsewhere, middle, old.place + away * share)
    variance = jnp.where(elsewhere, found, share * found)
    return Plane(place, jnp.sqrt(variance + DRIFT * DRIFT))
