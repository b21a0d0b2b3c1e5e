"""Replay of a bundle's test vectors through its controller; a part of the self-test (`selftest.py`).

The self-test executes this file after it has compared the file with the manifest.
"""

import math
import struct
from collections import namedtuple

VECTOR_COLUMNS = (
    "run,event,force_measured,position_desired,velocity_desired,position_measured,time,position,velocity,"
    "acceleration,force_command,position_command,faults,force_simulated"
)
VECTORS_BEFORE_TIME = ("wrench_measured", "pose_desired", "twist_desired", "pose_measured")
VECTORS_AFTER_TIME = ("pose", "twist", "wrench_command", "pose_command")
COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
SIX_AXIS_VECTOR_COLUMNS = ",".join(
    [
        "run,event",
        *(f"{name}_{axis}" for name in VECTORS_BEFORE_TIME for axis in COORDINATES),
        "time",
        *(f"{name}_{axis}" for name in VECTORS_AFTER_TIME for axis in COORDINATES),
        "faults",
        *(f"wrench_simulated_{axis}" for axis in COORDINATES),
    ]
)
# Layout of vectors.csv for a controller: its columns; numbers of each quantity; number of quantities after
# the time that describe the model's motion; the method that commands the drives; parts of a force command
# with a common range and unit; largest difference between runtime and simulation, divided by the range of a
# run's commands [1] (the simulation rounds in another order).
Layout = namedtuple("Layout", "columns width motions method parts error")
LAYOUTS = {
    "Controller": Layout(VECTOR_COLUMNS, 1, 3, "position_command", ((0, 1, "N"),), 1e-11),
    "Controller6": Layout(SIX_AXIS_VECTOR_COLUMNS, 6, 2, "pose_command", ((0, 3, "N"), (3, 6, "N m")), 1e-9),
}


def controller_name(runtime):
    """Return the name of the runtime's controller."""
    return next(name for name in LAYOUTS if name in runtime)


def read_vectors(text, layout=LAYOUTS["Controller"]):
    """Yield (line number, list of numbers) for each row of vectors.csv; an empty field becomes None."""
    lines = text.split("\n")
    if lines[0].rstrip("\r") != layout.columns:
        raise ValueError(f"line 1: unknown columns, expected {layout.columns}")
    width, time = layout.columns.count(",") + 1, 2 + 4 * layout.width
    for number, line in enumerate(lines[1:], start=2):
        if number == len(lines) and not line:
            return
        try:
            row = [float(field) if field else None for field in line.rstrip("\r").split(",")]
        except ValueError:
            row = []
        if len(row) != width or any(value is None for index, value in enumerate(row) if index != time):
            raise ValueError(f"line {number}: not a row of {width} numbers")
        yield number, row


def replay_vectors(rows, gains, runtime):
    """Replay all rows of vectors.csv through the runtime's controller with the gain file `gains`.

    Return two results. The first is a dictionary: for each run, a list of (line number, force command,
    simulated force command), where each command is a list of numbers. The second is a list of descriptions of
    the differences from the recorded commands.
    """
    name = controller_name(runtime)
    layout, controller, runs, different = LAYOUTS[name], None, {}, []
    width, time = layout.width, 2 + 4 * layout.width
    after = time + 1 + layout.motions * width
    columns = layout.columns.split(",")[after : after + 2 * width + 1]
    for number, row in rows:
        run, event = row[:2]
        if event == 1:
            controller = runtime[name].from_file(gains)
        elif controller is None or event not in (0, 2):
            raise ValueError(
                f"line {number}: event: found {event!r}, expected 0, 1 or 2, and 1 in the first row"
            )
        elif event == 2:
            controller.next_contact()
        command = controller.step(*quantities(row[2:time], width), row[time])
        sent = getattr(controller, layout.method)(*quantities(row[time + 1 : after], width))
        command, sent = ([command], [sent]) if width == 1 else (command, sent)
        # The faults are integers in the file, and are compared as floats like all other columns.
        values = [*command, *sent, float(controller.faults)]
        texts = [
            f"{column}: found {value!r}, expected {expected!r}"
            for column, value, expected in zip(columns, values, row[after:], strict=False)
            if not are_same_bits(value, expected)
        ]
        if texts:
            different.append(f"line {number}, run {int(run)}: {', '.join(texts)}")
        runs.setdefault(int(run), []).append((number, command, row[-width:]))
    return runs, different


def quantities(row, width):
    """Return the numbers of a row if `width` is 1; else divide them into lists of `width` numbers."""
    if width == 1:
        return row
    return [row[index : index + width] for index in range(0, len(row), width)]


def are_same_bits(found, expected):
    """Return whether two floats are equal, including the sign of zero; any NaN equals any other."""
    both_nan = math.isnan(found) and math.isnan(expected)
    return both_nan or struct.pack("<d", found) == struct.pack("<d", expected)


def compare_simulated(runs, layout):
    """Compare the force commands of each run with the simulated force commands.

    Return whether they agree, and a description of the result.
    """
    largest, compared = 0.0, 0
    for run, ticks in runs.items():
        stated = [tick for tick in ticks if not any(map(math.isnan, tick[2]))]
        compared += len(stated)
        for first, last, unit in layout.parts:
            expected = [0.0, *(value for tick in stated for value in tick[2][first:last])]
            span = max(expected) - min(expected)
            for number, forces, commands in stated:
                for force, simulated in zip(forces[first:last], commands[first:last], strict=True):
                    error = abs(force - simulated)
                    if not error <= layout.error * span:
                        text = f"found {force!r} {unit}, expected {simulated!r} {unit}"
                        limit = f"within {layout.error} of the range {span!r} {unit}"
                        return False, f"line {number}: run {run}: force command: {text} {limit}"
                    largest = max(largest, error / span if span else 0.0)
    if not compared:
        return False, "contains no simulated forces"
    return True, f"{compared} ticks, forces agree with the simulation within {largest:.1e} of their range"
