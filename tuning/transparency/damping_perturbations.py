"""Damping perturbations: the same mechanism with additional dissipation.

The slope of e against e* measures the response of a compensator to dissipation that it was not tuned for. An
elastic mechanism alone, with e* = 1 always, does not show it. The perturbation of scenario i dissipates like
an oscillator with e* = exp(-pi zeta_i), whose damping ratios zeta_i cover [0, `MAX_DAMPING_RATIO`] evenly, in
terms of the mechanism's contact law (`ContactLaw.perturb_damping`).
"""

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.structs import Mechanism, value_at

MAX_DAMPING_RATIO = 0.15  # damping ratio: e* = 0.62


def perturb_damping(
    mechanism: Mechanism, draws: Mapping[str, np.ndarray]
) -> tuple[Mechanism, dict[str, np.ndarray]]:
    """Return the mechanism and its draws with an additional damping ratio for each draw.

    Raise `InputError` if the contact law does not define its dissipation.
    """
    number = len(next(iter(draws.values())))
    # Multiples of the golden ratio keep the damping ratio uncorrelated with the order of the draws.
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
        return _repeat_last_entry(values, entries) * law.damped if key == "damping" else np.asarray(values)

    key, values = law.perturb_damping(drawn, ratio, mass, velocity)
    # The list gets as many entries as the draws have.
    listed = list(contact.damping) + [contact.damping[-1]] * (entries - len(contact.damping))
    changed = {"law": law.damped_as or law.name, "damping": listed} if key == "damping" else {}
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
    """Return (draws, entries), the last entry repeated."""
    return values[:, np.minimum(np.arange(entries), values.shape[1] - 1)]
