"""State of the loop from tick to tick: numerical model, motion simulator, delay lines of the sensors."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactParameters
from jaxhil.simulation.contact_force import ContactSample, PlantSignals, SamplingInterval
from jaxhil.simulation.probe import FirstContact


class PlantState(NamedTuple):
    """Drives and motion simulator."""

    commands: tuple[Array, ...]  # position commands sent to the drives, c(n), c(n-1), ... [m]
    step: Array  # last step of the command [m]
    state: tuple[Array, ...]  # state of the motion simulator
    wanted: Float[Array, "*batch"] | None  # c(n) before the limits [m]; None without limits

    @property
    def sent(self) -> Float[Array, "*batch"]:
        """Command c(n) of the controller [m], before any limits."""
        return self.commands[0] if self.wanted is None else self.wanted

    @property
    def shortfall(self) -> Float[Array, "*batch"] | None:
        """Distance [m] of c(n) from the command before the limits; None without limits."""
        return None if self.wanted is None else abs(self.wanted - self.commands[0])


class Rings(NamedTuple):
    """Delay lines, each a ring of samples."""

    plant_signals: PlantSignals  # contact without the effects of the sensors
    # force behind the sensor's lag [N]; None without lag
    reading: Float[Array, "samples *batch"] | None
    # position of the mechanism at its sampling instant [m]; None if unused
    position: Float[Array, "samples *batch"] | None
    # sampling intervals whose contact is not yet computed; None with one surface
    interval: SamplingInterval | None


class SensorState(NamedTuple):
    """Inputs of future sensor readings."""

    rings: Any  # delay lines (`Rings`; None if they are stored separately)
    last: ContactSample  # last sample of the contact
    # time with a force since the last sample [periods]; None if touching samples are counted instead
    touched: Array | None
    lagged: Array  # reading of a lagging force sensor at the end of its sampling interval [N]
    # position sample of the sampling interval before the run [m]; None if unused
    first_position: Array | None


class LoopState(NamedTuple):
    """State of the loop."""

    position: Float[Array, "*batch"]  # position of the numerical model [m]
    velocity: Float[Array, "*batch"]  # velocity of the numerical model [m/s]
    plant: PlantState  # drives and motion simulator
    sensed: SensorState  # inputs of future sensor readings
    law: tuple[Array, ...]  # state of the contact law
    controller: Any  # state of the compensator
    parameters: ContactParameters  # contact law's parameters for the current contact
    onset_velocity: Float[Array, "*batch"]  # velocity of the uniform motion in which the run began [m/s]
    onset_tick: Int[Array, "*batch"]  # tick at which the run began
    first_contact: FirstContact | None  # first touch of the hardware; None without a probe
