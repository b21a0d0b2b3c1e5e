"""Closed loop of a bundle's FMUs, controller and rig, compared with `simulate`.

A sequential master (co-simulation program) steps one FMU after the other.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
from msgspec import structs

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.run import simulate
from jaxhil.sixdof.run import simulate_six_axes
from tuning.bundle.controller_kind import kind_of
from tuning.bundle.fmu import controller, rig
from tuning.bundle.fmu.archive import find_compiler
from tuning.bundle.fmu.library import FmuError, FmuInstance
from tuning.bundle.fmu.variables import controller_variables, six_axis_names
from tuning.rig.contact_detector import ContactDetector
from tuning.verification.six_axes import FinalTwist, compare_final_twists

FMU_LOOP_LIMIT = 1e-9  # largest difference of a contact's restitution, or of the final twist [1]
MAX_LATENCY = 4  # largest `rig.command_latency` [periods]
READINGS = ("force_measured", "position_measured", "position", "velocity", "acceleration")
SIX_AXIS_READINGS = ("wrench_measured", "pose_measured", "pose", "twist")


class FmuContact(msgspec.Struct, frozen=True):
    """Nominal contact, as computed with the FMUs of controller and rig, and as simulated."""

    restitution: float | None  # restitution with the FMUs [1]; None if the contact does not end
    simulated_restitution: float | None  # restitution of `simulate` with the master's period [1]
    status: str  # status of the contact that the FMUs computed
    simulated_status: str  # status of the contact that `simulate` computed


class FmuLoop(msgspec.Struct, frozen=True):
    """Comparison of two nominal runs: one computed by the FMUs of controller and rig, one by `simulate`.

    On one axis, the contacts are compared; with six axes, the twist at the end of the run.
    """

    fmi: int  # version of FMI
    command_latency: int  # `rig.command_latency` of the simulation, with the period of the master [periods]
    contacts: tuple[FmuContact, ...]
    reasons: tuple[str, ...]  # differences between FMUs and simulation; empty if both agree
    final_twist: FinalTwist | None = None  # twist at the end of the run with six axes; None on one axis


def compare_fmu_loop(files: Mapping[str, bytes], loaded: Any) -> FmuLoop | None:
    """Run the nominal contacts with the FMUs of a checked bundle, and compare them with the simulation.

    The libraries are compiled from the sources, which `check_bundle` has verified. The sequential master adds
    one period to the command latency. The controller has no limits here, because they may stop this run. On
    one axis, the sensors have no noise, because the random generators of FMU and simulation differ.

    Args:
        files: content of the bundle's files.
        loaded: gain file of the bundle.

    Returns:
        The comparison. It is None without a compiler or FMU of the rig, or if the simulation cannot repeat
        the run: the latency is out of range or, on one axis, the force sensor has a bias.
    """
    document, mechanism = loaded.document, loaded.mechanism
    fmi = next((version for version in (3, 2) if f"fmi{version}/{rig.IDENTIFIER}.fmu" in files), None)
    if fmi is None or find_compiler() is None:
        return None
    extra = document.get("figures", {}).get("co_simulation", {}).get("extra_periods", 0)
    latency = mechanism.rig.command_latency + (1 - extra)
    if not 0 <= latency <= MAX_LATENCY:
        return None
    late = structs.replace(mechanism, rig=structs.replace(mechanism.rig, command_latency=latency))
    try:
        if not isinstance(late, Mechanism):
            return _compare_final_twist(files, fmi, loaded, late)
        return None if late.rig.force_sensor.bias else _compare_contacts(files, fmi, loaded, late)
    except FmuError as error:
        return FmuLoop(fmi, latency, (), (f"fmi{fmi}: {error}",))


def _compare_contacts(files: Mapping[str, bytes], fmi: int, loaded: Any, mechanism: Mechanism) -> FmuLoop:
    """Compare the nominal contacts with the FMUs to the simulated ones, on one axis."""
    latency, quiet = mechanism.rig.command_latency, _without_noise(mechanism)
    expected = simulate(quiet, loaded.compensator, loaded.gains).contacts
    contacts = _run_loop(files, fmi, loaded.document, quiet)
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


def _compare_final_twist(files: Mapping[str, bytes], fmi: int, loaded: Any, mechanism: Any) -> FmuLoop:
    """Compare the final twist of the nominal run with the FMUs to the simulated one, with six axes."""
    latency, period = mechanism.rig.command_latency, mechanism.rig.control_period
    final = simulate_six_axes(mechanism, loaded.compensator, loaded.gains).final
    ticks = round(final.time / period)
    final_twist = _run_six_axis_loop(files, fmi, loaded.document, mechanism, ticks)
    compared = compare_final_twists(final_twist, np.array(final.twist), ticks, "ok")
    reasons = ()
    if not compared.difference <= FMU_LOOP_LIMIT:
        reasons = (
            f"fmi{fmi}, final twist: found a difference of {compared.difference:.1e}, expected "
            f"{FMU_LOOP_LIMIT:.0e} or less (simulation with rig.command_latency = {latency})",
        )
    return FmuLoop(fmi, latency, (), reasons, compared)


def _find_difference(contact: FmuContact) -> str:
    """Describe the difference between FMUs and simulation; return an empty text if they agree."""
    found, simulated = contact.restitution, contact.simulated_restitution
    if contact.status != contact.simulated_status:
        return f"status '{contact.status}' with both FMUs, expected '{contact.simulated_status}'"
    if found is None or simulated is None or abs(found - simulated) <= FMU_LOOP_LIMIT:
        return ""
    return f"e = {found!r} with both FMUs, expected {simulated!r}"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _without_noise(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism without noise of the sensors."""
    sensors = {
        name: structs.replace(getattr(mechanism.rig, name), noise_std=0.0)
        for name in ("force_sensor", "position_sensor")
    }
    return structs.replace(mechanism, rig=structs.replace(mechanism.rig, **sensors), uncertainty={})


