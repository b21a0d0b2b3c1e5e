"""Six-axis mechanism files: their content, and one-line error messages."""

import copy
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxhil.errors import InputError
from jaxhil.mechanism.file import (
    any_from_plain_data,
    builtin_path,
    load,
    load_any,
    six_axis_names,
    to_plain_data,
)
from jaxhil.mechanism.six_axes import numeric_keys_of
from jaxhil.mechanism.toml_table import parse_toml
from jaxhil.mechanism.uncertainty import PHASE_KEY, draw

RAW = {name: parse_toml(builtin_path(name).read_bytes(), name, "") for name in six_axis_names()}
BODY = {"position": [0, 0, 0], "attitude": [1, 0, 0, 0], "velocity": [0, 0, 0], "angular_velocity": [0, 0, 0]}


def refusal(*overrides, name="probe-drogue", unset=()):
    arguments = overrides[0] if len(overrides) == 1 and isinstance(overrides[0], dict) else overrides
    with pytest.raises(InputError) as caught:
        load_any(name, arguments, unset)
    message = str(caught.value)
    assert all(line.isprintable() and line.startswith(f"{name}: ") for line in message.splitlines())
    return message


@pytest.mark.parametrize("name", RAW)
def test_six_axis_builtins_are_read_and_state_their_sources(name):
    mechanism = load_any(name).mechanism
    assert mechanism.name == name and mechanism.uncertainty
    assert "assumed" in mechanism.source
    text = json.dumps(to_plain_data(mechanism), allow_nan=False)
    assert any_from_plain_data(json.loads(text), name) == mechanism


