"""Flight recorder: log of a controller's readings and commands, in memory until it is written to a file.

    recorder = FlightRecorder(controller.control_period)
    # in every tick, after `step` and `position_command`:
    recorder.add(force_measured, position_desired, velocity_desired, position_measured, time, force, faults)
    # at each call of `next_contact`:
    recorder.next_contact()
    # after the session:
    recorder.write("session.csv")

`jaxhil shadow`, `identify` and `monitor` read the log. The log has the columns of `jaxhil simulate --log`,
the index of the contact, and the bits of the faults. The mapping of the log (`jaxhil/log/1`) is a second
file. This module needs only the standard library, and a bundle contains a copy of it.
"""

import os
from array import array
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
# Channels of the mapping by number of axes: name, and prefix and suffixes of the columns.
CHANNELS = {
    1: tuple(
        (name, name, ("",))
        for name in (
            "force_measured", "position_desired", "velocity_desired", "position_measured", "force_command",
        )
    ),
    6: (
        ("wrench_measured", "wrench_measured_", WRENCH),
        ("pose_desired", "desired_", COORDINATES),
        ("twist_desired", "twist_desired_", TWIST),
        ("pose_measured", "pose_measured_", COORDINATES),
        ("wrench_command", "command_", WRENCH),
    ),
}  # fmt: skip
DEFAULT_TICKS = 600_000  # number of ticks in memory: ten minutes at 1 kHz


class FlightRecorder:
    """Recorder of a controller's newest ticks; its constructor allocates all memory.

    Args:
        period: control period [s].
        axes: number of axes, 1 or 6.
        ticks: number of ticks in memory; when the memory is full, a new tick replaces the oldest one.
        equivalent_mass: mass of a one-axis numerical model [kg], which `write` adds to the mapping. None
            leaves it out; `jaxhil identify` then needs it from a prior mechanism file.

    Example:
        >>> import tempfile
        >>> from jaxhil.rig.flight_recorder import FlightRecorder
        >>> recorder = FlightRecorder(0.001)
        >>> recorder.add(10.0, 0.001, -0.005, 0.0012, 0.0, 10.5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     recorder.write(f"{folder}/session.csv")
        ...     print(open(f"{folder}/session.csv").readlines()[1].strip())
        0.0,10.0,0.001,-0.005,0.0012,10.5,0,0
    """

    __slots__ = ("_axes", "_contact", "_count", "_mass", "_names", "_period", "_rows", "_ticks", "_width")

    def __init__(
        self, period: float, axes: int = 1, ticks: int = DEFAULT_TICKS, equivalent_mass: float | None = None
    ) -> None:
        if axes not in CHANNELS or ticks < 1:
            raise ValueError(f"axes, ticks: found {axes}, {ticks}, expected 1 or 6, and at least 1")
        columns = [prefix + suffix for _, prefix, suffixes in CHANNELS[axes] for suffix in suffixes]
        self._names = ["time", *columns, "contact", "faults"]
        self._width = len(self._names)
        self._rows = array("d", bytes(8 * self._width * ticks))
        self._period, self._axes, self._ticks, self._mass = period, axes, ticks, equivalent_mass
        self._count = self._contact = 0

    def __len__(self) -> int:
        """Return the number of ticks in memory."""
        return min(self._count, self._ticks)

    @property
    def heading(self) -> str:
        """Return the first line of the log, with the names of the columns."""
        return ",".join(self._names) + "\n"

    def add(
        self,
        force_measured: float | Sequence[float],
        position_desired: float | Sequence[float],
        velocity_desired: float | Sequence[float],
        position_measured: float | Sequence[float],
        time: float | None,
        command: float | Sequence[float],
        faults: int = 0,
    ) -> None:
        """Add one tick: the arguments of the controller's `step`, its command and its faults.

        Args:
            force_measured: force reading [N]; six axes: wrench [N, N m].
            position_desired: position of the numerical model before the tick [m]; six axes: pose [m, rad].
            velocity_desired: velocity of the numerical model [m/s]; six axes: twist [m/s, rad/s].
            position_measured: position reading [m]; six axes: pose [m, rad].
            time: time of the tick [s]; if None, the tick's index multiplied by the control period.
            command: command that `step` has returned [N]; six axes: wrench [N, N m].
            faults: bits of the tick's faults, and of the faults that tripped the controller.
        """
        stamp = self._count * self._period if time is None else time
        values = (force_measured, position_desired, velocity_desired, position_measured, command)
        if self._axes > 1:
            values = tuple(value for vector in values for value in vector)  # pyright: ignore
        start = self._count % self._ticks * self._width
        row = array("d", (stamp, *values, self._contact, faults))  # pyright: ignore
        if len(row) == self._width:  # a vector of another length would shift all later rows
            self._rows[start : start + self._width] = row
            self._count += 1

    def next_contact(self) -> None:
        """Begin a new run; call this method together with the controller's `next_contact`."""
        self._contact += 1

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the log (`NAME.csv`) and its mapping (`NAME.toml`), which describes the log's columns.

        Args:
            path: path of the log; its name must end in `.csv`.

        Raises:
            ValueError: if the name does not end in `.csv`.
            FileExistsError: if one of the files exists; no file is overwritten.
            OSError: if a file cannot be written. No incomplete file remains, and the ticks stay in memory.
        """
        log = Path(path)
        if log.suffix != ".csv":
            raise ValueError(f"{log}: found {log.suffix!r}, expected a name that ends in .csv")
        # A literal string of TOML contains no quotes, and file patterns treat brackets as sets.
        pattern = "".join("?" if letter in "'[]*" else letter for letter in log.name)
        mapping = log.with_suffix(".toml")
        _create(mapping, [self.mapping(pattern)])
        try:
            _create(log, self._lines())
        except BaseException:
            mapping.unlink()
            raise

    def _lines(self) -> Iterator[str]:
        """Yield the lines of the log, from the oldest tick to the newest one."""
        yield self.heading
        first = self._count % self._ticks if self._count > self._ticks else 0
        for number in range(len(self)):
            start = (first + number) % self._ticks * self._width
            *values, contact, faults = self._rows[start : start + self._width]
            yield ",".join([*map(repr, values), f"{contact:.0f}", f"{faults:.0f}"]) + "\n"

    def mapping(self, pattern: str) -> str:
        """Return the mapping of logs whose names match `pattern`: TOML text that describes their columns."""
        lines = ['schema = "jaxhil/log/1"', "", "[channels]", 'time = "time"']
        for channel, prefix, suffixes in CHANNELS[self._axes]:
            columns = [f'"{prefix}{suffix}"' for suffix in suffixes]
            lines.append(f"{channel} = {columns[0] if self._axes == 1 else '[' + ', '.join(columns) + ']'}")
        lines += ['contact_index = "contact"', "", "[timing]", f"control_period = {self._period!r}", ""]
        if self._mass is not None:
            lines += ["[bodies]", f"equivalent_mass = {self._mass!r}", ""]
        return "\n".join([*lines, "[[runs]]", f"files = '{pattern}'", 'kind = "contact"', ""])


def _create(path: Path, lines: Iterable[str]) -> None:
    """Create a file with these lines; delete it if it cannot be completed."""
    with path.open("x", encoding="utf-8", newline="\n") as file:
        try:
            file.writelines(lines)
            file.flush()
        except BaseException:
            path.unlink()
            raise
