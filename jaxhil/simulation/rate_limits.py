"""Velocity and acceleration limits of the motion simulator, applied to its position command."""

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.simulation.loop import RigConstants
from jaxhil.simulation.loop_state import PlantState


def apply_limits(rig: RigConstants, plant: PlantState, command: Array) -> tuple[Array, Array, Array | None]:
    """Return limited command [m], its step [m] and unlimited command [m]; the last is None without limits."""
    if plant.unlimited_command is None:
        return command, plant.step, None
    simulator = rig.scenario.simulator
    limited, step = limit_command(
        command, plant.unlimited_command, plant.commands[0], plant.step, rig.constants.control_period,
        simulator.velocity_limit, simulator.acceleration_limit,
    )  # fmt: skip
    return limited, step, command


def limit_command(
    unlimited_command: Array,
    unlimited_before: Array,
    previous: Array,
    previous_step: Array,
    control_period: Array,
    velocity_limit: Array,
    acceleration_limit: Array,
) -> tuple[Array, Array]:
    """Return the limited position command c(n+1) [m] and its step c(n+1) - c(n) [m].

    The velocity limit v_max restricts the step to v_max T. The acceleration limit a_max restricts the change
    of the step to q = a_max T^2.

    The limited command follows a uniformly moving unlimited command without overshoot. If the limited command
    is a distance b behind, a step s and m further steps close this distance. Each of these steps is shorter
    by q than the step before it, so that b = (m + 1) s - q m (m + 1)/2. Here m is the largest number for
    which none of these steps is negative.

    If no limit is active, apart from rounding, c(n+1) equals the unlimited command exactly.

    Args:
        unlimited_command: Unlimited command for tick n + 1 [m].
        unlimited_before: Unlimited command for tick n [m].
        previous: Limited command c(n) [m].
        previous_step: Last step of the limited command, c(n) - c(n-1) [m].
        control_period: Control period T [s].
        velocity_limit: Velocity limit v_max [m/s]; infinite if there is none.
        acceleration_limit: Acceleration limit a_max [m/s^2]; infinite if there is none.
    """
    largest = velocity_limit * control_period
    change = acceleration_limit * control_period**2
    limited = jnp.isfinite(change)
    change = jnp.where(limited, change, 1)
    unlimited = unlimited_command - previous
    behind, unlimited_step = unlimited_before - previous, unlimited_command - unlimited_before
    more = jnp.floor((jnp.sqrt(1 + 8 * jnp.abs(behind) / change) - 1) / 2)
    closing = behind / (more + 1) + jnp.sign(behind) * change * more / 2
    step = jnp.where(limited, unlimited_step + closing, unlimited)
    step = jnp.where(limited, jnp.clip(step, previous_step - change, previous_step + change), step)
    step = jnp.where(step > largest, largest, jnp.where(step < -largest, -largest, step))
    rounding = (
        2
        * jnp.finfo(unlimited_command.dtype).eps
        * (jnp.abs(unlimited_command) + jnp.abs(previous) + jnp.abs(unlimited_step))
    )
    follows = jnp.abs(step - unlimited) <= rounding
    return jnp.where(follows, unlimited_command, previous + step), jnp.where(follows, unlimited, step)
