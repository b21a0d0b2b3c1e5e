"""Variables of an FMU: their causality, type, unit, bounds and start value.

The position of a variable in the list is its value reference; the first variable is the time. Vectors of six
axes are six successive variables.
"""

import copy
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from jaxhil.mechanism.file import from_plain_data
from jaxhil.rig.faults import UNUSABLE
from jaxhil.rig.flight_recorder import COORDINATES, TWIST, WRENCH
from jaxhil.rig.law_status import STATUSES
from tuning.bundle.controller_kind import ONE_AXIS, kind_of


class Variable(NamedTuple):
    """Variable of an FMU."""

    name: str
    causality: Literal["independent", "parameter", "input", "output"]
    type: Literal["real", "integer", "boolean", "string"]
    description: str
    unit: str = "1"  # "1" if dimensionless
    start: float = 0.0  # value before the first step
    lowest: float = -math.inf  # lower bound; for a parameter, the FMU rejects values beyond it
    highest: float = math.inf  # upper bound

    @property
    def c_name(self) -> str:
        """Return the name of the variable's value reference in C."""
        return f"V_{re.sub('[^A-Za-z0-9]', '_', self.name).upper()}"


MODEL_MASSES = 1e-9, 1e12  # [kg]; bounds of the equivalent mass
TIME = Variable("time", "independent", "real", "time of the communication point", "s")
MAX_SEED = 2**31 - 1  # largest seed that a 32-bit integer can hold
SEED = Variable("seed", "parameter", "integer", "seed of the sensor noise", lowest=0, highest=MAX_SEED)
VECTORS = {  # names and units of the components of a vector of six axes
    "wrench": (WRENCH, ("N", "N m")),
    "pose": (COORDINATES, ("m", "rad")),
    "twist": (TWIST, ("m/s", "rad/s")),
}
FLIGHT_LOG = Variable(
    "flight_log", "parameter", "string", "path of the flight log, which ends in .csv; empty for no log"
)
INTEGRATES_MODEL = Variable(
    "integrates_model", "parameter", "boolean",
    "whether the FMU itself integrates the numerical model; each run begins from the desired motion",
)  # fmt: skip
EVENTS = (
    Variable("next_contact", "input", "boolean", "true in the first step of each run of a series"),
    Variable("reset", "input", "boolean", "true in a step that begins with a reset after a trip"),
    Variable("emergency_stop", "input", "boolean", "whether the rig's emergency stop is active"),
    Variable("tare", "input", "boolean", "whether the step adds a reading to the tare, without a command"),
    Variable("has_tick_time", "input", "boolean", "whether tick_time is the time of a steady clock"),
    Variable("tick_time", "input", "real", "time of the tick, for the detection of missed ticks", "s"),
)
STATUS_CODES = ", ".join(f"{status.number} {status.name}" for status in STATUSES)
STATUS_OUTPUTS = (
    Variable("tripped", "output", "boolean", "whether a fault has tripped the controller"),
    Variable("at_rest", "output", "boolean", "whether the drives' command has come to rest after a trip"),
    Variable("tare_done", "output", "boolean", "whether the tare has ended"),
    Variable("status", "output", "integer", f"status of the compensator: {STATUS_CODES}"),
    Variable("faults", "output", "integer", "bits of this tick's faults"),
    Variable("seen_faults", "output", "integer", "bits of all faults since the reset"),
    Variable("trip_cause", "output", "integer", "bits of the faults that tripped the controller; 0: none"),
    Variable("missed_ticks", "output", "integer", "number of missed ticks since the reset"),
    Variable("late_ticks", "output", "integer", "number of late ticks since the reset"),
    Variable("contact_number", "output", "integer", "number of the last audited contact; 0: none"),
    Variable("contact_status", "output", "integer", f"status of the last audited contact: {STATUS_CODES}"),
)


def controller_variables(document: Mapping[str, Any]) -> list[Variable]:
    """Return the variables of the controller's FMU.

    Args:
        document: gain document.

    Returns:
        Time, inputs, outputs, gains and limits, in the order of their value references.
    """
    kind = kind_of(document)
    signals = _one_axis_signals(document) if kind is ONE_AXIS else _six_axis_signals()
    bits = {fault.bit: fault.name for fault in kind.faults} | {UNUSABLE: "unusable"}
    names = "; ".join(f"{bit:#x} {name}" for bit, name in bits.items())
    outputs = [
        output._replace(description=f"{output.description}: {names}") if output.name == "faults" else output
        for output in STATUS_OUTPUTS
    ]
    return [TIME, *EVENTS, *signals, *outputs, FLIGHT_LOG, *_parameters(document)]


def c_names(variables: Iterable[Variable]) -> list[str]:
    """Return the names of the value references in C."""
    return [variable.c_name for variable in variables]


