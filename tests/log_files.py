"""Small log files as rigs and their tools write them, all with the same contact."""

# Each case is one line.
# ruff: noqa: E501

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from log_cases import PERIOD, touches

LOG = touches(1)
BEGIN = datetime(2026, 3, 1, 9, 59, 59, 900000)


class LogFile(NamedTuple):
    """A file's name, the function that writes it, and what the user answers to `# which of:`."""

    name: str
    write: Callable[[Path], Any]
    answers: dict[str, str] = {}  # noqa: RUF012
    atol: float = 1e-13  # m and N, of the values read back


def text(
    names: str, separator: str = ",", *, scale: float = 1.0, time: Callable[[float], str] = repr, head: str = "",
    units: str = "", decimal: str = ".", encoding: str = "utf-8", end: str = "", more: dict[str, Any] | None = None,
) -> Callable[[Path], None]:  # fmt: skip
    """Return a function that writes time, command, position and force; lengths are multiplied by `scale`."""
    times = [time(float(t)) for t in LOG["t"]]
    columns = [
        times,
        *(map(repr, (LOG[n] * (1.0 if n == "F" else scale)).tolist()) for n in ("xd", "xm", "F")),
    ]
    columns += [[str(cell) for cell in column] for column in (more or {}).values()]
    rows = [separator.join(row).replace(".", decimal) + end for row in zip(*columns, strict=True)]
    lines = [*([head] if head else []), *([names] if names else []), *([units] if units else []), *rows, ""]

    def write(path: Path) -> None:
        path.write_bytes("\r\n".join(lines).encode(encoding))

    return write


def at(t: float) -> datetime:
    return BEGIN + timedelta(microseconds=round(1e6 * t))


def net(t: float) -> str:
    """Format a time as .NET's format `o` does."""
    return f"{at(t):%Y-%m-%dT%H:%M:%S}.{at(t).microsecond * 10:07d}+01:00"


LVM = """LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t.
Multi_Headings\tNo
X_Columns\tOne
Time_Pref\tRelative
Date\t2026/03/01
***End_of_Header***\t
\t
Channels\t3\t\t\t
Samples\t600\t600\t600\t
Y_Unit_Label\tmm\tmm\tN\t
X_Dimension\tTime\tTime\tTime\t
X0\t0.0E+0\t0.0E+0\t0.0E+0\t
Delta_X\t0.001\t0.001\t0.001\t
***End_of_Header***\t\t\t\t""".replace("\n", "\r\n")


def merged(path: Path, steps: dict[str, int], late: dict[str, float]) -> None:
    """Write topics with separate clocks as PlotJuggler does: a row for each message, other cells empty."""
    rows = []
    for index, name in enumerate(("xd", "xm", "F")):
        for t, value in zip(LOG["t"][:: steps[name]], LOG[name][:: steps[name]].tolist(), strict=True):
            rows.append((float(t) + late[name], index, value))
    lines = ["__time,/cmd/position,/drive/position/act,/sensor/force"]
    for t, index, value in sorted(rows):
        cells = ["", "", ""]
        cells[index] = repr(value)
        lines.append(",".join([f"{1_700_000_000 + t:.6f}", *cells]))
    path.write_text("\n".join([*lines, ""]))


def fast(names: str, hold: bool, factor: int = 2) -> Callable[[Path], None]:
    """Return a writer of rows at a multiple of the control rate; commands are held or interpolated."""

    def write(path: Path) -> None:
        fine = PERIOD / factor * np.arange(factor * (len(LOG["t"]) - 1))
        index = np.arange(len(fine)) // factor
        columns = [np.interp(fine, LOG["t"], LOG[name]) for name in ("xd", "xm", "F")]
        if hold:
            columns[0] = LOG["xd"][index]
        rows = zip(fine.tolist(), *(column.tolist() for column in columns), strict=True)
        path.write_text("\n".join([names, *(",".join(map(repr, row)) for row in rows), ""]))

    return write


def mat_with_time(labels: tuple[str, ...]) -> Callable[[Path], None]:
    """Return a writer of Simulink's "Structure With Time" with several signals."""

    def write(path: Path) -> None:
        from scipy.io import savemat

        kind = [("values", object), ("dimensions", object), ("label", object), ("blockName", object)]
        signals = np.empty((1, 3), kind)
        for index, (name, label) in enumerate(zip(("xd", "xm", "F"), labels, strict=True)):
            signals[0, index] = (LOG[name][:, None], 1.0, label, f"rig/Scope{index}")
        savemat(path, {"log": {"time": LOG["t"][:, None], "signals": signals, "blockName": "rig/Scope"}})

    return write


def mat_to_file(path: Path) -> None:
    """Write Simulink's "To File" array: a row per signal, time in the first."""
    from scipy.io import savemat

    savemat(path, {"ans": np.array([LOG[name] for name in ("t", "xd", "xm", "F")])})


def mat_to_workspace(path: Path) -> None:
    """Write Simulink's "To Workspace" array: a column per signal, with the times in `tout`."""
    from scipy.io import savemat

    savemat(path, {"tout": LOG["t"][:, None], "yout": np.array([LOG[name] for name in ("xd", "xm", "F")]).T})


