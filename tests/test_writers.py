"""Writers of gain files: independent readers return the same bits."""

import copy
import csv
import io
import json
import re
import struct

import pytest
from gain_documents import gain_document, sign
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scipy.io import loadmat

from jaxhil.errors import InputError
from jaxhil.rig import COMPENSATORS
from jaxhil.rig.limits import LIMITS
from tuning.bundle.writers import csv_files, gain_entries, limit_entries, matlab_files, ros2_files

FINITE = st.floats(allow_nan=False, allow_infinity=False)
AWKWARD = [5e-324, -0.0, 1e16, 1e22, 1e-5, 123456789012345680.0, 1.7976931348623157e308, 0.1 + 0.2]


def bits(value):
    assert type(value) is float
    return struct.pack("<d", value)


def document(values, limits):
    """Return a document whose gains have these values, without checking their bounds."""
    made = copy.deepcopy(gain_document("response_error"))
    for name, value in zip(made["gains"], values, strict=True):
        made["gains"][name]["value"] = value
    made["limits"] = {
        name: {"value": value, "unit": LIMITS[name].unit} for name, value in zip(LIMITS, limits, strict=False)
    }
    return sign(made)


documents = st.builds(
    document,
    st.lists(FINITE | st.sampled_from(AWKWARD), min_size=12, max_size=12),
    st.lists(st.none() | FINITE | st.sampled_from(AWKWARD), max_size=len(LIMITS)),
)
writer_test = settings(max_examples=25)


@writer_test
@given(documents)
def test_ros2_parameter_file_is_read_back_bit_for_bit(made):
    text = ros2_files(made)["ros2.yaml"].decode("ascii")
    tree = YAML(typ="safe", pure=True).load(text)
    assert list(tree) == ["/jaxhil_controller"] and list(tree["/jaxhil_controller"]) == ["ros__parameters"]
    result = tree["/jaxhil_controller"]["ros__parameters"]
    for section, entries in (("gains", gain_entries(made)), ("limits", limit_entries(made))):
        assert list(result.get(section, {})) == list(entries)
        for name, one in entries.items():
            assert bits(result[section][name]) == bits(one.value)
            assert result["units"][section][name] == one.unit
    assert bits(result["control_period"]) == bits(0.001)
    assert (result["compensator"], result["sha256"]) == ("response_error", made["sha256"])


