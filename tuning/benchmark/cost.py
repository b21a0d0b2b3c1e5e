"""What a law costs per tick of the rig's runtime in plain Python: a timing, which no two runs repeat."""

import math
import statistics
import time
from collections.abc import Mapping

from jaxhil.rig import COMPENSATORS

TICKS = 2000
APPROACH, CONTACT = 0.02, 0.2  # s


def microseconds_per_tick(
    law: str, gains: Mapping[str, float], period: float, clearance: float, velocity: float
) -> float:
    """Median time [us] of one tick, through contacts of a spring of 2.5 Hz entered at `velocity` [m/s]."""
    compensator = COMPENSATORS[law](gains, period, clearance)
    spent = []
    rate = math.pi / CONTACT
    for tick in range(TICKS):
        now = (tick * period) % (APPROACH + CONTACT) - APPROACH
        touching = now > 0
        position = velocity / rate * math.sin(rate * now) if touching else velocity * now
        speed = velocity * math.cos(rate * now) if touching else velocity
        force = 1e5 * position if touching else 0.0
        begun = time.perf_counter()
        command = compensator.step(force, position, speed, position)
        compensator.position_command(position, speed, -command)
        spent.append(time.perf_counter() - begun)
    return 1e6 * statistics.median(spent)
