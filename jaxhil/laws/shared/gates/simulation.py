"""Gates that open and close smoothly, where a switch would wait for the next tick.

A reading is assumed linear between two ticks. From the shares of the last two control periods that it was
beyond a threshold follows the gate, the time beyond weighted with a triangle two periods wide: 1 beyond the
threshold, 0 within, once differentiable with respect to the time of the crossing. The sum of the gate over
the ticks is the time beyond, in periods, and its mean delay is one period, whenever between ticks the
crossings occur (at least two periods apart). A switch has an error of up to half a period, which is a
sawtooth function of every delay.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def share_beyond(
    excess: Float[Array, "*batch"], excess_before: Float[Array, "*batch"], moved: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Return the share of the last period that a reading, linear between ticks, was beyond a threshold [1].

    Args:
        excess: how far the reading is beyond: 0 within, of slope 1 beyond, negative beyond a lower threshold.
        excess_before: excess on the tick before.
        moved: change of the reading since then, in the same unit.
    """
    crossed = (jnp.sign(excess) != jnp.sign(excess_before)) & (moved != 0)
    # While beyond, moved/moved would have rounding errors, and no derivative at a standstill.
    crossing = (excess - excess_before) / jnp.where(crossed, moved, 1)
    return jnp.where(crossed, crossing, jnp.where(excess == 0, 0, 1).astype(excess.dtype))


def gate(share: Float[Array, "*batch"], share_before: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the gate (s^2 + l^2)/2 + s l (2 - s - l) for the shares s of the last period, l of that before.

    If the threshold was crossed once, this is the integral of a triangle over the time beyond: with the age u
    [periods], u for u < 1 and 2 - u for 1 <= u < 2. It is s^2/2, then 1/2 + l - l^2/2, on the way in, and it
    increases with s and l.
    """
    return (share**2 + share_before**2) / 2 + share * share_before * (2 - share - share_before)
