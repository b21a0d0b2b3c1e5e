"""Which delays and lags of the force sensor the bank of delays supposes.

17 delays lie evenly within `delay_spread` of the given one; each is there twice, by slopes that wander and by
slopes that hardly do. Where no lag is told, as many hypotheses have the given delay and a lag of 0.25, 0.5,
.. 4.25 ms. A lag l that is told is part of the given delay: then nine have the lag l, and a transport delay
evenly within `delay_spread` of what is left of the given one, together as likely as all delays, and eight lag
by 0.5, 1, .. 4 ms more.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

DELAYS = LAGS = 17
FIRST_LAG = 2 * DELAYS
HYPOTHESES = FIRST_LAG + LAGS
AS_TOLD = 9  # lags that are as told, where one is
LAG_STEP, LONGER_STEP = 0.00025, 0.0005  # s from lag to lag, and where one is told
LEAST_LAG = 1e-6  # s: a shorter one is none
LAGGING = 0.0001  # of a delay's probability, that of each lag that is not told

DELAYED = np.arange(HYPOTHESES) < FIRST_LAG


class Supposed(NamedTuple):
    """By each hypothesis; what is carried is in terms of a delay."""

    offsets: Float[Array, "hypotheses *batch"]  # how much older the force is than given, but for its lag [s]
    lags: Float[Array, "lags *batch"]  # of the last hypotheses [s]
    older: Float[Array, "hypotheses *batch"]  # how much older it is to first order, with its lag [s]
    first: Float[Array, "hypotheses *batch"]  # what is carried before the first contact
    either: Float[Array, "hypotheses *batch"]  # and what where it is over: only then its slopes tell


def suppose(delay_spread: Float[Array, "*batch"], sensor_lag: Float[Array, "*batch"]) -> Supposed:
    """Delays within `delay_spread` [s] of the given one; the lag that is told [s], or 0."""
    column, like = (-1, *[1] * delay_spread.ndim), delay_spread.dtype
    place = jnp.arange(LAGS, dtype=like).reshape(column)
    spread, told = delay_spread[None], sensor_lag[None]
    delays = jnp.linspace(-1, 1, DELAYS, dtype=like).reshape(column) * spread
    as_told, lagging = place < AS_TOLD, told > LEAST_LAG
    longer = jnp.where(as_told, 0, LONGER_STEP * (place - (AS_TOLD - 1)))
    lags = jnp.where(lagging, told + longer, LAG_STEP * (place + 1))
    newer = jnp.where(lagging, jnp.where(as_told, (0.25 * place - 1) * spread, 0) - told, 0)
    likely = jnp.where(as_told, DELAYS / AS_TOLD, LONGER_STEP / LAG_STEP * LAGGING)
    likely = jnp.where(lagging, likely, LAGGING)
    none = jnp.zeros_like(delays)
    return Supposed(
        offsets=jnp.concatenate([delays, delays, newer]),
        lags=lags,
        older=jnp.concatenate([delays, delays, newer + lags]),
        first=jnp.concatenate([none + 1, none, likely]),
        either=jnp.concatenate([none + 0.5, none + 0.5, likely]),
    )
