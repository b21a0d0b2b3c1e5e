"""Free rigid body in zero gravity, and one control period of its numerical model.

Position and velocity are those of the centre of mass, in world axes. The attitude rotates body axes into
world axes. The state of the rotation is the angular momentum J w in world axes, which is constant without a
torque, unlike the angular velocity.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from jaxhil.sixdof.rotations import Quaternion, compose, exponential, normalise, rotate, rotate_back
from jaxhil.sixdof.vectors import Matrix, Vector, cross, dot, inverse

# Share of a period's velocity change that acts in the same period; the integrator's own delay is 1 - share.
SHARES = {"semi_implicit_euler": 1.0, "zoh": 0.5, "explicit_euler": 0.0}


class Body(NamedTuple):
    """Rigid body with an interface frame, at the docking mechanism."""

    mass: Float[Array, "..."]  # [kg]
    inertia: Matrix  # about the centre of mass, in body axes [kg m^2]
    inverse_inertia: Matrix  # [1/(kg m^2)]
    interface: Vector  # origin of the interface frame, from the centre of mass, in body axes [m]
    interface_attitude: Quaternion | None  # from interface axes to body axes; None if they are equal


class State(NamedTuple):
    """Motion of a body."""

    position: Vector  # of the centre of mass, in world axes [m]
    velocity: Vector  # of the centre of mass, in world axes [m/s]
    attitude: Quaternion  # from body axes to world axes
    spin: Vector  # angular momentum about the centre of mass, in world axes [kg m^2/s]


class Load(NamedTuple):
    """Force and torque on a body, in world axes."""

    force: Vector  # [N]
    torque: Vector  # about the centre of mass [N m]


def build_body(
    mass: Float[Array, "..."], inertia: Matrix, interface: Vector, interface_attitude: Quaternion | None
) -> Body:
    """Return a body of `mass` [kg] and `inertia` [kg m^2], which is symmetric and positive definite."""
    return Body(mass, inertia, inverse(inertia), interface, interface_attitude)


def build_state(
    body: Body, position: Vector, velocity: Vector, attitude: Quaternion, angular_velocity: Vector
) -> State:
    """Return the state of a body with `angular_velocity` [rad/s, body axes]."""
    return State(position, velocity, attitude, rotate(attitude, body.inertia @ angular_velocity))


def angular_velocity(body: Body, state: State) -> Vector:
    """Return the angular velocity [rad/s], in body axes."""
    return body.inverse_inertia @ rotate_back(state.attitude, state.spin)


def kinetic_energy(body: Body, state: State) -> Float[Array, "..."]:
    """Return the kinetic energy [J]."""
    spin = rotate_back(state.attitude, state.spin)
    return (body.mass * dot(state.velocity, state.velocity) + dot(spin, body.inverse_inertia @ spin)) / 2


def linear_momentum(body: Body, state: State) -> Vector:
    """Return the linear momentum [kg m/s], in world axes."""
    return body.mass * state.velocity


def angular_momentum(body: Body, state: State) -> Vector:
    """Return the angular momentum [kg m^2/s] about the world's origin, in world axes."""
    return cross(state.position, linear_momentum(body, state)) + state.spin


@jax.jit
def kick_drift(
    body: Body, state: State, load: Load, period: Float[Array, "..."], share: Float[Array, "..."] | float
) -> State:
    """Return the state a control `period` [s] later; `share` is that of the integrator (`SHARES`).

    In one dimension these are the integrators of `jaxhil.simulation.integrators`. The rotation is an explicit
    Lie midpoint step (Krysl and Endres, Int. J. Numer. Methods Eng. 62, 2005) of second order, with one
    evaluation of the load.
    """
    kick, twist = (period / body.mass) * load.force, period * load.torque
    spin = state.spin + share * twist

    def turned(attitude: Quaternion, duration) -> Quaternion:
        """Return the initial attitude rotated for `duration` at the angular velocity for `attitude`."""
        angular = body.inverse_inertia @ rotate_back(attitude, spin)
        return compose(state.attitude, exponential(duration * angular))

    halfway = turned(state.attitude, period / 2)
    return State(
        position=state.position + period * (state.velocity + share * kick),
        velocity=state.velocity + kick,
        attitude=normalise(turned(halfway, period)),
        spin=state.spin + twist,
    )
