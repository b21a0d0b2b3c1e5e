"""Gates that open and close smoothly with the time between two ticks at which a threshold is crossed."""


def share_beyond(excess: float, excess_before: float, moved: float) -> float:
    """Return the share of the last period that a reading, linear between ticks, was beyond a threshold.

    Args:
        excess: how far the reading is beyond: 0 within, of slope 1 beyond, negative beyond a lower threshold.
        excess_before: excess on the tick before.
        moved: change of the reading since then, in the same unit.
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
    """Return the time beyond a threshold, weighted with a triangle two periods wide: 0 to 1.

    The arguments are the shares of the last period and of the one before. The result is exact if the
    threshold was crossed once. Its sum over the ticks is the time beyond in periods, its mean delay one
    period.
    """
    return (share * share + share_before * share_before) / 2.0 + share * share_before * (
        2.0 - share - share_before
    )
