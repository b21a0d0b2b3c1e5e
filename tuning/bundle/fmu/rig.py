"""FMU of the rig: numerical model, motion simulator, contact and sensors of a mechanism.

On one axis, the C code has the equations of `tuning.rig.plant`, and this module generates its constants. With
six axes, `tuning.bundle.fmu.rig_six_axes` generates the C code.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import structs

from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.file import AnyMechanism, any_from_plain_data
from jaxhil.mechanism.structs import Contact, Mechanism
from tuning.bundle.c99_tables import format_double
from tuning.bundle.fmu.archive import build_fmu
from tuning.bundle.fmu.sources import read_source
from tuning.bundle.fmu.variables import (
    MODEL_MASSES,
    SEED,
    TIME,
    Variable,
    six_axis_vector,
    target_angular_velocity,
)
from tuning.rig.plant import PlantConstants, compute_plant_constants

IDENTIFIER = "jaxhil_rig"
LAWS = (
    *("linear", "kelvin_voigt", "hunt_crossley", "piecewise_linear"),
    *("hardening", "depth_damped", "elastoplastic", "preloaded"),
)
# Bounds of the parameters: values from which a simulation remains finite.
SPEEDS, FORCES, DISTANCES = (1e-9, 1e3), (0.0, 1e9), (0.0, 1e3)
SOURCE_FILES = ("numerical_model.h", "contact_law.h", "contact_law.c", "sensor_lag.h", "sensor_lag.c")

_CONSTANTS_TEMPLATE = """\
/* Constants of the rig, from the mechanism file; numbers in SI units. */
#ifndef RIG_CONSTANTS_H
#define RIG_CONSTANTS_H

#include <math.h>

enum {{ {laws} }};

{macros}
{tables}
#endif
"""


class UnsupportedRig(InputError):
    """Rig with a property that its FMU cannot simulate."""


def describe_unsupported(mechanism: AnyMechanism) -> str | None:
    """Describe the first property of the rig that its FMU cannot simulate; return None if there is none."""
    sensor = mechanism.rig.force_sensor
    effects = {"missed_tick_probability": mechanism.rig.missed_tick_probability}
    if isinstance(mechanism, Mechanism):
        if mechanism.contact.law not in LAWS:
            law = format_value(mechanism.contact.law)
            return f"contact.law: found {law}, expected one of {', '.join(LAWS)}"
        effects = {
            "force_sensor.jitter": sensor.jitter,
            "force_sensor.loss_probability": sensor.loss_probability,
            "force_sensor.bias_random_walk": sensor.bias_random_walk,
            **effects,
        }
    if sensor.filter is not None:
        return "rig.force_sensor.filter: found a filter, expected none"
    for key, value in effects.items():
        if value:
            return f"rig.{key}: found {value:g}, expected 0"
    return None


def rig_fmu(document: Mapping[str, Any], fmi: int) -> bytes:
    """Return the archive of the rig's FMU, without library, for the mechanism of a gain document.

    Args:
        document: gain document.
        fmi: version of FMI, 2 or 3.

    Raises:
        UnsupportedRig: If the rig's FMU cannot simulate the rig, see `describe_unsupported`.
        InputError: If a user's contact law has an operation that the generator of C code does not know.
    """
    mechanism = without_extra_periods(document)
    unsupported = describe_unsupported(mechanism)
    if unsupported is not None:
        raise UnsupportedRig(f"fmu: {unsupported}; no FMU of the rig can be written")
    return build_fmu(
        identifier=IDENTIFIER,
        name=f"{IDENTIFIER}: {mechanism.name}",
        description="Simulated docking rig: numerical model, motion simulator, contact and sensors",
        period=mechanism.rig.control_period,
        variables=rig_variables(mechanism),
        files=model_files(document, mechanism),
        constants={},
        fmi=fmi,
    )


def model_files(document: Mapping[str, Any], mechanism: AnyMechanism) -> dict[str, str]:
    """Return the C files of the rig's model."""
    if isinstance(mechanism, Mechanism):
        return {
            **{name: read_source(name) for name in SOURCE_FILES},
            "fmu_model.h": read_source("rig.h"),
            "fmu_model.c": read_source("rig.c"),
            "rig_constants.h": rig_constants(mechanism),
        }
    from tuning.bundle.fmu.rig_six_axes import rig_program

    return {
        "fmu_model.h": read_source("rig_six_axes.h"),
        "fmu_model.c": read_source("rig_six_axes.c"),
        **rig_program(document, mechanism),
    }


