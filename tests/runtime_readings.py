"""Readings of a contact for the tests of the runtime's controller."""

import math
import random

from jaxhil.rig import Controller

Reading = tuple[float, float, float, float]


def readings(count: int, *, seed: int = 0, two_sided: float = 0.0) -> list[Reading]:
    """Return noisy readings (F, x_d, v_d, x_m) of a contact and, with a gap, of the far surface too."""
    rng = random.Random(seed)
    stiffness, damping, rate = 1.2e5, 300.0, 25.0
    amplitude = 2e-4 + two_sided
    rows = []
    for n in range(count):
        t = n * 1e-3 - 0.01
        x, v = amplitude * math.sin(rate * t), amplitude * rate * math.cos(rate * t)
        late = t - 0.009
        xl, vl = amplitude * math.sin(rate * late), amplitude * rate * math.cos(rate * late)
        depth = xl if xl > 0 else min(xl + two_sided, 0.0) if two_sided else 0.0
        force = stiffness * depth + damping * vl if depth else 0.0
        measured = amplitude * math.sin(rate * (t - 0.006)) + rng.gauss(0.0, 1e-7)
        rows.append((force + rng.gauss(0.0, 1.0), x, v, measured))
    return rows


def run(controller: Controller, ticks: list[Reading]) -> list[float]:
    return [controller.step(*tick) for tick in ticks]
