"""Detection of the onset and end of contacts, and computation of their restitution, in plain Python.

The rules are in section 2 of `notebooks/guide/model.md`. `jaxhil.simulation.metrics` applies the same rules
to batches, but is too slow for a real-time loop.
"""

import math
from typing import NamedTuple

from jaxhil.mechanism.sensor_filter import settling_constant
from jaxhil.mechanism.structs import Mechanism
from tuning.rig.numerical_model import NOISE_AND_BIAS_KEYS

FADED_COMMAND_RATIO = 1e-6  # force command, divided by its peak, below which it has decayed [1]
MAX_FADING_TIME = 0.1  # longest wait for the force command to decay [s]
MAX_CONTACT_DURATION = 10.0  # longest contact [s]; a longer one ends with the status "timeout"
DIVERGENCE_SPEED_RATIO = 1e3  # largest speed / approach speed [1]; above it, the status is "diverged"


class RigContact(NamedTuple):
    """Measured properties of one contact on the simulated rig."""

    number: int  # index of the contact in the mechanism's lists of stiffness and damping
    approach_velocity: float  # speed of the numerical model before the contact [m/s]
    restitution: float  # NaN if the contact did not end
    peak_force: float  # largest sample of the real force [N]
    duration: float  # time with a real contact force [s]
    status: str  # a status of `jaxhil.simulation.metrics`, "tripped" or "stalled"
    onset_tick: int  # tick of the run at which the contact starts
    # sequence numbers of the first and last packet of the contact, set by `RigTask`
    packets: tuple[int, int] = (0, 0)
    # largest age of a position command during the contact [periods], set by `RigTask`
    oldest_command: int = 0

    def as_tripped(self) -> "RigContact":
        """Return the contact with the status "tripped" and the restitution NaN."""
        return self._replace(status="tripped", restitution=math.nan)


class ContactDetector:
    """Detector of the contacts of one run; a mechanism with two surfaces has several contacts in a run."""

    def __init__(self, mechanism: Mechanism) -> None:
        rig, sensor = mechanism.rig, mechanism.rig.force_sensor
        self._period, self._clearance = rig.control_period, mechanism.contact.clearance
        lag = (sensor.delay + sensor.jitter + 20 * settling_constant(sensor)) / self._period
        min_ticks = math.floor(lag + 2 + 1e-9) + 1
        max_ticks = min_ticks + math.ceil(MAX_FADING_TIME / self._period)
        self._min_ticks_without_force, self._max_ticks_without_force = min_ticks, max_ticks
        self._has_noise_or_bias = any(getattr(sensor, key) != 0.0 for key in NOISE_AND_BIAS_KEYS)
        self._max_contact_ticks = MAX_CONTACT_DURATION / self._period
        self._max_approach_ticks = self._max_contact_ticks
        if math.isfinite(self._clearance):
            self._max_approach_ticks += 10 * self._clearance / mechanism.approach.velocity / self._period
        self._divergence_speed = DIVERGENCE_SPEED_RATIO * mechanism.approach.velocity
        self.begin(0)

    def begin(self, number: int) -> None:
        """Begin a new run; `number` is the index of its first contact in the mechanism's stiffness list."""
        self._number, self._tick = number, 0
        self._ticks_without_force, self._remaining_command = 1_000_000, 0.0
        self._approach = self._rebound = 0.0
        self._reset_contact()

    def observe(
        self, position: float, velocity: float, command: float, force: float, reading: float
    ) -> RigContact | None:
        """Process one tick; return the contact that ends at this tick, or None.

        Args:
            position: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            command: force command F_c [N].
            force: real contact force [N].
            reading: measured force [N].
        """
        command_magnitude, speed, force_magnitude = abs(command), abs(velocity), abs(force)
        in_contact = force_magnitude > 0.0
        if self._onset_tick < 0:
            if self._has_noise_or_bias:
                begins = in_contact or position > 0.0 or position < -self._clearance
            else:
                begins = in_contact or command_magnitude > self._remaining_command
            if begins:
                self._onset_tick = self._tick
                # The hardware may not have touched yet, so restart the count of ticks without a force.
                self._ticks_without_force = -1
                self._side = 1.0 if position > -self._clearance / 2 else -1.0
        if self._onset_tick < 0:
            self._approach = speed
        self._rebound = speed
        self._peak_command = max(self._peak_command, command_magnitude)
        self._peak_force = max(self._peak_force, force_magnitude)
        self._contact_ticks += in_contact
        self._has_measured_force = self._has_measured_force or (self._contact_ticks > 0 and reading != 0.0)
        self._ticks_without_force = 0 if in_contact else self._ticks_without_force + 1
        self._tick += 1
        faded = command_magnitude <= FADED_COMMAND_RATIO * self._peak_command
        faded = faded or self._ticks_without_force >= self._max_ticks_without_force
        # Between two surfaces a contact ends at the latest in the middle of the gap.
        faded = faded or self._side != (1.0 if position > -self._clearance / 2 else -1.0)
        has_ended = self._ticks_without_force >= self._min_ticks_without_force and faded
        if self._onset_tick >= 0 and self._side * velocity < 0.0 and has_ended:
            remaining_command = max(FADED_COMMAND_RATIO * self._peak_command, command_magnitude)
            return self._end("ok" if self._has_measured_force else "not reached", remaining_command)
        return self._end_if_failed(command_magnitude)

    def cut(self, status: str) -> RigContact | None:
        """End the current contact with the given status; return this contact, or None if there is none."""
        return self._end(status, 0.0) if self._onset_tick >= 0 else None

    def _end_if_failed(self, command_magnitude: float) -> RigContact | None:
        if not (math.isfinite(self._rebound) and math.isfinite(command_magnitude)):
            return self._end("non-finite", 0.0)
        if self._rebound > self._divergence_speed:
            return self._end("diverged", 0.0)
        if self._onset_tick >= 0:
            is_too_long = self._tick - self._onset_tick > self._max_contact_ticks
        else:
            is_too_long = self._tick > self._max_approach_ticks
        if not is_too_long:
            return None
        return self._end("timeout" if self._contact_ticks > 0 else "not reached", 0.0)

    def _end(self, status: str, remaining_command: float) -> RigContact:
        approach = self._approach
        restitution = self._rebound / approach if status == "ok" and approach > 0.0 else math.nan
        result = RigContact(
            number=self._number,
            approach_velocity=approach,
            restitution=restitution,
            peak_force=self._peak_force,
            duration=self._contact_ticks * self._period,
            status=status,
            onset_tick=self._onset_tick,
        )
        # A force command that remains from this contact must not count as the onset of the next contact.
        self._number += 1
        self._remaining_command, self._approach = remaining_command, self._rebound
        self._reset_contact()
        return result

    def _reset_contact(self) -> None:
        self._onset_tick, self._side, self._contact_ticks, self._has_measured_force = -1, 1.0, 0, False
        self._peak_force = self._peak_command = 0.0
