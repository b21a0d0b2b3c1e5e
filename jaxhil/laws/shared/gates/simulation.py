"""Gates that open and close smoothly where a switch would wait for a tick.

Between two ticks a reading is taken to go straight. The share of the last control period that it spent beyond
a threshold, together with the share of the period before, weighs that time with a triangle two periods wide:
1 beyond the threshold, 0 short of it, once differentiable in the time of the crossing. Summed over ticks the
gate is the time spent beyond, in periods, and its mean delay is one period, wherever between ticks the
crossings fall (two periods or more apart). A switch errs there by up to half a period, in a sawtooth of
every delay.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def share_beyond(
    excess: Float[Array, "*batch"], excess_before: Float[Array, "*batch"], moved: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Share of a period that a reading, straight between two ticks, spent beyond a threshold [1].

    `excess` is by how much it is beyond at the tick (`excess_before`: at the tick before), 0 short of the
    threshold and of slope 1 in the reading beyond, as `deflection` is; `moved` is the reading's change. Of
    two thresholds with a gap between them the excess beyond the lower one is negative. One unit throughout.
    """
    crossed = (jnp.sign(excess) != jnp.sign(excess_before)) & (moved != 0)
    # Not moved/moved while beyond: rounding would tell, and so would the derivative of a standstill.
    crossing = (excess - excess_before) / jnp.where(crossed, moved, 1)
    return jnp.where(crossed, crossing, jnp.where(excess == 0, 0, 1).astype(excess.dtype))


def gate(share: Float[Array, "*batch"], share_before: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Weight [1] of the time beyond a threshold: (s^2 + l^2)/2 + s l (2 - s - l), from its shares s of the
    last period and l of the one before.

    If the threshold was crossed once, that is the integral over the time beyond, of age u [periods], of the
    triangle u for u < 1, 2 - u for u < 2: s^2/2, then 1/2 + l - l^2/2 on the way in. It rises with s and l.
    """
    return (share**2 + share_before**2) / 2 + share * share_before * (2 - share - share_before)