def test_one_or_two_numbers_set_the_values_of_all_six_axes():
    simulator = load_any("probe-drogue").mechanism.rig.simulator
    assert simulator.damping_ratio == [0.8] * 6
    assert simulator.natural_frequency == [14.0] * 3 + [11.0] * 3
    changes = {"rig.simulator.natural_frequency.rotation": 9.0, "rig.simulator.delay[5]": 0.0}
    changes["rig.force_sensor.noise_std"] = {"force": 0.5, "torque": 0.05}
    changes["rig.force_sensor.crosstalk"] = 0.01
    rig = load_any("probe-drogue", changes).mechanism.rig
    assert rig.simulator.natural_frequency == [14.0] * 3 + [9.0] * 3
    assert rig.simulator.delay == [4e-3, 4e-3, 3e-3, 5.3e-3, 5.3e-3, 0.0]
    assert rig.force_sensor.noise_std == [0.5] * 3 + [0.05] * 3
    assert rig.force_sensor.crosstalk == [[0.01] * 6] * 6


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("schema=jaxhil/mechanism/3", "schema: found 'jaxhil/mechanism/3', expected"),
        ("schema=jaxhil/mechanism/1", "found 'jaxhil/mechanism/1' with the tables target and chaser"),
        ("target.inertia=[0, 0, 0]", "only zeros, expected positive principal moments"),
        ("target.inertia=[1, 1, 3]", "principal moments 1, 1 and 3 kg m^2, expected moments of a rigid body"),
        ("target.inertia=[1, 1, -1]", "principal moment of -1 kg m^2, expected positive"),
        ("target.inertia=[1, 1, 1e-7]", "moments from 1e-07 to 1 kg m^2, expected moments of at "
                                        "least"),
        ("target.inertia=[[1, 2, 0], [1, 2, 0], [0, 0, 2]]", "2 at row 1, column 2, and 1 at the"),
        ("target.inertia=[[1, 0, 0], 2, 3]", "three moments, or three rows"),
        ("chaser.interface=[0, 0, 1.0]", "expected a centre beyond C, at positive z"),
        ("target.interface_rotation=[3, 0, 0]", "target.interface: found a centre of mass at z = 1.18"),
        ("target.interface_rotation=[4, 0, 0]", "a rotation by 4 rad, expected a rotation vector shorter"),
        ("approach.attitude=[1, 1, 0]", "a rotation by 1.414 rad, expected a rotation vector of at most 1"),
        ("approach.velocity[2]=0.01", "approach.velocity[2]: found 0.01, expected a number < 0 m/s"),
        ("contact={}", "contact: found nothing, expected [contact.NAME]"),
        ("contact={law='linear', stiffness=1}", "a table without a name: law, stiffness, expected tables ["),
        ("contact.tip.target.half_angle=45", "found 45, expected a number > 0 rad and < 1.5708 rad"),
        ("contact.tip.target={shape='plane', point=[0, 0, 0]}",
         "normal: found nothing, expected a list of 3 entries, each a finite number (plane needs it)"),
        ("contact.tip.friction={law='regularised', coefficient=1}",
         "slip: found nothing, expected a number > 0 m/s (regularised needs it)"),
        ("contact.tip.stifness=1", "an unknown key, expected one of chaser, target"),
        ("contact.tip.stifness=1", "did you mean stiffness?"),
        ("contact.tip.stiffness=[1, 2]", "[1.0, 2.0], expected a number > 0 N/m (law hunt_crossley)"),
        ("contact.tip.law=hardening", "reference_depth: found nothing, expected a number > 0"),
        ("contact.tip.depths=[1]", "depths: found [1.0], expected nothing (only for law piecewise_linear)"),
        ("contact.tip.friction.law=bristle", "slip: found 0.0025, expected nothing (bristle"),
        ("contact.tip.chaser.radius=0.05", "0.05, expected a number < 0.04 m, the radius of the shape"),
        ("contact.tip.chaser.radius=0", "expected a number > 0 m, because a drogue with mouth_radius"),
        ("contact.tip.chaser.from=[0, 0, 0]", "expected nothing (sphere does not use it: unset it)"),
        ("contact.tip.chaser.shape=drogue", "centre: found [0.0, 0.0, 0.0], expected nothing (drogue"),
        ("contact.tip.target.mouth_radius=0.02", "expected a number > 0.0292"),
        ("contact.tip.target_pattern.phase=1", "expected nothing, or pattern = { count = N } as well"),
        ("rig.simulator.delay=[1, 2]", "a list of 2 entries, expected a list of 6 entries"),
        ("rig.simulator.delay=2.0", "rig.simulator.delay[0]: found 2.0, expected a number from 0 to 1 s"),
        ("rig.simulator.model=ideal", "damping_ratio: found [0.8, 0.8,"),
        ("rig.force_sensor.side=fixed", "tool: found a table, expected nothing (a fixed sensor"),
        ("rig.force_sensor.tool.inertia=[1, 1, 3]", "tool.inertia: found principal moments 1, 1 and 3"),
        ("rig.force_sensor.crosstalk=[[0,1,0,0,0,0],[1,0,0,0,0,0],[0,0,0,0,0,0],[0,0,0,0,0,0],"
         "[0,0,0,0,0,0],[0,0,0,0,0,0]]", "crosstalk: found channels that are nearly identical"),
        ("rig.velocity_limit=1", "rig.velocity_limit: found an unknown key"),
        ('uncertainty."contact.tip.stifness"={distribution="normal",std=1}', "did you mean contact.tip"),
        ('uncertainty."target.inertia"={distribution="normal",std=1,independent=true}', "are not symmetric"),
        ('uncertainty."approach.velocity"={distribution="uniform",low=-0.1,high=0.1,independent=true}',
         "a z component of up to 0.1 m/s, expected only draws < 0 m/s"),
    ],
)  # fmt: skip
def test_unusable_six_axis_values_are_named_in_error(override, reason):
    assert reason in refusal(override)


SPRING = np.eye(6).tolist()
NO_SPRING = (-np.eye(6)).tolist()
LEGS = "hydraulic-hexapod"


