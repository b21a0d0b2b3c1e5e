"""Motion of the numerical model, and constants of the rig that the controller knows."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.laws.six_axis_base import SixAxisConstants
from jaxhil.sixdof.approach import begin as place
from jaxhil.sixdof.equations import product, solve
from jaxhil.sixdof.relative import Pair, Pose, States, Twist, coordinates, mass_matrix, relative
from jaxhil.sixdof.rotations import identity
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensor import tool_mass
from jaxhil.sixdof.vectors import assembled, vector


def model_motion(bodies: Pair, states: States) -> tuple[Array, Array, Array]:
    """Return coordinates, their rates and the twist of the numerical model, (6, *batch) each.

    The results describe chaser frame C relative to target frame T. `states` are the states of the model's
    bodies.
    """
    pose, twist = relative(bodies, states)
    at, rates = coordinates(pose, twist)
    return assembled(at), assembled(rates), assembled(twist)


def controller_constants(scenario: Scenario, has_tool: bool) -> SixAxisConstants:
    """Return the constants of the rig that the compensator knows.

    `has_tool` states whether the force sensor carries a tool. Such a sensor also reads the tool's inertial
    force.
    """
    bodies, period = scenario.bodies, scenario.control_period
    zero = jnp.zeros_like(period)
    still = vector(jnp.zeros((3, *period.shape), period.dtype))
    docked = place(bodies, Pose(still, identity(zero)), Twist(still, still), zero)
    mass = mass_matrix(bodies, docked)
    unit = jnp.broadcast_to(jnp.eye(6, dtype=period.dtype).reshape(6, 6, *[1] * period.ndim), mass.shape)
    inverse = solve(mass, unit)
    correction = unit
    if has_tool:
        correction = solve(unit - product(tool_mass(scenario.sensor.assumed_tool), inverse), unit)
    return SixAxisConstants(period, mass, inverse, correction)
