"""Damped twins: the same mechanism with more dissipation than it has, from none more to a third of the speed.

How a law answers to dissipation that it was not tuned for is the slope of e against e*; an elastic mechanism
alone, whose e* is always 1, does not show it. The twin of scenario i has the dissipation of an oscillator
whose damping ratio zeta_i goes evenly through [0, `MOST`], e* = exp(-pi zeta), in the terms of its own law.
"""

from collections.abc import Mapping

import msgspec
import numpy as np
from jaxtyping import Float

from jaxhil.mechanism.structs import Mechanism

MOST = 0.15  # damping ratio: e* = 0.62


def damped_twins(
    mechanism: Mechanism, draws: Mapping[str, np.ndarray]
) -> tuple[Mechanism, dict[str, np.ndarray]]:
    """The mechanism and its draws with a damping ratio added that is spread over the draws in their order.

    kelvin_voigt, piecewise_linear, hardening: b + 2 zeta sqrt(k M), k the first slope. hunt_crossley:
    chi + pi zeta/v, as e* is about 1 - chi v. depth_damped: the b of the same dissipation at the deepest
    point. elastoplastic: unloading_ratio exp(2 pi zeta), as e* = unloading_ratio^(-1/2). preloaded: the
    friction that takes 1 - e*^2 of the energy on the way to its deepest point without it, and back.
    """
    number = len(next(iter(draws.values())))
    # Neighbouring draws get ratios far apart, so that nothing that goes with their order goes with the ratio.
    ratio = MOST * ((np.arange(number) * 0.6180339887498949) % 1)[:, None]
    contact = mechanism.contact
    mass = _mass(mechanism, draws)[:, None]
    velocity = np.broadcast_to(draws.get("approach.velocity", mechanism.approach.velocity), (number,))[
        :, None
    ]

    def drawn(path: str, nominal) -> np.ndarray:
        nominal = np.asarray(nominal, float)
        return np.asarray(draws.get(path, np.broadcast_to(nominal, (number, *nominal.shape))))

    if contact.law == "elastoplastic":
        path = "contact.unloading_ratio"
        steeper = drawn(path, getattr(contact, "unloading_ratio", 1.0)) * np.exp(2 * np.pi * ratio[:, 0])
        return mechanism, {**draws, path: steeper}
    if contact.law == "preloaded":
        preload, friction = (
            drawn(f"contact.{key}", getattr(contact, key)) for key in ("preload", "friction")
        )
        stiffness = drawn("contact.stiffness", contact.stiffness)[:, 0]
        energy = (mass * velocity**2)[:, 0] / 2
        deepest = 2 * energy / (preload + np.sqrt(preload**2 + 2 * stiffness * energy))
        lost = energy * -np.expm1(-2 * np.pi * ratio[:, 0])
        return mechanism, {**draws, "contact.friction": friction + lost / (2 * deepest)}
    stiffness = drawn("contact.stiffness", contact.stiffness)
    stiffness = stiffness.reshape(number, stiffness.shape[1], -1)[:, :, 0]
    entries = max(stiffness.shape[1], len(contact.damping))
    stiffness = _entries(stiffness, entries)
    if contact.law == "hunt_crossley":
        added = np.pi * ratio / velocity * np.ones_like(stiffness)
    elif contact.law == "depth_damped":
        order = drawn("contact.exponent", contact.exponent)[:, None] + 1
        depth = (order * mass * velocity**2 / (2 * stiffness)) ** (1 / order)
        reach = drawn("contact.reference_depth", getattr(contact, "reference_depth", 1.0))[:, None]
        added = 1.5 * np.pi * ratio / velocity * stiffness * depth ** (order - 2) * reach
    else:
        added = 2 * ratio * np.sqrt(stiffness * mass)
    law = "kelvin_voigt" if contact.law == "linear" else contact.law
    before = _entries(drawn("contact.damping", contact.damping), entries) * (contact.law != "linear")
    # Entries as many as there are draws for.
    listed = list(contact.damping) + [contact.damping[-1]] * (entries - len(contact.damping))
    twin = msgspec.structs.replace(
        mechanism, contact=msgspec.structs.replace(contact, law=law, damping=listed)
    )
    return twin, {**draws, "contact.damping": before + added}


def _mass(mechanism: Mechanism, draws: Mapping[str, np.ndarray]) -> Float[np.ndarray, "draws"]:
    number = len(next(iter(draws.values())))
    bodies = mechanism.bodies

    def drawn(name):
        return np.broadcast_to(draws.get(f"bodies.{name}", getattr(bodies, name)), (number,))

    if bodies.equivalent_mass is not None:
        return drawn("equivalent_mass")
    chaser, target = drawn("chaser_mass"), drawn("target_mass")
    return chaser * target / (chaser + target)


def _entries(values: np.ndarray, entries: int) -> np.ndarray:
    """(draws, entries), the last entry repeated."""
    return values[:, np.minimum(np.arange(entries), values.shape[1] - 1)]