def without_extra_periods(document: Mapping[str, Any]) -> AnyMechanism:
    """Return the mechanism of a gain document, without the command latency that a co-simulation adds."""
    mechanism = any_from_plain_data(copy.deepcopy(document["mechanism"]), "gain document")
    extra = document.get("figures", {}).get("co_simulation", {}).get("extra_periods", 0)
    if not 0 <= extra <= mechanism.rig.command_latency:
        expected = f"0 to {mechanism.rig.command_latency}, the rig.command_latency"
        raise InputError(
            f"figures.co_simulation.extra_periods: found {format_value(extra)}, expected {expected}"
        )
    latency = mechanism.rig.command_latency - extra
    return structs.replace(mechanism, rig=structs.replace(mechanism.rig, command_latency=latency))


def rig_variables(mechanism: AnyMechanism) -> list[Variable]:
    """Return the variables of the rig's FMU, in the order of their value references."""
    return _one_axis_variables(mechanism) if isinstance(mechanism, Mechanism) else _six_axis_variables()


def _six_axis_variables() -> list[Variable]:
    """Return the variables of the FMU of a rig with six axes."""
    return [
        TIME,
        *six_axis_vector("wrench_command", "wrench", "input", "wrench of the controller about T's origin"),
        *six_axis_vector("pose_command", "pose", "input", "pose command to the motion simulator"),
        *six_axis_vector("wrench_measured", "wrench", "output", "measured wrench about T's origin"),
        *six_axis_vector("pose_measured", "pose", "output", "measured pose of C relative to T"),
        *six_axis_vector("pose", "pose", "output", "pose of C relative to T in the numerical model"),
        *six_axis_vector("twist", "twist", "output", "twist of C relative to T in the numerical model"),
        *six_axis_vector("wrench_contact", "wrench", "output", "real wrench without effects of the sensor"),
        *target_angular_velocity("output"),
        SEED,
    ]


def _one_axis_variables(mechanism: Mechanism) -> list[Variable]:
    rig, approach = mechanism.rig, mechanism.approach
    force, position = rig.force_sensor, rig.position_sensor

    def parameter(name: str, unit: str, description: str, start: float, lowest: float, highest: float):
        return Variable(name, "parameter", "real", description, unit, start, lowest, highest)

    def output(name: str, unit: str, description: str):
        return Variable(name, "output", "real", description, unit)

    return [
        TIME,
        Variable("force_command", "input", "real", "force of the controller on the numerical model", "N"),
        Variable("position_command", "input", "real", "position command to the motion simulator", "m"),
        Variable("next_run", "input", "boolean", "true in a step that begins a run, at the rebound speed"),
        Variable("contact", "input", "integer", "index of the next contact in the mechanism's lists"),
        output("force_measured", "N", "reading of the force sensor, compression positive"),
        output("position_measured", "m", "position reading of the motion simulator"),
        output("position", "m", "position of the numerical model"),
        output("velocity", "m/s", "velocity of the numerical model"),
        output("acceleration", "m/s^2", "acceleration of the numerical model in the last period"),
        output("contact_force", "N", "real contact force, without the effects of the sensor"),
        output("position_shortfall", "m", "distance between the requested and the rate-limited command"),
        parameter("equivalent_mass", "kg", "mass of the model", mechanism.bodies.mass, *MODEL_MASSES),
        parameter("approach_velocity", "m/s", "speed of the first approach", approach.velocity, *SPEEDS),
        parameter("approach_phase", "1", "phase of the first touch in a period", approach.phase, 0.0, 1.0),
        parameter("force_noise", "N", "standard deviation of the noise", force.noise_std, *FORCES),
        parameter("position_noise", "m", "standard deviation of the noise", position.noise_std, *DISTANCES),
        SEED,
    ]  # fmt: skip


