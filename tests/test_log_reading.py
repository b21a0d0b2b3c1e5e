"""Log files: text dialects and Parquet give the same campaign; one-line errors."""

import hashlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from log_cases import CHANNELS, MASS, PERIOD, mapping, read, sway, touches, write_csv
from pyarrow import parquet

import jaxhil
from jaxhil.errors import InputError
from jaxhil.mechanism.file import load
from tuning.identification.logs.campaign import read_campaign

LOG = touches(2)


def same(one, other):
    assert len(one.runs) == len(other.runs)
    for a, b in zip(one.runs, other.runs, strict=True):
        for name in ("tick", "position_desired", "position_measured", "force_measured", "force_command"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_log_file_is_read_back_with_the_written_values(tmp_path):
    path = write_csv(tmp_path / "a.csv", LOG)
    result = read(path)
    assert [(run.kind, run.source, set(run.contact_index)) for run in result.runs] == [
        ("contact", "a.csv", {0}),
        ("contact", "a.csv", {1}),
    ]
    for channel, column in CHANNELS.items():
        if channel != "time":
            whole = np.concatenate([getattr(run, channel) for run in result.runs])
            np.testing.assert_array_equal(whole, LOG[column])
    np.testing.assert_array_equal(np.concatenate([run.tick for run in result.runs]), np.arange(1200))
    for run in result.runs:
        assert run.valid.all() and run.time_stamp_error < 1e-12
        assert run.speed == pytest.approx(5e-3, rel=1e-3)
        # The log is divided midway between the contacts.
        touched = np.flatnonzero(run.force_command)
        assert 100 < touched[0] and touched[-1] < len(run.tick) - 100
    assert result.equivalent_mass == MASS and result.timing.control_period == PERIOD
    assert result.sources == {"a.csv": hashlib.sha256(path.read_bytes()).hexdigest()}
    assert result.notes == ()
    # The last entry of a prior's list repeats.
    (one, two) = read_campaign([path], mapping(), load("rig-300kg").mechanism).runs
    assert set(one.contact_index) == set(two.contact_index) == {0}


def test_text_log_dialects_and_parquet_give_the_same_campaign(tmp_path):
    plain = read(write_csv(tmp_path / "a.csv", LOG))
    same(plain, read(write_csv(tmp_path / "b.txt", LOG, delimiter="\t")))
    head = "Logger 3.1\nstarted 06/29/2022, 04:05\n"
    same(plain, read(write_csv(tmp_path / "c.dat", LOG, head=head), text={"skip_rows": 2}))
    german = write_csv(tmp_path / "d.csv", LOG, delimiter=";")
    german.write_bytes(b"\xef\xbb\xbf" + german.read_bytes().replace(b".", b",").replace(b"\n", b"\r\n"))
    same(plain, read(german, text={"decimal": ","}))
    bare = write_csv(tmp_path / "e.csv", LOG)
    bare.write_text(bare.read_text().partition("\n")[2])
    same(plain, read(bare, **{name: str(index + 1) for index, name in enumerate(CHANNELS)}))
    more = LOG | {"note": np.array(["x"] * 1200), "xd2": LOG["xd"]}
    parquet.write_table(
        pa.table(more | {"t": pa.array(LOG["t"] * 1e3).cast(pa.float64())}), tmp_path / "f.parquet"
    )
    same(plain, read(tmp_path / "f.parquet", time={"column": "t", "unit": "ms"}))
    stamps = pa.array((1.7e18 + LOG["t"] * 1e9).astype(np.int64)).cast(pa.timestamp("ns"))
    parquet.write_table(pa.table(more | {"t": stamps}), tmp_path / "g.parquet")
    same(plain, read(tmp_path / "g.parquet"))
    named = write_csv(
        tmp_path / "h.csv", LOG | {"t": np.array([f"06/29/2022 04:05:{s:09.6f} PM" for s in LOG["t"]])}
    )
    named.write_text(named.read_text().replace("'", ""))
    same(plain, read(named, time={"column": "t", "time_format": "%m/%d/%Y %I:%M:%S.%f %p"}))


def test_log_units_signs_and_offsets_are_applied(tmp_path):
    shown = LOG | {"xd": -1e3 * LOG["xd"] - 7.0, "F": LOG["F"] / 4.4482216152605 * 10}
    path = write_csv(tmp_path / "a.csv", shown)
    result = read(
        path,
        position_desired={"column": "xd", "unit": "mm", "sign": -1, "offset": 7.0},
        force_measured={"column": "F", "unit": "lbf", "scale": 0.1},
    )
    x = np.concatenate([run.position_desired for run in result.runs])
    force = np.concatenate([run.force_measured for run in result.runs])
    np.testing.assert_allclose(x, LOG["xd"], atol=1e-17)
    np.testing.assert_allclose(force, LOG["F"], rtol=1e-14, atol=1e-14)


def test_log_is_divided_into_runs_by_times_by_mode_column_or_by_index_column(tmp_path):
    path = write_csv(
        tmp_path / "a.csv", LOG | {"state": np.repeat([0, 7], 600), "touch": np.repeat([4, 2], 600)}
    )
    by_mode = read(path, mode={"column": "state", "values": {"0": "contact", "7": "contact"}})
    assert [run.kind for run in by_mode.runs] == ["contact", "contact"]
    pair = read(
        path, mode={"column": "state", "values": {"0": "contact", "7": "free"}}, contact_index="touch"
    ).runs
    assert [(run.kind, len(run.tick), run.tick[0]) for run in pair] == [
        ("contact", 600, 0),
        ("free", 600, 600),
    ]
    assert set(pair[0].contact_index) == {4}
    with pytest.raises(InputError, match=r"a.csv: row 601: mode: found '7', expected one of 0, free, press"):
        read(path, mode={"column": "state", "values": {"0": "contact"}})


def test_logged_contact_with_lost_rows_is_a_single_contact(tmp_path):
    log = touches(2)
    deep = int(np.argmax(log["F"][:600]))
    cut = {name: np.delete(one, slice(deep - 8, deep + 8)) for name, one in log.items()}
    runs = read(write_csv(tmp_path / "a.csv", cut)).runs
    assert [int(run.contact_index[0]) for run in runs] == [0, 0, 1]
    assert runs[1].tick[0] - runs[0].tick[-1] == 17


def test_log_of_simulated_run_is_read_back_as_simulated(tmp_path):
    mechanism = load("varying").mechanism
    run = jaxhil.simulate(mechanism)
    run.to_csv(tmp_path / "run.csv")
    result = read_campaign([tmp_path / "run.csv"], prior=mechanism)
    assert [list(set(one.contact_index)) for one in result.runs] == [[0], [1], [2]]
    assert (result.equivalent_mass, result.timing.command_hold) == (350.0, "linear")
    for one, contact in zip(result.runs, run.contacts, strict=True):
        assert one.speed == pytest.approx(contact.approach_velocity, rel=1e-9)
        np.testing.assert_array_equal(
            one.position_desired, run.position_desired[run.contact == one.contact_index[0]]
        )


def edit(path: Path, row: int, cell: int, text: str) -> Path:
    lines = path.read_text().split("\n")
    cells = lines[row].split(",")
    cells[cell] = text
    lines[row] = ",".join(cells)
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize(
    ("row", "cell", "text", "reason"),
    [
        (30, 1, "nan", "row 30: position_desired: found nan, expected a finite number"),
        (30, 1, "inf", "row 30: position_desired: found inf"),
        (30, 0, "nan", "row 30: time: found nan"),
        (30, 1, "", "row 30: position_desired: found nan"),
        (30, 1, "12,5", "Row #31: Expected 6 columns, got 7"),
        (30, 1, "abc", "Row #31: CSV conversion error to double: invalid value 'abc'"),
        (1, 1, "abc", "column 'xd': found 'abc', expected numbers"),
        (30, 0, "0.001", "row 30: time: found 0.001 s after 0.028 s, expected an increasing time"),
        (30, 0, "0.028", "row 30: time: found 0.028 s after 0.028 s"),
        (0, 1, "xdd", "found no column with this name, expected t, xdd, xm, F, vd, Fc (did you mean xdd?)"),
        (0, 2, "xd", "column 'xd': found 2 columns, expected one"),
    ],
)  # fmt: skip
def test_unusable_cells_of_log_files_are_rejected(tmp_path, row, cell, text, reason):
    path = edit(write_csv(tmp_path / "a.csv", LOG), row, cell, text)
    with pytest.raises(InputError) as caught:
        read(path)
    assert reason in str(caught.value) and str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()


def test_unusable_log_files_are_rejected(tmp_path):
    short = {name: one[:100] for name, one in LOG.items()}
    cases = {
        "none.csv": "found no such file",
        "folder": "found a name that ends in ''",
        "a.docx": "found a name that ends in '.docx', expected .csv",
        "empty.csv": "found no line of column names",
        "names.csv": "found 0 rows, expected at least 200",
        "short.csv": "found 100 rows, expected at least 200",
        "torn.parquet": "cannot be read",
        "torn.csv": "cannot be read",
    }
    (tmp_path / "folder").mkdir()
    (tmp_path / "a.docx").touch()
    (tmp_path / "empty.csv").touch()
    (tmp_path / "names.csv").write_text(",".join(LOG) + "\n")
    write_csv(tmp_path / "short.csv", short)
    (tmp_path / "torn.parquet").write_bytes(b"PAR1 and then nothing")
    (tmp_path / "torn.csv").write_bytes(b"t,xd,xm,F,vd,Fc\n" + bytes(range(256)) * 4)
    for name, reason in cases.items():
        with pytest.raises(InputError) as caught:
            read(tmp_path / name)
        assert reason in str(caught.value) and name in str(caught.value) and str(caught.value).isprintable()
    with pytest.raises(InputError, match="logs: found none"):
        read_campaign([])


def test_logged_contact_requires_force_and_free_run_requires_no_force(tmp_path):
    path = write_csv(tmp_path / "a.csv", sway())
    (run,) = read(path, "free").runs
    assert run.force_measured is None and run.contact_index is None and run.kind == "free"
    with pytest.raises(InputError, match="force_measured: found no such channel"):
        read(path)


def test_log_without_contact_is_omitted_if_other_logs_have_contacts(tmp_path):
    weak = touches(1)
    weak["F"] = 0.3 * np.random.default_rng(0).standard_normal(len(weak["F"]))
    weak["Fc"] = 0.0 * weak["F"]
    paths = [write_csv(tmp_path / "a.csv", LOG), write_csv(tmp_path / "b.csv", weak)]
    campaign = read_campaign(paths, mapping(force_command=None))
    assert [run.source for run in campaign.runs] == ["a.csv", "a.csv"]
    assert campaign.notes == (f"{paths[1]}: 600 rows without contact are omitted",)
    with pytest.raises(InputError, match=r"b\.csv: found no run in 600 rows, expected at least 50 success"):
        read_campaign(paths[1:], mapping(force_command=None))