@contextmanager
def _both_fmus(
    files: Mapping[str, bytes], fmi: int, document: Mapping[str, Any], mechanism: AnyMechanism, **noise: float
) -> Iterator[tuple[FmuInstance, FmuInstance]]:
    """Context manager: provide the FMUs of controller (without limits) and rig (with `noise`)."""
    period, limits = mechanism.rig.control_period, kind_of(document).limits
    regulator = FmuInstance(
        files[f"fmi{fmi}/{controller.IDENTIFIER}.fmu"], controller_variables(document), period
    )
    plant = FmuInstance(files[f"fmi{fmi}/{rig.IDENTIFIER}.fmu"], rig.rig_variables(mechanism), period)
    regulator.begin(**{f"limits.{name}": limit.default for name, limit in limits.items()})
    plant.begin(**noise)
    yield regulator, plant
    regulator.close()
    plant.close()


def _run_six_axis_loop(
    files: Mapping[str, bytes], fmi: int, document: Mapping[str, Any], mechanism: Any, ticks: int
) -> np.ndarray:
    """Step the FMUs in turn, the controller's first, for `ticks` periods; return the final twist (6,)."""
    readings = [name for vector in SIX_AXIS_READINGS for name in six_axis_names(vector)]
    commands = [name for vector in ("wrench_command", "pose_command") for name in six_axis_names(vector)]
    with _both_fmus(files, fmi, document, mechanism) as (regulator, plant):
        for _ in range(ticks):
            sensed = plant.get(*readings)
            desired = {
                f"{vector}_desired.{name.partition('.')[2]}": sensed[name]
                for vector in ("pose", "twist")
                for name in six_axis_names(vector)
            }
            regulator.set(sensed | desired)
            regulator.step()
            plant.set(regulator.get(*commands))
            plant.step()
        return np.array([*plant.get(*six_axis_names("twist")).values()])


def _run_loop(files: Mapping[str, bytes], fmi: int, document: Mapping[str, Any], mechanism: Mechanism):
    """Step the FMUs in turn, the controller's first, until all contacts end or one fails; return them.

    With one contact surface, each contact is a new run, which begins at the speed of the previous rebound.
    """
    watch, contacts, two_sided = ContactDetector(mechanism), [], math.isfinite(mechanism.contact.clearance)
    with _both_fmus(files, fmi, document, mechanism, force_noise=0.0, position_noise=0.0) as (
        regulator,
        plant,
    ):
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
    return contacts
