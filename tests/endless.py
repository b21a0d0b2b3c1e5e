"""Contact that never ends: growth or decay of the oscillation of the loop.

With both surfaces at x = 0 and tension allowed, the contact is never released. Its oscillation grows or
decays as the dominant root of the characteristic equation of the loop.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from math import pi
from typing import Any

import jax
import numpy as np
from jax import lax
from lanes import IDEAL, MASS, QUICK, mechanism, per_lane, spread, validated

from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.loop import build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.rollout import run_segment, segment_length, start_rollout
from jaxhil.simulation.tick import Tick

OMEGA = 2 * pi * 3.0
STIFFNESS = MASS * OMEGA**2
CHUNK = 256  # ticks


def persistent(
    parsed: Mechanism, compensator: str, seconds: float, gains: Mapping[str, Any], **leaves: Any
) -> Tick:
    """Return the record of an endless contact; `leaves` are scenario values, as in `lanes.spread`."""
    lanes = next(iter(leaves.values())).shape[-1]
    scenario = spread(parsed, lanes, clearance=np.zeros(lanes), **leaves)
    loop = build_loop(parsed, compensator, scenario)
    gains = per_lane(gains, lanes)
    rig, run = _begin(loop, gains, scenario)
    recorded = []
    for _ in range(math.ceil(seconds / float(np.min(scenario.control_period)) / CHUNK)):
        run, seen = _go_on(loop, gains, rig, run)
        recorded.append(jax.device_get(seen))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *recorded)


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def _begin(loop, gains, scenario):
    rig = build_rig_constants(loop, scenario)
    return rig, start_rollout(loop, rig, gains, skip_flight=False)


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def _go_on(loop, gains, rig, run):
    """Simulate one chunk; longer chunks take more time per tick."""

    def body(run, _):
        return run_segment(loop, rig, gains, run, record=True)

    run, seen = lax.scan(body, run, None, length=CHUNK // segment_length(loop))
    return run, jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), seen)


def without_period(
    compensator: str,
    seconds: float,
    gains: Mapping[str, Any],
    periods: tuple[float, float] = (5e-4, 2.5e-4),
    **leaves: Any,
) -> np.ndarray:
    """Extrapolate the growth to T -> 0 from two periods, for a loop whose error is of first order in T.

    The second period is half the first; `lead_filter` is half the period, and the simulator is ideal.
    """
    lanes = next(iter(leaves.values())).shape[-1]
    period = np.repeat(periods, lanes)
    both = {name: np.tile(value, 2) for name, value in leaves.items()}
    gains = {name: np.tile(value, 2) for name, value in gains.items()} | {"lead_filter": period / 2}
    ticks = persistent(spring(), compensator, seconds, gains, control_period=period, **both)
    coarse, fine = growth(ticks).reshape(2, lanes)
    return 2 * fine - coarse


def growth(ticks: Tick) -> np.ndarray:
    """Return the logarithm of the ratio of successive extrema of x_d in the second half of a record."""
    rates = []
    for x in np.abs(ticks.signals.position_desired).T:
        top = np.flatnonzero((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:])) + 1
        bend = 2 * x[top] - x[top - 1] - x[top + 1]
        heights = x[top] + (x[top + 1] - x[top - 1]) ** 2 / (8 * bend)
        half = len(heights) // 2
        rates.append(np.log(heights[-1] / heights[half]) / (len(heights) - 1 - half))
    return np.array(rates)


def spring(simulator: Mapping[str, Any] = IDEAL, period: float = 5e-4) -> Mechanism:
    """Return an endless undamped contact of 3 Hz with a motion simulator without delays."""
    return validated(mechanism({"stiffness": [STIFFNESS], "tension": True}, simulator, 0.0, period=period))


def characteristic_root(equation: Callable[[complex], complex], start: complex = 1j * OMEGA) -> complex:
    """Return the root [1/s] of the characteristic equation near `start`, by the secant method."""
    before, root = start * (1 + 1e-3), start
    value_before = equation(before)
    for _ in range(50):
        value = equation(root)
        if value == value_before:
            break
        before, root, value_before = root, root - value * (root - before) / (value - value_before), value
    return root


def decay(root: complex) -> float:
    """Return the logarithm of the ratio of successive extrema of an oscillation with this root."""
    return pi * root.real / abs(root.imag)
