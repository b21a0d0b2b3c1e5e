"""Flight recorder: shadow mode, identification and monitoring read its log, and nothing is overwritten."""

import resource
import subprocess
import sys
from pathlib import Path

import bundles
import numpy as np
import pytest
import shadow_logs

import jaxhil.rig.flight_recorder as module
import tuning
from jaxhil.rig import Controller
from jaxhil.rig.flight_recorder import FlightRecorder
from tuning.identification.logs.campaign import read_campaign
from tuning.identification.logs.mapping import load_mapping

RECORDED = ("force_measured", "position_desired", "velocity_desired", "position_measured", "time")


class Result:
    """Stand-in for a result of `tuning.tune`."""

    document = bundles.document("rig-300kg", "phase_lead")


@pytest.fixture(scope="module")
def columns():
    document = Result.document
    return shadow_logs.record_contacts(lambda: Controller.from_dict(document), document["mechanism"])


def recorded(columns, **options):
    """Return a recorder with the ticks of the columns."""
    recorder = FlightRecorder(0.001, **options)
    for row in range(len(columns["time"])):
        if row and columns["contact"][row] != columns["contact"][row - 1]:
            recorder.next_contact()
        recorder.add(*(columns[name][row] for name in RECORDED), columns["force_command"][row], 0x100)
    return recorder


def test_shadow_mode_reads_log_of_the_flight_recorder(tmp_path, columns):
    log = tmp_path / "rig's [1].csv"
    recorded(columns).write(log)
    for mapping in (None, log.with_suffix(".toml")):
        document = tuning.shadow(Result, log, map=mapping).document
        assert [contact["share"] for contact in document["contacts"]] == [0.0, 0.0]
        assert [contact["compared"] for contact in document["contacts"]] == [259, 259]


def test_identification_reads_log_of_the_flight_recorder(tmp_path, columns):
    log = tmp_path / "session.csv"
    recorded(columns, equivalent_mass=300.0).write(log)
    campaign = read_campaign([log], load_mapping(tmp_path / "session.toml"))
    assert len(campaign.runs) == 2 and campaign.equivalent_mass == 300.0
    assert np.array_equal(campaign.runs[1].force_measured, columns["force_measured"][260:])


def test_flight_recorder_keeps_the_newest_ticks(tmp_path, columns):
    recorder = recorded(columns, ticks=300)
    recorder.write(tmp_path / "session.csv")
    rows = np.loadtxt(tmp_path / "session.csv", delimiter=",", skiprows=1)
    assert len(recorder) == len(rows) == 300
    assert np.array_equal(rows[:, 0], columns["time"][220:]) and rows[-1, -1] == 0x100
    assert np.array_equal(rows[:, -2], columns["contact"][220:])


def test_flight_recorder_overwrites_no_file_and_ignores_vectors_of_wrong_length(tmp_path):
    recorder = FlightRecorder(0.001, axes=6, ticks=2)
    vector = [1.0, 2.0, 3.0, 4.0, 5.0, np.nan]
    recorder.add(vector, vector, vector, vector, None, vector)
    recorder.add(vector[:5], vector, vector, vector, None, vector)
    assert len(recorder) == 1
    recorder.write(tmp_path / "session.csv")
    with pytest.raises(FileExistsError):
        recorder.write(tmp_path / "session.csv")
    with pytest.raises(ValueError, match=r"expected a name that ends in \.csv"):
        recorder.write(tmp_path / "session.txt")
    with pytest.raises(ValueError, match="expected 1 or 6"):
        FlightRecorder(0.001, axes=2)
    assert (tmp_path / "session.csv").read_text().splitlines()[1].endswith("5.0,nan,0,0")


def test_flight_recorder_leaves_no_incomplete_file_on_a_full_disk(tmp_path):
    recorder = FlightRecorder(0.001)
    for _ in range(2000):
        recorder.add(0.0, 0.0, 0.0, 0.0, None, 0.0)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            recorder.write(tmp_path / "session.csv")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError):
        recorder.write(tmp_path / "missing" / "session.csv")
    recorder.write(tmp_path / "session.csv")
    assert len((tmp_path / "session.csv").read_text().splitlines()) == 2001


def test_flight_recorder_needs_only_the_standard_library():
    path = str(Path(module.__file__))
    program = f"import runpy, sys; runpy.run_path({path!r}); assert 'numpy' not in sys.modules"
    assert subprocess.run([sys.executable, "-I", "-S", "-c", program], check=False).returncode == 0
