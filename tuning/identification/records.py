"""Records of a campaign: logged runs with one row per control period, and the timing of the logs.

All values are in SI units and have the signs of the numerical model (`notebooks/guide/model.md`, section 1):
positions increase in the direction of approach, and a force that pushes the bodies apart is positive. Sensor
readings are NaN in rows that were lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

RunKind = Literal["free", "press", "tap", "contact", "rest"]
CONTACT_KINDS: tuple[RunKind, ...] = "contact", "press", "tap"
CommandHold = Literal["zoh", "linear"]
RowConvention = Literal["tick", "sent", "after"]
DEFAULT_MECHANISM_NAME = "identified"  # default name of the mechanism, without a prior file
# Number of ticks by which the readings of a row are older than its command. A "sent" row contains the command
# of the next tick; an "after" row contains the readings of the next tick.
ROW_SHIFT = {"tick": 0, "sent": 1, "after": -1}


@dataclass(frozen=True)
class StampClock:
    """Accuracy of the time stamps of a log; without time stamps, the clock is assumed to be perfect."""

    period: float  # control period measured by the time stamps [s]
    drift: float  # ppm, relative difference of the measured period from the nominal control period
    jitter: float  # standard deviation of the time stamps about the ticks [s]
    lost: int  # number of missing rows


@dataclass(frozen=True)
class LoggedRun:
    """Part of a log that contains a single kind of experiment and at most one contact.

    Arrays have one entry per control period, including lost rows.
    """

    kind: RunKind  # kind of experiment
    source: str  # name of the log file
    tick: np.ndarray  # int64, number of the control period of each row
    time_stamp_error: float  # standard deviation of the time stamps about the ticks [s]
    position_desired: np.ndarray  # m
    position_measured: np.ndarray  # m
    force_measured: np.ndarray | None  # N
    velocity_desired: np.ndarray | None  # m/s
    force_command: np.ndarray | None  # N
    valid: np.ndarray  # bool; False if the row was lost, or if fits must not use its readings
    contact_index: np.ndarray | None  # int64, index into the lists in `[contact]`; -1: no contact
    speed: float | None  # approach speed [m/s]; None if unknown
    begin: float = 0.0  # time stamp of tick 0 [s]
    force_late: np.ndarray | None = None  # time from each row to its force reading [s]

    @property
    def valid_forces(self) -> np.ndarray:
        """Return the valid force readings [N]; the array is empty without a measured force."""
        if self.force_measured is None:
            return np.zeros(0)
        force = np.asarray(self.force_measured, float)
        return force[self.valid & np.isfinite(force)]


@dataclass(frozen=True)
class CampaignTiming:
    """Timing of the logged commands and readings, as specified by the user."""

    control_period: float  # s
    command_hold: CommandHold  # drives' input between two ticks: held or interpolated
    command_latency: int  # periods until a command takes effect
    # A "sent" row contains the next tick's command; an "after" row contains the next tick's readings.
    row: RowConvention
    clock: StampClock | None = None  # clock of the log with the largest jitter
    computing_delay: int = 0  # periods from a reading to the first command that depends on it
    two_clocks: bool = False  # whether the forces were logged with a separate clock

    @property
    def shift(self) -> int:
        """Return by how many periods the readings in a row of a log are older than the command in that row.

        The computing delay is subtracted, because in the loop it cannot be distinguished from a delay of the
        motion simulator.
        """
        return ROW_SHIFT[self.row] - self.computing_delay


@dataclass(frozen=True)
class Campaign:
    """All logged runs of a rig, their timing, and the mass of the numerical model."""

    runs: tuple[LoggedRun, ...]
    timing: CampaignTiming
    equivalent_mass: float  # equivalent mass of the numerical model [kg]
    sources: dict[str, str] = field(default_factory=dict)  # hexadecimal SHA-256 of each log, by file name
    notes: tuple[str, ...] = ()  # remarks of the reader on the logs
    integrator: str | None = None  # integrator of the numerical model, or None if unknown
