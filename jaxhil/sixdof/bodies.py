"""A free rigid body in zero g, and one control period of its numerical model.

Position and velocity are those of the centre of mass, in world axes; the attitude turns body axes into world
axes. What is carried of the rotation is the spin angular momentum J w in world axes: without a torque it does
not change, while the angular velocity does.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from jaxhil.sixdof.rotations import Quaternion, compose, exponential, normalise, rotate, rotate_back
from jaxhil.sixdof.vectors import Matrix, Vector, cross, dot, inverse

# Share of a period's kick that acts on the period's motion: the model's own delay is 1 - share.
SHARES = {"semi_implicit_euler": 1.0, "zoh": 0.5, "explicit_euler": 0.0}


class Body(NamedTuple):
    """A rigid body with an interface frame, which is where the docking mechanism is."""

    mass: Float[Array, "..."]  # [kg]
    inertia: Matrix  # about the centre of mass, in body axes [kg m^2]
    inverse_inertia: Matrix  # [1/(kg m^2)]
    interface: Vector  # origin of the interface frame, from the centre of mass, in body axes [m]
    interface_attitude: Quaternion | None  # from interface axes to body axes; None where they are the same


class State(NamedTuple):
    """Motion of a body."""

    position: Vector  # of the centre of mass, in world axes [m]
    velocity: Vector  # of the centre of mass, in world axes [m/s]
    attitude: Quaternion  # from body axes to world axes
    spin: Vector  # angular momentum about the centre of mass, in world axes [kg m^2/s]


class Load(NamedTuple):
    """What acts on a body, in world axes."""

    force: Vector  # [N]
    torque: Vector  # about the centre of mass [N m]


def build_body(
    mass: Float[Array, "..."], inertia: Matrix, interface: Vector, interface_attitude: Quaternion | None
) -> Body:
    """A body of `mass` [kg] and `inertia` [kg m^2], symmetric and positive definite."""
    return Body(mass, inertia, inverse(inertia), interface, interface_attitude)


def build_state(
    body: Body, position: Vector, velocity: Vector, attitude: Quaternion, angular_velocity: Vector
) -> State:
    """State of a body that turns at `angular_velocity` [rad/s, body axes]."""
    return State(position, velocity, attitude, rotate(attitude, body.inertia @ angular_velocity))


def angular_velocity(body: Body, state: State) -> Vector:
    """Angular velocity [rad/s], in body axes."""
    return body.inverse_inertia @ rotate_back(state.attitude, state.spin)


def kinetic_energy(body: Body, state: State) -> Float[Array, "..."]:
    """Kinetic energy [J]."""
    spin = rotate_back(state.attitude, state.spin)
    return (body.mass * dot(state.velocity, state.velocity) + dot(spin, body.inverse_inertia @ spin)) / 2


def linear_momentum(body: Body, state: State) -> Vector:
    """Linear momentum [kg m/s], in world axes."""
    return body.mass * state.velocity


def angular_momentum(body: Body, state: State) -> Vector:
    """Angular momentum [kg m^2/s] about the world's origin, in world axes."""
    return cross(state.position, linear_momentum(body, state)) + state.spin


@jax.jit
def kick_drift(
    body: Body, state: State, load: Load, period: Float[Array, "..."], share: Float[Array, "..."] | float
) -> State:
    """The state a control `period` [s] later; `share` is that of the integrator (`SHARES`).

    On the line these are `jaxhil.simulation.integrators`. The rotation is an explicit Lie midpoint step
    (Krysl and Endres, Int. J. Numer. Methods Eng. 62, 2005): of second order, for one reading of the load.
    """
    kick, twist = (period / body.mass) * load.force, period * load.torque
    spin = state.spin + share * twist

    def turned(attitude: Quaternion, duration) -> Quaternion:
        """The attitude at the start, turned for `duration` at the angular velocity it has at `attitude`."""
        angular = body.inverse_inertia @ rotate_back(attitude, spin)
        return compose(state.attitude, exponential(duration * angular))

    halfway = turned(state.attitude, period / 2)
    return State(
        position=state.position + period * (state.velocity + share * kick),
        velocity=state.velocity + kick,
        attitude=normalise(turned(halfway, period)),
        spin=state.spin + twist,
    )
