"""Pushes on the hardware for the measurement of transparency, and the ideal contacts with the same pushes.

A push is a half-sine of duration `PUSH_DURATION` that is in no model, with `PUSH_SIZE` of the ideal contact's
peak force. It is centred at a quarter or at three quarters of the ideal contact's duration after the first
touch, on the hardware and in the ideal contact. Transparency is the change of e on the hardware over that of
the ideal contact: 1 for a test of the hardware, 0 for a law that replays what it expects.

The push acts on the first contact only, since later contacts already differ by their approach speed.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.contact.ideal_contact_motion import integrate_contact
from jaxhil.contact.laws import ContactLaw, ContactParameters
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.probe import Probe, Push
from jaxhil.simulation.scenario import Scenario
from tuning.batches import join_batches

PUSH_SIZE, PUSH_DURATION = 0.2, 0.02  # share of the peak force [1]; duration [s]
EARLY_PUSH_CENTRE, LATE_PUSH_CENTRE = 0.25, 0.75  # centre as share of the contact's duration [1]
# Definition of `early` and `late` in written files, by which other definitions are recognised.
PUSH_DEFINITION = (
    f"a push on the hardware at {100 * EARLY_PUSH_CENTRE:g} and {100 * LATE_PUSH_CENTRE:g} % "
    "of the contact's duration in space"
)
MOTION_SAMPLES = 129  # samples of an ideal contact's motion
LANES_PER_CALL = 256  # lanes integrated in one call


class IdealContacts(NamedTuple):
    """Ideal contacts."""

    restitution: Float[np.ndarray, "slots scenarios"]  # e* [1]
    peak_force: Float[np.ndarray, "slots scenarios"]  # [N]
    duration: Float[np.ndarray, "slots scenarios"]  # [s]
    depth: Float[np.ndarray, "slots samples scenarios"]  # penetration [m] at `MOTION_SAMPLES` times
    early: Float[np.ndarray, "scenarios"]  # restitution of the first contact with an early push [1]
    late: Float[np.ndarray, "scenarios"]  # restitution of the first contact with a late push [1]


def compute_ideal_contacts(
    law: ContactLaw,
    scenarios: Scenario,
    velocity: Float[np.ndarray, "slots scenarios"],
    contacts: int,
) -> IdealContacts:
    """Compute the first `contacts` ideal contacts of every scenario, with approach speeds `velocity` [m/s].

    Further slots repeat the last contact.
    """
    slots, number = velocity.shape
    contact = jax.tree.map(lambda leaf: np.asarray(leaf)[:contacts], scenarios.contact)
    contact = jax.device_get(parameters_by_slot(contact))
    mass = np.broadcast_to(scenarios.equivalent_mass, (contacts, number))

    def integrate(parameters, mass, velocity, size, centre) -> Any:
        """Integrate the contacts of all lanes, `LANES_PER_CALL` at a time."""
        leaves = parameters, mass, velocity, size, centre
        lanes = mass.size
        flat = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-2], lanes), leaves)
        parts = []
        for begin in range(0, lanes, LANES_PER_CALL):
            chunk = np.minimum(np.arange(begin, begin + LANES_PER_CALL), lanes - 1)
            part = _integrate_motion(law, *jax.tree.map(lambda leaf, chunk=chunk: leaf[..., chunk], flat))
            parts.append(
                jax.tree.map(lambda leaf, lanes=lanes - begin: leaf[..., :lanes], jax.device_get(part))
            )
        return jax.tree.map(
            lambda leaf: leaf.reshape(*leaf.shape[:-1], lanes // number, number), join_batches(parts)
        )

    speed = np.asarray(velocity[:contacts])
    zero = np.zeros_like(speed)
    plain = integrate(contact, mass, speed, zero, zero)
    first = jax.tree.map(lambda leaf: leaf[..., :1, :], contact), mass[:1], speed[:1]
    size = PUSH_SIZE * plain.peak_force[:1]
    # With the same integration as for `plain`, its error cancels in the difference.
    early, late = (
        integrate(*first, size, share * plain.duration[:1]).restitution[0]
        for share in (EARLY_PUSH_CENTRE, LATE_PUSH_CENTRE)
    )

    def by_slot(leaf):
        return leaf[np.minimum(np.arange(slots), contacts - 1)]

    return IdealContacts(
        by_slot(plain.restitution),
        by_slot(plain.peak_force),
        by_slot(plain.duration),
        by_slot(np.moveaxis(plain.position, 1, 0)),
        early,
        late,
    )


def add_probe(scenarios: Scenario, space: Any, share: float | None = None) -> Scenario:
    """Return the scenarios with the ideal motion of each contact and, with a `share`, a push.

    The push is centred at that share of the first ideal contact's duration.
    """
    size: Any = np.zeros_like(space.peak_force)
    centre: Any = np.zeros_like(space.peak_force)
    width: Any = np.full_like(size, PUSH_DURATION)
    if share is not None:
        size[0] = PUSH_SIZE * space.peak_force[0]
        centre[0] = share * space.duration[0]
    return scenarios._replace(probe=Probe(Push(size, centre, width), space.depth, space.duration))


class _IdealMotion(NamedTuple):
    """Batch of ideal contacts, with the position at `MOTION_SAMPLES` times."""

    restitution: Array
    peak_force: Array
    duration: Array
    position: Array


@partial(jax.jit, static_argnums=0)
def _integrate_motion(
    law: ContactLaw, parameters: ContactParameters, mass: Array, velocity: Array, size: Array, centre: Array
) -> _IdealMotion:
    push = Push(size, centre, jnp.full_like(size, PUSH_DURATION))
    reference = law.reference(parameters, mass, velocity)
    share = jnp.linspace(0, 1, MOTION_SAMPLES, dtype=velocity.dtype)[:, None]
    until = jnp.where(size > 0, centre + PUSH_DURATION / 2, 0)
    motion = integrate_contact(
        law, parameters, mass, velocity, push.force, until, share * reference.duration[None]
    )
    return _IdealMotion(
        motion.restitution, motion.peak_force, reference.duration, jnp.asarray(motion.position)
    )
