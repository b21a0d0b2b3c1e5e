"""Invariance of six-axis contact to interface frames and to exchange of target and chaser.

Cases: a probe in a drogue and a ball on a plane, off-centre and oblique, with friction. First the bodies are
exchanged, so that the drogue belongs to the chaser; then the frames T and C are moved and rotated on their
bodies.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from six_axes import FULL, lanes, place, plain_body, spheres, springs

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.sixdof.bodies import build_body, build_state, kinetic_energy
from jaxhil.sixdof.candidates import TargetSpheres
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.friction import Regularised
from jaxhil.sixdof.ideal_contact_integration import (
    IdealContactModel,
    error_speed,
    integrate_until,
    start_integration,
)
from jaxhil.sixdof.relative import Pair, States
from jaxhil.sixdof.rotations import exponential, identity, rotate, rotate_back
from jaxhil.sixdof.shapes import Drogue, Plane
from jaxhil.sixdof.vectors import components

pytestmark = pytest.mark.slow
BATCH, DURATION = (1,), 0.4
ONE = jnp.ones((1, 1))
RUBBING = Regularised(0.2 * ONE, 2e-3 * ONE)
LAW = springs(3e6 * ONE, 1.5 * ONE, 1.5 * ONE)


def bodies():
    return Pair(
        plain_body(1800.0, FULL[0], (0.05, -0.02, 1.2), BATCH),
        plain_body(420.0, FULL[1], (0.01, 0.04, -1.0), BATCH),
    )


def start(pair):
    """Return the states of both bodies, independent of their interface frames."""
    target = build_state(
        pair.target, place([0, 0, 0], BATCH), place([0, 0, 0], BATCH), identity(jnp.ones(1)),
        place([1e-3, 2e-3, -1e-3], BATCH),
    )  # fmt: skip
    turned = exponential(place([0.02, 0.03, -0.01], BATCH))
    apart = place([0.03, -0.025, 0.014], BATCH)
    at = pair.target.interface + apart - rotate(turned, pair.chaser.interface)
    moving = place([1e-3, -2e-3, -0.025], BATCH), place([3e-3, -2e-3, 1e-3], BATCH)
    return States(target, build_state(pair.chaser, at, moving[0], turned, moving[1]))


def collide(pair, states, group):
    """Return the states of the bodies after the contact, and the lost energy."""
    contact_model, time, longest = (
        IdealContactModel(pair, (group,), ()),
        lanes(DURATION, BATCH),
        lanes(1e-3, BATCH),
    )

    @jax.jit
    def flown(contact_model, states):
        return integrate_until(
            contact_model,
            start_integration(contact_model, states, longest),
            time,
            longest,
            error_speed(contact_model, states),
        ).states

    end = flown(contact_model, states)
    energies = [sum(kinetic_energy(*one) for one in zip(pair, now, strict=True)) for now in (states, end)]
    return end, energies[0] - energies[1]


def close(result, expected, before):
    """Check that results agree to 1e-9 of the change during the contact, which must not be zero."""
    for one, other, begun in zip(result, expected, before, strict=True):
        for name in ("velocity", "spin", "position"):
            a, b, c = (np.asarray(components(getattr(state, name))) for state in (one, other, begun))
            changed = np.max(np.abs(b - c))
            assert changed > 1e-3 or name == "position"
            np.testing.assert_allclose(a, b, atol=1e-9 * max(changed, 0.01), rtol=0)


def test_six_axis_contact_is_invariant_to_frames_and_exchange_of_bodies():
    pair, points = bodies(), place([[0.0], [0.0], [0.0]], BATCH)
    before = start(pair)
    drogue = Drogue(0.75 * ONE, 0.04 * ONE, 0 * ONE)
    probe = jnp.zeros((3, 1, 1))
    expected, lost = collide(pair, before, spheres(probe, 0.02 * ONE, drogue, "hunt_crossley", LAW, RUBBING))
    assert float(lost[0]) > 0.01
    swapped = Pair(pair.chaser, pair.target)
    contact = ContactGroup(
        TargetSpheres(points, 0.02 * ONE, drogue), CONTACT_LAWS["hunt_crossley"], LAW, RUBBING
    )
    result, other = collide(swapped, States(before.chaser, before.target), contact)
    close(result[::-1], expected, before)
    np.testing.assert_allclose(other, lost, rtol=1e-8)
    close(*contact_in_moved_frames(pair, before), before)


def contact_in_moved_frames(pair, before):
    """Return a ball's contact with an oblique plane, with original and with moved frames."""
    normal, centre = place([[0.2], [-0.1], [0.97]], BATCH), place([[0.1], [0.2], [0.05]], BATCH)
    normal = (1 / np.sqrt(0.2**2 + 0.1**2 + 0.97**2)) * normal
    on_it, radius = place([[0.0], [0.0], [0.052]], BATCH), 0.02 * ONE

    def result(pair, centre, on_it, normal):
        shape = Plane(on_it, normal)
        group = spheres(components(centre), radius, shape, "hunt_crossley", LAW, RUBBING)
        return collide(pair, before, group)[0]

    expected = result(pair, centre, on_it, normal)
    moves = [((0.3, -0.1, 0.2), (0.4, 0.2, -0.7)), ((-0.2, 0.1, 0.15), (-0.3, 0.5, 0.1))]
    turned, frames = [], []
    for body, (by, turn) in zip(pair, moves, strict=True):
        attitude, offset = exponential(place(turn, BATCH)), place(by, BATCH)
        turned.append(build_body(body.mass, body.inertia, body.interface + offset, attitude))
        frames.append((place(np.array(by)[:, None], BATCH), jax.tree.map(lambda leaf: leaf[None], attitude)))
    (target, to_target), (chaser, to_chaser) = frames
    moved_result = result(
        Pair(*turned), rotate_back(to_chaser, centre - chaser), rotate_back(to_target, on_it - target),
        rotate_back(to_target, normal),
    )  # fmt: skip
    return moved_result, expected
