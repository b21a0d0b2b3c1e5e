"""Pushes on the hardware for the measurement of transparency, and the ideal contacts with the same pushes.

A push is a force that no model contains. Its shape is a half-sine with the duration `PUSH_DURATION`, and its
amplitude is `PUSH_SIZE` times the ideal contact's peak force. The push is centred at 25 % (early) or 75 %
(late) of the ideal contact's duration after the first touch, on the hardware and in the ideal contact.
Transparency is the change of e on the rig, divided by the change of e of the ideal contact. It is 1 if the
compensator reacts to the push correctly, and 0 if the compensator only reproduces the contact that it
expects.

The push acts only on the first contact, because later contacts differ anyway by their approach speeds.
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

PUSH_SIZE, PUSH_DURATION = 0.2, 0.02  # amplitude / peak force of the ideal contact [1]; duration [s]
EARLY_PUSH_CENTRE, LATE_PUSH_CENTRE = 0.25, 0.75  # time of the centre / duration of the ideal contact [1]
# Files contain this definition of `early` and `late`, so that other definitions can be recognised.
PUSH_DEFINITION = (
    f"a push on the hardware at {100 * EARLY_PUSH_CENTRE:g} and {100 * LATE_PUSH_CENTRE:g} % "
    "of the ideal contact's duration"
)
MOTION_SAMPLES = 129  # number of samples of the motion of an ideal contact
LANES_PER_CALL = 256  # number of contacts that are integrated in one call, to limit the memory


class IdealContacts(NamedTuple):
    """Ideal contacts of many scenarios without pushes, and e* of the first ideal contacts with a push."""

    restitution: Float[np.ndarray, "slots scenarios"]  # restitution e* without a push [1]
    peak_force: Float[np.ndarray, "slots scenarios"]  # peak force without a push [N]
    duration: Float[np.ndarray, "slots scenarios"]  # duration without a push [s]
    depth: Float[np.ndarray, "slots samples scenarios"]  # penetration at `MOTION_SAMPLES` times [m]
    early: Float[np.ndarray, "scenarios"]  # restitution e* of the first contact with an early push [1]
    late: Float[np.ndarray, "scenarios"]  # restitution e* of the first contact with a late push [1]


def compute_ideal_contacts(
    law: ContactLaw,
    scenarios: Scenario,
    velocity: Float[np.ndarray, "slots scenarios"],
    contacts: int,
) -> IdealContacts:
    """Compute ideal contacts of every scenario without pushes, and the first contact also with pushes.

    `velocity` contains the approach speeds [m/s]. Only the first `contacts` ideal contacts are computed; all
    later entries of the axis `slots` repeat the last of them.
    """
    slots, number = velocity.shape
    contact = jax.tree.map(lambda leaf: np.asarray(leaf)[:contacts], scenarios.contact)
    contact = jax.device_get(parameters_by_slot(contact))
    mass = np.broadcast_to(scenarios.equivalent_mass, (contacts, number))

    def integrate(parameters, mass, velocity, size, centre) -> Any:
        """Integrate the motion of all contacts, in chunks of `LANES_PER_CALL` contacts."""
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
    # The integration error cancels in the difference from `plain`, which uses the same integration.
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
    """Add the motion of the ideal contacts `space` to their scenarios and, if `share` is given, a push.

    The push acts on the first contact, centred at the fraction `share` of this ideal contact's duration.
    """
    size: Any = np.zeros_like(space.peak_force)
    centre: Any = np.zeros_like(space.peak_force)
    width: Any = np.full_like(size, PUSH_DURATION)
    if share is not None:
        size[0] = PUSH_SIZE * space.peak_force[0]
        centre[0] = share * space.duration[0]
    return scenarios._replace(probe=Probe(Push(size, centre, width), space.depth, space.duration))


class _IdealMotion(NamedTuple):
    """Batch of ideal contacts, computed by numerical integration."""

    restitution: Array  # restitution e* with the push [1], (lanes,)
    peak_force: Array  # peak force with the push [N], (lanes,)
    duration: Array  # duration without a push [s], (lanes,)
    position: Array  # penetration at `MOTION_SAMPLES` times [m], (samples, lanes)


@partial(jax.jit, static_argnums=0)
def _integrate_motion(
    law: ContactLaw, parameters: ContactParameters, mass: Array, velocity: Array, size: Array, centre: Array
) -> _IdealMotion:
    push = Push(size, centre, jnp.full_like(size, PUSH_DURATION))
    reference = law.ideal_contact(parameters, mass, velocity)
    share = jnp.linspace(0, 1, MOTION_SAMPLES, dtype=velocity.dtype)[:, None]
    until = jnp.where(size > 0, centre + PUSH_DURATION / 2, 0)
    motion = integrate_contact(
        law, parameters, mass, velocity, push.force, until, share * reference.duration[None]
    )
    return _IdealMotion(
        motion.restitution, motion.peak_force, reference.duration, jnp.asarray(motion.position)
    )