@pytest.mark.parametrize(
    ("name", "changes", "reason"),
    [
        ("ring-capture", {"latch.hooks.depth": None}, "found nothing, expected a number >= 0 m, or latched"),
        ("ring-capture", {"latch.hooks.latched": True}, "latched: found true, expected false, because an"),
        ("ring-capture", {"latch.hooks.stiffness": None}, "stiffness: found nothing, expected six numbers"),
        ("ring-capture", {"latch.hooks.stiffness_matrix": SPRING}, "stiffness_matrix as well, expected"),
        ("ring-capture",
         {"latch.hooks.stiffness": None, "latch.hooks.stiffness_matrix": NO_SPRING,
          "uncertainty": {}}, "or has an eigenvalue below 0, expected the matrix of a spring"),
        ("ring-capture", {"latch.hooks.angel": 0.1}, "an unknown key, expected one of chaser, pattern"),
        ("ring-capture", {"latch.hooks.pattern.count": 0}, "count: found 0, expected an integer from 1"),
        ("ring-capture", {"latch": {"a b": {"chaser": [0, 0, 0]}}}, 'latch."a b": found the name'),
        (LEGS, {"rig.simulator.height": None}, 'height: found nothing, expected a value (space = "stewart" '
                                               'needs'),
        (LEGS, {"rig.simulator.base": [[0, 0, 0]]}, "base: found a list of 1 entry, expected a list of 6"),
        (LEGS, {"rig.simulator.base[2]": [0, 0]}, "base[2]: found a list of 2 entries, expected a list of 3"),
        (LEGS, {"rig.simulator.stroke": [2, 1]}, "stroke: found [2.0, 1.0], expected [shortest, "),
        (LEGS, {"rig.simulator.delay": {"translation": 1e-3, "rotation": 2e-3}}, "list of six numbers"),
        (LEGS, {"rig.simulator.space": "task"}, '(space = "task" does not use it)'),
        (LEGS, {"rig.simulator.space": "two_robots", "rig.simulator.target_robot.share": 0.5},
         'base: found [[1.58, 0.255, 0.0]'),
        ("claw-two-arms", {"rig.simulator.target_robot": None}, "target_robot: found nothing, expected"),
        ("claw-two-arms", {"rig.simulator.target_robot.share": 1.5}, "share[0]: found 1.5, expected a "
                                                                     "number"),
        ("claw-two-arms", {"rig.simulator.target_robot.time_constant": 0.1}, "(model second_order does not"),
        ("claw-two-arms", {"rig.simulator.space": "tasks"}, "expected one of stewart, task, two_robots"),
    ],
)  # fmt: skip
def test_unusable_six_axis_latches_and_simulators_are_named_in_error(name, changes, reason):
    assert reason in refusal(changes, name=name)


def test_six_axis_contact_shapes_that_cannot_touch_are_rejected():
    capsule = {"shape": "capsule", "from": [0, 0, 0], "to": [0, 0, 1], "radius": 0.1}
    raw = copy.deepcopy(RAW["probe-drogue"])
    raw["contact"]["tip"]["chaser"] = capsule
    with pytest.raises(InputError, match="found drogue against the chaser's capsule, expected a sphere on"):
        any_from_plain_data(raw, "f")
    raw["contact"]["tip"]["target"] = {**capsule, "to": [0, 0, 0]}
    with pytest.raises(InputError, match=r"contact\.tip\.target\.to: found the same point as from"):
        any_from_plain_data(raw, "f")
    raw["contact"]["tip"]["target"] = capsule
    assert any_from_plain_data(raw, "f")


