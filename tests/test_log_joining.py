"""Channels with separate clocks: aligned with the rows of the desired position, or rejected by name."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_cases import CHANNELS, mapping, read, touches, write_csv

from jaxhil.errors import InputError
from tuning.identification.logs.resampling import resample_to_rows

PERIOD, ROWS = 1e-3, 2000


def smooth(times):
    """Return a smooth signal at the given times."""
    return np.sin(2 * np.pi * 2.3 * times) + 0.3 * np.cos(2 * np.pi * 7.1 * times + 1.0)


def scattered(times, jitter, seed=0):
    return times + np.clip(jitter * np.random.default_rng(seed).standard_normal(len(times)), -4e-4, 4e-4)


def joined(sampled, stamps=None, ticks=None, jitter=0.0):
    """Return row ticks, aligned readings and notes; `sampled` are the times of the readings [s]."""
    ticks = np.arange(ROWS) if ticks is None else ticks
    rows = scattered(PERIOD * ticks, jitter, 1)
    columns = {"position_desired": ticks.astype(float), "position_measured": smooth(sampled)}
    columns["force_measured"] = columns["position_measured"]
    clocks = dict.fromkeys(columns, sampled if stamps is None else stamps) | {"position_desired": rows}
    named = {"position_desired": "xd", "position_measured": "xm", "force_measured": "F"}
    result, times, notes = resample_to_rows("a", columns, clocks, named, PERIOD)
    remaining_ticks = result["position_desired"].astype(int)
    assert len(times) == len(remaining_ticks) == len(result["position_measured"])
    assert np.all(np.isin(times, rows))
    if "force_late" in result:
        # Forces are not interpolated: each is one of the readings, and its delay is reported.
        assert np.all(np.isin(result["force_measured"], columns["force_measured"]))
        moved = (2 * np.pi * 7.1) * (0.02 * PERIOD + jitter)
        at = PERIOD * remaining_ticks + result["force_late"]
        assert np.max(np.abs(result["force_late"])) <= (0.51 * PERIOD if jitter == 0.0 else 0.7 * PERIOD)
        assert np.max(np.abs(result["force_measured"] - smooth(at))) < moved
    return remaining_ticks, result["position_measured"], notes


@pytest.mark.parametrize("late", [5.0, -7.0, 0.0])
@pytest.mark.parametrize("jitter", [0.0, 5e-5])
def test_log_channel_that_begins_some_ticks_later_is_shifted_exactly(late, jitter):
    sampled = PERIOD * (np.arange(ROWS - 40) + late)
    ticks, force, notes = joined(sampled, scattered(sampled, jitter, 2), jitter=jitter)
    np.testing.assert_array_equal(force, smooth(PERIOD * (late + np.arange(ROWS)))[(ticks - int(late))])
    assert ticks[0] == max(late, 0) and ticks[-1] == ROWS - 41 + late
    assert "are used unchanged" in notes[0]
    assert f"{40 + max(0, -late):.0f} rows without readings of all channels" in notes[1]


@given(
    late=st.floats(-0.02, 0.3),
    rate=st.sampled_from([1.0, 1.00003, 0.99995, 0.5, 0.1, 0.37, 0.95]),
    jitter=st.sampled_from([0.0, 2e-5]),
    lost=st.sampled_from([0.0, 0.01]),
    ends=st.integers(500, ROWS),
    seed=st.integers(0, 99),
)
@settings(deadline=None, max_examples=30)
def test_readings_with_own_clock_are_interpolated_to_times_of_log_rows(late, rate, jitter, lost, ends, seed):
    random = np.random.default_rng(seed)
    count = int(ends / rate)
    sampled = (late + PERIOD * rate * np.arange(count))[random.uniform(size=count) >= lost]
    ticks = np.flatnonzero(random.uniform(size=ROWS) >= lost)
    kept, force, _ = joined(sampled, scattered(sampled, jitter * rate, seed), ticks, jitter)
    # Between readings a period apart, the interpolation error is T^2 / 8 times the curvature.
    bent = (2 * np.pi * 7.1) ** 2 * PERIOD**2 / 8
    moved = (2 * np.pi * 7.1) * (0.02 * PERIOD + jitter)
    assert np.max(np.abs(force - smooth(PERIOD * kept))) < bent + moved
    inside = (ticks * PERIOD > sampled[0] + PERIOD) & (ticks * PERIOD < sampled[-1] - PERIOD)
    assert len(kept) > (0.9 if lost else 0.999) * np.count_nonzero(inside) - 2 and set(kept) <= set(ticks)


def test_gap_in_a_log_channel_drops_the_rows_within_the_gap():
    sampled = np.delete(PERIOD * np.arange(ROWS), slice(1000, 1200)) + 4e-4
    ticks, _, notes = joined(sampled)
    assert not np.any((ticks > 1000) & (ticks < 1200)) and "are interpolated" in notes[0]
    assert len(ticks) == ROWS - 200 - 2


@pytest.mark.parametrize(
    ("stamps", "reason"),
    [
        (PERIOD * np.arange(ROWS)[::-1], "row 2: stamps of 'F': found 1.998 s after 1.999 s"),
        (np.repeat(PERIOD * np.arange(ROWS // 2), 2), "row 2: stamps of 'F': found 0 s after 0 s"),
        (
            np.where(np.arange(ROWS) == 77, np.nan, PERIOD * np.arange(ROWS)),
            "row 78: stamps of 'F': found nan s",
        ),
        (
            2 * PERIOD * np.arange(ROWS),
            "stamps of 'F': found readings 0.002 s apart, expected the control period",
        ),
        (
            100 + PERIOD * np.arange(ROWS),
            "found no time with readings of all channels ('xd' 0 to 1.999 s, 'F' 100",
        ),
        (PERIOD * np.arange(ROWS - 1), "stamps of 'F': found 1999, expected 2000: one per row"),
        (None, "column 'F': found no stamps, expected stamps"),
    ],
)
def test_log_channel_with_incompatible_clock_is_named_in_error(stamps, reason):
    rows = PERIOD * np.arange(ROWS)
    columns = {"position_desired": rows, "force_measured": rows}
    with pytest.raises(InputError) as caught:
        named = {"position_desired": "xd", "force_measured": "F"}
        resample_to_rows("a", columns, {"position_desired": rows, "force_measured": stamps}, named, PERIOD)
    assert str(caught.value).startswith("a: ") and reason in str(caught.value)


def test_log_channel_that_holds_its_value_is_not_interpolated():
    rows = PERIOD * np.arange(ROWS)
    columns = {"position_desired": rows, "contact_index": np.repeat([0.0, 3.0], ROWS // 2)}
    columns["mode"] = np.array(["free"] * (ROWS // 2) + ["contact"] * (ROWS // 2), object)
    clocks = {"position_desired": rows, "contact_index": rows - 4e-4, "mode": rows + 3e-4}
    result, _, _ = resample_to_rows("a", columns, clocks, {name: name for name in columns}, PERIOD)
    assert set(result["contact_index"]) == {0.0, 3.0} and set(result["mode"]) == {"free", "contact"}


def separate(late, rows=580):
    """Write a log whose force has separate time stamps and another number of rows."""
    log = touches(1)
    force = {"tF": 1e3 * (log["t"][:rows] + late), "F": log["F"][:rows]}
    return log, {"tx": 1e3 * log["t"], **{name: log[name] for name in ("xd", "xm", "vd", "Fc")}}, force


TIMES = {
    "time": {"column": "x/tx", "unit": "ms"},
    "force_measured": {"column": "f/F", "time": "f/tF"},
    **{name: f"x/{column}" for name, column in CHANNELS.items() if name not in ("time", "force_measured")},
}


@pytest.mark.parametrize("late", [0.005, -0.012])
def test_log_channel_is_aligned_by_time_stamps_named_in_mapping_file(tmp_path, late):
    h5py = pytest.importorskip("h5py")
    log, *groups = separate(late)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for group, columns in zip("xf", groups, strict=True):
            for name, values in columns.items():
                file[f"{group}/{name}"] = values
    campaign = read(tmp_path / "a.h5", **TIMES)
    (run,) = campaign.runs
    shift, first = round(1e3 * late), np.flatnonzero(log["xd"] == run.position_desired[0])[0]
    np.testing.assert_array_equal(run.force_measured, log["F"][first - shift : first - shift + len(run.tick)])
    assert f"which begin {abs(shift)} ms" in campaign.notes[0]
    # Different numbers of rows cannot be aligned by row number.
    with pytest.raises(InputError, match="found columns of different lengths"):
        read(tmp_path / "a.h5", **TIMES | {"force_measured": "f/F"})
    with pytest.raises(InputError, match=r"channels.force_measured.time is given"):
        read(tmp_path / "a.h5", **TIMES, timing={"clock": "index"})


def test_time_stamps_of_a_log_channel_require_time_stamps_of_rows():
    with pytest.raises(InputError, match=r"channels.force_measured.time: found 'tF', expected none"):
        mapping(time={"rate": 1000.0}, force_measured={"column": "F", "time": "tF"})


def test_text_log_channel_of_same_length_is_aligned_by_own_time_stamps(tmp_path):
    log = touches(1)
    path = write_csv(tmp_path / "a.csv", log | {"tF": log["t"] + 0.003})
    (run,) = read(path, force_measured={"column": "F", "time": "tF"}).runs
    np.testing.assert_array_equal(run.force_measured, log["F"][:-3])
    np.testing.assert_array_equal(run.position_desired, log["xd"][3:])


@pytest.mark.parametrize(("unit", "late"), [(1.0, 0.005), (1e3, 0.005), (1.0, 1e-4)])
def test_time_stamps_of_channel_group_that_differ_from_row_stamps_are_rejected(tmp_path, unit, late):
    h5py, log = pytest.importorskip("h5py"), touches(1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x/time"], file["f/time"], file["f/count"] = log["t"], unit * (log["t"] + late), 2.0 * log["t"]
        for name in ("xd", "xm", "vd", "Fc"):
            file[f"x/{name}"] = log[name]
        file["f/F"] = log["F"]
    columns = TIMES | {"time": "x/time", "force_measured": "f/F"}
    with pytest.raises(
        InputError, match=r"'f/F': found separate time stamps in 'f/time' that differ from 'x/time'"
    ):
        read(tmp_path / "a.h5", **columns)
    if unit == 1.0:
        assert read(
            tmp_path / "a.h5", **columns | {"force_measured": {"column": "f/F", "time": "f/time"}}
        ).notes
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["f/time"][:] = unit * log["t"]
    (run,) = read(tmp_path / "a.h5", **columns).runs
    np.testing.assert_array_equal(run.force_measured, log["F"])


HOSTILE = st.one_of(
    st.floats(),
    st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, -1e300, 5e-324]),
)


@settings(deadline=None, max_examples=60)
@given(
    place=st.integers(0, 299),
    value=HOSTILE,
    count=st.integers(0, 300),
    rate=st.sampled_from([1e-9, 1e-4, 1e-3, 1.4e-3, 1e9]),
    whose=st.sampled_from(["position_desired", "force_measured"]),
)
def test_log_channel_with_any_clock_is_aligned_or_rejected_with_one_line_message(
    place, value, count, rate, whose
):
    rows = {"position_desired": PERIOD * np.arange(300), "force_measured": rate * np.arange(count)}
    if len(rows[whose]):
        rows[whose][place % len(rows[whose])] = value
    columns = {name: np.zeros(len(one)) for name, one in rows.items()}
    try:
        result, times, _ = resample_to_rows("a", columns, rows, {name: name for name in rows}, PERIOD)
    except InputError as error:
        assert str(error).isprintable() and str(error).startswith("a: ")
        return
    assert all(len(one) == len(times) and np.all(np.isfinite(one)) for one in result.values())
