"""Gain file of a six-axis rig: invalid and changed files are rejected with one line."""

import functools
import json
import math
from itertools import groupby
from operator import itemgetter

import pytest
from gain_documents import sign
from hypothesis import given, settings
from hypothesis import strategies as st
from six_axis_documents import LIMITS, six_axis_document
from six_axis_flights import fly
from test_runtime_gain_files import JSON_VALUES, paths, value_at

from jaxhil.rig.six_axes import Controller6, GainFileError


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda d: d.pop("constants"), "constants: found nothing"),
        (lambda d: d.update(axes=1), "axes: found 1, expected 6"),
        (lambda d: d["constants"].pop("mass_matrix"), "constants.mass_matrix: found nothing"),
        (lambda d: d["constants"]["mass_matrix"].pop(), "6 rows of 6 numbers"),
        (lambda d: d["constants"]["mass_matrix"][0].__setitem__(0, math.inf), "JSON"),
        (lambda d: d["constants"]["inverse_mass"][2].__setitem__(2, 0.01), "the inverse of"),
        (lambda d: d["constants"]["mass_matrix"][0].__setitem__(1, 1.0), "positive definite"),
        (lambda d: d["constants"]["mass_matrix"][3].__setitem__(3, -9.0), "positive definite"),
        (lambda d: d["constants"].update(mass_matrix=[[1.0] * 6] * 6), "positive definite"),
        (lambda d: d["constants"]["mass_matrix"][4].append(0.0), "6 rows of 6 numbers"),
        (lambda d: d["constants"].update(mass_matrix="M"), "6 rows of 6 numbers"),
        (lambda d: d["constants"]["mass_matrix"][4].__setitem__(0, [1.0]), "a finite number"),
        (lambda d: d["constants"]["tool_correction"][2].__setitem__(2, -1.0), "tool_correction"),
        (lambda d: d["constants"]["tool_correction"][0].__setitem__(5, 1.0), "tool_correction"),
        (lambda d: d["constants"].update(more=1), "an extra key 'more'"),
        (lambda d: d["constants"].update(longest_delay=5.0), "constants.longest_delay"),
        (lambda d: d["constants"].update(sensor_sign=0.5), "constants.sensor_sign"),
        (lambda d: d["constants"]["tool_load"].pop(), "constants.tool_load"),
        (lambda d: d["limits"].update(stroke={"value": 1.0, "unit": "m"}), "an unknown limit"),
        (lambda d: d["limits"]["force_range"].update(unit="N m"), "limits.force_range.unit"),
        (lambda d: d["limits"]["command_lowest_x"].update(value=0.41), "is not below"),
        (lambda d: d["gains"]["velocity_gain"].update(value=1e9, upper=1e9), "gains.velocity_gain"),
        (lambda d: d.update(compensator="smith_predictor"), "compensator"),
    ],
)
def test_invalid_six_axis_gain_file_is_rejected(change, message):
    document = six_axis_document(limits=LIMITS)
    change(document)
    try:
        document = sign(document)
    except ValueError:
        pass
    with pytest.raises(GainFileError, match=message) as error:
        Controller6.from_dict(document)
    assert "\n" not in str(error.value)


@functools.cache
def paths_by_part():
    """Return the paths of a gain file's entries, by the first key."""
    return {
        part: list(group) for part, group in groupby(paths(six_axis_document(limits=LIMITS)), itemgetter(0))
    }


PARTS = "constants", "gains", "limits", "axes", "control_period", "compensator"


CHANGES = JSON_VALUES | st.sampled_from((-1.0, 0.0, 1 - 1e-6, 1.5, 1e9, 1e300))


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(PARTS), st.integers(0), CHANGES, st.sampled_from(("replace", "scale", "remove")))
def test_changed_six_axis_gain_file_loads_or_is_rejected_with_one_line(part, index, value, change):
    """Change or remove one entry, sign the file again, and run the controller if the file loads."""
    document, choices = six_axis_document(limits=LIMITS), paths_by_part()[part]
    *path, key = choices[index % len(choices)]
    container = value_at(document, path)
    if change == "remove":
        del container[key]
    elif change == "scale" and isinstance(container[key], float) and isinstance(value, float):
        container[key] *= value
    else:
        container[key] = value
    try:
        rig = Controller6.from_dict(sign(document))
    except GainFileError as error:
        assert str(error).isprintable() and len(str(error)) < 1500
    except ValueError:
        assert not is_json(document)  # `sign` cannot express the value in JSON
    else:
        for pose in fly(rig, 20, wrench=[50.0, 0.0, 200.0, 1.0, 0.0, 0.0]):
            assert all(map(math.isfinite, pose))


def is_json(document):
    """Return whether JSON can express the document."""
    try:
        json.dumps(document, allow_nan=False)
    except ValueError:
        return False
    return True


def test_six_axis_gain_file_with_changed_digit_in_constants_is_rejected():
    document = six_axis_document()
    document["constants"]["mass_matrix"][0][0] *= 1 + 1e-15
    with pytest.raises(GainFileError, match="sha256"):
        Controller6.from_dict(document)


def test_six_axis_gain_file_with_delay_longer_than_delay_line_is_rejected():
    document = six_axis_document(identification_delay=0.52)
    document["gains"]["identification_delay"]["upper"] = 1.0
    with pytest.raises(GainFileError, match="periods"):
        Controller6.from_dict(sign(document))
