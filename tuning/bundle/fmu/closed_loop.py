"""Closed loop of a bundle's FMUs, controller and rig, compared with `simulate`.

A sequential master (co-simulation program) steps one FMU after the other.
"""

import math
from collections.abc import Mapping
from typing import Any

import msgspec
from msgspec import structs

from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.run import simulate
from tuning.bundle.controller_kind import ONE_AXIS, kind_of
from tuning.bundle.fmu import controller, rig
from tuning.bundle.fmu.archive import find_compiler
from tuning.bundle.fmu.library import FmuError, FmuInstance
from tuning.bundle.fmu.variables import controller_variables
from tuning.rig.contact_detector import ContactDetector

FMU_LOOP_LIMIT = 1e-9  # largest difference of a contact's restitution [1]
MAX_LATENCY = 4  # largest `rig.command_latency` [periods]
READINGS = ("force_measured", "position_measured", "position", "velocity", "acceleration")


class FmuContact(msgspec.Struct, frozen=True):
    """Nominal contact in the loop of both FMUs, and in the simulation."""

    restitution: float | None  # restitution with the FMUs [1]; None if the contact does not end
    simulated_restitution: float | None  # restitution of `simulate` with the master's period [1]
    status: str  # status of the contact in the loop of FMUs
    simulated_status: str  # status of the contact in the simulation


class FmuLoop(msgspec.Struct, frozen=True):
    """Comparison of the nominal contacts in the loop of both FMUs with the simulation."""

    fmi: int  # version of FMI
    command_latency: int  # `rig.command_latency` of the simulation, with the period of the master [periods]
    contacts: tuple[FmuContact, ...]
    reasons: tuple[str, ...]  # differences between FMUs and simulation; empty if both agree


def compare_fmu_loop(files: Mapping[str, bytes], loaded: Any) -> FmuLoop | None:
    """Close the loop through the FMUs of a checked bundle; compare the nominal contacts with the simulation.

    The libraries are compiled from the sources, which `check_bundle` has verified. The sequential master adds
    one period to the command latency. Noise and the controller's limits are left out, because the limits may
    stop this run.

    Args:
        files: content of the bundle's files.
        loaded: gain file of the bundle.

    Returns:
        The comparison; None if there is no compiler, or no pair of FMUs that the simulation can repeat.
    """
    document, mechanism = loaded.document, loaded.mechanism
    fmi = next((version for version in (3, 2) if f"fmi{version}/{rig.IDENTIFIER}.fmu" in files), None)
    if fmi is None or kind_of(document) is not ONE_AXIS or find_compiler() is None:
        return None
    extra = document.get("figures", {}).get("co_simulation", {}).get("extra_periods", 0)
    latency = mechanism.rig.command_latency + (1 - extra)
    if not 0 <= latency <= MAX_LATENCY or mechanism.rig.force_sensor.bias != 0.0:
        return None
    quiet = _without_noise(mechanism, latency)
    expected = simulate(quiet, loaded.compensator, loaded.gains).contacts
    try:
        contacts = _run_loop(files, fmi, document, quiet)
    except FmuError as error:
        return FmuLoop(fmi, latency, (), (f"fmi{fmi}: {error}",))
    comparisons = tuple(
        FmuContact(_number(contact.restitution), _number(other.restitution), contact.status, other.status)
        for contact, other in zip(contacts, expected, strict=False)
    )
    reasons = [
        f"fmi{fmi}, contact {number}: found {difference} (simulation with rig.command_latency = {latency})"
        for number, contact in enumerate(comparisons, start=1)
        if (difference := _find_difference(contact))
    ]
    return FmuLoop(fmi, latency, comparisons, tuple(reasons))


def _find_difference(contact: FmuContact) -> str:
    """Return the difference between both loops in words; an empty text if they agree."""
    found, simulated = contact.restitution, contact.simulated_restitution
    if contact.status != contact.simulated_status:
        return f"status '{contact.status}' with both FMUs, expected '{contact.simulated_status}'"
    if found is None or simulated is None or abs(found - simulated) <= FMU_LOOP_LIMIT:
        return ""
    return f"e = {found!r} with both FMUs, expected {simulated!r}"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _without_noise(mechanism: Mechanism, latency: int) -> Mechanism:
    """Return the mechanism with this command latency and without noise of the sensors."""
    sensors = {
        name: structs.replace(getattr(mechanism.rig, name), noise_std=0.0)
        for name in ("force_sensor", "position_sensor")
    }
    return structs.replace(
        mechanism, rig=structs.replace(mechanism.rig, command_latency=latency, **sensors), uncertainty={}
    )


def _run_loop(files: Mapping[str, bytes], fmi: int, document: Mapping[str, Any], mechanism: Mechanism):
    """Run the nominal contacts as a sequential master, the controller first; return the contacts.

    Each run begins at the speed of the previous rebound.
    """
    period, limits = mechanism.rig.control_period, ONE_AXIS.limits
    regulator = FmuInstance(
        files[f"fmi{fmi}/{controller.IDENTIFIER}.fmu"], controller_variables(document), period
    )
    plant = FmuInstance(files[f"fmi{fmi}/{rig.IDENTIFIER}.fmu"], rig.rig_variables(mechanism), period)
    regulator.begin(**{f"limits.{name}": limit.default for name, limit in limits.items()})
    plant.begin(force_noise=0.0, position_noise=0.0)
    watch, contacts, two_sided = ContactDetector(mechanism), [], math.isfinite(mechanism.contact.clearance)
    while len(contacts) < mechanism.approach.contacts:
        sensed = plant.get(*READINGS, "contact_force")
        motion = sensed["position"], sensed["velocity"]
        inputs = {name: sensed[name] for name in READINGS}
        regulator.set({**inputs, "position_desired": motion[0], "velocity_desired": motion[1]})
        regulator.step()
        commands = regulator.get("force_command", "position_command")
        regulator.set({"next_contact": False})
        plant.set({**commands, "next_run": False})
        contact = watch.observe(
            *motion, commands["force_command"], sensed["contact_force"], sensed["force_measured"]
        )
        if contact is not None:
            contacts.append(contact)
            if contact.status != "ok":
                break
            plant.set({"contact": len(contacts), "next_run": not two_sided})
            regulator.set({"next_contact": not two_sided})
            if not two_sided:
                watch.begin(len(contacts))
        plant.step()
    regulator.close()
    plant.close()
    return contacts
