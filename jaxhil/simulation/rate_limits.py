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
    """The limited command c(n+1) [m] and its step c(n+1) - c(n) [m].

    `wanted` and `wanted_before` are what is commanded without limits for n + 1 and n [m], `previous` is c(n),
    `previous_step` c(n) - c(n-1).

    Velocity: |c(n+1) - c(n)| <= v_max T. Acceleration: the step changes by at most q = a_max T^2, and a
    command in uniform motion is not overshot. The step s that closes in on it, b behind, is the longest that
    m more steps, each shorter by q, bring to rest on it: b = (m + 1) s - q m (m + 1)/2. Where neither limit
    binds by more than rounding, c(n+1) is the command wanted, to the bit.
    """
    largest = velocity_limit * control_period
    change = acceleration_limit * control_period**2
    limited = jnp.isfinite(change)
    change = jnp.where(limited, change, 1)
    unlimited = wanted - previous
    behind, own_step = wanted_before - previous, wanted - wanted_before
    more = jnp.floor((jnp.sqrt(1 + 8 * jnp.abs(behind) / change) - 1) / 2)
    closing = behind / (more + 1) + jnp.sign(behind) * change * more / 2
    step = jnp.where(limited, own_step + closing, unlimited)
    step = jnp.where(limited, jnp.clip(step, previous_step - change, previous_step + change), step)
    step = jnp.where(step > largest, largest, jnp.where(step < -largest, -largest, step))
    rounding = 2 * jnp.finfo(wanted.dtype).eps * (jnp.abs(wanted) + jnp.abs(previous) + jnp.abs(own_step))
    follows = jnp.abs(step - unlimited) <= rounding
    return jnp.where(follows, wanted, previous + step), jnp.where(follows, unlimited, step)
