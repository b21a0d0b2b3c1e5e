"""Log files of rigs and their tools: each is read with its drafted mapping, or rejected with one line."""

# Each case is one line.
# ruff: noqa: E501

import importlib.util
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_cases import PERIOD, read, write_csv
from log_files import FILES, LOG, fast, merged, text

from jaxhil.errors import InputError
from tuning.__main__ import main
from tuning.identification.logs.campaign import read_campaign
from tuning.identification.logs.column_names import find_unit, match_channel
from tuning.identification.logs.mapping import TextFormat, load_mapping
from tuning.identification.logs.mapping_draft import draft_mapping
from tuning.identification.logs.row_rate import find_command_phase
from tuning.identification.logs.text_layout import detect_layout
from tuning.identification.logs.units import parse_unit

LIBRARIES = {
    ".mat": "pymatreader",
    ".h5": "h5py",
    ".mcap": "rosbags",
    ".mf4": "asammdf",
    ".mdf": "asammdf",
    ".tdms": "nptdms",
}
CHANNELS = {"position_desired": "xd", "position_measured": "xm", "force_measured": "F"}


def drafted(path, answers=(), text=TextFormat()):  # noqa: B008
    """Return the mapping that is drafted from a log, with the user's answers and the mass."""
    draft = draft_mapping([path], text).replace("# [bodies]", "[bodies]").replace("# equ", "equ")
    for channel, column in dict(answers).items():
        draft, count = re.subn(rf"# {channel} = .*which of:.*", f'{channel} = "{column}"', draft)
        assert count == 1, f"{channel} is not in question:\n{draft}"
    file = path.parent / "map.toml"
    file.write_text(draft)
    return load_mapping(file)


@pytest.mark.filterwarnings("ignore")  # warnings of other libraries
@pytest.mark.parametrize("name", FILES)
def test_log_file_is_read_with_the_mapping_drafted_from_it(tmp_path, name):
    case = FILES[name]
    library = LIBRARIES.get(Path(case.name).suffix)
    if library is not None:
        pytest.importorskip(library)
    path = tmp_path / case.name
    path = case.write(path) or path
    campaign = read_campaign([path], drafted(path, case.answers))
    (run,) = campaign.runs
    assert campaign.timing.control_period == PERIOD and run.kind == "contact"
    first = int(np.argmin(np.abs(LOG["xd"] - run.position_desired[0])))
    rows = slice(first, first + len(run.tick))
    assert len(run.tick) >= 598
    for channel, column in CHANNELS.items():
        np.testing.assert_allclose(getattr(run, channel), LOG[column][rows], rtol=0, atol=case.atol)


REFUSED = {
    "docx": ("a.docx", b"PK", "found a name that ends in '.docx', expected .csv, .tsv, .txt"),
    "nothing": ("a.lvm", b"", "found no line of column names"),
    "one column": ("a.dat", b"x\r\n" + b"1\r\n" * 300, "column 'xd': found no column with this name, expected x"),
    "names alone": ("a.out", b"t xd xm F vd Fc\n", "found 0 rows, expected at least 200"),
    "ragged": ("a.csv", b"t,xd,xm,F,vd,Fc\n" + b"1,2,3,4,5,6\n" * 300 + b"1,2,3\n", "Row #302: Expected 6 columns, got 3"),
    "text among numbers": ("a.csv", b"t,xd,xm,F,vd,Fc\n" + b"1,2,3,4,5,6\n" * 300 + b"1,2,x,4,5,6\n", "conversion error to double: invalid value 'x'"),
    "stamps in words": ("a.csv", b"t,xd,xm,F,vd,Fc\n" + b"noon,2,3,4,5,6\n" * 300, "row 1: time: found 'noon', expected numbers, texts in ISO 8601"),
    "one bad stamp": ("a.csv", b"t,xd,xm,F,vd,Fc\n" + b"2026-03-01T10:00:00Z,2,3,4,5,6\n" * 300 + b"2026-03-32T10:00:00Z,2,3,4,5,6\n", "row 301: time: found '2026-03-32T10:00:00Z'"),
    "half an UTF-16 file": ("a.txt", "t\txd".encode("utf-16")[:-1], "found no column with this name"),
    "mat": ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(200), "cannot be read"),
    "hdf5": ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(200), "cannot be read"),
    "bag": ("a.mcap", b"\x89MCAP0\r\n" + bytes(200), "cannot be read"),
    "mdf": ("a.mf4", b"MDF     4.10    " + bytes(200), "cannot be read"),
    "tdms": ("a.tdms", b"TDSm" + bytes(200), "cannot be read"),
    "parquet": ("a.parquet", b"PAR1" + bytes(200) + b"PAR1", "cannot be read"),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", REFUSED)
