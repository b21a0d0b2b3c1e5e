"""Velocity and acceleration limits of the motion simulator, as rate limits on its command."""

import jax.numpy as jnp
from jaxtyping import Array


def limit_command(
    wanted: Array,
    wanted_before: Array,
    previous: Array,
    previous_step: Array,
    control_period: Array,
    velocity_limit: Array,
    acceleration_limit: Array,
) -> tuple[Array, Array]:
    """Return the limited command c(n+1) [m] and its step c(n+1) - c(n) [m].

    `wanted` and `wanted_before` are the commands without limits for n + 1 and n [m], `previous` is c(n),
    `previous_step` is c(n) - c(n-1).

    Velocity limit: |c(n+1) - c(n)| <= v_max T. Acceleration limit: the step changes by at most q = a_max T^2,
    and does not overshoot a command in uniform motion. If the output is b behind, the step s is the longest
    one from which m more steps, each shorter by q, reach the command with zero closing speed: b = (m + 1) s -
    q m (m + 1)/2. If neither limit is active beyond rounding, c(n+1) is exactly the command without limits.
    """
    largest = velocity_limit * control_period
    change = acceleration_limit * control_period**2
    limited = jnp.isfinite(change)
    change = jnp.where(limited, change, 1)
    unlimited = wanted - previous
    behind, wanted_step = wanted_before - previous, wanted - wanted_before
    more = jnp.floor((jnp.sqrt(1 + 8 * jnp.abs(behind) / change) - 1) / 2)
    closing = behind / (more + 1) + jnp.sign(behind) * change * more / 2
    step = jnp.where(limited, wanted_step + closing, unlimited)
    step = jnp.where(limited, jnp.clip(step, previous_step - change, previous_step + change), step)
    step = jnp.where(step > largest, largest, jnp.where(step < -largest, -largest, step))
    rounding = 2 * jnp.finfo(wanted.dtype).eps * (jnp.abs(wanted) + jnp.abs(previous) + jnp.abs(wanted_step))
    follows = jnp.abs(step - unlimited) <= rounding
    return jnp.where(follows, wanted, previous + step), jnp.where(follows, unlimited, step)