def test_six_axis_start_table_and_approach_table_are_mutually_exclusive():
    start = {"start.target": BODY, "start.chaser": {**BODY, "position": [0, 0, 3]}}
    with pytest.raises(InputError, match=r"start: found \[approach\] as well, expected either \[start\] or"):
        load_any("probe-drogue", start)
    mechanism = load_any(
        "probe-drogue", {**start, "approach": None, "contact": {}, "uncertainty": {}}
    ).mechanism
    assert mechanism.start.duration is None and PHASE_KEY not in draw(mechanism, 1, 0)
    assert "approach: found nothing, expected [approach], or [start]" in refusal(unset=["approach"])
    start["start.chaser"]["attitude"] = [1, 0.1, 0, 0]
    with pytest.raises(InputError, match=r"attitude: found a quaternion of norm 1\.0049876, expected"):
        load_any("probe-drogue", {**start, "approach": None})


def test_six_axis_start_table_in_the_guide_is_read():
    text = (Path(__file__).parents[1] / "notebooks" / "guide" / "six_axes.md").read_text(encoding="utf-8")
    shown = re.search(r"^```toml\n(\[start\].*?)^```", text, re.M | re.S)
    assert shown is not None
    changes = {"approach": None, "start": parse_toml(shown[1].encode(), "guide", "")["start"]}
    start = load_any("probe-drogue", changes).mechanism.start
    assert start.duration == 1.2 and start.chaser.position == [0.06, -0.05, 2.21]


def test_all_six_axis_values_including_lists_and_inertias_may_be_uncertain():
    entry = {"distribution": "uniform", "factor": [0.9, 1.1]}
    mechanism = load_any("petals").mechanism
    uncertain = {
        path: entry
        for path in ("target.inertia", "contact.edge_left.chaser.from", "contact.rings.friction.stiffness")
    }
    assert set(uncertain) < set(numeric_keys_of(mechanism))
    independent = {"distribution": "normal", "std": 0.01, "independent": True}
    uncertain["rig.force_sensor.crosstalk"] = independent
    drawn = draw(load_any("petals", {"uncertainty": uncertain}).mechanism, 64, 1)
    assert drawn["target.inertia"].shape == (64, 3) and drawn["rig.force_sensor.crosstalk"].shape == (
        64,
        6,
        6,
    )
    share = drawn["contact.edge_left.chaser.from"] / np.array([0.527, -0.286, 1.0])
    np.testing.assert_allclose(share[:, 0], share[:, 1])
    assert np.all(drawn["contact.edge_left.chaser.from"][:, 2] == 0)
    assert np.all((drawn[PHASE_KEY] >= 0) & (drawn[PHASE_KEY] <= 1)) and drawn[PHASE_KEY].shape == (64,)
    assert 0.008 < np.std(drawn["rig.force_sensor.crosstalk"]) < 0.012


def test_one_axis_commands_reject_six_axis_mechanism_files():
    with pytest.raises(
        InputError, match=r"^petals: schema: found jaxhil/mechanism/2 \(six axes\), expected jaxhil"
    ):
        load("petals")


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda one: st.lists(one, max_size=7) | st.dictionaries(st.text(max_size=8), one, max_size=3),
    max_leaves=8,
)


def places(node, path=()):
    """Yield the path of every value in a raw table."""
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in entries:
        yield (*path, key)
        yield from places(value, (*path, key))


PLACES = [(name, path) for name, raw in RAW.items() for path in places(raw)]


@settings(deadline=None, max_examples=40)
@given(place=st.sampled_from(PLACES), junk=JUNK, sibling=st.sampled_from(PLACES))
def test_any_six_axis_mechanism_table_is_read_or_rejected_with_one_line_message(place, junk, sibling):
    """Replace one value by a value of any type, or by a value from elsewhere in the files."""
    name, path = place
    for value in (junk, value_at(RAW[sibling[0]], sibling[1])):
        raw = copy.deepcopy(RAW[name])
        value_at(raw, path[:-1])[path[-1]] = value
        try:
            mechanism = any_from_plain_data(raw, "f")
        except InputError as error:
            assert str(error).isprintable() and ": found " in str(error) and ", expected " in str(error)
        else:
            assert any_from_plain_data(to_plain_data(mechanism), "f") == mechanism


def value_at(node, path):
    for part in path:
        node = node[part]
    return node
