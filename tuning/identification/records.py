"""Records of a campaign: runs on the grid of control periods, and the timing of commands and readings.

All values are in SI units and have the signs of the model (`notebooks/guide/model.md`, section 1): positions
increase towards the hardware, and a repelling force is positive. Sensor readings of a lost row are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

RunKind = Literal["free", "press", "tap", "contact", "rest"]
CommandHold = Literal["zoh", "linear"]
RowConvention = Literal["tick", "sent", "after"]
DEFAULT_MECHANISM_NAME = "identified"  # name of an identified mechanism without a prior
# Ticks by which the readings of a row lag its command: a "sent" row holds the command of the next tick, an
# "after" row the readings of the next tick.
ROW_SHIFT = {"tick": 0, "sent": 1, "after": -1}


@dataclass(frozen=True)
class StampClock:
    """Clock of a run's time stamps; a log without stamps has a perfect clock."""

    period: float  # s, control period measured by the stamps
    drift: float  # ppm, excess of that period over the nominal control period
    jitter: float  # s, standard deviation of the stamps about the ticks
    lost: int  # number of missing rows


@dataclass(frozen=True)
class LoggedRun:
    """Segment of a log; every array has one entry per row, lost rows included."""

    kind: RunKind  # kind of experiment
    source: str  # name of the log file
    tick: np.ndarray  # int64, control period in which the row was written
    time_stamp_error: float  # s, standard deviation of the stamps about the ticks
    position_desired: np.ndarray  # m
    position_measured: np.ndarray  # m
    force_measured: np.ndarray | None  # N
    velocity_desired: np.ndarray | None  # m/s
    force_command: np.ndarray | None  # N
    valid: np.ndarray  # bool, False if the row was lost or rebuilt: its residual is not used
    contact_index: np.ndarray | None  # int64, entry of the mechanism's contact lists; -1: no contact
    speed: float | None  # m/s, approach speed; None if unknown
    begin: float = 0.0  # s, time of tick 0 by the stamps
    force_late: np.ndarray | None = None  # s, time from a row to the reading of its force


@dataclass(frozen=True)
class CampaignTiming:
    """Timing of commands and readings; it is specified by the user, never estimated."""

    control_period: float  # s
    command_hold: CommandHold  # motion of the drives' input between ticks
    command_latency: int  # periods until a command takes effect
    # convention; "sent": with the next tick's command, "after": with the next tick's readings
    row: RowConvention
    clock: StampClock | None = None  # clock of the run with the largest jitter
    computing_delay: int = 0  # periods from a reading to the command that depends on it
    two_clocks: bool = False  # whether the forces were logged with a separate clock

    @property
    def shift(self) -> int:
        """Return the periods by which readings lag the command of their row without the motion.

        For the loop, a computing delay has the same effect as a motion that starts later.
        """
        return ROW_SHIFT[self.row] - self.computing_delay


@dataclass(frozen=True)
class Campaign:
    """All runs of a rig."""

    runs: tuple[LoggedRun, ...]
    timing: CampaignTiming
    equivalent_mass: float  # kg, equivalent mass of the numerical model
    sources: dict[str, str] = field(default_factory=dict)  # SHA-256 of each file by its name, in hex
    notes: tuple[str, ...] = ()  # remarks about the logs, from reading them
    integrator: str | None = None  # integrator of the numerical model; None if unknown
