"""The controller that the rig calls once per control period.

It checks what comes in and what goes out, watches the clock, and leaves the law to the compensator
that its gain file names. Whatever is not finite trips it: from then on the force is 0 until
`reset`.
"""

import os
from collections.abc import Mapping
from math import isfinite
from typing import Any

from .errors import refusal
from .gain_file import GainFile, check_gain_document, read_gain_document
from .registry import COMPENSATORS


class Controller:
    """One compensator with its gains and its state.

    Attributes: `missed_ticks`, the control periods since `reset` in which `step` was not called,
    as far as the times passed to it tell.
    """

    __slots__ = (
        "_command",
        "_compensator",
        "_late",
        "_period",
        "_status",
        "_time",
        "_tripped",
        "missed_ticks",
    )

    def __init__(self, gain_file: GainFile, source: str = "gain document") -> None:
        compensator = COMPENSATORS[gain_file.compensator]
        period = gain_file.control_period
        try:
            self._compensator = compensator(gain_file.gains, period, gain_file.clearance)
        except ValueError as error:
            raise refusal(source, "gains", str(error), "gains that fit the control period") from None
        self._period = period
        self._late = 1.5 * period
        self.reset()

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> "Controller":
        """The controller of a gain file. Raises GainFileError for a file that does not fit."""
        source = os.fspath(path)
        return cls(check_gain_document(read_gain_document(source), source), source)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "Controller":
        """The controller of a gain file's content. Raises GainFileError if it does not fit."""
        return cls(check_gain_document(document))

    @property
    def control_period(self) -> float:
        """The control period [s] for which the gains hold."""
        return self._period

    @property
    def status(self) -> str:
        """`ok`, or `tripped: ` and the reason."""
        return self._status

    @property
    def identified(self) -> tuple[float, float]:
        """Identified stiffness [N/m] and damping [N s/m]; (0, 0) if the law identifies none."""
        return self._compensator.identified

    def step(
        self,
        force_measured: float,
        position_desired: float,
        velocity_desired: float,
        position_measured: float,
        time: float | None = None,
    ) -> float:
        """The force F_c [N] that the numerical model is to feel this tick.

        Force in N, positions in m, velocity in m/s. With `time` [s], a gap of more than 1.5
        periods since the last tick adds to `missed_ticks` the periods left out. Once tripped, 0.0
        until `reset`.
        """
        if self._tripped:
            return 0.0
        try:
            force = float(force_measured)
            position = float(position_desired)
            velocity = float(velocity_desired)
            measured = float(position_measured)
            now = None if time is None else float(time)
        except (TypeError, ValueError, OverflowError):
            return self._trip("an input is not a number")
        if not (isfinite(force) and isfinite(position) and isfinite(velocity) and isfinite(measured)):
            return self._trip(
                _not_finite(
                    force_measured=force,
                    position_desired=position,
                    velocity_desired=velocity,
                    position_measured=measured,
                )
            )
        try:
            if now is not None:
                if not isfinite(now):
                    return self._trip(_not_finite(time=now))
                if self._time is not None and now - self._time > self._late:
                    self.missed_ticks += int((now - self._time) / self._period + 0.5) - 1
                self._time = now
            command = self._compensator.step(force, position, velocity, measured)
        except ArithmeticError:
            return self._trip("the arithmetic overflowed")
        if not isfinite(command):
            return self._trip("the compensated force is not finite")
        return command

    def position_command(self, position: float, velocity: float, acceleration: float) -> float:
        """The position [m] to command, from the numerical model's motion after this tick's step.

        An input that is not finite trips the controller and holds the last command.
        """
        try:
            command = self._compensator.position_command(
                float(position), float(velocity), float(acceleration)
            )
            finite = isfinite(command) and isfinite(velocity) and isfinite(acceleration)
        except (TypeError, ValueError, ArithmeticError):
            finite = False
            command = 0.0
        if not finite:
            if not self._tripped:
                self._trip("the numerical model's motion is not finite")
            return self._command
        self._command = command
        return command

    def reset(self) -> None:
        """Restart everything: filters, identified parameters, a trip, the count of ticks."""
        self._compensator.reset()
        self._tripped = False
        self._status = "ok"
        self._time: float | None = None
        self._command = 0.0
        self.missed_ticks = 0

    def next_contact(self) -> None:
        """Begin a fresh run for the next contact: filters, delay lines and covariance restart.

        Identified parameters carry over, a trip stays latched, and the time until the next tick
        does not count as missed.
        """
        self._compensator.next_contact()
        self._time = None

    def _trip(self, reason: str) -> float:
        self._tripped = True
        self._status = f"tripped: {reason}"
        return 0.0


def _not_finite(**inputs: float) -> str:
    name, value = next(item for item in inputs.items() if not isfinite(item[1]))
    return f"{name} is {value!r}"
