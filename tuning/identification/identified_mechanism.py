"""Mechanism file of an identification: identified values replace those of the prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxhil.mechanism.file import to_plain_data
from jaxhil.mechanism.structs import Mechanism
from tuning.identification import parameters
from tuning.identification.contact_fit import ContactFit
from tuning.identification.mechanism_file import make_uncertainty_tables, set_value
from tuning.identification.options import IdentificationOptions
from tuning.identification.parameters import SIMULATOR_PREFIX
from tuning.identification.rational import MotionModel
from tuning.identification.records import DEFAULT_MECHANISM_NAME, Campaign
from tuning.identification.result import ParameterEstimate
from tuning.identification.uncertainty_effect import IDENTIFIED_SOURCE_PREFIX


def make_mechanism(
    campaign: Campaign,
    prior: Mechanism | None,
    model: MotionModel | None,
    contact: ContactFit | None,
    estimates: Sequence[ParameterEstimate],
    draws_by_key: Mapping[str, np.ndarray],
    options: IdentificationOptions,
) -> dict[str, Any]:
    """Return the content of a mechanism file in which identified values replace those of the prior.

    Args:
        campaign: Logs of the identification.
        prior: Mechanism with the values that the logs do not determine, or None.
        model: Model of the motion simulator, or None if no model is known.
        contact: Fit of the contact, or None if the prior's contact is used.
        estimates: Estimates of all parameters.
        draws_by_key: Posterior draws of the identified parameters.
        options: Options of the identification.
    """
    timing = campaign.timing
    document: dict[str, Any] = {"schema": "jaxhil/mechanism/1", "name": DEFAULT_MECHANISM_NAME}
    document |= {} if prior is None else to_plain_data(prior)
    speeds = [run.speed for run in campaign.runs if run.speed]
    values = {estimate.key: estimate.value for estimate in estimates}
    document["source"] = _describe_source(campaign)
    document["bodies"] = {"equivalent_mass": campaign.equivalent_mass}
    document.setdefault("approach", {"velocity": float(np.median(speeds)) if speeds else 0.005})
    if contact is not None:
        document["contact"] = parameters.make_contact_section(contact.law, values)
        if prior is None:
            document["approach"]["contacts"] = len(document["contact"]["stiffness"])
    else:
        for key, value in values.items():
            if key.startswith("contact."):
                set_value(document, key, value)
    rig = dict(document.get("rig", {}))
    rig |= {key: getattr(timing, key) for key in ("control_period", "command_latency", "command_hold")}
    rig |= {} if campaign.integrator is None else {"integrator": campaign.integrator}
    simulator = {
        key[len(SIMULATOR_PREFIX) :]: value
        for key, value in values.items()
        if key.startswith(SIMULATOR_PREFIX)
    }
    if simulator and model is not None:
        before = rig.get("simulator", {})
        simulator = {
            **{k: v for k, v in before.items() if k.endswith("_limit")},
            **parameters.make_simulator_section(model),
            "delay": before.get("delay", 0.0),
            **simulator,
        }
        rig["simulator"] = {**simulator, "delay": max(simulator["delay"], 0.0)}
    for section in ("force_sensor", "position_sensor"):
        sensor = {**rig.get(section, {})}
        prefix = f"rig.{section}."
        estimated = {key[len(prefix) :]: value for key, value in values.items() if key.startswith(prefix)}
        if section == "force_sensor" and contact is not None:
            sensor.pop("dead_zone", None)
        if section == "force_sensor" and contact is not None:
            # The estimated delay includes a sensor lag that the contacts do not determine.
            sensor.pop("time_constant", None)
        if "filter.cutoff" in estimated:
            sensor["filter"] = {**sensor["filter"], "cutoff": estimated.pop("filter.cutoff")}
        sensor |= estimated
        rig[section] = {**sensor, "delay": max(sensor.get("delay", 0.0), 0.0)}
    if "rig.contact_plane" in values:
        rig["contact_plane"] = values["rig.contact_plane"]
    document["rig"] = rig
    if draws_by_key:
        document.pop("correlation", None)
    document |= _merge_uncertainty(document, draws_by_key, options)
    return document


def compute_bound_excess(key: str, draws: np.ndarray) -> float:
    """Return how far the mean of the draws is below the parameter's lower bound of 0.

    Return 0 if the mean is not below 0, or if the parameter has no lower bound.
    """
    bounded = key.endswith(".delay") or key.startswith("contact.damping")
    return max(-float(draws.mean()), 0.0) if bounded else 0.0


def _merge_uncertainty(
    document, draws_by_key: Mapping[str, np.ndarray], options: IdentificationOptions
) -> dict[str, Any]:
    """Return the tables `[uncertainty]` and `[correlation]` of the mechanism file.

    The tables contain the identified parameters, and the prior's uncertainty of the other parameters.
    """
    # A damping that is 0 in every draw has no uncertainty.
    keys = [key for key, draws in draws_by_key.items() if np.ptp(draws) > 0.0]
    if not keys:
        return {}
    floors = np.array([
        options.clock if key.endswith(".delay")
        else options.calibration * abs(float(draws_by_key[key].mean())) if key.startswith("contact.stiffness")
        else 0.0
        for key in keys
    ])  # fmt: skip
    offsets = np.array([compute_bound_excess(key, draws_by_key[key]) for key in keys])
    tables = make_uncertainty_tables(keys, np.array([draws_by_key[key] for key in keys]).T, floors, offsets)
    # If the simulator or the contact was identified, the prior's entries for the whole section are dropped.
    sections = {f"{name.rsplit('.', 1)[0]}." for name in tables["uncertainty"]} & {
        SIMULATOR_PREFIX,
        "contact.",
    }
    replaced = (*sections, *tables["uncertainty"])
    prior = {
        key: value for key, value in document.get("uncertainty", {}).items() if not key.startswith(replaced)
    }
    return {**tables, "uncertainty": {**prior, **tables["uncertainty"]}}


def _describe_source(campaign: Campaign) -> str:
    files = ", ".join(f"{name} (SHA-256 {digest[:12]})" for name, digest in campaign.sources.items())
    return f"{IDENTIFIED_SOURCE_PREFIX} {files or 'a campaign in memory'}"[:9_000]