def test_log_file_that_cannot_be_used_is_rejected_with_one_line(tmp_path, name):
    file, content, reason = REFUSED[name]
    path = tmp_path / file
    if (library := LIBRARIES.get(path.suffix)) is not None:
        pytest.importorskip(library)
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ") and str(caught.value).isprintable()
    assert reason in str(caught.value)


SUFFIXES = [
    ".csv",
    ".dat",
    ".lvm",
    ".parquet",
    *(s for s, name in LIBRARIES.items() if importlib.util.find_spec(name)),
]
HEADS = {
    ".mat": b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM", ".h5": b"\x89HDF\r\n\x1a\n", ".mcap": b"\x89MCAP0\r\n",
    ".mf4": b"MDF     4.10    ", ".mdf": b"MDF     3.30    ", ".tdms": b"TDSm", ".parquet": b"PAR1",
}  # fmt: skip


def check_bytes(suffix, content):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        path.write_bytes(content)
        for use in (lambda: draft_mapping([path]), lambda: read(path)):
            try:
                use()
            except InputError as error:
                assert str(error).startswith(f"{path}: ") and str(error).isprintable()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("examples", [10, pytest.param(1000, marks=pytest.mark.slow)])
def test_log_file_of_any_bytes_is_read_or_rejected_with_one_line(examples):
    @settings(deadline=None, max_examples=examples)
    @given(st.sampled_from(SUFFIXES), st.booleans(), st.binary(max_size=400))
    def check(suffix, has_head, content):
        check_bytes(suffix, HEADS.get(suffix, b"t,xd,xm,F\n") * has_head + content)

    check()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("examples", [10, pytest.param(400, marks=pytest.mark.slow)])
def test_damaged_log_file_of_any_format_is_read_or_rejected_with_one_line(valid_files, examples):
    @settings(deadline=None, max_examples=examples)
    @given(st.data())
    def check(data):
        suffix, content = data.draw(st.sampled_from(valid_files))
        position = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            check_bytes(suffix, content[:position])
        else:
            changed = bytes([data.draw(st.integers(0, 255))])
            check_bytes(suffix, content[:position] + changed + content[position + 1 :])

    check()


@pytest.fixture(scope="module")
def valid_files(tmp_path_factory):
    """Return the suffix and the content of one file of each format."""
    folder, result = tmp_path_factory.mktemp("valid"), []
    for name in ("lvm", "utf-16", "several blanks", "structure with time", "HDF5 rows", "MDF units", "TDMS units", "JointState"):  # fmt: skip
        case = FILES[name]
        path = folder / case.name
        if path.suffix in SUFFIXES or path.suffix == ".txt":
            path = case.write(path) or path
            files = [path] if path.is_file() else list(path.glob("*.mcap"))
            result += [(file.suffix, file.read_bytes()) for file in files]
    return result


