"""From a fit's own parameters to the keys of a mechanism file, value by value and draw by draw."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxhil.contact.laws import KEYS, contact_law
from tuning.identification.contact import ContactFit
from tuning.identification.contact_laws import Law
from tuning.identification.normal_draws import factor
from tuning.identification.rational import Model

SIMULATOR = "rig.simulator."


def simulator_section(model: Model) -> dict[str, Any]:
    """`rig.simulator` of a mechanism file."""
    many, values = model.structure, np.exp(model.parameters[: model.structure.order])
    delay = {"delay": float(max(model.delay, 0.0))}
    if many.order == 0:
        return {"model": "ideal", **delay}
    if many.name == "first_order":
        return {"model": "first_order", "time_constant": float(values[0]), **delay}
    if many.name == "second_order":
        natural = {"natural_frequency": float(values[0] / (2.0 * np.pi)), "damping_ratio": float(values[1])}
        return {"model": "second_order", **natural, **delay}
    numerator, denominator = model.fraction
    if many.name == "third_order":
        return {
            "model": "third_order",
            "coefficients": [float(value) for value in denominator[-2::-1]],
            **delay,
        }
    above, below = (part / denominator[-1] for part in (numerator, denominator))
    return {
        "model": "transfer_function",
        "numerator": [float(value) for value in above],
        "denominator": [float(value) for value in below],
        **delay,
    }


def simulator_draws(model: Model, covariance: np.ndarray, frequency: float, count: int, rng) -> tuple[
    dict[str, np.ndarray], np.ndarray
]:  # fmt: skip
    """Draws by key, and by how much the lag at a frequency [Hz] differs in each draw [s].

    First and second order have keys of their own; of other models the delay takes all that is uncertain, the
    lag at the contact's frequency."""
    off = rng.standard_normal((count, len(covariance))) @ factor(covariance).T
    s = np.array([2j * np.pi * frequency])
    slopes = -np.imag(model.slopes(s)[:, 0]) / (2.0 * np.pi * frequency)
    lag = off @ slopes
    values = model.parameters + off
    name = model.structure.name
    if name == "first_order":
        return {SIMULATOR + "time_constant": np.exp(values[:, 0]), SIMULATOR + "delay": values[:, 1]}, lag
    if name == "second_order":
        return {
            SIMULATOR + "natural_frequency": np.exp(values[:, 0]) / (2.0 * np.pi),
            SIMULATOR + "damping_ratio": np.exp(values[:, 1]),
            SIMULATOR + "delay": values[:, 2],
        }, lag
    return {SIMULATOR + "delay": model.delay + lag}, lag


def contact_draws(contact: ContactFit) -> dict[str, np.ndarray]:
    """Draws by key; a list's entries have their number behind the key."""
    draws = contact.draws()
    own = dict(zip(contact.posterior.names, draws.T, strict=True))
    found = {"rig.force_sensor.delay": own["delay"]}
    if "time_constant" in own:
        found["rig.force_sensor.time_constant"] = own["time_constant"]
    if contact.problem.plane is None:
        found["rig.contact_plane"] = own["plane"]
    law = contact_law(contact.law.name)
    for i in contact.readings.entries:
        fitted = {name: own[f"{name}.{i}"] for name in contact.law.names if f"{name}.{i}" in own}
        found |= law.file_values(fitted, i)
    if "damping" in own:
        found["contact.damping.0"] = own["damping"]
    if contact.dead_zone:
        found["rig.force_sensor.dead_zone"] = -own["bias"]
    return found


def contact_section(law: Law, values: dict[str, float]) -> dict[str, Any]:
    """`contact` of a mechanism file from values by key."""
    section: dict[str, Any] = {"law": law.name, **law.shape}
    stiffness = _entries(values, "contact.stiffness.")
    segmented = contact_law(law.name).segmented
    section["stiffness"] = stiffness if segmented else [one for (one,) in stiffness]
    if damping := _entries(values, "contact.damping."):
        section["damping"] = [max(one, 0.0) for (one,) in damping]
    return section | {key: values[f"contact.{key}"] for key in KEYS if f"contact.{key}" in values}


def _entries(values: dict[str, float], prefix: str) -> list[list[float]]:
    """The values of a list's entries in order; an entry that was never met is that before it."""
    found: dict[int, list[float]] = {}
    for key in sorted(key for key in values if key.startswith(prefix)):
        found.setdefault(int(key[len(prefix) :].split(".")[0]), []).append(values[key])
    if not found:
        return []
    first = min(found)
    return [found[max((i for i in found if i <= j), default=first)] for j in range(max(found) + 1)]
