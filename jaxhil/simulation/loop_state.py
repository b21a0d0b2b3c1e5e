"""State of the loop: numerical model, motion simulator, sensors, contact law and compensator."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactParameters
from jaxhil.simulation.cells import IntervalInputs
from jaxhil.simulation.contact_force import ContactSample, PlantSignals, SamplingInterval
from jaxhil.simulation.probe import FirstContact
from jaxhil.simulation.timing import HeldValues


class PlantState(NamedTuple):
    """State of the drives and of the motion simulator."""

    commands: tuple[Array, ...]  # limited position commands c(n), c(n-1), ... that the drives received [m]
    step: Array  # last step of the limited position command, c(n) - c(n-1) [m]
    state: tuple[Array, ...]  # state of the motion simulator
    # unlimited position command for tick n [m]; None without limits
    unlimited_command: Float[Array, "*batch"] | None
    # drive command at the end of the last interval before the run [m]; None unless the motion simulator is a
    # moving average
    first_command: Float[Array, "*batch"] | None

    @property
    def sent(self) -> Float[Array, "*batch"]:
        """Return the position command that the compensator sent for tick n [m], before limits are applied."""
        return self.commands[0] if self.unlimited_command is None else self.unlimited_command

    @property
    def shortfall(self) -> Float[Array, "*batch"] | None:
        """Return the distance [m] of the limited from the unlimited position command; None without limits."""
        return None if self.unlimited_command is None else abs(self.unlimited_command - self.commands[0])


class Rings(NamedTuple):
    """Delay lines of the sensors, stored as ring buffers."""

    plant_signals: PlantSignals  # real forces, without the effects of the sensors
    # output of the force sensor's lag at the sampling instants [N]; None for a sensor without lag
    reading: Float[Array, "samples *batch"] | None
    # position of the mechanism at the position sensor's sampling instant [m]; None if unused
    position: Float[Array, "samples *batch"] | None
    # data of the sampling intervals whose contact is computed later in the tick; None with one surface
    interval: SamplingInterval | None
    # drive command at the end of each interval [m]; None unless the motion simulator is a moving average
    command: Float[Array, "samples *batch"] | None
    inputs: IntervalInputs | None  # inputs of the motion in each sampling interval; None without jitter


class SensorState(NamedTuple):
    """State of the sensors, from which future readings are computed."""

    rings: Any  # delay lines (`Rings`); None while they are stored separately
    last: ContactSample  # contact at the last sampling instant
    # duration of contact since the last sample [periods]; None if samples in contact are counted instead
    contact_time: Array | None
    lagged: Array  # output of the force sensor's lag at the end of the last sampling interval [N]
    # sample of the position sensor in the sampling interval before the run [m]; None if unused
    first_position: Array | None


class LoopState(NamedTuple):
    """State of the loop, which changes from tick to tick."""

    position: Float[Array, "*batch"]  # position of the numerical model [m]
    velocity: Float[Array, "*batch"]  # velocity of the numerical model [m/s]
    plant: PlantState  # state of the drives and of the motion simulator
    sensed: SensorState  # state of the sensors
    law: tuple[Array, ...]  # state of the contact law
    controller: Any  # state of the compensator
    parameters: ContactParameters  # parameters of the contact law in the current contact
    onset_velocity: Float[Array, "*batch"]  # velocity of the uniform motion at the start of the run [m/s]
    onset_tick: Int[Array, "*batch"]  # number of the first tick of the run
    first_contact: FirstContact | None  # first touch of the hardware; None without a probe
    held: HeldValues | None  # values of the last tick; None without timing effects
    # change of the force sensor's bias since the run began [N]; None for a constant bias
    bias_walk: Float[Array, "*batch"] | None = None
