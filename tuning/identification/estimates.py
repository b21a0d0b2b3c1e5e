"""Estimates with their intervals, from draws of what logs tell and from what sensors say at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaxhil.contact.laws import contact_law
from jaxhil.mechanism.structs import numeric_keys
from tuning.identification.contact import ContactFit
from tuning.identification.result import Estimate

# Where damping may be 0, its intervals and those of what goes along with it are the shortest ones.
DAMPED = ("contact.damping", "rig.force_sensor.delay")
NEAR, CROWD = 0.1, 0.005  # standard deviations from 0, and share of the draws there, that make a crowd


def estimates(found, motion, contact, force, position, fixed) -> tuple[Estimate, ...]:
    """Estimates of what has draws, then of what the sensors say at rest and of what was told."""
    bounded = DAMPED if any(at_zero(one) for key, one in found.items() if key.startswith(DAMPED[0])) else ()
    every = [_of_draws(key, values, key.startswith(bounded)) for key, values in found.items()]
    others = []
    if force is not None and not force.silent:
        others.append(_plain("rig.force_sensor.noise_std", force.std, force.std_std))
        others.append(_plain("rig.force_sensor.bias", force.mean, force.mean_std))
    elif contact is not None:
        std = contact.readings.std
        others.append(_plain("rig.force_sensor.noise_std", std, std / np.sqrt(2.0 * contact.freedom)))
        if force is None:
            bias = contact.posterior.draws[:, contact.posterior.names.index("bias")]
            others.append(_plain("rig.force_sensor.bias", float(bias.mean()), float(bias.std())))
    if force is not None and force.quantum:
        others.append(_plain("rig.force_sensor.quantum", force.quantum, 0.0))
    if position is not None:
        others.append(_plain("rig.position_sensor.noise_std", position.std, position.std_std))
        if position.quantum:
            others.append(_plain("rig.position_sensor.quantum", position.quantum, 0.0))
    elif motion is not None:
        count = sum(len(one.frequency) for one in motion.spectra)
        std = motion.noise_std
        others.append(_plain("rig.position_sensor.noise_std", std, std / np.sqrt(2.0 * max(count, 1))))
    others += [
        Estimate(key, value, 0.0, value, value, unit_of(key), told=True) for key, value in fixed.items()
    ]
    return (*every, *others)


def at_zero(values: np.ndarray) -> bool:
    """Return whether draws that cannot be negative crowd at 0, so that 0 is as likely as any."""
    return bool(np.mean(values <= NEAR * values.std()) > CROWD)


def shortest(values: np.ndarray) -> tuple[float, float]:
    """Return the shortest interval with 95 % of the draws; of those that crowd at 0 it has 0."""
    ordered = np.sort(values)
    inside = int(np.ceil(0.95 * len(ordered)))
    first = int(np.argmin(ordered[inside - 1 :] - ordered[: len(ordered) - inside + 1]))
    return float(ordered[first]), float(ordered[first + inside - 1])


def _of_draws(key: str, values: np.ndarray, bounded: bool = False) -> Estimate:
    low, high = shortest(values) if bounded else np.quantile(values, (0.025, 0.975))
    if bounded and key.startswith(DAMPED[0]) and at_zero(values):
        low, high = 0.0, np.quantile(values, 0.95)
    return Estimate(
        key, float(values.mean()), float(values.std(ddof=1)), float(low), float(high), unit_of(key)
    )


def _plain(key: str, value: float, std: float) -> Estimate:
    return Estimate(key, value, std, value - 1.96 * std, value + 1.96 * std, unit_of(key))


def unit_of(key: str) -> str:
    """SI unit of a key, the number of a list's entry behind it or not."""
    parts = key.split(".")
    while parts[-1].isdigit():
        parts.pop()
    return numeric_keys()[".".join(parts)].unit


def combinations(found: Mapping[str, np.ndarray], contact: ContactFit | None) -> tuple[Estimate, ...]:
    """What the logs tell better than its parts: delays together, damping less stiffness times delay."""
    combined = []
    motion, force = (found.get(key) for key in ("rig.simulator.delay", "rig.force_sensor.delay"))
    lag = found.get("rig.force_sensor.time_constant")
    if force is not None and lag is not None:
        force = force + lag
        combined.append(replace(_of_draws("rig.force_sensor.delay", force), key="delay and lag of force"))
    if motion is not None and force is not None:
        combined.append(
            replace(_of_draws("rig.force_sensor.delay", motion + force), key="delay of motion and force")
        )
    damping, stiffness = found.get("contact.damping.0"), found.get("contact.stiffness.0")
    if contact is None or not contact_law(contact.law.name).is_linear:
        return tuple(combined)
    if force is not None and damping is not None and stiffness is not None:
        apparent = replace(_of_draws("contact.damping", damping - stiffness * force), key="apparent damping")
        combined.append(apparent)
    return tuple(combined)
