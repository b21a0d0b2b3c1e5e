"""Integrators of rigs: advance the numerical model (mass times acceleration = -force) by one control period.

Each integrator adds its own delay to the loop: 0 for semi-implicit Euler, T/2 for the exact zero-order hold,
and T for explicit Euler, where T is the control period (notebooks/guide/model.md, section 6, item 7).

All functions take position [m], velocity [m/s], acceleration [m/s^2] and control period [s], as floats or as
arrays that broadcast. The functions return position and velocity one control period later.
"""

from typing import TypeVar

from jaxtyping import Array

Number = TypeVar("Number", Array, float)


def semi_implicit_euler(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """Integrate one control period by semi-implicit Euler: v += T a, then x += T v."""
    velocity = velocity + control_period * acceleration
    return position + control_period * velocity, velocity


def zero_order_hold(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """Integrate one control period exactly for a constant force: x += T v + T^2 a / 2, v += T a."""
    increment = control_period * acceleration
    return position + control_period * (velocity + increment / 2), velocity + increment


def explicit_euler(position: Number, velocity: Number, acceleration: Number, control_period: Number):
    """Integrate one control period by explicit Euler: x += T v, then v += T a."""
    return position + control_period * velocity, velocity + control_period * acceleration


INTEGRATORS = {
    "semi_implicit_euler": semi_implicit_euler,
    "zoh": zero_order_hold,
    "explicit_euler": explicit_euler,
}
