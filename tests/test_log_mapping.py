"""Mapping files of logs: allowed content, and error messages."""

import copy

import pytest

from jaxhil.errors import InputError
from jaxhil.mechanism.file import load
from tuning.identification.logs.campaign import read_campaign
from tuning.identification.logs.mapping import get_si_conversion, load_mapping, parse_mapping

FULL = {
    "schema": "jaxhil/log/1",
    "channels": {
        "time": {"column": "Time", "unit": "ms"},
        "position_desired": {"column": "cmd", "unit": "mm", "sign": -1, "offset": 2},
        "position_measured": {"column": "pos", "unit": "counts", "scale": 1e-6},
        "force_measured": {"column": "Fz", "unit": "lbf"},
        "force_command": "Fc",
        "mode": {"column": "state", "values": {"3": "contact"}},
    },
    "timing": {
        "control_period": 0.001,
        "command_hold": "zoh",
        "command_latency": 1,
        "row": "sent",
        "clock": "index",
    },
    "bodies": {"chaser_mass": 700.0, "target_mass": 700.0},
    "text": {"skip_rows": 7, "delimiter": ";", "decimal": ","},
    "runs": [
        {"files": "free_*.csv", "kind": "free", "begin": 1.0, "end": 61.0},
        {"files": ["day1/*.mf4"], "kind": "contact"},
    ],
}


def changed(path, value):
    raw = copy.deepcopy(FULL)
    node = raw
    *way, last = path
    for part in way:
        node = node[part]
    if value is None:
        del node[last]
    else:
        node[last] = value
    return raw


def test_mapping_applies_scale_unit_offset_and_sign_to_logged_numbers():
    channels = parse_mapping(FULL, "map").channels
    assert get_si_conversion(channels.position_desired, "position_desired") == (-1e-3, -2e-3)
    assert get_si_conversion(channels.position_measured, "position_measured") == (1e-6, 0.0)
    assert get_si_conversion(channels.force_measured, "force_measured") == (4.4482216152605, 0.0)
    assert get_si_conversion(channels.force_command, "force_command") == (1.0, 0.0)


def test_mapping_file_is_equivalent_to_mapping_dictionary(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text("""
        schema = "jaxhil/log/1"
        [channels]
        rate = 500.0
        position_desired = "a"
        position_measured = { column = "b", unit = "um" }
        [[runs]]
        files = "*.csv"
        kind = "rest"
    """)
    result = load_mapping(path)
    assert result.channels.time.rate == 500.0 and result.channels.time.column is None
    assert result.runs[0].files == ["*.csv"] and result.timing.row == "tick"
    assert result.runs[0].names(tmp_path / "x.csv") and not result.runs[0].names(tmp_path / "x.mf4")
    assert parse_mapping(FULL, "map").runs[1].names(tmp_path / "day1" / "x.mf4")
    with pytest.raises(InputError, match=r"none.toml: found no such file, expected a mapping file"):
        load_mapping(tmp_path / "none.toml")
    path.write_text("schema = ")
    with pytest.raises(InputError, match="not valid TOML"):
        load_mapping(path)


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        (("schema",), "jaxhil/mechanism/1", "schema: found 'jaxhil/mechanism/1', expected jaxhil/log/1"),
        (("channels", "position_desire"), "x", "position_desire: found an unknown key, expected one of"),
        (("channels", "position_desired"), None, "channels.position_desired: found nothing"),
        (("channels", "time"), {}, "channels.time: found neither, expected either a column"),
        (("channels", "time"), {"column": "t", "rate": 1.0}, "channels.time: found both"),
        (("channels", "time", "unit"), "mm", "time.unit: found 'mm', expected one of s, ms, us, ns"),
        (("channels", "force_measured", "unit"), "mm", "found 'mm', expected one of N, kN, mN, lbf, counts"),
        (("channels", "position_desired", "unit"), "mmm", "did you mean mm"),
        (("channels", "position_measured", "scale"), None, "scale: found none, expected the value of"),
        (("channels", "position_desired", "sign"), 0, "sign: found 0, expected 1 or -1"),
        (("channels", "position_desired", "sign"), 2, "sign: found 2, expected an integer from -1 to 1"),
        (("channels", "position_desired", "scale"), 0, "scale: found 0.0"),
        (("channels", "position_desired", "offset"), float("inf"), "offset: found inf"),
        (("channels", "mode", "values"), {"3": "docking"}, "values.3: found 'docking', expected one of"),
        (("timing", "row"), "next", "timing.row: found 'next', expected one of after, sent, tick"),
        (("timing", "control_period"), 0, "control_period: found 0"),
        (("bodies", "equivalent_mass"), 3.0, "bodies: found chaser_mass and equivalent_mass and target_mass"),
        (("text", "delimiter"), ";;", "delimiter: found ';;'"),
        (("runs",), [], "runs: found a list of 0 entries"),
        (("runs", 0, "kind"), "fre", "runs[0].kind: found 'fre', expected one of contact, free"),
        (("runs", 0, "end"), 0.5, "runs[0].end: found 0.5, expected a number > begin, 1 s"),
        (("runs", 0, "files"), [], "runs[0].files: found a list of 0 entries"),
        (("channels",), "x", "channels: found 'x', expected a table"),
        (("channels", "time"), [1], "channels.time: found [1], expected a table"),
        (("runs",), ["x"], "runs[0]: found 'x', expected a table"),
    ],
)  # fmt: skip
def test_unusable_mapping_is_rejected(path, value, reason):
    with pytest.raises(InputError) as caught:
        parse_mapping(changed(path, value), "map.toml")
    assert str(caught.value).startswith("map.toml: ") and reason in str(caught.value)
    assert str(caught.value).isprintable()


def test_value_missing_from_both_mapping_and_prior_is_named_in_error(tmp_path):
    log = tmp_path / "free_1.csv"
    log.touch()
    cases = [
        (changed(("bodies",), None), "bodies.equivalent_mass: found nothing"),
        (changed(("timing",), None), "timing.control_period: found nothing"),
        (
            changed(("channels", "time"), {"rate": 999.0}),
            "channels.time.rate: found 999 Hz, expected 1 / control_period",
        ),
    ]
    for raw, reason in cases:
        with pytest.raises(InputError, match=reason):
            read_campaign([log], parse_mapping(raw, "map"))
    prior = load("varying").mechanism
    bare = {key: one for key, one in FULL.items() if key not in ("bodies", "timing", "text")}
    with pytest.raises(InputError, match=r"free_1.csv: found no line of column names"):
        read_campaign([log], parse_mapping(bare, "map"), prior)
    with pytest.raises(
        InputError,
        match=r"x.csv: found a name that no \[\[runs\]\] entry matches, expected 'free_\*.csv', 'day1",
    ):
        read_campaign([tmp_path / "x.csv"], parse_mapping(FULL, "map"))
