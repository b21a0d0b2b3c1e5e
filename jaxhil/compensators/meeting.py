"""A contact as the retrospective references meet it: its surface, where that is, on what scale of time.

Signals are aligned with the force that is read, and scaled by the contact's approach speed v0 and the mass M.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.compensators.base import Constants, Gains
from jaxhil.compensators.contact_plane import Plane, found_variance, learn_plane
from jaxhil.compensators.history import History, Samples, positions_before, recall
from jaxhil.compensators.onset import Found, Onset, find, rarity
from jaxhil.compensators.reintegration import Scales, beyond

USUAL_PACE = 14.0  # 1/s: slower contact is followed on a slower scale of time
SLOWEST = 0.01  # of that
MARGIN = 0.0625  # of the stretch between two samples, that the surface is off its end


class Meeting(NamedTuple):
    """The surface, where one is found."""

    found: Bool[Array, "*batch"]  # whether it is
    scales: Scales  # of the contact
    planes: Plane  # of both sides, 1 and -1, (2, *batch), as expected from now on
    start: Samples  # last sample before the hardware met it
    index: Array  # tick of the run, of that sample
    since: Float[Array, "*batch"]  # from the meeting to the next sample [ticks]
    place: Float[Array, "*batch"]  # by how much the surface is deeper than told, by these readings alone [m]
    variance: Float[Array, "*batch"]  # of that [m^2]
    stiffness: Float[Array, "*batch"]  # the most that it may be, on the contact's scale of time [1/s^2]


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
    weight, period = gains["equivalent_mass"] * speed, constants.control_period
    variance = gains["force_noise_floor"] ** 2 + noise / (weight * weight)
    unknown = (gains["bias_spread"] / weight) ** 2
    place, spread = (jnp.where(side < 0, both[1], both[0])[None] for both in planes)

    def rare(ages):
        away = beyond(side[None], constants.clearance[None], positions_before(history, tick, ages)) - place
        return rarity(away, spread, (period * speed)[None])

    return find(onset, tick, period, variance, unknown, rare)


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
    width = high - low
    now = learn_plane(expected, low, high, found_variance(width, found.age))
    end = high - MARGIN * (high - low)
    place = jnp.where(now.place < low, low, jnp.where(now.place > end, end, now.place))
    wide = high > low
    since = jnp.where(wide, (high - place) / jnp.where(wide, high - low, 1), 0.5)
    weight = gains["equivalent_mass"] * speed
    stiff = found.stiffness > 0
    pace = jnp.where(stiff, jnp.sqrt(jnp.where(stiff, found.stiffness, 1)) / USUAL_PACE, 0)
    pace = jnp.clip(pace, SLOWEST, 1)
    scales = Scales(side, place, speed, pace, weight * pace, side * found.bias * weight)
    detected = found.detected
    chosen = Scales(*(jnp.where(detected, new, before) for new, before in zip(scales, old, strict=True)))
    here = detected[None] & (row[None] == jnp.arange(2).reshape(2, *[1] * row.ndim))
    carried = Plane(*(jnp.where(here, new[None], both) for new, both in zip(now, planes, strict=True)))
    stiffness = found.stiffness / (pace * pace)
    met = 0.5 * (low + high) - found.earlier * width
    around = width * width * (1 / 12 + found.variance)
    return Meeting(detected, chosen, carried, start, index, since, met, around, stiffness)
