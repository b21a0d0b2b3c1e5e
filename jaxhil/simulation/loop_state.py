"""What the loop carries from tick to tick: numerical model, motion simulator, delay lines of the sensors."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactParameters
from jaxhil.simulation.contact_force import ContactSample, PlantSignals, SamplingInterval
from jaxhil.simulation.probe import FirstContact


class Plant(NamedTuple):
    """Drives and motion simulator."""

    commands: tuple[Array, ...]  # position commands sent to the drives, c(n), c(n-1), ... [m].
    step: Array  # last step of the command [m]
    state: tuple[Array, ...]  # of the motion simulator
    wanted: Float[Array, "*batch"] | None  # c(n) before the limits [m]; None without limits

    @property
    def sent(self) -> Float[Array, "*batch"]:
        """c(n) as the controller commanded it [m]: before the limits, where there are any."""
        return self.commands[0] if self.wanted is None else self.wanted

    @property
    def shortfall(self) -> Float[Array, "*batch"] | None:
        """How far the limits keep c(n) from what was wanted [m], where there are any."""
        return None if self.wanted is None else abs(self.wanted - self.commands[0])


class Rings(NamedTuple):
    """Delay lines, each a ring of samples."""

    plant_signals: PlantSignals  # of the contact, without the sensors
    # what a lagging sensor makes of the force [N]; None without lag
    reading: Float[Array, "samples *batch"] | None
    # of the mechanism, where its sensor samples it [m]; None where nobody reads it
    position: Float[Array, "samples *batch"] | None
    # sampling intervals whose contact is still to come; None with one surface
    interval: SamplingInterval | None


class Sensed(NamedTuple):
    """What the sensors will read."""

    rings: Any  # delay lines (`Rings`; None where they are held apart)
    last: ContactSample  # last sample of the contact
    # time with a force since the last sample [periods]; None where touching samples are counted
    touched: Array | None
    lagged: Array  # reading of a lagging force sensor at the end of its sampling interval [N]
    # position sample of the sampling interval before the run [m]; None where nobody reads it
    first_position: Array | None


class LoopState(NamedTuple):
    """All that evolves."""

    position: Float[Array, "*batch"]  # of the numerical model [m]
    velocity: Float[Array, "*batch"]  # of the numerical model [m/s]
    plant: Plant  # drives and motion simulator
    sensed: Sensed  # what the sensors will read
    law: tuple[Array, ...]  # state of the contact law
    controller: Any  # state of the compensator
    parameters: ContactParameters  # of the contact law, for the contact under way
    entry_velocity: Float[Array, "*batch"]  # of the uniform motion in which the run began [m/s]
    entry_tick: Int[Array, "*batch"]  # at which the run began
    first_contact: FirstContact | None  # of the hardware, where the run is probed (else None)
