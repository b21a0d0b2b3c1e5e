"""A run in six degrees of freedom as plain arrays: every number of it is a leaf.

The batch is the trailing axis; candidates, latches and the axes of the motion simulator come before it.
"""

from typing import NamedTuple

from jaxtyping import Array, Float, UInt32

from jaxhil.simulation.scenario import MotionSimulator
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.kinematics import Kinematics
from jaxhil.sixdof.latch import Latch
from jaxhil.sixdof.relative import Pair, States
from jaxhil.sixdof.sensor import Sensor


class Scenario(NamedTuple):
    """One run per lane."""

    bodies: Pair
    start: States  # of the numerical model, at tick 0
    groups: tuple[ContactGroup, ...]  # the contact
    latches: tuple[Latch, ...]
    simulator: MotionSimulator  # of each axis, (..., axes, *batch), without limits
    kinematics: Kinematics  # what the axes move
    sensor: Sensor
    control_period: Float[Array, "*batch"]  # T [s]
    duration: Float[Array, "*batch"]  # after which the run ends at the latest, to the nearest tick [s]
    key: UInt32[Array, "2 *batch"]  # of the sensor's noise
