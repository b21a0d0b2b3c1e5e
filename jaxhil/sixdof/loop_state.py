"""Structure, constants, states and records of the loop of the six-axis rig (`jaxhil.sixdof.loop`)."""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int, UInt32

from jaxhil.laws.simulation_base import Gains
from jaxhil.laws.six_axis_base import SixAxisConstants, SixAxisSignals
from jaxhil.mechanism.sensor_filter import FilterModes
from jaxhil.simulation.scenario import TimingBatch
from jaxhil.simulation.timing import HeldValues
from jaxhil.sixdof.axes import Axes, Hardware
from jaxhil.sixdof.forces import ContactGroup, Forces, Memory
from jaxhil.sixdof.kinematics import Kinematics, RigidMotion
from jaxhil.sixdof.latch import Latch, LatchState
from jaxhil.sixdof.relative import Pair, Pose, States, Twist, Wrench
from jaxhil.sixdof.sensor import Sensor

SIDES = ("fixed", "moving")  # sides of the rig on which the force sensor may be
# Minimum number of ticks for settling before a run, if axis positions are not linear functions of the
# coordinates; a power of two.
SETTLING_TICKS = 256


class Loop(eqx.Module):
    """Structure of the loop. Each combination of values of the fields needs a separate compiled program."""

    integrator: str = eqx.field(static=True)  # integrator of the numerical model, a name of `SHARES`
    hold: str = eqx.field(static=True)  # hold of the command within a period, "linear" or "zoh"
    latency: int = eqx.field(static=True)  # latency of the command [control periods], 0 or 1
    # length of the delay line [control periods], a power of two above the longest delay
    ring: int = eqx.field(static=True)
    side: str = eqx.field(static=True, default="fixed")  # side of the force sensor, one of `SIDES`
    has_noise: bool = eqx.field(static=True, default=False)  # whether the force sensor has noise
    has_lag: bool = eqx.field(static=True, default=True)  # whether the force sensor has a lag or a filter
    # low-pass filter of the force sensor: its modes; None without a filter
    sensor_filter: FilterModes | None = eqx.field(static=True, default=None)
    # whether the force sensor has a quantum, a dead zone or a range
    has_sample_effects: bool = eqx.field(static=True, default=True)
    # whether the dead zone leaves larger readings unchanged, instead of reducing them by its half-width
    cuts_dead_zone: bool = eqx.field(static=True, default=False)
    has_pose_errors: bool = eqx.field(static=True, default=False)  # whether the pose has noise or a quantum
    # whether the pose is measured even if neither the sensor's tool nor the compensator needs it
    measures_pose: bool = eqx.field(static=True, default=False)
    # length of the compensator's own delay line [control periods], a power of two
    controller_ring: int = eqx.field(static=True, default=1)
    # name of the compensator, one of `SIX_AXIS_COMPENSATORS`
    compensator: str = eqx.field(static=True, default="none")
    episodes: int = eqx.field(static=True, default=1)  # number of evaluated episodes
    # whether a run continues after its last evaluated episode until the end of its duration
    whole: bool = eqx.field(static=True, default=False)


class RigConstants(NamedTuple):
    """Constants of a batch of runs: bodies, hardware, sensors and compensator."""

    bodies: Pair  # bodies of the numerical model
    axes: Axes  # axes of the motion simulator, with the sensors' delays
    kinematics: Kinematics
    groups: tuple[ContactGroup, ...]  # groups of shape pairs that may touch
    latches: tuple[Latch, ...]
    sensor: Sensor
    period: Float[Array, "*batch"]  # control period T [s]
    key: UInt32[Array, "2 *batch"]  # key of the sensors' noise
    gains: Gains  # gains of the compensator, (*batch)
    constants: SixAxisConstants  # constants of the rig that the compensator knows
    prepared: Any  # constants that the compensator's `prepare` computes
    timing: TimingBatch | None  # timing effects of the rig; None if there are none


class NumericalController(NamedTuple):
    """State of the controller: sensor lag, compensator, and values for lost frames and missed ticks."""

    # last input and last output of the lag, or of each mode of the filter; None without either
    lag: tuple[Wrench, Any] | None
    law: Any  # state of the compensator
    held: HeldValues | None = None  # values of the last tick; None without timing effects
    # change of the force sensor's bias until the last tick [N, N m], (6, *batch); None for a constant bias
    bias_walk: Array | None = None


class RunState(NamedTuple):
    """State of a batch of runs between two ticks."""

    states: States  # states of the numerical model's bodies
    near: Float[Array, "6 *batch"]  # coordinates of the numerical model's pose
    twist: Float[Array, "6 *batch"]  # twist of the numerical model
    hardware: Hardware
    memories: tuple[Memory, ...]  # states of the contact and friction laws
    latch_states: tuple[LatchState, ...]  # states of the latches
    controller: NumericalController
    tick: Int[Array, ""]  # index of the next tick


class Tick(NamedTuple):
    """Record of one tick: numerical model, hardware, and wrenches."""

    states: States  # states of the numerical model's bodies at the tick
    pose: Pose  # pose of the hardware at the force sensor's sampling instant
    twist: Twist  # twist of the hardware at the force sensor's sampling instant
    contact: Wrench  # wrench of contacts and latches at the sampling instant
    forces: tuple[Forces, ...]  # contact forces of each group of shape pairs at the sampling instant
    latch_states: tuple[LatchState, ...]  # states of the latches
    signals: SixAxisSignals  # inputs of the compensator
    command: Wrench  # wrench command, which acts on the numerical model
    sent: Float[Array, "6 *batch"]  # pose command after the tick [m, rad]


class Sensed(NamedTuple):
    """Real contact and sensor readings of a tick."""

    motion: RigidMotion  # motion of the hardware at the force sensor's sampling instant
    contact: Wrench  # wrench of contacts and latches at the sampling instant
    forces: tuple[Forces, ...]  # contact forces of each group of shape pairs at the sampling instant
    memories: tuple[Memory, ...]  # next states of the contact laws
    latch_states: tuple[LatchState, ...]  # next states of the latches
    lag: tuple[Wrench, Any] | None  # next state of the force sensor's lag or filter
    signals: SixAxisSignals  # inputs of the compensator
    reading: Wrench | None  # reading of the force sensor's channels; None without timing effects
    missed: Bool[Array, "*batch"] | None  # whether the controller misses the tick; None if it misses none
    bias_walk: Array | None  # change of the force sensor's bias since tick 0, (6, *batch); None if constant
