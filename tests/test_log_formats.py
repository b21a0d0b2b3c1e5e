"""Log formats of other tools, written by each format's own library and read like text files."""

import numpy as np
import pytest
from log_cases import CHANNELS, PERIOD, read, touches, write_csv

from jaxhil.errors import InputError
from tuning.identification.logs.readers import open_log

LOG = touches(1)


def mat_5(path):
    from scipy.io import savemat

    matrix = np.stack([LOG["xd"], LOG["xm"]], axis=1)
    savemat(path, {"log": {"t": LOG["t"], "F": LOG["F"], "x": matrix}, "gain": 3.0, "note": "none"})
    return path, {
        "time": "log.t",
        "position_desired": "log.x_1",
        "position_measured": "log.x_2",
        "force_measured": "log.F",
    }


def mat_73(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("log")
        for name, column in LOG.items():
            group.create_dataset(name, data=column[None]).attrs["MATLAB_class"] = np.bytes_("double")
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path, {name: f"log.{column}" for name, column in CHANNELS.items()}


def hdf5(path):
    h5py = pytest.importorskip("h5py")
    table = np.rec.fromarrays([LOG["vd"], LOG["Fc"]], names="vd,Fc")
    with h5py.File(path, "w") as file:
        file["rig/t"], file["rig/F"] = LOG["t"], LOG["F"]
        file["rig/x"] = np.stack([LOG["xd"], LOG["xm"]], axis=1)
        file["rig/model"], file["rig/name"] = table, "a rig"
    columns = ("rig/t", "rig/x_1", "rig/x_2", "rig/F", "rig/model.vd", "rig/model.Fc")
    return path, dict(zip(CHANNELS, columns, strict=True))


def bag(path):
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path.with_suffix("")
    state, header = store.types["sensor_msgs/msg/JointState"], store.types["std_msgs/msg/Header"]
    stamp = store.types["builtin_interfaces/msg/Time"]
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/rig", state.__msgtype__, typestore=store)
        for t, x, xm, force in zip(LOG["t"], LOG["xd"], LOG["xm"], LOG["F"], strict=True):
            nanoseconds = 1_700_000_000_000_000_000 + round(1e9 * t)
            message = state(
                header=header(stamp=stamp(sec=0, nanosec=0), frame_id="rig"),
                name=["x"],
                position=np.array([x, xm]),
                velocity=np.array([]),
                effort=np.array([force]),
            )
            writer.write(connection, nanoseconds, store.serialize_cdr(message, state.__msgtype__))
    columns = ("/rig.time", "/rig.position_1", "/rig.position_2", "/rig.effort_1")
    return folder, dict(zip(CHANNELS, columns, strict=False))


def mdf(path):
    asammdf = pytest.importorskip("asammdf")
    signals = [
        asammdf.Signal(samples=column, timestamps=LOG["t"], name=name)
        for name, column in LOG.items()
        if name != "t"
    ]
    with asammdf.MDF() as file:
        file.append(signals)
        file.save(path)
    return path, CHANNELS | {"time": "time"}


def tdms(path):
    nptdms = pytest.importorskip("nptdms")
    properties = {"wf_increment": 1e-3, "wf_start_offset": 0.0, "wf_samples": 600}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("rig", name, LOG[name], properties) for name in LOG if name != "t"]
        )
    return path, {name: f"rig/{column}" for name, column in CHANNELS.items()} | {"time": "rig/xd.time"}


FORMATS = [
    ("a.mat", mat_5),
    ("b.mat", mat_73),
    ("a.h5", hdf5),
    ("a.db3", bag),
    ("a.mcap", bag),
    ("a.mf4", mdf),
    ("a.tdms", tdms),
]


@pytest.mark.filterwarnings("ignore")  # warnings of other libraries
@pytest.mark.parametrize(("name", "write"), FORMATS)
def test_all_log_formats_give_the_same_campaign(tmp_path, name, write):
    if write is mat_5:
        pytest.importorskip("pymatreader")
    path, columns = write(tmp_path / name)
    absent = dict.fromkeys(set(CHANNELS) - set(columns))
    (result,) = read(path, **columns, **absent).runs
    (text,) = read(write_csv(tmp_path / "text.csv", LOG), **absent).runs
    np.testing.assert_array_equal(result.tick, text.tick)
    for channel in set(columns) - {"time"}:
        np.testing.assert_array_equal(getattr(result, channel), getattr(text, channel))
    with pytest.raises(InputError, match="column 'nothing': found no column with this name, expected"):
        read(path, **columns | {"position_desired": "nothing"}, **absent)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("suffix", [".mat", ".h5", ".mcap", ".mf4", ".tdms"])
def test_truncated_log_or_missing_library_is_rejected_with_one_line_message(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"torn" * 100)
    with pytest.raises(InputError) as caught:
        open_log(path).read(["t"])
    result = str(caught.value)
    assert result.startswith(f"{path}: ") and result.isprintable()
    assert (
        "cannot be read: " in result
        or "which is not installed: python3 -m pip install 'jaxhil[logs]'" in result
    )


