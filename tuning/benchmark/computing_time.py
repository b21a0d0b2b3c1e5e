"""Measurement of the time that a compensator needs for one tick in the rig's Python runtime."""

import math
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.rig import COMPENSATORS
from jaxhil.rig.six_axes import SIX_AXIS_COMPENSATORS, ModelConstants

TIMED_TICKS = 2000  # number of ticks whose time is measured
APPROACH_DURATION, CONTACT_DURATION = 0.02, 0.2  # durations of the simulated approach and contact [s]
STIFFNESS = 1e5  # stiffness of the simulated contact [N/m]
DEFAULT_VELOCITY = 0.01  # approach speed if the file defines the initial states instead of a speed [m/s]


def measure_tick_time(mechanism: AnyMechanism, law: str, gains: Mapping[str, float]) -> float:
    """Measure the median computing time [us] of one tick, during elastic contacts that last 0.2 s each.

    Args:
        mechanism: mechanism for which the compensator is built.
        law: name of the compensator.
        gains: gains by name.
    """
    period = mechanism.rig.control_period
    if isinstance(mechanism, SixAxisMechanism):
        approach = mechanism.approach
        velocity = DEFAULT_VELOCITY if approach is None else -approach.velocity[2]
        tick_once = _build_six_axis_tick(mechanism, law, gains)
    else:
        velocity = mechanism.approach.velocity
        tick_once = _build_tick(COMPENSATORS[law](gains, period, mechanism.contact.clearance))
    spent = []
    rate = math.pi / CONTACT_DURATION
    for tick in range(TIMED_TICKS):
        now = (tick * period) % (APPROACH_DURATION + CONTACT_DURATION) - APPROACH_DURATION
        touching = now > 0
        position = velocity / rate * math.sin(rate * now) if touching else velocity * now
        speed = velocity * math.cos(rate * now) if touching else velocity
        force = STIFFNESS * position if touching else 0.0
        start = time.perf_counter()
        tick_once(force, position, speed)
        spent.append(time.perf_counter() - start)
    return 1e6 * statistics.median(spent)


def _build_tick(compensator: Any) -> Callable[[float, float, float], None]:
    """Return a function of force, position and speed that runs one tick of a one-axis compensator."""

    def tick_once(force: float, position: float, speed: float) -> None:
        command = compensator.step(force, position, speed, position)
        compensator.position_command(position, speed, -command)

    return tick_once


def _build_six_axis_tick(
    mechanism: SixAxisMechanism, law: str, gains: Mapping[str, float]
) -> Callable[[float, float, float], None]:
    """Return a function of force, position and speed that runs one tick of a six-axis compensator.

    The arguments are components along the docking axis; all other components are 0.
    """
    from jaxhil.sixdof.model_constants import model_constants

    constants = ModelConstants(**model_constants(mechanism))
    compensator = SIX_AXIS_COMPENSATORS[law](gains, constants, mechanism.rig.control_period)

    def along_axis(value: float) -> list[float]:
        return [0.0, 0.0, value, 0.0, 0.0, 0.0]

    def tick_once(force: float, position: float, speed: float) -> None:
        pose, twist = along_axis(-position), along_axis(-speed)
        compensator.step(along_axis(force), pose, twist, pose)
        compensator.pose_command(pose, twist)

    return tick_once
