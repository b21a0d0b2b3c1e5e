"""Descriptions of the rig's one-axis and six-axis controllers, which exports use."""

from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jaxhil.rig
import jaxhil.rig.six_axes
from jaxhil.rig.controller import Controller
from jaxhil.rig.faults import FAULTS, Fault
from jaxhil.rig.gain_file import check_gain_document
from jaxhil.rig.inputs import Tare
from jaxhil.rig.limits import LIMITS, ORDER, RANGES, Limit
from jaxhil.rig.registry import COMPENSATORS, Compensator
from jaxhil.rig.six_axes.controller import Controller6
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS
from jaxhil.rig.six_axes.gain_file import check_six_axis_document
from jaxhil.rig.six_axes.inputs import WrenchTare
from jaxhil.rig.six_axes.limits import SIX_AXIS_LIMITS, SIX_AXIS_ORDER, SIX_AXIS_RANGES
from jaxhil.rig.six_axes.registry import SIX_AXIS_COMPENSATORS, ModelConstants, SixAxisCompensator
from jaxhil.rig.six_axes.vectors import COORDINATES


class ControllerKind(NamedTuple):
    """Kind of controller: its classes, compensators, tables, and the names of its methods in C."""

    axes: int  # number of axes of motion
    package: ModuleType  # package whose public names the bundle's Python module exports
    controller: type  # class of the controller
    compensators: Mapping[str, type[Any]]  # classes of the compensators by name
    table: str  # name of `compensators` in the package's module `registry`
    protocol: type  # protocol of the compensators
    constants: type | None  # class of the numerical model's constants; None if there are none
    check_document: Callable[..., Any]  # function that checks a gain document and returns its content
    limits: Mapping[str, Limit]
    ranges: tuple[tuple[str, str], ...]  # pairs of limits of which the first must be below the second
    order: tuple[tuple[str, str], ...]  # pairs of limits of which the first must not be above the second
    faults: tuple[Fault, ...]
    methods: Mapping[str, str]  # name in C of each method or property of the controller, in C's order
    c_names: Mapping[type, str]  # name in C of each class whose name differs in Python
    test_program: str  # file of the part of the C test program that depends on the number of axes
    stroke: tuple[Sequence[str], Sequence[str]]  # names of the limits of position commands: lowest, highest
    numerical_model: str  # file with the numerical model of the docking, in the folder of `tuning`


COMMON_METHODS = ("emergency_stop", "reset", "next_contact", "tripped", "at_rest", "bias")
ONE_AXIS = ControllerKind(
    axes=1,
    package=jaxhil.rig,
    controller=Controller,
    compensators=COMPENSATORS,
    table="COMPENSATORS",
    protocol=Compensator,
    constants=None,
    check_document=check_gain_document,
    limits=LIMITS,
    ranges=RANGES,
    order=ORDER,
    faults=FAULTS,
    methods={
        **{name: name for name in ("tare", "step", "position_command", *COMMON_METHODS)},
        **{name: name for name in ("missed_ticks", "late_ticks", "force_delay")},
        "_status": "law_status",
        "_last_count": "last_contact",
    },
    c_names={Tare: "bias_tare"},
    test_program="test_vectors_one_axis.c",
    stroke=(("command_lowest",), ("command_highest",)),
    numerical_model="rig/numerical_model.py",
)
SIX_AXES = ControllerKind(
    axes=6,
    package=jaxhil.rig.six_axes,
    controller=Controller6,
    compensators=SIX_AXIS_COMPENSATORS,
    table="SIX_AXIS_COMPENSATORS",
    protocol=SixAxisCompensator,
    constants=ModelConstants,
    check_document=check_six_axis_document,
    limits=SIX_AXIS_LIMITS,
    ranges=SIX_AXIS_RANGES,
    order=SIX_AXIS_ORDER,
    faults=SIX_AXIS_FAULTS,
    methods={
        "_convert": "from_sensor",
        "_take": "tare",
        "_step": "step",
        "_pose_command": "pose_command",
        **{name: name for name in (*COMMON_METHODS, "channels", "missed_ticks", "late_ticks")},
        **{name: name for name in ("loop_delay", "unpaid_impulse")},
        "_status": "law_status",
        "_last_count": "last_contact",
    },
    c_names={Controller6: "controller", ModelConstants: "constants", WrenchTare: "bias_tare"},
    test_program="test_vectors_six_axes.c",
    stroke=(
        [f"command_lowest_{axis}" for axis in COORDINATES],
        [f"command_highest_{axis}" for axis in COORDINATES],
    ),
    numerical_model="rig/numerical_model_six_axes.py",
)


def kind_of(document: Mapping[str, Any]) -> ControllerKind:
    """Return the kind of controller that a gain document is for."""
    return SIX_AXES if document.get("axes") == SIX_AXES.axes else ONE_AXIS
