"""Scenarios of a six-axis mechanism as arrays that contain every number of a run.

The last axis of all arrays is the batch. The axis before it, if any, has an entry for each pair of shapes,
each latch or each axis of the motion simulator.
"""

from typing import NamedTuple

from jaxtyping import Array, Float, UInt32

from jaxhil.simulation.scenario import MotionSimulatorBatch, TimingBatch
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.ideal_contact import IdealContactRecord
from jaxhil.sixdof.kinematics import Kinematics
from jaxhil.sixdof.latch import Latch
from jaxhil.sixdof.relative import Pair, States
from jaxhil.sixdof.sensor import Sensor


class Scenario(NamedTuple):
    """Batch of scenarios; each lane is one run."""

    bodies: Pair
    start: States  # states of the numerical model at tick 0
    groups: tuple[ContactGroup, ...]  # groups of shape pairs that may touch
    latches: tuple[Latch, ...]
    simulator: MotionSimulatorBatch  # transfer function of each axis, (..., axes, *batch), without limits
    kinematics: Kinematics  # kinematics of the motion simulator
    sensor: Sensor  # sensors of force and pose
    control_period: Float[Array, "*batch"]  # control period T [s]
    duration: Float[Array, "*batch"]  # maximum duration of the run [s], which is rounded to ticks
    key: UInt32[Array, "2 *batch"]  # key of the sensors' noise
    timing: TimingBatch | None = None  # timing effects of the rig; None if there are none
    # ideal contact from `start`; None: every run computes the ideal contact
    ideal_contact: IdealContactRecord | None = None