def bag_of_topics(path, log, late):
    """Write a bag whose force has a separate topic, with its first message some ticks later."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    number, folder = store.types["std_msgs/msg/Float64"], path.with_suffix("")
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        for name, values in log.items():
            if name == "t":
                continue
            connection = writer.add_connection(f"/{name}", number.__msgtype__, typestore=store)
            for t, value in zip(log["t"] + late * (name == "F"), values, strict=True):
                raw = store.serialize_cdr(number(data=value), number.__msgtype__)
                writer.write(connection, 1_700_000_000_000_000_000 + round(1e9 * t), raw)
    return folder, {name: f"/{column}.data" for name, column in CHANNELS.items()} | {"time": "/xd.time"}


def mdf_of_groups(path, log, late):
    asammdf = pytest.importorskip("asammdf")
    names = [name for name in log if name != "t"]
    with asammdf.MDF() as file:
        for group in ([name for name in names if name != "F"], ["F"]):
            times = log["t"] + late * (group == ["F"])
            file.append([asammdf.Signal(samples=log[name], timestamps=times, name=name) for name in group])
        file.save(path)
    return path, CHANNELS | {"time": "time"}


def tdms_with_offsets(path, log, late):
    nptdms = pytest.importorskip("nptdms")
    properties = {"wf_increment": PERIOD, "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([
            nptdms.ChannelObject(
                "rig", name, log[name], properties | {"wf_start_offset": late * (name == "F")}
            )
            for name in log if name != "t"
        ])  # fmt: skip
    return path, {name: f"rig/{column}" for name, column in CHANNELS.items()} | {"time": "rig/xd.time"}


def tdms_with_start_times(path, log, late):
    nptdms = pytest.importorskip("nptdms")
    begin = np.datetime64("2026-03-01T10:00:00.000000", "us")
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([
            nptdms.ChannelObject("rig", name, log[name], {
                "wf_increment": PERIOD, "wf_start_offset": 0.0,
                "wf_start_time": begin + np.timedelta64(round(1e6 * late * (name == "F")), "us"),
            })
            for name in log if name != "t"
        ])  # fmt: skip
    return path, {name: f"rig/{column}" for name, column in CHANNELS.items()} | {"time": "rig/F.time"}


OWN_CLOCKS = [
    ("a.db3", bag_of_topics),
    ("a.mcap", bag_of_topics),
    ("a.mf4", mdf_of_groups),
    ("a.tdms", tdms_with_offsets),
    ("a.tdms", tdms_with_start_times),
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("name", "write"), OWN_CLOCKS)
@pytest.mark.parametrize("late", [0.005, -0.007])
def test_log_channels_that_begin_at_different_times_are_aligned(tmp_path, name, write, late):
    path, columns = write(tmp_path / name, LOG, late)
    result = read(path, **columns)
    (run,) = result.runs
    assert any("F" in note and "has separate stamps" in note for note in result.notes)
    shift = round(late / PERIOD)
    first = np.flatnonzero(LOG["xd"] == run.position_desired[0])[0]
    rows = np.arange(first, first + len(run.tick))
    np.testing.assert_array_equal(run.position_desired, LOG["xd"][rows])
    np.testing.assert_array_equal(run.force_measured, LOG["F"][rows - shift])
    assert len(rows) == len(LOG["t"]) - abs(shift)


@pytest.mark.filterwarnings("ignore")
def test_log_channels_with_other_rates_or_clocks_are_read_or_rejected(tmp_path):
    path, columns = mdf_of_groups(tmp_path / "a.mf4", LOG, 0.005)
    with pytest.raises(InputError, match=r'timing.clock: found "index", expected "stamps", because '):
        read(path, **columns, timing={"clock": "index"})
    with pytest.raises(
        InputError, match="time: found column 'vd', expected one of time, because 'F' has separate"
    ):
        read(path, **columns | {"time": "vd", "velocity_desired": None})
    asammdf = pytest.importorskip("asammdf")
    fast = np.arange(0.1, 0.55, 1e-4)
    for index, (times, values) in enumerate(((fast, np.interp(fast, LOG["t"], LOG["F"])),
                                             (LOG["t"][::2], LOG["F"][::2]))):  # fmt: skip
        with asammdf.MDF() as file:
            names = [name for name in LOG if name not in ("t", "F")]
            file.append([asammdf.Signal(samples=LOG[n], timestamps=LOG["t"], name=n) for n in names])
            file.append([asammdf.Signal(samples=values, timestamps=times, name="F")])
            file.save(tmp_path / f"{index}.mf4")
    (run,) = read(tmp_path / "0.mf4", **columns).runs
    assert 448 <= len(run.tick) <= 450
    first = np.flatnonzero(LOG["xd"] == run.position_desired[0])[0]
    np.testing.assert_allclose(run.force_measured, LOG["F"][first : first + len(run.tick)], atol=1e-9)
    with pytest.raises(
        InputError, match=r"stamps of 'F': found readings 0.002 s apart, expected the control"
    ):
        read(tmp_path / "1.mf4", **columns)


@pytest.mark.filterwarnings("ignore")
def test_log_waveform_without_start_time_among_timed_waveforms_is_rejected(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    begin = {"wf_start_time": np.datetime64("2026-03-01T10:00:00", "us")}
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment([
            nptdms.ChannelObject("rig", name, LOG[name], {"wf_increment": PERIOD, "wf_start_offset": 0.0}
                                 | (begin if name != "F" else {}))
            for name in LOG if name != "t"
        ])  # fmt: skip
    columns = {name: f"rig/{column}" for name, column in CHANNELS.items()} | {"time": "rig/xd.time"}
    with pytest.raises(InputError, match="'rig/F': found no wf_start_time, expected one as in other"):
        read(tmp_path / "a.tdms", **columns)
