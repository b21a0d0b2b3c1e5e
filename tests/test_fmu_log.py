"""Flight log of the controller's FMU: equal to that of the Python recorder, and written only if it is set."""

import resource
import tomllib
from pathlib import Path

import fmus
import numpy as np
import pytest
from bundles import document
from fmus import RunningFmu, fmpy
from test_fmu import folder_of

import tuning
from jaxhil.rig.flight_recorder import CHANNELS, WRENCH, FlightRecorder

INPUTS = ("force_measured", "position_desired", "velocity_desired", "position_measured")
FAILED = pytest.raises(Exception, match="failed with status 3")


@pytest.fixture(params=[3, pytest.param(2, marks=pytest.mark.slow)])
def fmu(request):
    running = RunningFmu(folder_of("one axis", request.param))
    yield running
    running.close()


def run_steps(fmu, recorder, count=100):
    """Step the FMU with a press against the surface; add all ticks to the recorder."""
    for tick in range(count):
        depth = 1e-4 * tick
        values = (200.0 * depth, depth, 5e-3, 0.9 * depth)
        events = {"next_contact": tick in (0, 60), "has_tick_time": tick > 50, "tick_time": 1e-3 * tick}
        fmu.set({**dict(zip(INPUTS, values, strict=True)), "position": depth, **events})
        fmu.step()
        outputs = fmu.get("force_command", "faults", "trip_cause")
        if tick == 60:
            recorder.next_contact()
        faults = outputs["faults"] | outputs["trip_cause"]
        recorder.add(*values, tick * fmu.period, outputs["force_command"], faults)


def read_log(path):
    return np.loadtxt(path, delimiter=",", skiprows=1)


def test_fmu_writes_the_log_of_the_flight_recorder(fmu, tmp_path):
    log = tmp_path / "läng weg.csv"
    fmu.reset(flight_log=str(log))
    assert fmu.get("flight_log")["flight_log"] in (str(log), str(log).encode())
    recorder = FlightRecorder(fmu.period, equivalent_mass=300.0)
    run_steps(fmu, recorder)
    fmu.instance.terminate()
    recorder.write(tmp_path / "python.csv")
    ours, expected = read_log(log), read_log(tmp_path / "python.csv")
    assert np.array_equal(ours, expected) and ours.shape == (100, 8)
    headings = [path.read_text().splitlines()[0] for path in (log, tmp_path / "python.csv")]
    assert headings[0] == headings[1]
    mappings = [
        tomllib.loads(path.with_suffix(".toml").read_text()) for path in (log, tmp_path / "python.csv")
    ]
    assert mappings[0].pop("runs") == [{"files": "*", "kind": "contact"}]
    mappings[1].pop("runs")
    assert mappings[0] == mappings[1]


def test_shadow_mode_repeats_the_log_of_the_fmu_bit_for_bit(fmu, tmp_path):
    class Result:
        document = document()

    fmu.reset(flight_log=str(tmp_path / "session.csv"))
    run_steps(fmu, FlightRecorder(fmu.period))
    fmu.reset()
    result = tuning.shadow(Result, tmp_path / "session.csv", map=tmp_path / "session.toml").document
    assert {contact["share"] for contact in result["contacts"]} == {0.0}


def test_fmu_rejects_a_log_that_exists_or_cannot_be_created(fmu, tmp_path):
    (tmp_path / "there.toml").write_text("user's file")
    for path in (tmp_path / "there.csv", tmp_path / "missing" / "session.csv"):
        with FAILED:
            fmu.reset(flight_log=str(path))
    for path in ("session.txt", "x" * 1100 + ".csv"):
        with FAILED:
            fmu.reset(flight_log=path)
    assert (tmp_path / "there.toml").read_text() == "user's file" and len(list(tmp_path.iterdir())) == 1
    fmu.reset()
    with FAILED:
        fmu.set({"flight_log": str(tmp_path / "late.csv")})


def test_fmu_continues_without_log_if_the_disk_is_full(fmu, tmp_path):
    log = tmp_path / "session.csv"
    fmu.reset(flight_log=str(log))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (15_000, limits[1]))
    try:
        run_steps(fmu, FlightRecorder(fmu.period), 300)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert log.read_bytes().endswith(b"\n") and 0 < len(read_log(log)) < 300
    assert fmu.messages in ([], ["flight_log: the flight log cannot be written, and ends here; "
                                 "the controller continues"])  # fmt: skip


def test_log_of_an_fmu_with_numerical_model_has_the_motion_of_the_model(tmp_path):
    running = RunningFmu(folder_of("one axis", 3))
    running.reset(
        integrates_model=True,
        position_desired=-0.01,
        velocity_desired=0.005,
        flight_log=str(tmp_path / "session.csv"),
    )
    positions = []
    for _ in range(10):
        positions.append(running.get("model_position")["model_position"])
        running.step()
    running.close()
    assert np.array_equal(read_log(tmp_path / "session.csv")[:, 2], positions)


@pytest.mark.slow
def test_log_of_the_six_axis_fmu_has_the_columns_of_the_flight_recorder(tmp_path):
    running = RunningFmu(folder_of("six axes", 3))
    running.reset(flight_log=str(tmp_path / "session.csv"))
    names = [part for vector in fmus.SIX_AXIS_INPUTS[:4] for part in fmus.part_names(vector)]
    inputs = {name: 1e-3 * number for number, name in enumerate(names)}
    running.set(inputs)
    running.step()
    commands = running.get(*fmus.part_names("wrench_command"))
    running.close()
    heading, row = (tmp_path / "session.csv").read_text().splitlines()
    columns = [prefix + suffix for _, prefix, suffixes in CHANNELS[6] for suffix in suffixes]
    assert heading.split(",") == ["time", *columns, "contact", "faults"]
    assert [float(value) for value in row.split(",")[:-1]] == [0.0, *inputs.values(), *commands.values(), 0.0]
    mapping = tomllib.loads((tmp_path / "session.toml").read_text())
    assert mapping["channels"]["wrench_command"] == [f"command_{part}" for part in WRENCH]


def test_rig_fmu_has_no_flight_log():
    from tuning.bundle.fmu.rig import rig_fmu

    path = fmus.write_fmu(Path(folder_of("one axis", 3)).with_name("rig.fmu"), rig_fmu(document(), 3), False)
    names = {variable.name for variable in fmpy.read_model_description(str(path)).modelVariables}
    assert "flight_log" not in names
