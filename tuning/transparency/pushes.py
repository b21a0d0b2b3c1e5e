"""What a comparison probes the laws with: pushes on the hardware, and the same contacts in space.

    Transparency: a half-sine push that no model knows of, `WIDTH` long, `SIZE` of the reference's peak force,
    centred at a quarter and at three quarters of the contact's duration in space, acts on the hardware and,
    as long after the first touch, in space. What it changes in e, over what it changes in space, is 1 for a
    test of the hardware, and 0 for a law that plays back what it expects.

The push is on the first contact alone: what follows a contact differs by its rebound already.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.contact.laws import ContactLaw, ContactParameters
from jaxhil.contact.reference_motion import integrate_contact
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.probe import Probe, Push
from jaxhil.simulation.scenario import Scenario
from tuning.batches import join

SIZE, WIDTH = 0.2, 0.02  # of the peak force; s
EARLY, LATE = 0.25, 0.75  # of the contact's duration
# What `early` and `late` are, as written files say it; those of another definition do not say so.
PUSHES = f"a push on the hardware at {100 * EARLY:g} and {100 * LATE:g} % of the contact's duration in space"
SAMPLES = 129  # of a reference's motion
LANES = 256  # integrated in one call


class Space(NamedTuple):
    """Contacts in space."""

    restitution: Float[np.ndarray, "slots scenarios"]  # e* [1]
    peak_force: Float[np.ndarray, "slots scenarios"]  # [N]
    duration: Float[np.ndarray, "slots scenarios"]  # [s]
    depth: Float[np.ndarray, "slots samples scenarios"]  # penetration [m] at `SAMPLES` times
    early: Float[np.ndarray, "scenarios"]  # restitution of the first contact under an early push [1]
    late: Float[np.ndarray, "scenarios"]  # under a late one [1]


def in_space(
    law: ContactLaw,
    scenarios: Scenario,
    velocity: Float[np.ndarray, "slots scenarios"],
    contacts: int,
) -> Space:
    """The first so many contacts of every scenario in space, each entered at its `velocity` [m/s].

    Slots beyond them hold the last one's numbers.
    """
    slots, number = velocity.shape
    contact = jax.tree.map(lambda leaf: np.asarray(leaf)[:contacts], scenarios.contact)
    contact = jax.device_get(parameters_by_slot(contact))
    mass = np.broadcast_to(scenarios.equivalent_mass, (contacts, number))

    def each(parameters, mass, velocity, size, centre) -> Any:
        """Lane by lane, `LANES` at a time."""
        leaves = parameters, mass, velocity, size, centre
        lanes = mass.size
        flat = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-2], lanes), leaves)
        parts = []
        for begin in range(0, lanes, LANES):
            some = np.minimum(np.arange(begin, begin + LANES), lanes - 1)
            part = _move(law, *jax.tree.map(lambda leaf, some=some: leaf[..., some], flat))
            parts.append(
                jax.tree.map(lambda leaf, lanes=lanes - begin: leaf[..., :lanes], jax.device_get(part))
            )
        return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], lanes // number, number), join(parts))

    entered = np.asarray(velocity[:contacts])
    none = np.zeros_like(entered)
    plain = each(contact, mass, entered, none, none)
    first = jax.tree.map(lambda leaf: leaf[..., :1, :], contact), mass[:1], entered[:1]
    size = SIZE * plain.peak_force[:1]
    # Both by the same integration: what is left of its error cancels in the difference.
    early, late = (each(*first, size, share * plain.duration[:1]).restitution[0] for share in (EARLY, LATE))

    def by_slot(leaf):
        return leaf[np.minimum(np.arange(slots), contacts - 1)]

    return Space(
        by_slot(plain.restitution),
        by_slot(plain.peak_force),
        by_slot(plain.duration),
        by_slot(np.moveaxis(plain.position, 1, 0)),
        early,
        late,
    )


def probed(scenarios: Scenario, space: Any, share: float | None = None) -> Scenario:
    """The scenarios with the reference beside each contact; with a push at a `share` of the first contact's
    duration in space, if one is given."""
    size: Any = np.zeros_like(space.peak_force)
    centre: Any = np.zeros_like(space.peak_force)
    width: Any = np.full_like(size, WIDTH)
    if share is not None:
        size[0] = SIZE * space.peak_force[0]
        centre[0] = share * space.duration[0]
    return scenarios._replace(probe=Probe(Push(size, centre, width), space.depth, space.duration))


class _ReferencePath(NamedTuple):
    """A batch of contacts in space; the position at `SAMPLES` times."""

    restitution: Array
    peak_force: Array
    duration: Array
    position: Array


@partial(jax.jit, static_argnums=0)
def _move(
    law: ContactLaw, parameters: ContactParameters, mass: Array, velocity: Array, size: Array, centre: Array
) -> _ReferencePath:
    push = Push(size, centre, jnp.full_like(size, WIDTH))
    reference = law.reference(parameters, mass, velocity)
    share = jnp.linspace(0, 1, SAMPLES, dtype=velocity.dtype)[:, None]
    until = jnp.where(size > 0, centre + WIDTH / 2, 0)
    motion = integrate_contact(
        law, parameters, mass, velocity, push.force, until, share * reference.duration[None]
    )
    return _ReferencePath(
        motion.restitution, motion.peak_force, reference.duration, jnp.asarray(motion.position)
    )
