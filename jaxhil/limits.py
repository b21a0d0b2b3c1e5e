"""Velocity and acceleration limits of the motion simulator, as rate limits on its command."""

import jax.numpy as jnp
from jaxtyping import Array


def limit_command(
    command: Array,
    previous: Array,
    previous_step: Array,
    model_step: Array,
    control_period: Array,
    velocity_limit: Array,
    acceleration_limit: Array,
) -> tuple[Array, Array]:
    """The limited command c(n+1) [m] and its step c(n+1) - c(n) [m].

    Velocity: |c(n+1) - c(n)| <= v_max T. Acceleration: the step changes by at most q = a_max T^2, and a
    command in uniform motion is not overshot. The step s that closes in on it, b behind, is the longest that
    m more steps, each shorter by q, bring to rest on it: b = (m + 1) s - q m (m + 1)/2. While neither limit
    binds, c(n+1) is the command itself.
    """
    largest = velocity_limit * control_period
    change = acceleration_limit * control_period**2
    limited = jnp.isfinite(change)
    change = jnp.where(limited, change, 1)
    behind = command - model_step - previous
    more = jnp.floor((jnp.sqrt(1 + 8 * jnp.abs(behind) / change) - 1) / 2)
    closing = behind / (more + 1) + jnp.sign(behind) * change * more / 2
    step = jnp.where(limited, model_step + closing, command - previous)
    step = jnp.where(limited, jnp.clip(step, previous_step - change, previous_step + change), step)
    step = jnp.where(step > largest, largest, jnp.where(step < -largest, -largest, step))
    untouched = (jnp.abs(step - (command - previous)) <= 1e-12 * jnp.abs(step)) & (
        jnp.abs(behind) <= 1e-12 * jnp.abs(model_step)
    )
    step = jnp.where(untouched, command - previous, step)
    return previous + step, step