def control_desk(path: Path) -> None:
    """Write dSPACE ControlDesk's export: a structure with X and Y, each with Name and Data."""
    from scipy.io import savemat

    kind = [("Name", object), ("Type", object), ("Data", object), ("Unit", object)]
    x, y = np.empty((1, 1), kind), np.empty((1, 3), kind)
    x[0, 0] = ("Time", "Double", LOG["t"][None], "s")
    names = ("Model Root/rig/SetPos/Out1", "Model Root/rig/ActPos/Out1", "Model Root/rig/Fz/Out1")
    for index, (column, name) in enumerate(zip(("xd", "xm", "F"), names, strict=True)):
        y[0, index] = (name, "Double", LOG[column][None], "N" if column == "F" else "m")
    savemat(path, {"measurement_001": {"X": x, "Y": y, "Description": "a rig", "Capture": {"Length": 0.6}}})


def hdf5_rows(path: Path) -> None:
    """Write row vectors, as MATLAB's `h5write` does."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, column in zip(("time", "cmd", "pos"), ("t", "xd", "xm"), strict=True):
            file[f"rig/{name}"] = LOG[column][None] * (1.0 if name == "time" else 1e3)
            file[f"rig/{name}"].attrs["units"] = "s" if name == "time" else "mm"
        file["rig/force"] = LOG["F"][None]


def hdf5_matrix(path: Path) -> None:
    """Write signals as the rows of a matrix."""
    import h5py

    with h5py.File(path, "w") as file:
        file["t"] = LOG["t"]
        file["x"] = np.array([LOG["xd"], LOG["xm"]])
        file["force"] = LOG["F"]


def mdf_units(path: Path) -> None:
    import asammdf

    names = {"SetPos": ("xd", 1e3, "mm"), "ActPos": ("xm", 1e6, "µm"), "LoadCell": ("F", 1e-3, "kN")}
    signals = [
        asammdf.Signal(samples=LOG[column] * factor, timestamps=LOG["t"], name=name, unit=unit)
        for name, (column, factor, unit) in names.items()
    ]
    with asammdf.MDF(version="3.30" if path.suffix == ".mdf" else "4.10") as file:
        file.append(signals)
        file.save(path)


def mdf_same_names(path: Path) -> None:
    """Write two groups, both with a channel `Position`."""
    import asammdf

    with asammdf.MDF() as file:
        for group, names in (("Command", {"Position": "xd"}), ("Drive", {"Position": "xm", "Force": "F"})):
            signals = [
                asammdf.Signal(LOG[c], LOG["t"], name=n, unit="N" if c == "F" else "m")
                for n, c in names.items()
            ]
            file.append(signals, acq_name=group, comment=group)
        file.save(path)


def tdms_units(path: Path) -> None:
    import nptdms

    units = {
        "xd": ("Command", 1e3, "mm"),
        "xm": ("Position", 1e3, "mm"),
        "F": ("Force", 1 / 4.4482216152605, "lbf"),
    }
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([
            nptdms.ChannelObject("rig", name, LOG[column] * factor, {
                "wf_increment": PERIOD, "wf_start_offset": 0.0, "unit_string": unit
            })
            for column, (name, factor, unit) in units.items()
        ])  # fmt: skip


def bag_joint_states(path: Path) -> Path:
    """Write JointStates with named joints; their header stamps are more accurate than the recording times."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    state, header = store.types["sensor_msgs/msg/JointState"], store.types["std_msgs/msg/Header"]
    stamp = store.types["builtin_interfaces/msg/Time"]
    random, folder = np.random.default_rng(0), path.with_suffix("")
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/rig", state.__msgtype__, typestore=store)
        late = 1_700_000_000_000_000_000
        for t, x, xm, force in zip(LOG["t"], LOG["xd"], LOG["xm"], LOG["F"], strict=True):
            nanoseconds = 1_700_000_000_000_000_000 + round(1e9 * t)
            message = state(
                header=header(
                    stamp=stamp(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9), frame_id=""
                ),
                name=["goal", "actual"],
                position=np.array([x, xm]),
                velocity=np.array([]),
                effort=np.array([0.0, force]),
            )
            late = max(late + 1, nanoseconds + int(random.integers(0, 3_000_000)))
            writer.write(connection, late, store.serialize_cdr(message, state.__msgtype__))
    return folder


SEC = {
    "sec": [1_700_000_000 + int(t + 0.9001) for t in LOG["t"]],
    "nanosec": [round(1e9 * (t + 0.9)) % 10**9 for t in LOG["t"]],
}

