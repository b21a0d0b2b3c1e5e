"""Simulated rig in C for the real-time loop of a bundle: the model of the rig's FMU as the loop's plant."""

import math
from collections.abc import Mapping
from importlib import resources
from typing import Any

from jaxhil.errors import InputError
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from tuning.bundle.fmu.rig import describe_unsupported, model_files, rig_variables, without_extra_periods
from tuning.bundle.fmu.sources import read_source, variable_files
from tuning.rig.contact_detector import MAX_CONTACT_DURATION, MAX_FADING_TIME
from tuning.rig.numerical_model import NumericalModel

# Variables at which the vectors of the loop begin, and the index of the contact, by number of axes.
VARIABLES = {
    1: ("FORCE_MEASURED", "POSITION_MEASURED", "FORCE_COMMAND", "POSITION_COMMAND", "CONTACT"),
    6: ("WRENCH_MEASURED_FX", "POSE_MEASURED_X", "WRENCH_COMMAND_FX", "POSE_COMMAND_X", "TIME"),
}
_HEADER = """\
/* Constants of the simulated rig; numbers in SI units. */
#ifndef RT_PLANT_RIG_H
#define RT_PLANT_RIG_H

/* Variables at which force, position and their commands begin, and the index of the contact (TIME: none). */
enum {{ FORCE = V_{0}, POSITION = V_{1}, FORCE_COMMAND = V_{2}, POSITION_COMMAND = V_{3}, CONTACT = V_{4} }};

/* When a run ends, see rt_plant_rig.c; number of contacts in the lists of the mechanism file. */
enum {{ LAST_TICK = {ticks}, BEHIND_TICKS = {behind}, CONTACTS = {contacts} }};

/* State of the numerical model at tick 0, see `readings` in rt_loop.h. */
#define RUN_START {{{start}}}

#endif
"""


def rig_plant_files(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the text of each C file of the simulated rig, by its name.

    Args:
        document: gain document.

    Raises:
        InputError: If the rig has a property that its FMU cannot simulate.
    """
    mechanism = without_extra_periods(document)
    if unsupported := describe_unsupported(mechanism):
        raise InputError(f"rehearsal: {unsupported}; the rig cannot be written in C")
    plant = resources.files("tuning") / "bundle" / "rt" / "rt_plant_rig.c"
    return {
        **model_files(document, mechanism),
        **variable_files(rig_variables(mechanism), "", mechanism.rig.control_period, {}),
        **{name: read_source(name) for name in ("fmu.h", "fmu_log.h")},
        plant.name: plant.read_text(encoding="utf-8"),
        "rt_plant_rig.h": _constants(document, mechanism),
    }


def _constants(document: Mapping[str, Any], mechanism: AnyMechanism) -> str:
    """Return the text of the header with the constants of the plant."""
    period, axes, contacts = mechanism.rig.control_period, 6, 1
    if isinstance(mechanism, Mechanism):
        axes, start = 1, NumericalModel(document["mechanism"]).start
        ticks = round(MAX_CONTACT_DURATION / period)
        # In a run between two surfaces, all contacts have the first contact law of the lists.
        contacts = 1 if math.isfinite(mechanism.contact.clearance) else mechanism.approach.contacts
    else:
        from tuning.bundle.fmu.rig_six_axes import nominal_start

        start, ticks = nominal_start(mechanism)
    behind = round(MAX_FADING_TIME / period)
    numbers = ", ".join(map(repr, start))
    return _HEADER.format(*VARIABLES[axes], ticks=ticks, behind=behind, contacts=contacts, start=numbers)