def test_draft_mapping_lists_candidate_columns_if_names_are_ambiguous(tmp_path):
    path = write_csv(tmp_path / "a.csv", {"a": LOG["t"], "b": LOG["xd"], "Fx": LOG["F"], "Fy": 2 * LOG["F"]})
    draft = draft_mapping([path])
    assert 'time = { column = "a", unit = "s" }  # by its values; rows are 0.001 s apart' in draft
    assert '# position_desired = { column = "" }  # which of: "b"' in draft
    assert '# force_measured = { column = "" }  # which of: "Fx", "Fy"' in draft
    (tmp_path / "map.toml").write_text(draft)
    with pytest.raises(InputError, match=r"channels.position_desired: found nothing, expected"):
        load_mapping(tmp_path / "map.toml")
    # A constant column is no candidate if another one moves.
    path = write_csv(tmp_path / "b.csv", LOG | {"Fz": LOG["F"], "F": 0 * LOG["F"]})
    assert 'force_measured = { column = "Fz" }' in draft_mapping([path])
    # A log with few or no rows also gives a draft.
    for rows in (0, 1, 3):
        path = write_csv(tmp_path / "c.csv", {name: column[:rows] for name, column in LOG.items()})
        assert 'position_desired = { column = "xd" }' in draft_mapping([path])


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("SetPos", "position_desired"), ("ActPos", "position_measured"), ("ACTPOS", "position_measured"),
        ("x_cmd", "position_desired"), ("x_act", "position_measured"), ("goal", "position_desired"),
        ("current", "position_measured"), ("current [A]", None), ("motor torque", None), ("x_err", None),
        ("vel_meas", None), ("velocity command", "velocity_desired"), ("F_cmd", "force_command"),
        ("Kraft / N", "force_measured"), ("Sensor A [kN]", "force_measured"), ("Tx", None), ("cmd_mode", None),
        ("/rig.effort.tool", "force_measured"), ("rig/SetPos/Out1", "position_desired"), ("state", "mode"),
    ],
)  # fmt: skip
def test_column_name_indicates_its_channel(name, channel):
    match = match_channel(name, find_unit(name))
    assert (match and match.channel) == channel


@pytest.mark.parametrize(
    ("text", "unit"),
    [("[mm]", "mm"), ("(µm)", "um"), ("\u03bcm", "um"), ("MM", "mm"), ("Newton", "N"), ("KN", "kN"), ("MN", None),
     ("Mm", None), ("mm/sec", "mm/s"), ("sec", "s"), ("V", None), ("", None), ("Micron", "um")],
)  # fmt: skip
def test_unit_stated_in_log_is_recognised_in_its_usual_spellings(text, unit):
    assert parse_unit(text) == unit


@settings(deadline=None, max_examples=30)
@given(
    st.floats(-6.0, 6.0), st.floats(0.5, 2.0), st.sampled_from([("x_cmd", "x_act"), ("x_cmd [mm]", "x_act")])
)
def test_drafted_positions_have_the_same_unit_if_their_strokes_are_similar(power, ratio, names):
    scale = 10.0**power
    with tempfile.TemporaryDirectory() as folder:
        columns = zip(("t", *names), (LOG["t"], scale * LOG["xd"], ratio * scale * LOG["xm"]), strict=True)
        draft = draft_mapping([write_csv(Path(folder) / "a.csv", dict(columns))])
    units = re.findall(r"^position_\w+ = \{ column = \"[^\"]*\"(?:, unit = \"(\w+)\")?", draft, re.MULTILINE)
    assert len(units) == 2 and units[0] == units[1], draft


def test_unit_stated_in_log_is_used_if_mapping_states_none(tmp_path):
    path = tmp_path / "a.csv"
    text("t,xd,xm,F", units="s,mm,mm,N", scale=1e3)(path)
    absent = {"velocity_desired": None, "force_command": None}
    (run,) = read(path, **absent).runs
    np.testing.assert_allclose(run.position_desired, LOG["xd"], atol=1e-15)
    campaign = read(path, **absent, position_desired={"column": "xd", "unit": "mm"}, force_measured={"column": "F", "unit": "kN", "scale": 1e-3})  # fmt: skip
    assert campaign.notes == (f"{path}: column 'F': read in kN, as the mapping states; the file states N",)


