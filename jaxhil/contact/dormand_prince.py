"""One step of Dormand and Prince's pair of order 5(4) for d'' = a(t, d, d'), and the motion within it."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

# Dormand and Prince 1980: nodes, coefficients of the stages, the last of which is the solution of order 5,
# and the error, solution of order 5 less that of order 4.
_NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_STAGES = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)


class Step(NamedTuple):
    """Motion at a step's end."""

    depth: Array  # penetration [m]
    velocity: Array  # its rate [m/s]
    first: Array  # acceleration at the step's start [m/s^2]
    last: Array  # acceleration at its end [m/s^2]
    errors: tuple[Array, Array]  # of penetration and rate


def take_step(
    acceleration: Callable[[Array, Array, Array], Array],
    time: Array,
    depth: Array,
    rate: Array,
    length: Array,
) -> Step:
    """A step of `length` [s] from penetration `depth` [m] and `rate` [m/s] at `time` [s]."""

    def total(row, slopes):
        return sum((a * slope for a, slope in zip(row, slopes, strict=True) if a), 0.0)

    end, end_rate = depth, rate
    rates, slopes = [rate], [acceleration(time, depth, rate)]
    for node, row in zip(_NODES[1:], _STAGES, strict=True):
        end = depth + length * total(row, rates)
        end_rate = rate + length * total(row, slopes)
        rates.append(end_rate)
        slopes.append(acceleration(time + node * length, end, end_rate))
    errors = length * total(_ERROR, rates), length * total(_ERROR, slopes)
    return Step(end, end_rate, slopes[0], slopes[-1], errors)


def along(s: Array | float, length: Array, depth: Array, velocity: Array, tried: Step) -> tuple[Array, Array]:
    """Position and velocity at the fraction s of a step, by its quintic (Hermite)."""
    speed, bend = velocity * length, tried.first * length**2 / 2
    moved = tried.depth - depth - speed - bend
    turned = tried.velocity * length - speed - 2 * bend
    curled = tried.last * length**2 - 2 * bend
    cubic = 10 * moved - 4 * turned + curled / 2
    quartic = -15 * moved + 7 * turned - curled
    quintic = 6 * moved - 3 * turned + curled / 2
    position = depth + s * (speed + s * (bend + s * (cubic + s * (quartic + s * quintic))))
    rate = speed + s * (2 * bend + s * (3 * cubic + s * (4 * quartic + s * 5 * quintic)))
    return position, jnp.where(length > 0, rate / jnp.where(length > 0, length, 1), velocity)
