"""Notes on an identification: assumptions and observations that are no estimates."""

from __future__ import annotations

from collections.abc import Sequence

from tuning.identification import contact_fit as contacts
from tuning.identification.contact_fit import ContactFit
from tuning.identification.free_motion import FreeMotion
from tuning.identification.noise import SensorNoise
from tuning.identification.structure_choice import MAX_RELATIVE_STD

FORCE_DELAY_KEY, DEAD_ZONE_KEY = "rig.force_sensor.delay", "rig.force_sensor.dead_zone"


def collect_notes(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    used: ContactFit | None,
    force: SensorNoise | None,
    vague: Sequence[str],
) -> list[str]:
    """Return notes on missing runs, vague parameters, and the noise and dead zone of the force."""
    notes = []
    if vague:
        taken = "the contact is the prior's" if used is None else "taken as the entry before it"
        notes.append(
            f"{', '.join(vague)}: known to {100 * MAX_RELATIVE_STD:.0f} % at best: {taken}; "
            "more touches or deeper ones would tell it"
        )
    if motion is None:
        notes.append("no free motion: the motion simulator is the prior's")
    if contact is None:
        notes.append("no contact: the contact and the force delay are the prior's")
    elif contact.drift is not None:
        rate, std = 1e6 * contact.drift.rate, 1e6 * contact.drift.std
        gains = f"the forces' clock gains {rate:.3g} +- {std:.2g} ppm on the drives'"
        notes.append(f"{gains}; a constant between them and {FORCE_DELAY_KEY} are one number: it is as told")
    if contact is not None and not contact.problem.damping_indices:
        notes.append(
            f"law {contact.law.name}: without damping, as asked for; a damping b with a force delay longer "
            "by b over the stiffness may explain the logs as well"
        )
    if contact is not None and contact.resampled:
        notes.append(contact.resampled)
    if force is not None and force.drift:
        notes.append(f"the force drifts at rest, by {force.drift:.3g} N from the first row to the last")
    if force is not None and force.pole > 0.5:
        notes.append(f"the force's noise is coloured (pole {force.pole:.2f}); tuning weighs it as white")
    if contact is not None and (entries := contact.readings.entries) != tuple(range(len(entries))):
        notes.append(f"of the contact lists only entries {', '.join(map(str, entries))} were met")
    if contact is not None and contact.dead_zone and contact.problem.plane is not None:
        spread = 1e3 * contacts.UNKNOWN_SURFACE_STD
        assumed = f"to be at 0 +- {spread:g} mm; --fix rig.contact_plane=VALUE specifies it"
        taken = "as told" if contact.has_specified_surface else assumed
        notes.append(f"the force has a dead zone: the contact plane was taken {taken}")
    return notes


def note_absent_dead_zone(contact: ContactFit | None, specified: float) -> list[str]:
    """Return a note if a dead zone was specified but the readings show none."""
    if contact is None or contact.dead_zone or not specified:
        return []
    return [f"{DEAD_ZONE_KEY}: {specified:g} N were told, but readings at rest show none: taken as none"]
