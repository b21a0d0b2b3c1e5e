"""Scenario in six degrees of freedom as arrays: every number of a run is a leaf.

The batch is the trailing axis; candidates, latches and the axes of the motion simulator come before it.
"""

from typing import NamedTuple

from jaxtyping import Array, Float, UInt32

from jaxhil.simulation.scenario import MotionSimulatorBatch
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.kinematics import Kinematics
from jaxhil.sixdof.latch import Latch
from jaxhil.sixdof.relative import Pair, States
from jaxhil.sixdof.sensor import Sensor


class Scenario(NamedTuple):
    """Batch of scenarios, one run per lane."""

    bodies: Pair
    start: States  # numerical model at tick 0
    groups: tuple[ContactGroup, ...]  # candidates of the contact
    latches: tuple[Latch, ...]
    simulator: MotionSimulatorBatch  # model of each axis, (..., axes, *batch), without limits
    kinematics: Kinematics  # relation of axes and coordinates
    sensor: Sensor
    control_period: Float[Array, "*batch"]  # T [s]
    duration: Float[Array, "*batch"]  # longest duration of the run, rounded to ticks [s]
    key: UInt32[Array, "2 *batch"]  # key of the sensor's noise
