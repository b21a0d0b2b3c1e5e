"""Outcome of runs: metrics of the contacts on the rig, compared with the ideal contacts."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.contact.ideal_contact import IdealContact
from jaxhil.contact.laws import ContactParameters
from jaxhil.simulation.contact_bounds import is_contact_out_of_bounds
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.metrics import OK, Metrics
from jaxhil.simulation.scenario import Scenario


class Outcome(NamedTuple):
    """Metrics of the contacts on the rig and of the ideal contacts; arrays of shape (contacts, *batch).

    The ideal contact is the contact without any delay at the same approach speed.
    """

    metrics: Metrics  # metrics of the contacts on the rig
    reference_restitution: Float[Array, "slots *batch"]  # restitution of the ideal contact [1]
    reference_peak_force: Float[Array, "slots *batch"]  # peak force of the ideal contact [N]
    # duration of the ideal contact [s]; infinite if the bodies never separate
    reference_duration: Float[Array, "slots *batch"]
    error: Float[Array, "slots *batch"]  # restitution minus the ideal contact's restitution [1]
    peak_ratio: Float[Array, "slots *batch"]  # largest |force command|, divided by the ideal peak force [1]
    # chatter of the force command (see `Metrics`), divided by the ideal contact's peak force [1]
    chatter: Float[Array, "slots *batch"]
    is_scheduled: Bool[Array, "slots *batch"]  # whether the scenario has this contact
    good: Bool[Array, "slots *batch"]  # whether the contact was reached and ended with the status `OK`
    # whether peak force or duration of the real contact violates the bounds in `contact_bounds`
    is_unlike_ideal: Bool[Array, "slots *batch"]

    @property
    def peak_force_ratio(self) -> Any:
        """Return the largest real contact force, divided by the ideal contact's peak force [1]."""
        return self.metrics.peak_force / self.reference_peak_force

    @property
    def duration_ratio(self) -> Any:
        """Return the duration of the real contact force, divided by the ideal contact's duration [1]."""
        return self.metrics.duration / self.reference_duration


def compare_with_ideal(loop: Loop, scenario: Scenario, metrics: Metrics) -> Outcome:
    """Compare contacts on the rig with ideal contacts of the same approach speed."""
    slots = metrics.restitution.shape[0]
    number = jnp.arange(slots, dtype=scenario.contacts.dtype).reshape(
        slots, *[1] * (metrics.restitution.ndim - 1)
    )
    is_scheduled = number < scenario.contacts[None]
    good = is_scheduled & (metrics.status == OK)
    velocity = jnp.where(good, metrics.approach_velocity, scenario.velocity[None])
    contact = parameters_by_slot(scenario.contact)
    mass = jnp.broadcast_to(scenario.equivalent_mass, velocity.shape)
    reference = loop.law.ideal_contact(contact, mass, velocity)
    known_reference = scenario.reference
    if known_reference is not None:
        is_known = ~jnp.isnan(known_reference.restitution)
        reference = IdealContact(
            *(jnp.where(is_known, a, b) for a, b in zip(known_reference, reference, strict=True))
        )
    return Outcome(
        metrics=metrics,
        reference_restitution=reference.restitution,
        reference_peak_force=reference.peak_force,
        reference_duration=reference.duration,
        error=metrics.restitution - reference.restitution,
        peak_ratio=metrics.peak_command / reference.peak_force,
        chatter=metrics.excess_variation / reference.peak_force,
        is_scheduled=is_scheduled,
        good=good,
        is_unlike_ideal=good
        & is_contact_out_of_bounds(
            metrics.peak_force,
            reference.peak_force,
            metrics.duration,
            reference.duration,
            scenario.control_period[None],
        ),
    )


def parameters_by_slot(contact: ContactParameters) -> ContactParameters:
    """Reorder axes to (segments, contacts, *batch): the contact law then computes all contacts as a batch."""
    nested = contact.stiffness.ndim > contact.damping.ndim
    return contact._replace(
        stiffness=jnp.moveaxis(contact.stiffness, 0, 1) if nested else contact.stiffness,
        depths=jnp.moveaxis(contact.depths, 0, 1),
    )
