"""Free rigid body without gravity, and the integration of its motion for one control period.

The state contains the spin angular momentum in world axes instead of the angular velocity, because the
angular momentum is constant without a torque.
"""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from jaxhil.sixdof.rotations import Quaternion, compose, exponential, normalise, rotate, rotate_back
from jaxhil.sixdof.vectors import Matrix, Vector, cross, dot, inverse

# Fraction of a period's velocity change that acts on the position in the same period [1]. The integrator adds
# a delay of (1 - fraction) control periods.
SHARES = {"semi_implicit_euler": 1.0, "zoh": 0.5, "explicit_euler": 0.0}


class Body(NamedTuple):
    """Rigid body with an interface frame, which is fixed at the docking mechanism."""

    mass: Float[Array, "..."]  # [kg]
    inertia: Matrix  # inertia about the centre of mass, in body axes [kg m^2]
    inverse_inertia: Matrix  # inverse of the inertia [1/(kg m^2)]
    interface: Vector  # vector from the centre of mass to the interface frame's origin, in body axes [m]
    interface_attitude: Quaternion | None  # rotation from interface axes to body axes; None for the identity


class State(NamedTuple):
    """Position, attitude, velocity and angular momentum of a body."""

    position: Vector  # position of the centre of mass, in world axes [m]
    velocity: Vector  # velocity of the centre of mass, in world axes [m/s]
    attitude: Quaternion  # rotation from body axes to world axes
    spin: Vector  # angular momentum about the centre of mass, in world axes [kg m^2/s]


class Load(NamedTuple):
    """Force and torque on a body, in world axes."""

    force: Vector  # [N]
    torque: Vector  # torque about the centre of mass [N m]


def build_body(
    mass: Float[Array, "..."], inertia: Matrix, interface: Vector, interface_attitude: Quaternion | None
) -> Body:
    """Return a body with a `mass` [kg] and a symmetric, positive definite `inertia` [kg m^2]."""
    return Body(mass, inertia, inverse(inertia), interface, interface_attitude)


def build_state(
    body: Body, position: Vector, velocity: Vector, attitude: Quaternion, angular_velocity: Vector
) -> State:
    """Return the state of a body; `angular_velocity` [rad/s] is in body axes."""
    return State(position, velocity, attitude, rotate(attitude, body.inertia @ angular_velocity))


def angular_velocity(body: Body, state: State) -> Vector:
    """Return a body's angular velocity [rad/s], in body axes."""
    return body.inverse_inertia @ rotate_back(state.attitude, state.spin)


def kinetic_energy(body: Body, state: State) -> Float[Array, "..."]:
    """Return the kinetic energy [J] of a body."""
    spin = rotate_back(state.attitude, state.spin)
    return (body.mass * dot(state.velocity, state.velocity) + dot(spin, body.inverse_inertia @ spin)) / 2


def linear_momentum(body: Body, state: State) -> Vector:
    """Return a body's linear momentum [kg m/s], in world axes."""
    return body.mass * state.velocity


def angular_momentum(body: Body, state: State) -> Vector:
    """Return a body's angular momentum [kg m^2/s] about the world's origin, in world axes."""
    return cross(state.position, linear_momentum(body, state)) + state.spin


@jax.jit
def kick_drift(
    body: Body, state: State, load: Load, period: Float[Array, "..."], share: Float[Array, "..."] | float
) -> State:
    """Integrate the motion of a body for a control `period` [s] under a constant load.

    `share` selects the integrator (see `SHARES`). In one dimension, the results equal the results of
    `jaxhil.simulation.integrators`. The rotation is integrated by an explicit Lie midpoint step of second
    order (Krysl and Endres, Int. J. Numer. Methods Eng. 62, 2005).
    """
    kick, twist = (period / body.mass) * load.force, period * load.torque
    spin = state.spin + share * twist

    def turned(attitude: Quaternion, duration) -> Quaternion:
        """Rotate the initial attitude for `duration` [s]; momentum and inertia are those at `attitude`."""
        angular = body.inverse_inertia @ rotate_back(attitude, spin)
        return compose(state.attitude, exponential(duration * angular))

    halfway = turned(state.attitude, period / 2)
    return State(
        position=state.position + period * (state.velocity + share * kick),
        velocity=state.velocity + kick,
        attitude=normalise(turned(halfway, period)),
        spin=state.spin + twist,
    )
