"""Contact at several points: normal forces, friction forces, and the resulting wrench.

A contact law of `jaxhil.contact` computes the normal force of each candidate from penetration and penetration
rate. A friction law computes the tangential force from the slip. Both forces are 0 without penetration.
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
    """Pairs of shapes that may touch (candidates).

    All pairs have the same two kinds of shapes and the same contact law.
    """

    candidates: Candidates  # pairs of shapes
    law: ContactLaw = eqx.field(static=True)  # contact law of the normal force
    parameters: ContactParameters  # parameters of the contact law, (candidates, *batch)
    friction: Friction  # friction law of the tangential force

    def init(self) -> "Memory":
        """Return the states of contact law and friction law before the first touch."""
        like = jnp.zeros_like(self.parameters.damping)
        return Memory(self.law.init(like), self.friction.init(like))


class Memory(NamedTuple):
    """States of a group's contact law and friction law."""

    law: tuple[Array, ...]
    friction: tuple[Vector, ...]


class Forces(NamedTuple):
    """Contact forces on the chaser, for each candidate (pair of shapes), in target frame T."""

    touch: Touch  # penetration, normal and point
    normal: Float[Array, "candidates *batch"]  # normal force F [N]
    tangential: Vector  # friction force f_t [N]
    slip: Vector  # chaser's velocity along the target's surface [m/s]


def contact_forces(
    group: ContactGroup, memory: Memory, pose: Pose, twist: Twist, duration: Float[Array, "*batch"]
) -> tuple[Forces, Memory]:
    """Compute a group's contact forces at a pose and twist, and the next states of its laws.

    `duration` is the time since the last evaluation of the laws [s].
    """
    pose, twist, duration = jax.tree.map(lambda leaf: leaf[None], (pose, twist, duration))
    touch = group.candidates.touch(pose)
    rate, slip = motion_at(touch, pose, twist)
    normal, law = group.law.step(group.parameters, memory.law, touch.depth, rate)
    # A contact law with tension may pull; a pulling contact has no friction.
    pressed = jnp.where(normal > 0, normal, 0)
    tangential, friction = group.friction.step(
        Touching(pressed, touch.normal, slip, duration), memory.friction
    )
    return Forces(touch, normal, tangential, slip), Memory(law, friction)


def total_wrench(forces: Forces) -> Wrench:
    """Sum all candidates' forces to a wrench on the chaser about the origin of target frame T."""
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
    """Compute the wrench [N, N m] of all groups on the chaser, the contact forces, and the laws' next states.

    `duration` is the time since the last evaluation of the contact and friction laws [s].
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
    """Return the largest penetration [m] of all shape pairs at a pose; minus infinity without shape pairs."""
    lifted = jax.tree.map(lambda leaf: leaf[None], pose)
    depth = jnp.full_like(pose.position.x, -jnp.inf)
    for group in groups:
        depth = jnp.maximum(depth, group.candidates.touch(lifted).depth.max(axis=0))
    return depth