def test_draft_mapping_uses_text_table_of_mapping_file(tmp_path, capsys):
    lines = ["0;0;0;0", *(f"{t};{x};{m};{f}" for t, x, m, f in zip(*(LOG[n].tolist() for n in ("t", "xd", "xm", "F")), strict=True))]  # fmt: skip
    path = tmp_path / "contact.csv"
    path.write_text("\n".join(["first;line;of;words", "t;SetPos;ActPos;F", *lines]))
    (tmp_path / "map.toml").write_text('[text]\nskip_rows = 1\ndelimiter = ";"\n')
    assert main(["identify", "--guess", str(path), "--map", str(tmp_path / "map.toml")]) == 0
    draft = capsys.readouterr().out
    assert (
        '[text]\nskip_rows = 1\ndelimiter = ";"' in draft
        and 'position_desired = { column = "SetPos" }' in draft
    )
    (tmp_path / "map.toml").write_text("[text]\nskip_row = 1\n")
    assert main(["identify", "--guess", str(path), "--map", str(tmp_path / "map.toml")]) == 2
    assert "text.skip_row: found an unknown key" in capsys.readouterr().err


def test_text_log_layout_is_detected_only_if_not_specified():
    lines = ["a b c", "mm mm N", "1,5 2 3", "2,5 3 4"]
    assert detect_layout(lines, TextFormat())[:5] == (["a", "b", "c"], ["mm", "mm", "N"], " ", ",", 2)
    layout = detect_layout(lines, TextFormat(units_row=False, decimal=".", delimiter=" ", skip_rows=0))
    assert layout.skipped == 1 and layout.units == ["", "", ""] and layout.decimal == "."
    lines = ["a;b", "volt;volt", "1;2", "2;3"]
    assert detect_layout(lines, TextFormat()).skipped == 1
    assert detect_layout(lines, TextFormat(units_row=True)).skipped == 2
    assert detect_layout([], TextFormat()).names == []


@given(st.lists(st.text(st.characters(exclude_characters="\r\n"), max_size=30), max_size=12))
def test_text_log_layout_has_equal_numbers_of_names_units_and_texts(lines):
    layout = detect_layout(lines, TextFormat())
    assert len(layout.names) == len(layout.units) == len(layout.texts) and layout.skipped <= len(lines)


@pytest.mark.parametrize(("rows", "hold"), [(2, True), (2, False), (4, True), (5, False)])
def test_log_with_several_rows_per_period_is_read_at_the_ticks(tmp_path, rows, hold):
    path = tmp_path / "a.csv"
    fast("t,xd,xm,F", hold, rows)(path)
    absent = {"velocity_desired": None, "force_command": None}
    for timing in ({}, {"rows_per_period": rows}):
        campaign = read(path, **absent, timing=timing)
        (run,) = campaign.runs
        np.testing.assert_allclose(run.position_desired, LOG["xd"][: len(run.tick)], atol=1e-17)
        np.testing.assert_allclose(run.force_measured, LOG["F"][: len(run.tick)], atol=1e-12)
        assert (
            f"{rows} rows per control period, of which the row with the new command is used"
            in campaign.notes[0]
        )
    # The ticks are the rows with new commands, also if the log begins between ticks or has lost rows.
    lines = path.read_text().split("\n")
    path.write_text("\n".join([lines[0], *lines[2:300], *lines[301:]]))
    (run,) = read(path, **absent).runs
    np.testing.assert_allclose(run.position_desired[50:100], LOG["xd"][51:101], atol=1e-17)
    by_rate = {"rate": rows / PERIOD}
    path.write_text("\n".join(lines))
    (run,) = read(path, **absent, time=by_rate).runs
    np.testing.assert_allclose(run.position_desired, LOG["xd"][: len(run.tick)], atol=1e-17)
    with pytest.raises(InputError, match=r"found rows 0.000"):
        read(path, **absent, timing={"rows_per_period": 3})
    with pytest.raises(
        InputError, match=r"channels.time.rate: found .* Hz, expected 3 times 1 / control_period"
    ):
        read(path, **absent, time=by_rate, timing={"rows_per_period": 3})