def rig_constants(mechanism: Mechanism) -> str:
    """Return the text of `rig_constants.h` for a mechanism."""
    rig, contact = mechanism.rig, mechanism.contact
    force, simulator = rig.force_sensor, rig.simulator
    plant = compute_plant_constants(mechanism)
    stiffness, damping, depths = _contact_tables(contact)
    integers = {
        "RIG_ORDER": max(1, len(plant.rows.transition)),  # an array in C has at least one element
        "RIG_LATENCY": rig.command_latency,
        "RIG_LINEAR_HOLD": int(rig.command_hold == "linear"),
        "RIG_RING": plant.ring_size,
        "RIG_WINDOW_INTERVALS": -1 if plant.rows.window_intervals is None else plant.rows.window_intervals,
        "RIG_CONTACT_INTERVALS": plant.contact_intervals,
        "RIG_FORCE_INTERVALS": plant.force_intervals,
        "RIG_POSITION_INTERVALS": plant.position_intervals,
        "RIG_CONTACTS": len(stiffness),
        "RIG_LAYERS": len(stiffness[0]),
        "RIG_LAW": f"LAW_{contact.law.upper()}",
        "RIG_TENSION": int(bool(getattr(contact, "tension", False))),
        "RIG_DEAD_ZONE_CUTS": int(force.dead_zone_kind == "cut"),
        "RIG_INTEGRATOR": f"INTEGRATOR_{rig.integrator.upper()}",
    }
    numbers = {
        "RIG_PERIOD": rig.control_period,
        "RIG_SAMPLE_TIME": plant.sample_time,
        "RIG_PLANE": rig.contact_plane,
        "RIG_CLEARANCE": contact.clearance,
        "RIG_VELOCITY_LIMIT": simulator.velocity_limit,
        "RIG_ACCELERATION_LIMIT": simulator.acceleration_limit,
        "RIG_TIME_CONSTANT": force.time_constant,
        "RIG_FORCE_QUANTUM": force.quantum,
        "RIG_DEAD_ZONE": force.dead_zone,
        "RIG_FORCE_BIAS": force.bias,
        "RIG_FORCE_RANGE": force.range,
        "RIG_POSITION_QUANTUM": rig.position_sensor.quantum,
        "RIG_EXPONENT": _contact_number(contact, "exponent", 1.0),
        "RIG_REFERENCE_DEPTH": _contact_number(contact, "reference_depth", 1.0),
        "RIG_UNLOADING_RATIO": _contact_number(contact, "unloading_ratio", 1.0),
        "RIG_PRELOAD": _contact_number(contact, "preload", 0.0),
        "RIG_FRICTION": _contact_number(contact, "friction", 0.0),
    }
    macros = integers | {name: _parenthesised(value) for name, value in numbers.items()}
    tables = [
        _table("rig_stiffness[RIG_CONTACTS][RIG_LAYERS]", stiffness),
        _table("rig_damping[RIG_CONTACTS]", damping),
        _table("rig_depths[RIG_LAYERS]", depths),
        *_simulator_tables(plant),
    ]
    return _CONSTANTS_TEMPLATE.format(
        laws=", ".join(f"LAW_{name.upper()}" for name in LAWS),
        macros="".join(f"#define {name} {value}\n" for name, value in macros.items()),
        tables="".join(tables),
    )


def _simulator_tables(plant: PlantConstants) -> list[str]:
    """Return the C tables of the motion simulator; an ideal simulator gets one state that stays 0."""
    rows = plant.rows
    order = max(1, len(rows.transition))

    def padded(row: Sequence[float]) -> list[float]:
        return [0.0] * (order + 2 - len(row)) + [*row]

    transition = [padded(row) for row in rows.transition] or [[0.0] * (order + 2)]
    pairs = {"start": rows.start, "sample": rows.sample, "end": rows.end}
    return [
        _table("rig_transition[RIG_ORDER][RIG_ORDER + 2]", transition),
        *(_table(f"rig_{name}[2][RIG_ORDER + 2]", [*map(padded, pair)]) for name, pair in pairs.items()),
        _table("rig_measured[RIG_ORDER + 2]", padded(rows.measured)),
        _table("rig_steady_command[RIG_ORDER]", rows.steady_command or [0.0]),
        _table("rig_steady_step[RIG_ORDER]", rows.steady_step or [0.0]),
    ]


def _contact_tables(contact: Contact) -> tuple[list[list[float]], list[float], list[float]]:
    """Return the stiffnesses (one per layer) and damping of each contact, and the depths where layers end."""
    count = max(len(contact.stiffness), len(contact.damping))
    slopes = [contact.stiffness[min(number, len(contact.stiffness) - 1)] for number in range(count)]
    damping = [float(contact.damping[min(number, len(contact.damping) - 1)]) for number in range(count)]
    depths = getattr(contact, "depths", None) or []
    return [row if isinstance(row, list) else [row] for row in slopes], damping, [*depths, math.inf]


def _contact_number(contact: Contact, name: str, default: float) -> float:
    """Return a number that only some contact laws have; `default` for other laws."""
    value = getattr(contact, name, None)
    return default if value is None else float(value)


def _table(declaration: str, values: Any) -> str:
    return f"static const double {declaration} = {_initialiser(values)};\n"


def _initialiser(values: Any) -> str:
    if isinstance(values, int | float):
        return format_double(float(values))
    return f"{{{', '.join(map(_initialiser, values))}}}"


def _parenthesised(value: float) -> str:
    """Return a C literal that can follow an operator."""
    text = format_double(value)
    return f"({text})" if text.startswith("-") else text
