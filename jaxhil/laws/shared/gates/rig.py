"""Gates that open and close smoothly with the time, between two ticks, at which a threshold is crossed."""


def share_beyond(excess: float, excess_before: float, moved: float) -> float:
    """Share of the last period that a reading, straight between two ticks, spent beyond a threshold.

    `excess`: by how much the reading is beyond, 0 short of the threshold and of slope 1 beyond it
    (negative beyond the lower one of two thresholds); `excess_before`: the tick before; `moved`:
    the reading's change. All of one unit.
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
    """Time beyond a threshold, weighed with a triangle two periods wide: 0 to 1.

    From the shares of the last period and of the one before; exact if the threshold was crossed
    once. Its sum over the ticks is the time beyond in periods, its mean delay one period.
    """
    return (share * share + share_before * share_before) / 2.0 + share * share_before * (
        2.0 - share - share_before
    )