@writer_test
@given(documents)
def test_ros2_parameter_numbers_are_doubles_and_texts_are_strings(made):
    """ROS 2's parser: a decimal point or .inf makes a double, quotes make a string."""
    sections = []
    for line in ros2_files(made)["ros2.yaml"].decode().splitlines()[3:]:
        indent, name, value = re.fullmatch(r"( +)([A-Za-z_][A-Za-z0-9_]*):(?: (\S.*))?", line).groups()
        sections[len(indent) // 2 - 2 :] = [name]
        if value is None:
            continue
        is_text = sections[0] in ("compensator", "mechanism", "sha256", "units")
        expected = r'"[^"]*"' if is_text else r"-?(\d+\.\d*([eE][-+]\d+)?|\.inf)"
        assert re.fullmatch(expected, value), line


def test_ros2_texts_that_look_like_numbers_stay_strings():
    made = gain_document("none")
    made["mechanism"]["name"] = "1e3"
    made["sha256"] = "1234e5"
    result = YAML(typ="safe", pure=True).load(ros2_files(made)["ros2.yaml"])["/jaxhil_controller"][
        "ros__parameters"
    ]
    assert (result["mechanism"], result["sha256"]) == ("1e3", "1234e5")
    # ROS 2 rejects an empty table.
    assert "gains" not in result and "limits" not in result


@writer_test
@given(documents)
def test_matlab_struct_is_read_back_bit_for_bit(made):
    files = matlab_files(made)
    assert files == matlab_files(made)
    result = loadmat(io.BytesIO(files["gains.mat"]), simplify_cells=True)["jaxhil"]
    for name, one in gain_entries(made).items():
        entry = result["gains"][name]
        for key in ("value", "lower", "upper"):
            assert bits(float(entry[key])) == bits(getattr(one, key))
        assert entry["unit"] == one.unit
    for name, one in limit_entries(made).items():
        assert bits(float(result["limits"][name]["value"])) == bits(one.value)
        assert result["limits"][name]["unit"] == one.unit
    assert (result["compensator"], result["sha256"]) == ("response_error", made["sha256"])
    assert result["control_period"] == 0.001


def mat_elements(content):
    """Yield (type, bytes) of the elements of MATLAB's level 5 format, from its published description."""
    offset = 0
    while offset < len(content):
        kind, size = struct.unpack_from("<II", content, offset)
        if kind >> 16:  # small element: size and type in one word
            yield kind & 0xFFFF, content[offset + 4 : offset + 4 + (kind >> 16)]
            offset += 8
        else:
            yield kind, content[offset + 8 : offset + 8 + size]
            offset += 8 + size + (-size % 8)


def mat_value(content):
    """Return the value of a matrix element: a struct of one element, a text, or a matrix of doubles."""
    parts = list(mat_elements(content))
    kind = parts[0][1][0]
    if kind == 2:
        width = struct.unpack("<i", parts[3][1])[0]
        names = [
            parts[4][1][i : i + width].split(b"\0")[0].decode() for i in range(0, len(parts[4][1]), width)
        ]
        return dict(zip(names, (mat_value(inner) for _, inner in parts[5:]), strict=True))
    if kind == 4:
        return parts[3][1].decode({4: "utf-16-le", 16: "utf-8", 2: "utf-8"}[parts[3][0]])
    assert (kind, parts[3][0] if parts[3][1] else 9) == (6, 9)
    return struct.unpack(f"<{len(parts[3][1]) // 8}d", parts[3][1])


def test_matlab_file_follows_published_description_of_the_format():
    made = document([*AWKWARD, 1.0, 2.0, 3.0, 4.0], [None, 2.5])
    content = matlab_files(made)["gains.mat"]
    assert content[124:128] == b"\x00\x01IM"
    ((kind, matrix),) = mat_elements(content[128:])
    result = mat_value(matrix)
    assert kind == 14
    assert list(result) == ["compensator", "control_period", "mechanism", "sha256", "gains", "limits"]
    for name, one in gain_entries(made).items():
        assert [bits(x) for x in result["gains"][name]["value"]] == [bits(one.value)]
        assert result["gains"][name]["unit"] == one.unit
    assert [one["value"] for one in result["limits"].values()] == [(1e6,), (2.5,)]


@writer_test
@given(documents)
def test_csv_gain_table_is_read_back_bit_for_bit(made):
    rows = list(csv.DictReader(io.StringIO(csv_files(made)["gains.csv"].decode("ascii"))))
    result = {row["name"]: row for row in rows}
    assert len(result) == len(rows)
    for name, one in gain_entries(made).items():
        for key in ("value", "lower", "upper"):
            assert bits(float(result[name][key])) == bits(getattr(one, key))
        assert result[name]["unit"] == one.unit
    for name, one in limit_entries(made).items():
        row = result[f"limits.{name}"]
        assert bits(float(row["value"])) == bits(one.value) and row["unit"] == one.unit
        assert row["lower"] == row["upper"] == ""
    assert bits(float(result["control_period"]["value"])) == bits(0.001)


@pytest.mark.parametrize("compensator", sorted(COMPENSATORS))
def test_gains_of_every_compensator_are_written_in_every_format(compensator):
    made = gain_document(compensator)
    text = ros2_files(made)["ros2.yaml"]
    result = YAML(typ="safe", pure=True).load(text)["/jaxhil_controller"]["ros__parameters"]
    values = {name: one["value"] for name, one in made["gains"].items()}
    assert result.get("gains", {}) == values
    mat = loadmat(io.BytesIO(matlab_files(made)["gains.mat"]), simplify_cells=True)["jaxhil"]
    assert {name: mat["gains"][name]["value"] for name in values} == values


def test_missing_limit_is_written_as_default_of_runtime():
    made = document([1.0] * 12, [None] * len(LIMITS))
    assert {name: one.value for name, one in limit_entries(made).items()} == {
        name: one.default for name, one in LIMITS.items()
    }


def test_gain_name_too_long_for_matlab_is_rejected():
    made = json.loads(json.dumps(gain_document("phase_lead")))
    made["gains"]["g" * 64] = made["gains"].pop("phase_lead")
    with pytest.raises(InputError, match="found 64 characters, expected at most 63"):
        matlab_files(made)
