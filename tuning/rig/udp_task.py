"""Computation of the controller's answers to the packets of a rig, without network and clock.

When a packet arrives after missing ticks, the controller executes these ticks with linearly interpolated
readings. The answer reports the fault `missed_tick`. If more ticks are missing than the limit
`missed_in_a_row` of the gain file (default `MAX_INTERPOLATED_TICKS`), the controller skips these ticks and
detects the gap in the rig's time. The numerical model continues under the last force command.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

if (Path(__file__).resolve().parent / "jaxhil_runtime.py").is_file():
    # The module is in a bundle, not in the source tree.
    import udp_protocol as udp  # pyright: ignore[reportMissingImports]
else:
    from tuning.rig import udp_protocol as udp

MAX_INTERPOLATED_TICKS = 10  # default limit on the number of successive missing ticks that are interpolated
MAX_COASTED_PERIODS = 10_000  # longest time that the model continues under the last force command [periods]
MISSED_TICK, LAW_IN_DOUBT = 0x200, 0x200000  # bits of two of the controller's faults (`jaxhil.rig`)


class ModelInLoop(Protocol):
    """Controller and numerical model with one axis or six axes; vectors have one number for each axis."""

    axes: int  # number of axes
    command: udp.Numbers  # position command [m, rad]
    force: udp.Numbers  # force command of the last tick [N, N m]

    @property
    def motion(self) -> tuple[udp.Numbers, udp.Numbers]: ...  # position and velocity of the model
    @property
    def rate(self) -> udp.Numbers: ...  # rate of the model's position [m/s, rad/s]
    @property
    def bodies(self) -> udp.Numbers: ...  # states of both bodies, as in `AnswerPacket.bodies`
    def place(self, start: Sequence[float]) -> bool: ...
    def begin(self) -> None: ...
    def tare(self, force: Sequence[float]) -> bool: ...
    def tick(self, tick: int, force: Sequence[float], position: Sequence[float], time: float) -> None: ...
    def coast(self) -> None: ...


class ControllerTask:
    """Task that computes the answers to readings with a controller and its numerical model, without network.

    Args:
        controller: controller of the gain file.
        model: numerical model, coupled with the same controller.
        max_interpolated: largest number of successive missing ticks that are interpolated.

    Attributes:
        period: control period [s].
        axes: number of axes.
        interpolated: number of interpolated ticks.
        executed: number of ticks that the last answer required, including interpolated ones.
        stale: number of packets that were dropped because they were old, or because their run was not
            prepared or has an invalid start.
        quality_flags: numbers of contacts with the fault `law_in_doubt`, by the compensator's status.
    """

    __slots__ = (
        *("_controller", "_last", "_max_interpolated", "_model", "_run", "_sequence", "_tared"),
        *("_trip_reason", "axes", "executed", "interpolated", "period", "quality_flags", "stale"),
    )

    def __init__(
        self, controller: Any, model: ModelInLoop, max_interpolated: float = MAX_INTERPOLATED_TICKS
    ) -> None:
        self._controller, self._model = controller, model
        self._max_interpolated = min(max_interpolated, MAX_INTERPOLATED_TICKS)
        self.period, self.axes = float(controller.control_period), model.axes
        self._sequence, self._run, self._tared = udp.SequenceFilter(), -1, False
        self._last: udp.ReadingPacket | None = None
        self._trip_reason = ""
        self.stale = self.interpolated = 0
        self.executed = 1
        self.quality_flags: dict[str, int] = {}

    @property
    def status(self) -> str:
        """Return the controller's status, such as "ok" or "tripped: ..."."""
        return str(self._controller.status)

    def answer(self, reading: udp.ReadingPacket) -> udp.AnswerPacket | None:
        """Return the answer to a reading.

        Return None if the reading is old, or if its run is invalid or has not been prepared.
        """
        unprepared = reading.event == udp.TICK and reading.run != self._run
        if unprepared or not self._sequence.is_newer(reading.sequence):
            self.stale += 1
            return None
        if reading.event == udp.RESET and reading.run != self._run and self._controller.reset():
            self._trip_reason = ""
        return self._step(reading) if reading.event == udp.TICK else self._prepare(reading)

    def _prepare(self, reading: udp.ReadingPacket) -> udp.AnswerPacket | None:
        model, faults = self._model, 0
        if reading.run != self._run:
            if not self._tared:
                self._tared = model.tare(reading.force)
            if not self._tared:
                return self._reply(reading, udp.TARING, (0.0,) * model.axes, model.motion, 0)
            if not model.place(reading.start):
                self.stale += 1
                return None
            faults = self._begin(reading)
        return self._reply(reading, udp.READY, model.rate, model.motion, faults)

    def _begin(self, reading: udp.ReadingPacket) -> int:
        """Begin a new run; return the faults that the controller reports at the end of the previous run."""
        faults = 0
        if self._run >= 0 and not self._controller.tripped:
            self._controller.next_contact()
            faults = self._reported_faults()
        self._model.begin()
        self._run, self._last = reading.run, None
        return faults

    def _reported_faults(self) -> int:
        """Return the controller's current faults; count the fault `law_in_doubt` in `quality_flags`."""
        controller = self._controller
        if controller.faults & LAW_IN_DOUBT:
            status = controller.last_contact.status
            self.quality_flags[status] = self.quality_flags.get(status, 0) + 1
        return controller.faults

    def _step(self, reading: udp.ReadingPacket) -> udp.AnswerPacket:
        model, last = self._model, self._last
        missed = reading.tick - (-1 if last is None else last.tick) - 1
        faults, self.executed = 0, 1
        if missed > 0:
            faults = MISSED_TICK
            if missed <= self._max_interpolated:
                faults |= self._interpolate(missed, reading)
            else:
                for _ in range(min(missed, MAX_COASTED_PERIODS)):
                    model.coast()
        motion, before = model.motion, model.command
        faults |= self._tick(reading.tick, reading.force, reading.position, reading.time)
        self._last = reading
        rate = model.rate
        if self._controller.tripped:
            # After a trip, the position command no longer follows the numerical model.
            rate = tuple((new - old) / self.period for new, old in zip(model.command, before, strict=True))
        return self._reply(reading, 0, rate, motion, faults, model.force)

    def _interpolate(self, missed: int, reading: udp.ReadingPacket) -> int:
        """Execute the missing packets' ticks with interpolated readings; return the faults of these ticks."""
        self.interpolated += missed
        self.executed += missed
        faults = 0
        last = self._last
        before = reading if last is None else last
        for number in range(missed):
            weight = (number + 1) / (missed + 1)
            force, position = (
                [a + weight * (b - a) for a, b in zip(*readings, strict=True)]
                for readings in ((before.force, reading.force), (before.position, reading.position))
            )
            tick = reading.tick - missed + number
            time = reading.time - (missed - number) * self.period
            faults |= self._tick(tick, force, position, time)
        return faults

    def _tick(self, tick: int, force: Sequence[float], position: Sequence[float], time: float) -> int:
        """Advance controller and numerical model by one period; return the controller's faults."""
        self._model.tick(tick, force, position, time)
        return self._reported_faults()

    def _reply(
        self,
        reading: udp.ReadingPacket,
        flags: int,
        rate: udp.Numbers,
        motion: tuple[udp.Numbers, udp.Numbers],
        faults: int,
        force: udp.Numbers | None = None,
    ) -> udp.AnswerPacket:
        if self._controller.tripped:
            flags |= udp.TRIPPED
            self._trip_reason = self._trip_reason or self.status[:96]
        _, sequence, run, tick, *_ = reading
        model = self._model
        return udp.AnswerPacket(
            flags=flags,
            sequence=sequence,
            run=run,
            tick=tick,
            position_command=model.command,
            command_rate=rate,
            position=motion[0],
            velocity=motion[1],
            force_command=(0.0,) * model.axes if force is None else force,
            bodies=model.bodies,
            faults=faults,
            trip_reason=self._trip_reason,
        )
