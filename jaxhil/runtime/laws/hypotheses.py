"""Which delays and lags of the force sensor the bank of delays supposes.

17 delays lie evenly within `delay_spread` of the given one; each is there twice, by slopes that wander and by
slopes that hardly do. Where no lag is told, as many hypotheses have the given delay and a lag of 0.25, 0.5,
.. 4.25 ms. A lag l that is told is part of the given delay: then nine have the lag l, and a transport delay
evenly within `delay_spread` of what is left of the given one, together as likely as all delays, and eight lag
by 0.5, 1, .. 4 ms more.
"""

from typing import NamedTuple

import numpy as np

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

    offsets: np.ndarray  # how much older the force is than by the given delay, but for its lag [s]
    lags: np.ndarray  # of the last LAGS hypotheses [s]
    older: np.ndarray  # how much older it is to first order, with its lag [s]
    first: np.ndarray  # what is carried before the first contact
    either: np.ndarray  # and what where it is over: only then its slopes tell how they are
    step: float  # from delay to delay [s]
    lag_step: float  # from lag to lag [s]
    untold: int  # the first hypothesis of a lag that is not told


def suppose(delay_spread: float, sensor_lag: float) -> Supposed:
    """Delays within `delay_spread` [s] of the given one; the lag that is told [s], or 0."""
    place = np.arange(float(LAGS))
    delays = np.array([0.125 * step - 1.0 for step in range(DELAYS)]) * delay_spread
    told = sensor_lag > LEAST_LAG
    if told:
        as_told = place < AS_TOLD
        longer = np.where(as_told, 0.0, LONGER_STEP * (place - (AS_TOLD - 1.0)))
        lags = sensor_lag + longer
        newer = np.where(as_told, (0.25 * place - 1.0) * delay_spread, 0.0) - sensor_lag
        likely = np.where(as_told, DELAYS / AS_TOLD, LONGER_STEP / LAG_STEP * LAGGING)
    else:
        lags = LAG_STEP * (place + 1.0)
        newer = np.zeros(LAGS)
        likely = np.full(LAGS, LAGGING)
    none = np.zeros(DELAYS)
    return Supposed(
        offsets=np.concatenate((delays, delays, newer)),
        lags=lags,
        older=np.concatenate((delays, delays, newer + lags)),
        first=np.concatenate((none + 1.0, none, likely)),
        either=np.concatenate((none + 0.5, none + 0.5, likely)),
        step=float(delays[1] - delays[0]),
        lag_step=LONGER_STEP if told else LAG_STEP,
        untold=FIRST_LAG + (AS_TOLD if told else 0),
    )
