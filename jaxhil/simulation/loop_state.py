"""What the loop carries from tick to tick: numerical model, motion simulator, delay lines of the sensors."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactParameters
from jaxhil.simulation.contact_force import ContactSample, PlantSignals, SamplingInterval
from jaxhil.simulation.probe import FirstContact


class Plant(NamedTuple):
    """Drives and motion simulator.

    commands: position commands sent to the drives, c(n), c(n-1), ... [m].
    step: last step of the command [m].
    state: of the motion simulator.
    wanted: c(n) before the limits [m]; None without limits.
    """

    commands: tuple[Array, ...]
    step: Array
    state: tuple[Array, ...]
    wanted: Float[Array, "*batch"] | None

    @property
    def sent(self) -> Float[Array, "*batch"]:
        """c(n) as the controller commanded it [m]: before the limits, where there are any."""
        return self.commands[0] if self.wanted is None else self.wanted

    @property
    def shortfall(self) -> Float[Array, "*batch"] | None:
        """How far the limits keep c(n) from what was wanted [m], where there are any."""
        return None if self.wanted is None else abs(self.wanted - self.commands[0])


class Rings(NamedTuple):
    """Delay lines, each a ring of samples.

    plant_signals: of the contact, without the sensors.
    reading: what a lagging sensor makes of the force [N]; None without lag.
    position: of the mechanism, where its sensor samples it [m].
    interval: sampling intervals whose contact is still to come; None with one surface.
    """

    plant_signals: PlantSignals
    reading: Float[Array, "samples *batch"] | None
    position: Float[Array, "samples *batch"]
    interval: SamplingInterval | None


class Sensed(NamedTuple):
    """What the sensors will read.

    rings: delay lines (`Rings`; None where they are held apart).
    last: last sample of the contact.
    lagged: reading of a lagging force sensor at the end of its sampling interval [N].
    first_position: position sample of the sampling interval before the run [m].
    """

    rings: Any
    last: ContactSample
    lagged: Array
    first_position: Array


class LoopState(NamedTuple):
    """All that evolves.

    position: of the numerical model [m].
    velocity: of the numerical model [m/s].
    plant: drives and motion simulator.
    sensed: what the sensors will read.
    law: state of the contact law.
    controller: state of the compensator.
    parameters: of the contact law, for the contact under way.
    entry_velocity: of the uniform motion in which the run began [m/s].
    entry_tick: at which the run began.
    first_contact: of the hardware, where the run is probed (else None).
    """

    position: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]
    plant: Plant
    sensed: Sensed
    law: tuple[Array, ...]
    controller: Any
    parameters: ContactParameters
    entry_velocity: Float[Array, "*batch"]
    entry_tick: Int[Array, "*batch"]
    first_contact: FirstContact | None
