"""Where contacts begin and end, tick by tick, and their restitution, in plain floats.

The rules are those of `notebooks/guide/model.md`, section 2. `jaxhil.simulation.metrics` follows batches by
the same ones; a loop in real time cannot wait for it.
"""

import math
from typing import NamedTuple

from jaxhil.mechanism.structs import Mechanism

FADED = 1e-6  # of the command's peak: it has died out
LONGEST_FADING = 0.1  # s, waited for that
LONGEST_CONTACT = 10.0  # s
RUNAWAY = 1e3  # of the approach speed


class ContactResult(NamedTuple):
    """One contact."""

    number: int  # in the mechanism's lists
    approach_velocity: float  # [m/s]
    restitution: float  # not a number where the contact did not end
    peak_force: float  # the largest sample of the real force [N]
    duration: float  # time in contact [s]
    status: str  # as in `jaxhil.simulation.metrics`, or "tripped"
    begun: int  # the tick of the run at which it began
    # numbers of the first and last packet about it, filled in by who exchanges them
    packets: tuple[int, int] = (0, 0)
    oldest_command: int = 0  # age of the oldest command used [periods], likewise


class ContactWatch:
    """Follows one run, contact by contact. A two-sided mechanism's run may have several."""

    def __init__(self, mechanism: Mechanism) -> None:
        rig, sensor = mechanism.rig, mechanism.rig.force_sensor
        self._period, self._clearance = rig.control_period, mechanism.contact.clearance
        lag = (sensor.delay + 20 * sensor.time_constant) / self._period
        self._quiet_ticks = math.floor(lag + 2 + 1e-9) + 1
        self._patience = self._quiet_ticks + math.ceil(LONGEST_FADING / self._period)
        self._noisy = sensor.noise_std != 0.0 or sensor.bias != 0.0
        self._limit = LONGEST_CONTACT / self._period
        self._waiting = self._limit
        if math.isfinite(self._clearance):
            self._waiting += 10 * self._clearance / mechanism.approach.velocity / self._period
        self._runaway = RUNAWAY * mechanism.approach.velocity
        self.begin(0)

    def begin(self, number: int) -> None:
        """A fresh run, whose first contact is `number` in the mechanism's lists."""
        self._number, self._tick = number, 0
        self._quiet, self._left = 1_000_000, 0.0
        self._approach = self._rebound = 0.0
        self._clear()

    def observe(
        self, position: float, velocity: float, command: float, force: float, reading: float
    ) -> ContactResult | None:
        """One tick: the model's position [m] and velocity [m/s], the force F_c [N] it feels, the real force
        and what the sensor reads [N]. The contact that is over with this tick, if one is; the next of the run
        may follow."""
        magnitude, speed, size = abs(command), abs(velocity), abs(force)
        in_contact = size > 0.0
        if self._begun < 0:
            if self._noisy:
                begins = in_contact or position > 0.0 or position < -self._clearance
            else:
                begins = in_contact or magnitude > self._left
            if begins:
                self._begun = self._tick
                # The hardware may follow the numerical model late.
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
        faded = magnitude <= FADED * self._peak_command or self._quiet >= self._patience
        # Between two surfaces a contact is over in the middle of the gap at the latest.
        faded = faded or self._side != (1.0 if position > -self._clearance / 2 else -1.0)
        quiet = self._quiet >= self._quiet_ticks and faded
        if self._begun >= 0 and self._side * velocity < 0.0 and quiet:
            left = max(FADED * self._peak_command, magnitude)
            return self._end("ok" if self._measured else "not reached", left)
        return self._failed(magnitude)

    def cut(self, status: str) -> ContactResult | None:
        """End the contact under way, if there is one, with a status that says why."""
        return self._end(status, 0.0) if self._begun >= 0 else None

    def _failed(self, magnitude: float) -> ContactResult | None:
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

    def _end(self, status: str, left: float) -> ContactResult:
        approach = self._approach
        restitution = self._rebound / approach if status == "ok" and approach > 0.0 else math.nan
        result = ContactResult(
            number=self._number,
            approach_velocity=approach,
            restitution=restitution,
            peak_force=self._peak_force,
            duration=self._contact_ticks * self._period,
            status=status,
            begun=self._begun,
        )
        # What is left of the last contact's command does not begin the next one.
        self._number, self._left, self._approach = self._number + 1, left, self._rebound
        self._clear()
        return result

    def _clear(self) -> None:
        self._begun, self._side, self._contact_ticks, self._measured = -1, 1.0, 0, False
        self._peak_force = self._peak_command = 0.0
