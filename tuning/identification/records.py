"""What readers of logs hand to the estimates: runs on a grid of ticks, and which tick's numbers a row holds.

Everything is in SI units and in the signs of the model (`notebooks/guide/model.md`, section 1): positions
grow towards the hardware, a force that pushes back is positive. A row that was lost has NaN for what sensors
read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Kind = Literal["free", "press", "tap", "contact", "rest"]
Hold = Literal["zoh", "linear"]
Row = Literal["tick", "sent", "after"]
# Ticks by which the logged readings lag the logged command by the way a row is written: "sent" rows hold the
# command of the next tick, "after" rows the readings of the next one.
UNNAMED = "identified"  # name of a mechanism that no prior names
ROW_SHIFT = {"tick": 0, "sent": 1, "after": -1}


@dataclass(frozen=True)
class Clock:
    """What the stamps of a run say of its clock; a log without stamps has a perfect one."""

    period: float  # s, between ticks by the stamps
    drift: float  # ppm, by which that is longer than the control period
    jitter: float  # s, standard deviation of the stamps about the ticks
    lost: int  # rows


@dataclass(frozen=True)
class Run:
    """One stretch of a log; every array has one entry a row, rows that were lost included."""

    kind: Kind  # what was done
    source: str  # name of the file it was read from
    tick: np.ndarray  # int64, control period in which the row was written
    time_stamp_error: float  # s, standard deviation of the stamps about the ticks
    position_desired: np.ndarray  # m
    position_measured: np.ndarray  # m
    force_measured: np.ndarray | None  # N
    velocity_desired: np.ndarray | None  # m/s
    force_command: np.ndarray | None  # N
    valid: np.ndarray  # bool, False where the row was lost or rebuilt: its residual does not count
    contact_index: np.ndarray | None  # int64, which entry of the contact lists is met; -1 for none
    speed: float | None  # m/s, of the approach, where the log tells it
    begin: float = 0.0  # s, of tick 0 by the stamps
    force_late: np.ndarray | None = None  # s, by which forces were read later than their rows


@dataclass(frozen=True)
class Timing:
    """When a command acts and when a row was read: told, never estimated."""

    control_period: float  # s
    command_hold: Hold  # what the drives do between ticks
    command_latency: int  # periods
    row: Row  # of a tick; "sent": with the next tick's command, "after": with the next tick's readings
    clock: Clock | None = None  # that of the run whose stamps scatter most
    computing_delay: int = 0  # periods from a reading to the command that answers it
    two_clocks: bool = False  # whether forces were logged by a clock of their own

    @property
    def shift(self) -> int:
        """Periods by which a row's readings lag its command and that are no delay of the motion.

        A controller that answers late is to the loop what a motion is that begins late."""
        return ROW_SHIFT[self.row] - self.computing_delay


@dataclass(frozen=True)
class Campaign:
    """All runs of a rig."""

    runs: tuple[Run, ...]
    timing: Timing
    equivalent_mass: float  # kg, of the numerical model
    sources: dict[str, str] = field(default_factory=dict)  # SHA-256 of each file, in hex
    notes: tuple[str, ...] = ()  # what readers wondered about
    integrator: str | None = None  # of the numerical model, where the logs or a prior tell it
