"""Gates: factors from 0 to 1 that depend smoothly on the time at which a signal crosses a threshold.

A reading is assumed to be linear between two ticks. `share_beyond` returns the share of a control period in
which the reading exceeds a threshold. `gate` weights the shares of the last two periods with a triangle of
two periods. The gate is 1 above the threshold, 0 below, and once differentiable with respect to the time of
the crossing. If crossings are at least two periods apart, the sum of the gates of all ticks is the time above
the threshold in periods. The mean delay of the gate is one period. A gate that switches at the next tick
would have an error of up to half a period, which would be a sawtooth function of every delay.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def share_beyond(
    excess: Float[Array, "*batch"], excess_before: Float[Array, "*batch"], moved: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Return the share [1] of the last period during which a reading exceeded a threshold.

    The reading is assumed to be linear in time between two ticks.

    Args:
        excess: reading minus threshold if the reading exceeds the threshold, else 0. For a reading below a
            lower threshold, the excess is negative.
        excess_before: excess on the previous tick.
        moved: change of the reading since the previous tick, in the unit of `excess`.
    """
    crossed = (jnp.sign(excess) != jnp.sign(excess_before)) & (moved != 0)
    # Without a crossing, moved/moved would have rounding errors, and no derivative at constant readings.
    crossing = (excess - excess_before) / jnp.where(crossed, moved, 1)
    return jnp.where(crossed, crossing, jnp.where(excess == 0, 0, 1).astype(excess.dtype))


def gate(share: Float[Array, "*batch"], share_before: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the gate: a factor that rises smoothly from 0 to 1 when a reading exceeds a threshold.

    From `share_beyond`, s is the share of the last period above the threshold, l that of the period before.

    The gate is (s^2 + l^2)/2 + s l (2 - s - l).

    If the reading crossed the threshold once, the gate is the integral of a weight over the time above the
    threshold. A moment u periods ago has the weight u for u < 1, and 2 - u for 1 <= u < 2. On the first tick
    after an upward crossing the gate is s^2/2, on the second 1/2 + l - l^2/2.
    """
    return (share**2 + share_before**2) / 2 + share * share_before * (2 - share - share_before)
