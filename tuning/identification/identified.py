"""The mechanism that an identification found, as a mechanism file has it: over what the prior says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxhil.mechanism.file import to_builtins
from jaxhil.mechanism.structs import Mechanism
from tuning.identification import parameters
from tuning.identification.contact import ContactFit
from tuning.identification.mechanism_file import put, uncertainty_tables
from tuning.identification.options import Options
from tuning.identification.parameters import SIMULATOR
from tuning.identification.rational import Model
from tuning.identification.records import UNNAMED, Campaign
from tuning.identification.result import Estimate
from tuning.identification.uncertain_effect import IDENTIFIED


def mechanism_of(
    campaign: Campaign,
    prior: Mechanism | None,
    model: Model | None,
    contact: ContactFit | None,
    estimates: Sequence[Estimate],
    found: Mapping[str, np.ndarray],
    options: Options,
) -> dict[str, Any]:
    """As a mechanism file has it: what was found over what the prior says."""
    timing = campaign.timing
    document: dict[str, Any] = {"schema": "jaxhil/mechanism/1", "name": UNNAMED}
    document |= {} if prior is None else to_builtins(prior)
    speeds = [run.speed for run in campaign.runs if run.speed]
    values = {one.key: one.value for one in estimates}
    document["source"] = _source(campaign)
    document["bodies"] = {"equivalent_mass": campaign.equivalent_mass}
    document.setdefault("approach", {"velocity": float(np.median(speeds)) if speeds else 0.005})
    if contact is not None:
        document["contact"] = parameters.contact_section(contact.law, values)
        if prior is None:
            document["approach"]["contacts"] = len(document["contact"]["stiffness"])
    else:
        for key, value in values.items():
            if key.startswith("contact."):
                put(document, key, value)
    rig = dict(document.get("rig", {}))
    rig |= {
        "control_period": timing.control_period,
        "command_latency": timing.command_latency,
        "command_hold": timing.command_hold,
    }
    rig |= {} if campaign.integrator is None else {"integrator": campaign.integrator}
    simulator = {key[len(SIMULATOR) :]: one for key, one in values.items() if key.startswith(SIMULATOR)}
    if simulator and model is not None:
        before = rig.get("simulator", {})
        simulator = {
            **{k: v for k, v in before.items() if k.endswith("_limit")},
            **parameters.simulator_section(model),
            "delay": before.get("delay", 0.0),
            **simulator,
        }
        rig["simulator"] = {**simulator, "delay": max(simulator["delay"], 0.0)}
    for section in ("force_sensor", "position_sensor"):
        told = {**rig.get(section, {})}
        if section == "force_sensor" and contact is not None:
            # What touches do not show is not there: a lag is in the delay that was found.
            told = {key: value for key, value in told.items() if key not in ("time_constant", "dead_zone")}
        prefix = f"rig.{section}."
        told |= {key[len(prefix) :]: value for key, value in values.items() if key.startswith(prefix)}
        rig[section] = {**told, "delay": max(told.get("delay", 0.0), 0.0)}
    if "rig.contact_plane" in values:
        rig["contact_plane"] = values["rig.contact_plane"]
    document["rig"] = rig
    if found:
        document.pop("correlation", None)
    document |= _uncertainty(document, found, options)
    return document


def off_bound(key: str, draws: np.ndarray) -> float:
    """Return by how much the file's value exceeds the draws' mean: a delay or a damping is at least 0."""
    bounded = key.endswith(".delay") or key.startswith("contact.damping")
    return max(-float(draws.mean()), 0.0) if bounded else 0.0


def _uncertainty(document, found: Mapping[str, np.ndarray], options: Options) -> dict[str, Any]:
    """The prior's for what was not found, and what was found, with its correlation."""
    # A damping that is 0 in every draw is no number to draw.
    keys = [key for key, draws in found.items() if np.ptp(draws) > 0.0]
    if not keys:
        return {}
    floors = np.array([
        options.clock if key.endswith(".delay")
        else options.calibration * abs(float(found[key].mean())) if key.startswith("contact.stiffness")
        else 0.0
        for key in keys
    ])  # fmt: skip
    off = np.array([off_bound(key, found[key]) for key in keys])
    tables = uncertainty_tables(keys, np.array([found[key] for key in keys]).T, floors, off)
    # Of a simulator or a contact that was found nothing of the prior's is left.
    sections = {f"{name.rsplit('.', 1)[0]}." for name in tables["uncertainty"]} & {SIMULATOR, "contact."}
    gone = (*sections, *tables["uncertainty"])
    kept = {key: one for key, one in document.get("uncertainty", {}).items() if not key.startswith(gone)}
    return {**tables, "uncertainty": {**kept, **tables["uncertainty"]}}


def _source(campaign: Campaign) -> str:
    files = ", ".join(f"{name} (SHA-256 {digest[:12]})" for name, digest in campaign.sources.items())
    return f"{IDENTIFIED} {files or 'a campaign in memory'}"[:9_000]
