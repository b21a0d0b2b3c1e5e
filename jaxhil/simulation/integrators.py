"""One control period of the numerical model M x'' = -F_c, for the three integrators in use on rigs.

Their own delay (notebooks/guide/model.md section 6, item 7): semi-implicit Euler none, exact zero-order hold
T/2, explicit Euler T. All arrays broadcast, plain floats stay such; position [m], velocity [m/s],
acceleration [m/s^2], control period T [s].
"""

from typing import TypeVar

from jaxtyping import Array

Number = TypeVar("Number", Array, float)


def semi_implicit_euler(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """v += T a, x += T v."""
    velocity = velocity + control_period * acceleration
    return position + control_period * velocity, velocity


def zero_order_hold(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """x += T v + T^2 a / 2, v += T a: exact for a force held over the period."""
    increment = control_period * acceleration
    return position + control_period * (velocity + increment / 2), velocity + increment


def explicit_euler(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """x += T v, v += T a."""
    return position + control_period * velocity, velocity + control_period * acceleration


INTEGRATORS = {
    "semi_implicit_euler": semi_implicit_euler,
    "zoh": zero_order_hold,
    "explicit_euler": explicit_euler,
}
