"""Damping perturbations: scenarios of the same mechanism with additional damping.

The slope of e against e* measures how a compensator responds to damping that its tuning did not include. An
elastic mechanism alone cannot show this, because its e* is always 1. The additional damping of scenario i
dissipates as much energy as an oscillator with the damping ratio zeta_i, which has e* = exp(-pi zeta_i). The
values zeta_i are spread evenly from 0 to `MAX_DAMPING_RATIO`. `ContactLaw.perturb_damping` converts them to
parameters of the contact law.
"""

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism

MAX_DAMPING_RATIO = 0.15  # largest additional damping ratio [1]; an elastic mechanism then has e* = 0.62


def perturb_damping(
    mechanism: Mechanism, draws: Mapping[str, np.ndarray]
) -> tuple[Mechanism, dict[str, np.ndarray]]:
    """Add damping to a mechanism, with a different damping ratio for each draw.

    Return a mechanism with a damped contact law, and the draws with the additional damping. Raise
    `InputError` if the contact law does not define how to add damping.
    """
    number = len(next(iter(draws.values())))
    # With multiples of the golden ratio, the damping ratios do not correlate with the order of the draws.
    ratio = MAX_DAMPING_RATIO * ((np.arange(number) * 0.6180339887498949) % 1)[:, None]
    contact, law = mechanism.contact, find_contact_law(mechanism.contact.law)
    mass = _compute_masses(mechanism, draws)[:, None]
    velocity = np.broadcast_to(draws.get("approach.velocity", mechanism.approach.velocity), (number,))[
        :, None
    ]
    entries = max(len(contact.stiffness), len(contact.damping))

    def drawn(key: str) -> np.ndarray:
        nominal = np.asarray(value_at(mechanism, f"contact.{key}"), float)
        values = draws.get(f"contact.{key}", np.broadcast_to(nominal, (number, *nominal.shape)))
        if key == "stiffness":
            return _repeat_last_entry(
                np.asarray(values).reshape(number, len(contact.stiffness), -1)[:, :, 0], entries
            )
        return _repeat_last_entry(values, entries) * law.is_damped if key == "damping" else np.asarray(values)

    key, values = law.perturb_damping(drawn, ratio, mass, velocity)
    # The draws have one value per entry, so that the nominal list needs the same number of entries.
    damping_list = list(contact.damping) + [contact.damping[-1]] * (entries - len(contact.damping))
    changed = {"law": law.damped_law or law.name, "damping": damping_list} if key == "damping" else {}
    perturbed = msgspec.structs.replace(mechanism, contact=msgspec.structs.replace(contact, **changed))
    return perturbed, {**draws, f"contact.{key}": values}


def _compute_masses(mechanism: Mechanism, draws: Mapping[str, np.ndarray]) -> Float[np.ndarray, "draws"]:
    number = len(next(iter(draws.values())))
    bodies = mechanism.bodies

    def drawn(name):
        return np.broadcast_to(draws.get(f"bodies.{name}", getattr(bodies, name)), (number,))

    if bodies.equivalent_mass is not None:
        return drawn("equivalent_mass")
    chaser, target = drawn("chaser_mass"), drawn("target_mass")
    return chaser * target / (chaser + target)


def _repeat_last_entry(values: np.ndarray, entries: int) -> np.ndarray:
    """Extend `values`, (draws, columns), to `entries` columns by repeating the last column."""
    return values[:, np.minimum(np.arange(entries), values.shape[1] - 1)]
