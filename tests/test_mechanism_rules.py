"""Rules for combinations of mechanism keys: contact laws, models, start of a run, transfer functions."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanism_table import (
    FIRST_ORDER,
    IDEAL,
    LAYERED,
    OF_OTHERS,
    THIRD_ORDER,
    TRANSFER_FUNCTION,
    changed,
    refusal,
)

from jaxhil.errors import InputError
from jaxhil.mechanism.file import from_plain_data, load, to_plain_data
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.rules import is_hurwitz

HARDENING = {"contact.law": "hardening", "contact.reference_depth": 2e-4}
DEPTH_DAMPED = {"contact.law": "depth_damped", "contact.reference_depth": 2e-4}
ELASTOPLASTIC = {
    "contact.law": "elastoplastic",
    "contact.unloading_ratio": 1.0,
    "contact.damping": [0.0, 0.0],
}


@pytest.mark.parametrize("contact", [HARDENING, DEPTH_DAMPED, ELASTOPLASTIC], ids=lambda c: c["contact.law"])
def test_contact_law_requires_its_keys_and_checks_their_ranges(contact):
    name, key = contact["contact.law"], list(contact)[1]
    drawn = {"uncertainty": {key: {"distribution": "uniform", "factor": [1.0, 1.5]}}}
    mechanism = from_plain_data(changed({**contact, **drawn}), "f")
    assert value_at(mechanism, key) == contact[key]
    message = refusal(changed({k: value for k, value in contact.items() if k != key}))
    assert f": {key}: found nothing, expected a number >" in message and f"(law {name} needs it)" in message
    for value in (0.99 if "ratio" in key else 0.0, math.inf, "1", [1.0]):
        assert f": {key}: found " in refusal(changed({**contact, key: value}))
    message = refusal(changed({key: contact[key]}))
    assert f": {key}: found {contact[key]}, expected nothing (only for law " in message and name in message
    others = ["contact.reference_depth", "contact.unloading_ratio"]
    other = others[key == others[0]]
    assert f": {other}: found 2.0, expected nothing" in refusal(changed({**contact, other: 2.0}))
    low = {key: {"distribution": "uniform", "low": 0.0, "high": 2.0}}
    assert f': uncertainty."{key}": found a draw of 0' in refusal(changed({**contact, "uncertainty": low}))


@pytest.mark.parametrize(
    "law", [{"contact.law": "kelvin_voigt"}, {"contact.law": "hardening", "contact.reference_depth": 2e-4}]
)
def test_damping_ratio_gives_damping_of_each_contact(law):
    stiffness = [1e5, 4e5, 9e5]
    raw = changed(
        {**law, "contact.stiffness": stiffness, "contact.damping": 0, "contact.damping_ratio": [0.1, 0.2]}
    )
    mechanism = from_plain_data(raw, "f")
    critical = [2 * math.sqrt(k * mechanism.bodies.mass) for k in stiffness]
    np.testing.assert_allclose(
        mechanism.contact.damping, [0.1 * critical[0], 0.2 * critical[1], 0.2 * critical[2]]
    )
    # The file of results contains the damping itself.
    assert "damping_ratio" not in to_plain_data(mechanism)["contact"]
    repeated = from_plain_data(changed({**law, "contact.damping": 0, "contact.damping_ratio": 0.05}), "f")
    assert len(repeated.contact.damping) == len(repeated.contact.stiffness)


def test_damping_ratio_is_rejected_if_negative_ambiguous_or_unsupported_by_contact_law():
    ratio = {"contact.damping": 0, "contact.damping_ratio": 0.1}
    for change, reason in (
        (
            {"contact.law": "linear"},
            "contact.damping_ratio: found [0.1], expected nothing (only for law kelvin_voigt",
        ),
        (
            {"contact.law": "kelvin_voigt", "contact.damping": 3.0},
            "found [0.1] and damping, expected either",
        ),
        (
            {"contact.law": "kelvin_voigt", "contact.damping_ratio": -0.1},
            "damping_ratio[0]: found -0.1, expected",
        ),
        (
            {"contact.law": "kelvin_voigt", "bodies": {"chaser_mass": 3.0}},
            "bodies.target_mass: found nothing",
        ),
        (
            {"contact.law": "kelvin_voigt", "contact.stiffness": [[1e5]]},
            "contact.stiffness[0]: found [100000.0]",
        ),
    ):
        assert reason in refusal(changed({**ratio, **change}))


@pytest.mark.parametrize("path", OF_OTHERS)
def test_mechanism_keys_of_other_contact_laws_and_simulator_models_are_rejected(path):
    message = refusal(changed({path: OF_OTHERS[path]}))
    assert f": {path}: found {OF_OTHERS[path]}, expected nothing (" in message
    uncertain = {path: {"distribution": "uniform", "factor": [0.5, 1.5]}}
    assert f': uncertainty."{path}": found ' in refusal(changed({"uncertainty": uncertain}))


def test_all_keys_that_another_law_and_model_do_not_use_are_rejected_at_once():
    changes = ["contact.law=hardening", "contact.exponent=2.0", "rig.simulator.model=moving_average"]
    keys = "contact.exponent", "contact.reference_depth", "damping_ratio", "natural_frequency", "window"
    with pytest.raises(InputError) as caught:
        load("varying", changes)
    lines = str(caught.value).splitlines()
    for line, key in zip(lines, keys, strict=True):
        assert f"{key}: found " in line
    assert lines[3].endswith("(moving_average does not use it: unset it, also in [uncertainty])")


def test_keys_that_contact_law_does_not_use_may_only_have_default_value():
    for law in (HARDENING, LAYERED):
        assert from_plain_data(changed({**law, "contact.exponent": 1.5, "contact.tension": False}), "f")
        for key, value, only in (
            ("contact.exponent", 1.4, "hunt_crossley or depth_damped"),
            ("contact.tension", True, "kelvin_voigt"),
        ):
            message = refusal(changed({**law, key: value}))
            assert f": {key}: found {str(value).lower()}, expected nothing (only for law {only})" in message
    drawn = {"contact.exponent": {"distribution": "uniform", "low": 1.0, "high": 2.0}}
    assert '"contact.exponent": found a key only for law hunt' in refusal(changed({"uncertainty": drawn}))


def test_preloaded_contact_law_rejects_damping():
    message = refusal(changed({"contact.law": "preloaded", "contact.damping": [3.0]}))
    assert ": contact.damping: found [3.0], expected 0 (law preloaded dissipates by friction)" in message


def test_elastoplastic_contact_law_rejects_damping():
    message = refusal(changed({**ELASTOPLASTIC, "contact.damping": [0.0, 3.0]}))
    assert ": contact.damping: found [0.0, 3.0], expected 0 (law elastoplastic" in message
    drawn = {"contact.damping": {"distribution": "uniform", "low": 0.0, "high": 2.0}}
    assert "found an uncertain damping" in refusal(changed({**ELASTOPLASTIC, "uncertainty": drawn}))


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"bodies.chaser_mass": 1.0}, "bodies.equivalent_mass"),
        ({"bodies": {"chaser_mass": 1.0}}, "bodies.target_mass"),
        ({"bodies": {"target_mass": 1.0}}, "bodies.chaser_mass"),
        ({"bodies": {"chaser_mass": 1e101, "target_mass": 1e101}}, "bodies.chaser_mass"),
        ({"contact.stiffness": [1e5, [1e5]]}, "contact.stiffness[1]"),
        ({**LAYERED, "contact.stiffness": [1e5]}, "contact.stiffness[0]"),
        ({**LAYERED, "contact.stiffness": [[1e5, 2e5]]}, "contact.stiffness[0]"),
        ({**LAYERED, "contact.depths": []}, "contact.depths"),
        ({**LAYERED, "contact.stiffness": [[1e5, 0.0, 1.0]]}, "contact.stiffness[0][1]"),
        ({"contact.clearance": 1e-4}, "contact.clearance"),
        ({**FIRST_ORDER, "rig.simulator.time_constant": 0.0}, "rig.simulator.time_constant"),
        ({**THIRD_ORDER, "rig.simulator.coefficients": [0.1, 0.1, 0.011]}, "rig.simulator.coefficients"),
        ({**IDEAL, "rig.simulator.model": "third_order"}, "rig.simulator.coefficients"),
        ({"rig.simulator.coefficients": [0.1, 0.1]}, "rig.simulator.coefficients"),
        (IDEAL, "rig.command_hold"),
    ],
)
def test_mechanism_keys_that_contradict_each_other_are_rejected(changes, key):
    assert f": {key}: found" in refusal(changed(changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"bodies": {"chaser_mass": 300, "target_mass": 1000}},
        LAYERED,
        FIRST_ORDER,
        THIRD_ORDER,
        TRANSFER_FUNCTION,
        {**IDEAL, "contact.damping": 0.0},
        {**IDEAL, "contact.law": "linear"},
        {**IDEAL, "rig.command_hold": "linear"},
    ],
)
def test_mechanism_of_every_contact_law_and_simulator_survives_json_round_trip(changes):
    mechanism = from_plain_data(changed(changes), "f")
    assert from_plain_data(to_plain_data(mechanism), "f") == mechanism


@pytest.mark.parametrize(
    ("changes", "lag"),
    [
        ({**IDEAL, "contact.damping": 0.0}, 0.0),
        (FIRST_ORDER, 0.01),
        # The draws go down to 10 Hz.
        ({}, 2 * 0.8 / (2 * math.pi * 10.0)),
        (THIRD_ORDER, 0.1),
        (
            {
                **TRANSFER_FUNCTION,
                "rig.simulator.numerator": [0.3, 2.0],
                "rig.simulator.denominator": [1e-3, 0.5, 2.0],
            },
            0.25 - 0.15,
        ),
    ],
)
def test_clearance_too_small_for_starting_positions_is_rejected(changes, lag):
    # Distances: free approach, contact phase, command latency, transport delay and lag of x_a.
    start = 0.005 * (0.02 + 0.001 + 0.001 + 0.004 + lag)
    changes = changes | {"rig.contact_plane": ...}
    assert from_plain_data(changed(changes | {"contact.clearance": start * (1 + 1e-9)}), "f")
    message = refusal(changed(changes | {"contact.clearance": start * (1 - 1e-9)}))
    assert ": contact.clearance: found " in message and f"expected a clearance > {start:g}" in message


def test_velocity_limit_below_the_approach_speed_is_rejected():
    path = "rig.simulator.velocity_limit"
    speed = value_at(from_plain_data(changed({}), "f"), "approach.velocity")
    expected = f"expected a number >= {speed:g} m/s, the approach speed"
    assert from_plain_data(changed({path: speed}), "f")
    assert f": {path}: found {0.99 * speed!r}, {expected}" in refusal(changed({path: 0.99 * speed}))
    for drawn in (
        {"approach.velocity": {"distribution": "uniform", "low": speed, "high": 1.01 * speed}},
        {path: {"distribution": "loguniform", "factor": [0.99, 1.5]}},
    ):
        assert f": {path}: found " in refusal(changed({path: speed, "uncertainty": drawn}))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_contact_plane_beyond_starting_position_is_rejected(side):
    # Distances: free approach, contact phase, command latency, transport delay and lag of x_a.
    plane = side * (0.02 - 0.99 * 0.005 * (0.026 + 2 * 0.8 / (2 * math.pi * 10.0)))
    changes = {"contact.clearance": 0.02}
    assert from_plain_data(changed(changes | {"rig.contact_plane": 0.99 * plane}), "f")
    message = refusal(changed(changes | {"rig.contact_plane": plane}))
    assert ": rig.contact_plane: found " in message
    assert "expected a number > -0.0197427 and < 0.0197427 m, the clearance minus" in message
    assert from_plain_data(changed({"contact.clearance": math.inf, "rig.contact_plane": plane}), "f")


@pytest.mark.parametrize(
    ("numerator", "denominator", "key"),
    [
        ([1.0, 1.0], [1.0, 1.0], "numerator"),
        ([1.0], [1.0], "numerator"),
        ([1.0 + 2e-9], [1.0, 1.0], "numerator"),
        ([0.0], [1.0, 1.0], "numerator"),
        ([-1.0], [1.0, -1.0], "denominator"),
        ([1.0], [1.0, 0.0, 1.0], "denominator"),
        ([1.0], [1.0, 1.0, 0.0], "denominator"),
        ([1.0], [1.0, 1.0, 1.0, 1.0], "denominator"),
        ([1.0], [1e100, 1e-100, 1e100, 1.0], "denominator"),
        ([1.0 + 5e-10], [1.0, 1.0], None),
        ([0.0, 0.0, 2.0], [0.0, 1.0, 3.0, 2.0], None),
        ([-1.0], [-1.0, -1.0], None),
        ([1.0, 1.0], np.poly(-np.ones(20)).tolist(), None),
    ],
)
def test_key_of_unusable_transfer_function_is_named_in_error(numerator, denominator, key):
    # The contact has a single surface, because some of these lags exceed any gap.
    changes = {**TRANSFER_FUNCTION, "contact.clearance": ...}
    changes |= {"rig.simulator.numerator": numerator, "rig.simulator.denominator": denominator}
    raw = changed(changes)
    if key:
        assert f": rig.simulator.{key}: found" in refusal(raw)
    else:
        simulator = from_plain_data(raw, "f").rig.simulator
        assert simulator.numerator == list(np.trim_zeros(numerator, "f"))
        assert simulator.denominator == list(np.trim_zeros(denominator, "f"))


@settings(deadline=None)
@given(
    st.lists(st.complex_numbers(min_magnitude=0.01, max_magnitude=100.0), max_size=3),
    st.lists(st.floats(-100.0, 100.0), max_size=3),
)
def test_hurwitz_criterion_agrees_with_roots(pairs, reals):
    roots = [*pairs, *np.conj(pairs), *reals]
    rightmost = max((root.real for root in map(complex, roots)), default=-1.0)
    polynomial = np.real(np.poly(roots)) if roots else np.ones(1)
    # Rounding of the coefficients may move roots across the imaginary axis.
    if abs(rightmost) > 1e-2:
        assert is_hurwitz(polynomial.tolist()) == (rightmost < 0.0)
        assert is_hurwitz((-polynomial).tolist()) == (rightmost < 0.0)
