"""Gates: factors from 0 to 1 that depend smoothly on the time at which a signal crosses a threshold."""


def share_beyond(excess: float, excess_before: float, moved: float) -> float:
    """Return the share [1] of the last period during which a reading exceeded a threshold.

    The reading is assumed to be linear in time between two ticks.

    Args:
        excess: reading minus threshold if the reading exceeds the threshold, else 0. If there is also a lower
            threshold and the reading is below it, reading minus lower threshold, which is negative.
        excess_before: excess on the previous tick.
        moved: change of the reading since the previous tick, in the unit of `excess`.
    """
    if excess > 0.0:
        crossed = excess_before <= 0.0
    elif excess < 0.0:
        crossed = excess_before >= 0.0
    else:
        crossed = excess_before != 0.0
    if crossed and moved != 0.0:
        return (excess - excess_before) / moved
    return 0.0 if excess == 0.0 else 1.0


def gate(share: float, share_before: float) -> float:
    """Return the gate: a factor that rises smoothly from 0 to 1 when a reading exceeds a threshold.

    The gate is the integral of a triangular weight over the time above the threshold in the last two periods.

    The result is exact if the reading crossed the threshold once. The gates of all ticks add up to the time
    above the threshold in periods, and the mean delay of the gate is one period.

    Args:
        share: share of the last period during which the reading exceeded the threshold.
        share_before: the same share for the period before.
    """
    return (share * share + share_before * share_before) / 2.0 + share * share_before * (
        2.0 - share - share_before
    )
