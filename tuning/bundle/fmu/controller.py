"""FMU of the controller: the C99 code of the bundle as a co-simulation FMU."""

import copy
import json
from collections.abc import Mapping
from typing import Any

from jaxhil.mechanism.file import from_plain_data
from jaxhil.rig.flight_recorder import FlightRecorder
from tuning.bundle.c99 import GAINS_FILE, HEADER_FILE, SOURCE_FILE, generate_c99, test_program
from tuning.bundle.controller_kind import ONE_AXIS, kind_of
from tuning.bundle.fmu.archive import build_fmu
from tuning.bundle.fmu.sources import read_source
from tuning.bundle.fmu.variables import c_names, controller_variables, six_axis_names
from tuning.bundle.rt_loop import body_constants
from tuning.bundle.vector_replay import LAYOUTS
from tuning.rig.numerical_model_six_axes import SHARES

IDENTIFIER = "jaxhil_controller"
INITIAL_INPUTS = ("position", "velocity", "position_desired", "velocity_desired")
SIX_AXIS_INITIAL_INPUTS = [
    name for vector in ("pose", "pose_desired", "twist_desired") for name in six_axis_names(vector)
]
_TESTED_FMU = """\
#include <stdbool.h>
#include <stdint.h>

#include "fmi{fmi}Functions.h"
#include "fmu_variables.h"

#define FMI_VERSION {fmi}

static fmi{fmi}{type} controller;
"""


def controller_fmu(document: Mapping[str, Any], fmi: int) -> bytes:
    """Return the archive of the controller's FMU, without library, for a checked gain document.

    Args:
        document: gain document.
        fmi: version of FMI, 2 or 3.

    Raises:
        InputError: If the compensator cannot be translated to C.
    """
    variables = controller_variables(document)
    names = c_names(variables)
    gains = [name for name in names if name.startswith("V_GAINS_")]
    limits = [name for name in names if name.startswith("V_LIMITS_")]
    code = generate_c99(document)
    is_one_axis = kind_of(document) is ONE_AXIS
    return build_fmu(
        identifier=IDENTIFIER,
        name=f"{IDENTIFIER}: {document['compensator']}",
        description="Controller of a docking rig; co-simulation with a rig adds a control period to the loop",
        period=float(document["control_period"]),
        variables=variables,
        files={
            HEADER_FILE: code[HEADER_FILE],
            SOURCE_FILE: code[SOURCE_FILE],
            GAINS_FILE: code[GAINS_FILE],
            "fmu_model.h": read_source("controller.h"),
            "fmu_model.c": read_source("controller_one_axis.c" if is_one_axis else "controller_six_axes.c"),
            "controller_events.h": read_source("controller_events.h"),
            "numerical_model.h": read_source(
                "numerical_model.h" if is_one_axis else "numerical_model_six_axes.h"
            ),
        },
        constants={
            "FMU_GAIN_COUNT": len(gains),
            "FMU_FIRST_GAIN": names.index(gains[0]) if gains else 0,
            "FMU_FIRST_LIMIT": names.index(limits[0]),
            **_log_constants(document),
            "FMU_AXES": document.get("axes", 1),
            **_model_constants(document),
        },
        fmi=fmi,
        initial_inputs=INITIAL_INPUTS if is_one_axis else SIX_AXIS_INITIAL_INPUTS,
    )


def _model_constants(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the C constants of the numerical model that the FMU can integrate."""
    integrator = document["mechanism"]["rig"]["integrator"]
    if kind_of(document) is ONE_AXIS:
        return {"FMU_INTEGRATOR": f"INTEGRATOR_{integrator.upper()}"}
    return {
        "FMU_VELOCITY_SHARE": repr(SHARES[integrator]),
        "FMU_BODIES": body_constants(document["mechanism"]),
    }


def _log_constants(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the flight log's first line, and the mapping file that describes the log, as C strings."""
    mass = None
    if kind_of(document) is ONE_AXIS:
        mass = from_plain_data(copy.deepcopy(document["mechanism"]), "gain document").bodies.mass
    recorder = FlightRecorder(
        float(document["control_period"]), document.get("axes", 1), ticks=1, equivalent_mass=mass
    )
    return {
        "FMU_LOG_COLUMNS": json.dumps(recorder.heading),
        "FMU_LOG_MAPPING": json.dumps(recorder.mapping("*")),
    }


def fmu_test_program(document: Mapping[str, Any], fmi: int) -> str:
    """Return a C program that replays the test vectors with the FMU, compiled with the FMU's sources.

    Args:
        document: gain document.
        fmi: version of FMI, 2 or 3.
    """
    kind = kind_of(document)
    layout = LAYOUTS[kind.controller.__name__]
    if kind is ONE_AXIS:
        force, position, first = "force", "position", ("V_FORCE_MEASURED", "V_POSITION", "V_FORCE_COMMAND")
    else:
        force, position, first = "wrench", "pose", ("V_WRENCH_MEASURED_FX", "V_POSE_X", "V_WRENCH_COMMAND_FX")
    text = read_source("test_vectors_fmu.c")
    for name, value in {
        "width": layout.width,
        "motions": layout.motions,
        "header": layout.columns,
        "readings": first[0],
        "motion": first[1],
        "commands": first[2],
        "force": force,
        "position": position,
    }.items():
        text = text.replace(f"@{name}@", str(value))
    return test_program(_TESTED_FMU.format(fmi=fmi, type="Instance" if fmi == 3 else "Component"), text)
