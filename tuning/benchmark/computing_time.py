"""Measurement of the time that a compensator needs for one tick in the rig's Python runtime."""

import math
import statistics
import time
from collections.abc import Mapping

from jaxhil.rig import COMPENSATORS

TIMED_TICKS = 2000  # number of ticks whose time is measured
APPROACH_DURATION, CONTACT_DURATION = 0.02, 0.2  # durations of the simulated approach and contact [s]


def measure_tick_time(
    law: str, gains: Mapping[str, float], period: float, clearance: float, velocity: float
) -> float:
    """Measure the median computing time [us] of one tick, during contacts with a spring of 2.5 Hz.

    Args:
        law: name of the compensator.
        gains: gains by name.
        period: control period [s].
        clearance: distance between the two surfaces [m]; infinite for one surface.
        velocity: approach speed [m/s].
    """
    compensator = COMPENSATORS[law](gains, period, clearance)
    spent = []
    rate = math.pi / CONTACT_DURATION
    for tick in range(TIMED_TICKS):
        now = (tick * period) % (APPROACH_DURATION + CONTACT_DURATION) - APPROACH_DURATION
        touching = now > 0
        position = velocity / rate * math.sin(rate * now) if touching else velocity * now
        speed = velocity * math.cos(rate * now) if touching else velocity
        force = 1e5 * position if touching else 0.0
        start = time.perf_counter()
        command = compensator.step(force, position, speed, position)
        compensator.position_command(position, speed, -command)
        spent.append(time.perf_counter() - start)
    return 1e6 * statistics.median(spent)