def test_log_whose_commands_do_not_show_the_ticks_requires_rows_per_period(tmp_path):
    times = PERIOD / 2 * np.arange(1200)
    x = np.interp(times, LOG["t"], LOG["xd"]) + 1e-7 * np.random.default_rng(0).standard_normal(1200)
    columns = {"t": times, "xd": x, "xm": x, "F": np.interp(times, LOG["t"], LOG["F"])}
    path = write_csv(tmp_path / "a.csv", columns)
    absent = {"velocity_desired": None, "force_command": None}
    with pytest.raises(InputError, match=r"found rows 0.0005 s apart, expected the control period, 0.001 s"):
        read(path, **absent)
    campaign = read(path, **absent, timing={"rows_per_period": 2})
    assert "delays may be wrong by up to 0.5 ms" in campaign.notes[0]


@given(st.integers(2, 20), st.integers(0, 19), st.integers(0, 2**32 - 1), st.booleans())
def test_command_phase_is_phase_of_rows_with_new_commands(rows, phase, seed, hold):
    commands = np.cumsum(np.random.default_rng(seed).standard_normal(60))
    tick = np.arange(rows * 58) + rows
    periods = (tick - phase % rows) / rows
    x = commands[periods.astype(int)] if hold else np.interp(periods, np.arange(60), commands)
    assert find_command_phase(tick, x, rows) == phase % rows


@pytest.mark.parametrize("late", [0.0, 3e-4])
def test_log_topics_in_sparse_rows_are_read_at_their_own_times(tmp_path, late):
    path = tmp_path / "a.csv"
    names = {"time": "__time", "position_desired": "/cmd/position", "position_measured": "/drive/position/act",
             "force_measured": "/sensor/force", "velocity_desired": None, "force_command": None}  # fmt: skip
    merged(path, {"xd": 1, "xm": 1, "F": 1}, {"xd": 0.0, "xm": 1e-5, "F": late})
    (run,) = read(path, **names).runs
    first = int(np.argmin(np.abs(LOG["xd"] - run.position_desired[0])))
    np.testing.assert_array_equal(run.force_measured, LOG["F"][first : first + len(run.tick)])
    if late:
        np.testing.assert_allclose(run.force_late, late, atol=2e-6)
    # Topics with different rates: a faster topic is read, a slower topic is rejected.
    merged(path, {"xd": 1, "xm": 1, "F": 2}, {"xd": 0.0, "xm": 1e-5, "F": late})
    with pytest.raises(
        InputError, match=r"'/sensor/force': found readings 0.002 s apart, expected the control"
    ):
        read(path, **names)
    merged(path, {"xd": 2, "xm": 1, "F": 1}, {"xd": 0.0, "xm": 0.0, "F": late})
    (run,) = read(path, **names, timing={"control_period": 2 * PERIOD}).runs
    first = int(np.argmin(np.abs(LOG["xd"] - run.position_desired[0])))
    np.testing.assert_array_equal(run.position_desired, LOG["xd"][first : first + 2 * len(run.tick) : 2])
    np.testing.assert_array_equal(run.position_measured, LOG["xm"][first : first + 2 * len(run.tick) : 2])


def test_log_with_stroke_above_one_metre_is_read_with_a_warning(tmp_path):
    absent = {"force_measured": None, "velocity_desired": None, "force_command": None}
    times = PERIOD * np.arange(4000)
    x = 0.7 * np.sin(2 * np.pi * 0.4 * (times + 6 * PERIOD))
    slow = {"t": times, "xd": x, "xm": 0.7 * np.sin(2 * np.pi * 0.4 * times)}
    campaign = read(write_csv(tmp_path / "a.csv", slow), "free", **absent)
    assert "position_desired: a stroke of 1.4 m: is its unit right?" in campaign.notes[0]
    slow = {"t": times, "xd": 100 * x, "xm": 100 * slow["xm"]}
    with pytest.raises(
        InputError, match=r"position_desired: found a stroke of 140 m, expected 1e-05 to 20 m"
    ):
        read(write_csv(tmp_path / "b.csv", slow), "free", **absent)
    with pytest.raises(InputError, match=r"position_desired: found a stroke of 1.4 m, expected 1e-05 to 1 m"):
        read(tmp_path / "a.csv", "press", **absent)
