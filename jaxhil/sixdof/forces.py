"""Contact at several points: normal forces, friction forces, and their resultant wrench.

A contact law of `jaxhil.contact` gives each candidate's normal force from its penetration and rate, a
friction law the tangential force from its slip. Neither tests for contact: without penetration the force is
0.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.contact.laws import ContactLaw, ContactParameters
from jaxhil.sixdof.candidates import Candidates, Touch, motion_at
from jaxhil.sixdof.friction import Friction, Touching
from jaxhil.sixdof.relative import Pose, Twist, Wrench
from jaxhil.sixdof.vectors import Vector, cross


class ContactGroup(eqx.Module):
    """Candidates of one kind with their laws."""

    candidates: Candidates  # pairs of shapes
    law: ContactLaw = eqx.field(static=True)  # contact law of the normal force
    parameters: ContactParameters  # parameters of the contact law, (candidates, *batch)
    friction: Friction  # friction law of the tangential force

    def init(self) -> "Memory":
        """Return the laws' state before the first touch."""
        like = jnp.zeros_like(self.parameters.damping)
        return Memory(self.law.init(like), self.friction.init(like))


class Memory(NamedTuple):
    """State of a contact's laws."""

    law: tuple[Array, ...]
    friction: tuple[Vector, ...]


class Forces(NamedTuple):
    """Forces of each candidate on the chaser, in T axes."""

    touch: Touch  # penetration, normal and point
    normal: Float[Array, "candidates *batch"]  # F [N]
    tangential: Vector  # f_t [N]
    slip: Vector  # [m/s]


def contact_forces(
    group: ContactGroup, memory: Memory, pose: Pose, twist: Twist, duration: Float[Array, "*batch"]
) -> tuple[Forces, Memory]:
    """Return the forces at a pose and twist, `duration` [s] after the laws' last evaluation."""
    pose, twist, duration = jax.tree.map(lambda leaf: leaf[None], (pose, twist, duration))
    touch = group.candidates.touch(pose)
    rate, slip = motion_at(touch, pose, twist)
    normal, law = group.law.step(group.parameters, memory.law, touch.depth, rate)
    # A pulling contact has no friction.
    pressed = jnp.where(normal > 0, normal, 0)
    tangential, friction = group.friction.step(
        Touching(pressed, touch.normal, slip, duration), memory.friction
    )
    return Forces(touch, normal, tangential, slip), Memory(law, friction)


def total_wrench(forces: Forces) -> Wrench:
    """Return the wrench of all candidates on the chaser, with its moment about T's origin."""
    force = forces.normal * forces.touch.normal + forces.tangential
    moment = cross(forces.touch.point, force)
    return Wrench(*(jax.tree.map(lambda part: part.sum(axis=0), part) for part in (force, moment)))


def contact_wrench(
    groups: tuple[ContactGroup, ...],
    memories: tuple[Memory, ...],
    pose: Pose,
    twist: Twist,
    duration: Float[Array, "*batch"],
) -> tuple[Wrench, tuple[Forces, ...], tuple[Memory, ...]]:
    """Return the wrench [N, N m] of contacts of several kinds, their forces, and the laws' next states.

    The laws were evaluated last `duration` [s] before.
    """
    results = [
        contact_forces(group, memory, pose, twist, duration)
        for group, memory in zip(groups, memories, strict=True)
    ]
    zero = Vector(*(jnp.zeros_like(duration) for _ in range(3)))
    wrench: Any = Wrench(zero, zero)
    for forces, _ in results:
        wrench = jax.tree.map(jnp.add, wrench, total_wrench(forces))
    return wrench, tuple(forces for forces, _ in results), tuple(memory for _, memory in results)


def deepest(groups: tuple[ContactGroup, ...], pose: Pose) -> Float[Array, "*batch"]:
    """Return the penetration [m] of the deepest candidate at a pose; minus infinity without candidates."""
    lifted = jax.tree.map(lambda leaf: leaf[None], pose)
    depth = jnp.full_like(pose.position.x, -jnp.inf)
    for group in groups:
        depth = jnp.maximum(depth, group.candidates.touch(lifted).depth.max(axis=0))
    return depth
