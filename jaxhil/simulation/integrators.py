"""Integrators of the numerical model M x'' = -F_c over one control period, as used on rigs.

Their own delays are (notebooks/guide/model.md, section 6, item 7): semi-implicit Euler 0, exact zero-order
hold T/2, explicit Euler T. All functions accept arrays that broadcast, or floats: position [m], velocity
[m/s], acceleration [m/s^2], control period T [s]. They return the next position and velocity.
"""

from typing import TypeVar

from jaxtyping import Array

Number = TypeVar("Number", Array, float)


def semi_implicit_euler(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """Compute v += T a, then x += T v."""
    velocity = velocity + control_period * acceleration
    return position + control_period * velocity, velocity


def zero_order_hold(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """Compute x += T v + T^2 a / 2 and v += T a, exact for a constant force in the period."""
    increment = control_period * acceleration
    return position + control_period * (velocity + increment / 2), velocity + increment


def explicit_euler(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """Compute x += T v, then v += T a."""
    return position + control_period * velocity, velocity + control_period * acceleration


INTEGRATORS = {
    "semi_implicit_euler": semi_implicit_euler,
    "zoh": zero_order_hold,
    "explicit_euler": explicit_euler,
}
