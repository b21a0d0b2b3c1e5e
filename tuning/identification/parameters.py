"""Conversion of fitted parameters and posterior draws to the keys of a mechanism file."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxhil.contact.laws import CONTACT_KEYS, find_contact_law
from tuning.identification.contact_fit import SPECIFIED_DEAD_ZONE_STD, ContactFit
from tuning.identification.contact_laws import Law
from tuning.identification.cut_zone import draw_zone
from tuning.identification.rational import MotionModel

SIMULATOR_PREFIX, CUTOFF_KEY = "rig.simulator.", "rig.force_sensor.filter.cutoff"
DEAD_ZONE_KEY, BIAS_KEY = "rig.force_sensor.dead_zone", "rig.force_sensor.bias"


def make_simulator_section(model: MotionModel) -> dict[str, Any]:
    """Return the section `rig.simulator` of a mechanism file that describes the model."""
    structure, values = model.structure, np.exp(model.parameters[: model.structure.order])
    delay = {"delay": float(max(model.delay, 0.0))}
    if structure.name == "moving_average":
        return {"model": "moving_average", "window": float(values[0]), **delay}
    if structure.order == 0:
        return {"model": "ideal", **delay}
    if structure.name == "first_order":
        return {"model": "first_order", "time_constant": float(values[0]), **delay}
    if structure.name == "second_order":
        natural = {"natural_frequency": float(values[0] / (2.0 * np.pi)), "damping_ratio": float(values[1])}
        return {"model": "second_order", **natural, **delay}
    numerator, denominator = model.fraction
    if structure.name == "third_order":
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


def draw_simulator_parameters(
    model: MotionModel, deviations: np.ndarray, frequency: float
) -> dict[str, np.ndarray]:
    """Return draws of the motion simulator's parameters by key.

    For a moving average or a first- or second-order model, the draws contain all parameters. For any other
    model, they contain only the delay: the fitted delay plus the deviation of the phase delay at the contact
    frequency.

    Args:
        model: Fitted model.
        deviations: Deviations of the draws from the model's parameters, shape (draws, parameters).
        frequency: Contact frequency [Hz].
    """
    values = model.parameters + deviations
    name = model.structure.name
    if name in ("first_order", "moving_average"):
        return {
            SIMULATOR_PREFIX + model.names[0]: np.exp(values[:, 0]),
            SIMULATOR_PREFIX + "delay": values[:, 1],
        }
    if name == "second_order":
        return {
            SIMULATOR_PREFIX + "natural_frequency": np.exp(values[:, 0]) / (2.0 * np.pi),
            SIMULATOR_PREFIX + "damping_ratio": np.exp(values[:, 1]),
            SIMULATOR_PREFIX + "delay": values[:, 2],
        }
    s = np.array([2j * np.pi * frequency])
    slopes = -np.imag(model.slopes(s)[:, 0]) / (2.0 * np.pi * frequency)
    return {SIMULATOR_PREFIX + "delay": model.delay + deviations @ slopes}


def convert_contact_draws(contact: ContactFit) -> dict[str, np.ndarray]:
    """Return the posterior draws of the contact by key; the key of a list entry ends in its index."""
    draws = contact.draws()
    draws_by_name = dict(zip(contact.posterior.names, draws.T, strict=True))
    result = {"rig.force_sensor.delay": draws_by_name["delay"]}
    if "time_constant" in draws_by_name:
        time_constants = draws_by_name["time_constant"]
        if not contact.readings.time_constant:
            result["rig.force_sensor.time_constant"] = time_constants
        elif np.ptp(time_constants) > 0.0:  # otherwise, the cutoff is that of the prior
            result[CUTOFF_KEY] = 0.5 / (np.pi * time_constants)
    if contact.problem.plane is None:
        result["rig.contact_plane"] = draws_by_name["plane"]
    law = find_contact_law(contact.law.name)
    for i in contact.readings.entries:
        fitted = {
            name: draws_by_name[f"{name}.{i}"] for name in contact.law.names if f"{name}.{i}" in draws_by_name
        }
        result |= law.file_values(fitted, i)
    if "damping" in draws_by_name:
        result["contact.damping.0"] = draws_by_name["damping"]
    if contact.readings.zone:
        result[DEAD_ZONE_KEY] = draw_zone(contact.problem, contact.posterior)
    elif contact.dead_zone:
        result |= _draw_dead_zone(contact, draws_by_name["bias"])
    return result


def _draw_dead_zone(contact: ContactFit, offset: np.ndarray) -> dict[str, np.ndarray]:
    """Return draws of a continuous dead zone [N] and of the bias [N]; `offset` is bias minus zone."""
    normal = np.random.default_rng(0).standard_normal(len(offset))
    if stated := contact.readings.subtracted:
        size = stated * (1.0 + SPECIFIED_DEAD_ZONE_STD * normal)
    elif contact.hidden_noise is not None:
        size = contact.hidden_noise.draw_zone(-offset, normal)
    else:
        # Adding 0.0 changes -0.0, which would be printed with its sign, to 0.0.
        return {DEAD_ZONE_KEY: np.maximum(-offset, 0.0) + 0.0}
    return {DEAD_ZONE_KEY: size, BIAS_KEY: offset + size}


def make_contact_section(law: Law, values: dict[str, float]) -> dict[str, Any]:
    """Return the section `contact` of a mechanism file for a law with the given values by key."""
    section: dict[str, Any] = {"law": law.name, **law.shape}
    stiffness = _collect_entries(values, "contact.stiffness.")
    is_segmented = find_contact_law(law.name).is_segmented
    section["stiffness"] = stiffness if is_segmented else [value for (value,) in stiffness]
    if damping := _collect_entries(values, "contact.damping."):
        section["damping"] = [max(value, 0.0) for (value,) in damping]
    return section | {key: values[f"contact.{key}"] for key in CONTACT_KEYS if f"contact.{key}" in values}


def _collect_entries(values: dict[str, float], prefix: str) -> list[list[float]]:
    """Return the list entries whose keys begin with `prefix`; a missing entry equals the previous one."""
    entries: dict[int, list[float]] = {}
    for key in sorted(key for key in values if key.startswith(prefix)):
        entries.setdefault(int(key[len(prefix) :].split(".")[0]), []).append(values[key])
    if not entries:
        return []
    first = min(entries)
    return [entries[max((i for i in entries if i <= j), default=first)] for j in range(max(entries) + 1)]