def six_axis_vector(name: str, quantity: str, causality: Any, description: str) -> list[Variable]:
    """Return the variables of a vector of six axes; the quantity is "wrench", "pose" or "twist"."""
    names, units = VECTORS[quantity]
    return [
        Variable(f"{name}.{part}", causality, "real", description, units[axis // 3])
        for axis, part in enumerate(names)
    ]


def target_angular_velocity(causality: Any) -> list[Variable]:
    """Return the variables of the target's angular velocity, which the start of a run needs."""
    description = "angular velocity of the target in the numerical model, in axes of T"
    return [
        Variable(f"target_angular_velocity.{part}", causality, "real", description, "rad/s")
        for part in TWIST[3:]
    ]


def six_axis_names(name: str) -> list[str]:
    """Return the names of the variables of a vector with six axes, such as `wrench_command`."""
    return [f"{name}.{part}" for part in VECTORS[name.partition("_")[0]][0]]


def _one_axis_signals(document: Mapping[str, Any]) -> list[Variable]:
    mass = from_plain_data(copy.deepcopy(document["mechanism"]), "gain document").bodies.mass

    def signal(name: str, causality: Any, unit: str, description: str) -> Variable:
        return Variable(name, causality, "real", description, unit)

    return [
        signal("force_measured", "input", "N", "reading of the force sensor, compression positive"),
        signal("position_desired", "input", "m", "position of the numerical model before the tick"),
        signal("velocity_desired", "input", "m/s", "velocity of the numerical model before the tick"),
        signal("position_measured", "input", "m", "position of the motion simulator; contact if positive"),
        signal("position", "input", "m", "newest position of the numerical model, to be commanded"),
        signal("velocity", "input", "m/s", "newest velocity of the numerical model"),
        signal("acceleration", "input", "m/s^2", "newest acceleration of the numerical model"),
        signal("force_command", "output", "N", "compensated force; its negative acts on the numerical model"),
        signal("position_command", "output", "m", "position command to the motion simulator"),
        signal("force_bias", "output", "N", "bias of the force sensor from the last tare"),
        signal("force_delay", "output", "s", "estimated delay of the force measurement; 0: none"),
        signal("stiffness", "output", "N/m", "identified stiffness; 0: none"),
        signal("damping", "output", "N s/m", "identified damping; 0: none"),
        signal("model_position", "output", "m", "newest position of the numerical model"),
        signal("model_velocity", "output", "m/s", "newest velocity of the numerical model"),
        INTEGRATES_MODEL,
        Variable(
            "equivalent_mass", "parameter", "real", "mass of the numerical model, if the FMU integrates it",
            "kg", mass, *MODEL_MASSES,
        ),
    ]  # fmt: skip


def _six_axis_signals() -> list[Variable]:
    vector = six_axis_vector
    return [
        *vector("wrench_measured", "wrench", "input", "measured wrench on the chaser about T's origin"),
        *vector("pose_desired", "pose", "input", "pose of C relative to T in the numerical model"),
        *vector("twist_desired", "twist", "input", "twist of C relative to T in the numerical model"),
        *vector("pose_measured", "pose", "input", "measured pose of C relative to T on the hardware"),
        *vector("pose", "pose", "input", "newest pose of the numerical model, to be commanded"),
        *vector("twist", "twist", "input", "newest twist of the numerical model"),
        *target_angular_velocity("input"),
        *vector("wrench_command", "wrench", "output", "compensated wrench about T's origin"),
        *vector("pose_command", "pose", "output", "pose command to the motion simulator"),
        *vector("wrench_bias", "wrench", "output", "bias of the force sensor from the last tare"),
        Variable("channels", "output", "integer", "bits of the sensor channels with a fault in this tick"),
        Variable(
            "loop_delay", "output", "real", "delay of the hardware in the last contact; 0: unknown", "s"
        ),
        Variable("unpaid_impulse", "output", "real", "share of the last contact's impulse that is owed"),
        *vector("model_pose", "pose", "output", "newest pose of the numerical model"),
        *vector("model_twist", "twist", "output", "newest twist of the numerical model"),
        INTEGRATES_MODEL,
    ]


def _parameters(document: Mapping[str, Any]) -> Sequence[Variable]:
    """Return gains and limits as parameters of the FMU, with the bounds that the controller accepts."""
    kind = kind_of(document)
    gain_file = kind.check_document(document, "gain document")
    law = gain_file.compensator
    gains = [
        Variable(
            f"gains.{name}", "parameter", "real", f"gain of the compensator {law}",
            gain.unit, gain_file.gains[name], gain.lowest, gain.highest,
        )
        for name, gain in kind.compensators[law].gains.items()
    ]  # fmt: skip
    limits = [
        Variable(
            f"limits.{name}", "parameter", "real", limit.meaning,
            limit.unit, gain_file.limits[name], limit.lowest, limit.highest,
        )
        for name, limit in kind.limits.items()
    ]  # fmt: skip
    return [*gains, *limits]
