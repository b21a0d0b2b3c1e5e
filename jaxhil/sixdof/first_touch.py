"""First touch of the ideal contact: point, normal, effective mass, and the bodies' states."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.lanes import select_lanes
from jaxhil.sixdof.bodies import Load, kick_drift
from jaxhil.sixdof.candidates import Touch, motion_at
from jaxhil.sixdof.ideal_contact_integration import IdealContactModel
from jaxhil.sixdof.relative import Pair, States, effective_mass, relative
from jaxhil.sixdof.vectors import Vector

TOUCH_STEPS = 4  # number of Newton steps for the time of the first touch


class FirstTouch(NamedTuple):
    """Bodies and contact geometry at the first touch of an episode."""

    states: States  # states of the bodies
    point: Vector  # point of the touch, in target frame T [m]
    normal: Vector  # normal of the target's surface, in target frame T


def find_first_touch(
    contact_model: IdealContactModel, before: States, depths: tuple[Float[Array, "_ *batch"], ...]
) -> FirstTouch:
    """Compute the first touch: Newton's method finds the duration of the free flight before the touch.

    Args:
        contact_model: Constants of the ideal contact.
        before: States at the start of the integration step in which the first touch begins.
        depths: Penetration of each pair of shapes at the end of this step [m], one array for each group; 0 in
            lanes without any touch.
    """
    zero = jnp.zeros_like(before.target.position.x)
    if not contact_model.groups:
        apart = zero + jnp.nan
        nowhere = Vector(apart, apart, apart)
        return FirstTouch(before, nowhere, nowhere)

    def touch_of(states: States) -> tuple[Touch, Array]:
        """Return geometry and penetration rate, at `states`, of the pair with the largest of the `depths`."""
        pose, twist = jax.tree.map(lambda leaf: leaf[None], relative(contact_model.bodies, states))
        touches = [group.candidates.touch(pose) for group in contact_model.groups]
        rates = [motion_at(touch, pose, twist)[0] for touch in touches]
        return _deepest(list(zip(touches, rates, strict=True)), depths)

    # The compiler would unroll a Python loop, fuse its computations and repeat them.
    def newton(_, carry: tuple[Array, States, FirstTouch]) -> tuple[Array, States, FirstTouch]:
        time, states, _ = carry
        touch, rate = touch_of(states)
        time = time - touch.depth / jnp.where(rate > 0, rate, jnp.inf)
        ahead = advance_free_flight(contact_model.bodies, before, time)
        return time, ahead, FirstTouch(states, touch.point, touch.normal)

    nothing = Vector(zero, zero, zero)
    start = zero, before, FirstTouch(before, nothing, nothing)
    *_, first_touch = lax.fori_loop(0, TOUCH_STEPS, newton, start)
    return first_touch


def first_touch_mass(bodies: Pair, first_touch: FirstTouch) -> Float[Array, "*batch"]:
    """Return the effective mass [kg] of the bodies at the first touch, along the normal of the touch."""
    return effective_mass(bodies, first_touch.states, first_touch.point, first_touch.normal)


def advance_free_flight(bodies: Pair, states: States, time: Float[Array, "*batch"]) -> States:
    """Return the states after a free flight that lasts `time` [s], integrated in a single step."""
    zero = jnp.zeros_like(time)
    nothing = Vector(zero, zero, zero)
    return States(*(
        kick_drift(body, state, Load(nothing, nothing), time, 1.0)
        for body, state in zip(bodies, states, strict=True)
    ))  # fmt: skip


def _deepest(candidates: list[tuple[Touch, Array]], depths: tuple[Array, ...]) -> tuple[Touch, Array]:
    """Return geometry and penetration rate of the shape pair that has the largest of the `depths` [m]."""
    best: tuple[tuple[Touch, Array], Array] | None = None
    for candidate, depth in zip(candidates, depths, strict=True):
        index = jnp.argmax(depth, axis=0)[None]

        def pick(leaf: Array, index: Array = index, like: Array = depth) -> Array:
            return jnp.take_along_axis(jnp.broadcast_to(leaf, like.shape), index, axis=0)[0]

        deepest = jax.tree.map(pick, candidate), pick(depth)
        best = deepest if best is None else select_lanes(deepest[1] > best[1], deepest, best)
    assert best is not None
    return best[0]
