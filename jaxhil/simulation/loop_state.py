"""What evolves in the loop from tick to tick, but for what the compensator keeps to itself."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactParameters
from jaxhil.simulation.contact_force import ContactSample, PlantSignals, SamplingInterval
from jaxhil.simulation.probe import FirstContact


class Plant(NamedTuple):
    """Motion simulator and drives: recent commands c(n), c(n-1) [m], last step of the command [m], state;
    c(n) before the limits, where there are any (else None)."""

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
    """Delay lines: of the plant signals, of what a lagging sensor makes of the force (else None), of the
    position, and of the intervals whose contact is still to come (else None)."""

    plant_signals: PlantSignals
    reading: Float[Array, "samples *batch"] | None
    position: Float[Array, "samples *batch"]
    interval: SamplingInterval | None


class Sensed(NamedTuple):
    """What the sensors will read: delay lines; the last sample of the contact, the lag's reading at the end
    of its interval, the position sample of the interval before the run."""

    rings: Any
    last: ContactSample
    lagged: Array
    first_position: Array


class LoopState(NamedTuple):
    """All that evolves: the model's position [m] and velocity [m/s], and the rest. The run under way was
    entered at `entry_tick`, in uniform motion of `entry_velocity` [m/s]. Where the run is probed, the
    hardware's first touch (else None)."""

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
