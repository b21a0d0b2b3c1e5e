"""Notes on an identification: assumptions, and observations that the estimates do not show."""

from __future__ import annotations

from collections.abc import Sequence

from tuning.identification import contact_fit as contacts
from tuning.identification.contact_fit import ContactFit
from tuning.identification.free_motion import FreeMotion
from tuning.identification.noise import NoiseEstimate
from tuning.identification.structure_choice import MAX_RELATIVE_STD

FORCE_DELAY_KEY, DEAD_ZONE_KEY = "rig.force_sensor.delay", "rig.force_sensor.dead_zone"
BIAS_KEY = "rig.force_sensor.bias"


def collect_notes(
    motion: FreeMotion | None,
    contact: ContactFit | None,
    used: ContactFit | None,
    force: NoiseEstimate | None,
    vague: Sequence[str],
) -> list[str]:
    """Return notes on missing runs, on undetermined parameters, and on the force sensor.

    Args:
        motion: Fit of the motion simulator, or None.
        contact: Fit of the contact, or None.
        used: The same as `contact` if the mechanism file contains its values; None if it does not.
        force: Noise of the force sensor at rest, or None.
        vague: Keys of the stiffness entries that the logs hardly determine.
    """
    notes = []
    if vague:
        taken = "the contact is the prior's" if used is None else "taken as the entry before it"
        notes.append(
            f"{', '.join(vague)}: known to {100 * MAX_RELATIVE_STD:.0f} % at best: {taken}; "
            "more or deeper contacts would determine it"
        )
    if motion is None:
        notes.append("no free motion: the motion simulator is the prior's")
    if contact is None:
        notes.append("no contact: the contact and the force delay are the prior's")
    elif contact.drift is not None:
        rate, std = 1e6 * contact.drift.rate, 1e6 * contact.drift.std
        gains = f"the force clock gains {rate:.3g} +- {std:.2g} ppm on the drives' clock"
        notes.append(f"{gains}; the logs do not show its offset, so {FORCE_DELAY_KEY} is as specified")
    if contact is not None and not contact.problem.damping_indices:
        notes.append(
            f"law {contact.law.name}: without damping, as specified; with a damping b, a force delay that is "
            "longer by b / stiffness may explain the logs equally well"
        )
    if contact is not None and contact.resampled:
        notes.append(contact.resampled)
    if force is not None and force.drift:
        notes.append(f"the force drifts at rest, by {force.drift:.3g} N from the first row to the last")
    if force is not None and force.walk:
        walk = f"the force's bias drifts, with a random walk of {force.walk[0]:.2g} N/sqrt(s)"
        notes.append(f"{walk}; jaxhil monitor does not model this")
    if force is not None and not force.walk and force.pole > 0.5:
        notes.append(f"the force's noise is coloured (pole {force.pole:.2f}); tuning treats it as white")
    if contact is not None and (entries := contact.readings.entries) != tuple(range(len(entries))):
        notes.append(f"the logs contain only entries {', '.join(map(str, entries))} of the contact lists")
    if contact is not None and contact.dead_zone and contact.problem.plane is not None:
        spread = 1e3 * contacts.UNKNOWN_SURFACE_STD
        assumed = f"assumed at 0 +- {spread:g} mm; --fix rig.contact_plane=VALUE specifies it"
        taken = "as specified" if contact.has_specified_surface else assumed
        notes.append(f"the force has a dead zone: the contact plane is {taken}")
    if contact is not None and contact.readings.subtracted and contact.readings.bias is not None:
        bias, std = contact.readings.subtracted + contact.readings.bias[0], contact.readings.bias[1]
        prior = f"estimated at {bias:.2g} +- {std:.2g} N before the contacts are fitted"
        notes.append(f"{BIAS_KEY}: the dead zone hides it: {prior}; --fix {BIAS_KEY}=VALUE specifies it")
    return notes


def note_absent_dead_zone(contact: ContactFit | None, specified: float) -> list[str]:
    """Return a note if the user specified a dead zone [N] that readings at rest do not show."""
    if contact is None or contact.dead_zone or not specified:
        return []
    return [
        f"{DEAD_ZONE_KEY}: {specified:g} N specified, but readings at rest show no dead zone: none is used"
    ]
