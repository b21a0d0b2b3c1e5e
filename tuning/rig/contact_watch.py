"""Detection of onset and end of contacts, and their restitution, in plain floats.

The rules are those of `notebooks/guide/model.md`, section 2. `jaxhil.simulation.metrics` applies the same
rules to batches, but is too slow for a loop in real time.
"""

import math
from typing import NamedTuple

from jaxhil.mechanism.structs import Mechanism

FADED_COMMAND_RATIO = 1e-6  # command over its peak [1] below which it has died out
MAX_FADING_TIME = 0.1  # longest wait for the command to die out [s]
MAX_CONTACT_DURATION = 10.0  # longest contact [s], after which it times out
DIVERGENCE_SPEED_RATIO = 1e3  # speed over the approach speed [1] beyond which a contact diverges


class RigContact(NamedTuple):
    """Result of one contact."""

    number: int  # index in the mechanism's lists
    approach_velocity: float  # [m/s]
    restitution: float  # NaN if the contact did not end
    peak_force: float  # largest sample of the real force [N]
    duration: float  # time in contact [s]
    status: str  # as in `jaxhil.simulation.metrics`, or "tripped"
    begun: int  # tick of the run at the onset
    # numbers of the first and last packet of the contact, set by `RigTask`
    packets: tuple[int, int] = (0, 0)
    oldest_command: int = 0  # age of the oldest command used [periods], set by `RigTask`


class ContactWatch:
    """Contact detector of one run, which may have several contacts if the mechanism is two-sided."""

    def __init__(self, mechanism: Mechanism) -> None:
        rig, sensor = mechanism.rig, mechanism.rig.force_sensor
        self._period, self._clearance = rig.control_period, mechanism.contact.clearance
        lag = (sensor.delay + 20 * sensor.time_constant) / self._period
        self._quiet_ticks = math.floor(lag + 2 + 1e-9) + 1
        self._patience = self._quiet_ticks + math.ceil(MAX_FADING_TIME / self._period)
        self._noisy = sensor.noise_std != 0.0 or sensor.bias != 0.0
        self._limit = MAX_CONTACT_DURATION / self._period
        self._waiting = self._limit
        if math.isfinite(self._clearance):
            self._waiting += 10 * self._clearance / mechanism.approach.velocity / self._period
        self._runaway = DIVERGENCE_SPEED_RATIO * mechanism.approach.velocity
        self.begin(0)

    def begin(self, number: int) -> None:
        """Begin a new run, whose first contact has index `number` in the mechanism's lists."""
        self._number, self._tick = number, 0
        self._quiet, self._left = 1_000_000, 0.0
        self._approach = self._rebound = 0.0
        self._clear()

    def observe(
        self, position: float, velocity: float, command: float, force: float, reading: float
    ) -> RigContact | None:
        """Process one tick; return the contact that ends with it, if any.

        Args:
            position: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            command: force command F_c [N].
            force: real contact force [N].
            reading: reading of the force sensor [N].
        """
        magnitude, speed, size = abs(command), abs(velocity), abs(force)
        in_contact = size > 0.0
        if self._begun < 0:
            if self._noisy:
                begins = in_contact or position > 0.0 or position < -self._clearance
            else:
                begins = in_contact or magnitude > self._left
            if begins:
                self._begun = self._tick
                # The hardware may still be behind the numerical model, so that waiting starts anew.
                self._quiet = -1
                self._side = 1.0 if position > -self._clearance / 2 else -1.0
        if self._begun < 0:
            self._approach = speed
        self._rebound = speed
        self._peak_command = max(self._peak_command, magnitude)
        self._peak_force = max(self._peak_force, size)
        self._contact_ticks += in_contact
        self._measured = self._measured or (self._contact_ticks > 0 and reading != 0.0)
        self._quiet = 0 if in_contact else self._quiet + 1
        self._tick += 1
        faded = magnitude <= FADED_COMMAND_RATIO * self._peak_command or self._quiet >= self._patience
        # Between two surfaces a contact ends at the latest in the middle of the gap.
        faded = faded or self._side != (1.0 if position > -self._clearance / 2 else -1.0)
        quiet = self._quiet >= self._quiet_ticks and faded
        if self._begun >= 0 and self._side * velocity < 0.0 and quiet:
            left = max(FADED_COMMAND_RATIO * self._peak_command, magnitude)
            return self._end("ok" if self._measured else "not reached", left)
        return self._failed(magnitude)

    def cut(self, status: str) -> RigContact | None:
        """End the current contact, if there is one, with the given status."""
        return self._end(status, 0.0) if self._begun >= 0 else None

    def _failed(self, magnitude: float) -> RigContact | None:
        if not (math.isfinite(self._rebound) and math.isfinite(magnitude)):
            return self._end("non-finite", 0.0)
        if self._rebound > self._runaway:
            return self._end("diverged", 0.0)
        if self._begun >= 0:
            late = self._tick - self._begun > self._limit
        else:
            late = self._tick > self._waiting
        if not late:
            return None
        return self._end("timeout" if self._contact_ticks > 0 else "not reached", 0.0)

    def _end(self, status: str, left: float) -> RigContact:
        approach = self._approach
        restitution = self._rebound / approach if status == "ok" and approach > 0.0 else math.nan
        result = RigContact(
            number=self._number,
            approach_velocity=approach,
            restitution=restitution,
            peak_force=self._peak_force,
            duration=self._contact_ticks * self._period,
            status=status,
            begun=self._begun,
        )
        # The rest of this contact's command must not begin the next one.
        self._number, self._left, self._approach = self._number + 1, left, self._rebound
        self._clear()
        return result

    def _clear(self) -> None:
        self._begun, self._side, self._contact_ticks, self._measured = -1, 1.0, 0, False
        self._peak_force = self._peak_command = 0.0
