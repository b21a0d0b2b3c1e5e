"""Nominal motion tick by tick: several compensators, and the ideal contact."""

import math

import numpy as np
import pytest

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.simulation.motion_curves import compute_nominal_motion

MECHANISM = load("varying", ["approach.contacts=2", "contact.damping=[0.0]"]).mechanism
GAINS = literature_gains(MECHANISM, "response_error")
LAWS = {
    "before": ("none", {}),
    "literature": ("response_error", GAINS),
    "tuned": ("response_error", GAINS | {"response_error": 0.5}),
    "again": ("none", {}),
}


@pytest.fixture(scope="module")
def segments():
    return compute_nominal_motion(MECHANISM, LAWS)


@pytest.mark.slow
def test_nominal_motion_of_several_compensators_equals_separate_simulations(segments):
    assert [list(piece.curves) for piece in segments] == [["ideal", *LAWS]] * 2
    for name in ("before", "literature", "tuned"):
        for piece, alone in zip(segments, compute_nominal_motion(MECHANISM, {name: LAWS[name]}), strict=True):
            np.testing.assert_allclose(
                piece.curves[name].position, alone.curves[name].position, rtol=1e-9, atol=1e-12
            )
    first = segments[0].curves
    np.testing.assert_array_equal(first["before"].force, first["again"].force)
    assert np.max(first["before"].force) != pytest.approx(np.max(first["literature"].force), rel=0.01)


def test_nominal_ideal_contact_motion_matches_closed_form(segments):
    stiffness, mass = MECHANISM.contact.stiffness[0], MECHANISM.bodies.mass
    space, velocity = segments[0].curves["ideal"], MECHANISM.approach.velocity
    assert np.max(space.force) == pytest.approx(velocity * math.sqrt(stiffness * mass), rel=1e-3)
    assert np.max(space.position) == pytest.approx(velocity * math.sqrt(mass / stiffness), rel=1e-3)
    assert space.velocity == velocity