FILES = {
    "jaxhil names": LogFile("a.csv", text("time,position_desired,position_measured,force_measured")),
    "units row": LogFile("a.csv", text("Time,Cmd,Pos,Force", units="s,mm,mm,N", scale=1e3)),
    "units row in brackets": LogFile("a.txt", text("Time\tCmd\tPos\tForce", "\t", units="[s]\t[mm]\t[mm]\t[N]", scale=1e3)),
    "preamble": LogFile("a.csv", text("Time,Command,Position,Force", head="Logger 3.1\r\nOperator,A. Smith\r\nRate (Hz),1000\r\n")),
    "preamble and units row": LogFile("a.csv", text("Time;Command;Position;Force", ";", head="Logger 3.1;V2\r\nRate;1000", units="s;um;um;N", scale=1e6)),
    "decimal commas": LogFile("a.csv", text("Time;Soll [mm];Ist [mm];Kraft [N]", ";", decimal=",", scale=1e3)),
    "decimal commas and tabs": LogFile("a.txt", text("t\tx_cmd\tx_act\tFz", "\t", decimal=",")),
    "decimal commas and blanks": LogFile("a.dat", text("t   x_cmd   x_act   Fz", "   ", decimal=",")),
    "several blanks": LogFile("a.dat", text("Time (s)    Set Pos    Act Pos    Load", "    ", end="  ")),
    "numpy.savetxt": LogFile("a.out", text("# t x_cmd x_act F", " ")),
    "numpy.savetxt with commas": LogFile("a.out", text("# t,x_cmd,x_act,F")),
    "lvm": LogFile("a.lvm", text("X_Value\tCommand\tPosition\tForce\tComment", "\t", head=LVM, scale=1e3)),
    "utf-16": LogFile("a.txt", text("Time\tSetPos\tActPos\tForce", "\t", encoding="utf-16")),
    "utf-16 with decimal commas": LogFile("a.csv", text("Zeit;SetPos;ActPos;Kraft", ";", decimal=",", encoding="utf-16")),
    "latin-1": LogFile("a.csv", text("Zeit,Soll (µm),Ist (µm),Kraft", scale=1e6, encoding="latin-1")),
    "Python isoformat": LogFile("a.csv", text("stamp,goal,current,force", time=lambda t: at(t).isoformat())),
    "Python isoformat with zone": LogFile("a.csv", text("stamp,goal,current,force", time=lambda t: at(t).replace(tzinfo=UTC).isoformat())),
    "Python str and blanks": LogFile("a.csv", text("stamp,goal,current,force", time=lambda t: str(at(t)))),
    ".NET round trip": LogFile("a.csv", text("Timestamp,SetPos,ActPos,Force", time=net)),
    "American stamps": LogFile("a.csv", text("Time,SetPos,ActPos,Force", time=lambda t: f"{at(t):%m/%d/%Y %I:%M:%S.%f %p}")),
    "header stamps in text": LogFile("a.csv", text("count,goal,current,force,header.stamp.sec,header.stamp.nanosec", more=SEC)),
    "no names": LogFile("a.csv", text(""), {"position_desired": "2", "position_measured": "3", "force_measured": "4"}),
    "unknown names": LogFile("a.csv", text("a,b,c,d"), {"position_desired": "b", "position_measured": "c", "force_measured": "d"}),
    "six axes": LogFile("a.csv", text("t,cmd_z,act_z,Fz,Fx,Fy,Tx", more={n: np.random.default_rng(i).standard_normal(600).tolist() for i, n in enumerate("xyz")}), {"force_measured": "Fz"}),
    "mm in one name": LogFile("a.csv", text("t,x_cmd [mm],x_act,F", scale=1e3)),
    "sparse rows": LogFile("a.csv", lambda path: merged(path, {"xd": 1, "xm": 1, "F": 1}, {"xd": 0.0, "xm": 1e-4, "F": 2e-4}), {}, 3e-6),
    "2 kHz held": LogFile("a.csv", fast("t,x_cmd,x_act,F", True)),
    "2 kHz interpolated": LogFile("a.csv", fast("t,x_cmd,x_act,F", False)),
    "4 kHz held": LogFile("a.csv", fast("t,x_cmd,x_act,F", True, 4)),
    "structure with time": LogFile("a.mat", mat_with_time(("x_cmd", "x_act", "force"))),
    "structure with time without labels": LogFile("a.mat", mat_with_time(("", "", "")), {"position_desired": "log.signals.values_1", "position_measured": "log.signals.values_2", "force_measured": "log.signals.values_3"}),
    "To File": LogFile("a.mat", mat_to_file, {"position_desired": "ans_2", "position_measured": "ans_3", "force_measured": "ans_4"}),
    "To Workspace": LogFile("a.mat", mat_to_workspace, {"position_desired": "yout_1", "position_measured": "yout_2", "force_measured": "yout_3"}),
    "ControlDesk": LogFile("a.mat", control_desk),
    "HDF5 rows": LogFile("a.h5", hdf5_rows),
    "HDF5 matrix": LogFile("a.h5", hdf5_matrix, {"position_desired": "x_1", "position_measured": "x_2"}),
    "MDF units": LogFile("a.mf4", mdf_units),
    "MDF 3 units": LogFile("a.mdf", mdf_units),
    "MDF same names": LogFile("a.mf4", mdf_same_names),
    "TDMS units": LogFile("a.tdms", tdms_units),
    "JointState": LogFile("a.mcap", bag_joint_states),
}  # fmt: skip
