"""Validation rules that involve several keys of a six-axis mechanism file: bodies, start, rig, uncertainty.

As in `jaxhil.mechanism.rules`, each rule raises a `KeyProblem` that names the key to change. Rules for shapes
and contact laws are in `jaxhil.mechanism.six_axes_contacts`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from jaxhil.errors import format_value
from jaxhil.mechanism.conversion import KeyPath, KeyProblem
from jaxhil.mechanism.correlation import check_correlation
from jaxhil.mechanism.rules import KEYS_OF_MODELS, check_sensor_filter, check_simulator_model, check_texts
from jaxhil.mechanism.six_axes import Contact, Latch, RigidBody, SixAxisMechanism, Start
from jaxhil.mechanism.six_axes_contacts import check_contact, check_latch
from jaxhil.mechanism.six_axes_rig import PER_AXIS_KEYS, Inertia, Rig, Simulator
from jaxhil.mechanism.timing_rules import check_six_axis_jitter
from jaxhil.mechanism.uncertainty_rules import Span, check_uncertainty

__all__ = ["check_contact_names", "check_leg_values", "check_six_axes", "inertia_matrix"]

MAX_ATTITUDE = 1.0  # limit on the rotation of C relative to T at the start [rad]
INERTIA_TOLERANCE = 1e-9  # tolerance of the rule that no moment exceeds the sum of the others [1]
MIN_INERTIA_RATIO = 1e-6  # lower limit on the ratio of the smallest to the largest moment of inertia [1]
QUATERNION_TOLERANCE = 1e-6  # limit on the deviation of a quaternion's norm from 1 [1]
# Required and optional keys of each kind of axes of the motion simulator.
KEYS_OF_SPACES: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "task": ((), ()),
    "stewart": (("base", "platform", "height"), ("stroke",)),
    "two_robots": (("target_robot",), ()),
}
NAME_PATTERN = re.compile(r"[A-Za-z0-9_-]{1,60}")


def check_six_axes(mechanism: SixAxisMechanism) -> None:
    """Check all rules for a six-axis mechanism. Raise `KeyProblem` for the first violation."""
    check_texts(mechanism)
    for name, body in (("target", mechanism.target), ("chaser", mechanism.chaser)):
        _check_body(name, body)
    _check_start(mechanism)
    for table, names in (("contact", mechanism.contact), ("latch", mechanism.latch)):
        for name in names:
            if not NAME_PATTERN.fullmatch(name):
                found = f"the name {format_value(name)}"
                raise KeyProblem((table, name), found, "at most 60 letters, digits, - and _")
    for name, contact in mechanism.contact.items():
        check_contact(mechanism, name, contact)
    for name, latch in mechanism.latch.items():
        check_latch(mechanism, name, latch)
    check_simulator_model(mechanism.rig.simulator, mechanism.uncertainty)
    _check_space(mechanism.rig.simulator)
    _check_hold(mechanism)
    _check_sensor(mechanism.rig, mechanism.uncertainty)
    spans = {path: _check_uncertainty(mechanism, path) for path in mechanism.uncertainty}
    check_correlation(mechanism)
    check_six_axis_jitter(mechanism, spans)


def check_contact_names(raw: Mapping[str, Any]) -> None:
    """Raise `KeyProblem` unless all contacts and latches in a parsed table have names."""
    for key, kind in (("contact", Contact), ("latch", Latch)):
        table = raw.get(key)
        entries = table.items() if isinstance(table, Mapping) else ()
        fields = [name for name, value in entries
                  if name in kind.__struct_fields__ and not isinstance(value, Mapping)]  # fmt: skip
        if fields:
            found = f"the keys of a table without a name: {', '.join(fields)}"
            raise KeyProblem((key,), found, f"tables [{key}.NAME], each with its own name")


def check_leg_values(raw: Mapping[str, Any]) -> None:
    """Raise `KeyProblem` if a hexapod has values for translation and rotation instead of for its legs."""
    simulator = raw["rig"]["simulator"]
    for key in PER_AXIS_KEYS:
        if simulator.get("space") == "stewart" and isinstance(simulator.get(key), Mapping):
            found = "a table of translation and rotation"
            expected = "one number, or a list of six numbers, one for each leg"
            raise KeyProblem(("rig", "simulator", key), found, expected)


def inertia_matrix(inertia: Inertia) -> np.ndarray:
    """Return inertia matrices (..., 3, 3) [kg m^2] from principal moments (..., 3) or from matrices."""
    values = np.asarray(inertia, float)
    return values if values.shape[-2:] == (3, 3) else values[..., None] * np.eye(3)


def _check_body(name: str, body: RigidBody) -> None:
    """Raise `KeyProblem` if the inertia or the interface rotation of a body is invalid."""
    _check_inertia((name, "inertia"), body.inertia)
    angle = float(np.linalg.norm(body.interface_rotation))
    if not angle < np.pi:
        found = f"a rotation by {angle:.4g} rad"
        raise KeyProblem((name, "interface_rotation"), found, "a rotation vector shorter than pi rad")


def _check_inertia(path: KeyPath, inertia: Inertia, *, massless: bool = False) -> None:
    """Check that a rigid body can have this inertia.

    Raise `KeyProblem` unless the matrix is symmetric and positive definite, and no principal moment exceeds
    the sum of the other two. If `massless` is true, the inertia may also be 0.
    """
    if len({isinstance(entry, list) for entry in inertia}) > 1:
        raise KeyProblem(path, format_value(inertia), "three moments, or three rows of three entries")
    matrix = inertia_matrix(inertia)
    scale = np.max(np.abs(matrix))
    if scale == 0:
        if massless:
            return
        raise KeyProblem(path, "only zeros", "positive principal moments")
    if np.any(np.abs(matrix - matrix.T) > 1e-12 * scale):
        row, column = np.argwhere(np.abs(matrix - matrix.T) > 1e-12 * scale)[0]
        found = f"{matrix[row, column]:g} at row {row + 1}, column {column + 1}, and {matrix[column, row]:g}"
        raise KeyProblem(path, found + " at the transposed entry", "a symmetric matrix")
    first, second, third = map(float, np.linalg.eigvalsh(matrix / scale) * scale)
    if not first > 0:
        raise KeyProblem(path, f"a principal moment of {first:g} kg m^2", "positive principal moments")
    if first < MIN_INERTIA_RATIO * third:
        found = f"principal moments from {first:g} to {third:g} kg m^2"
        raise KeyProblem(path, found, f"moments of at least {MIN_INERTIA_RATIO:g} times the largest moment")
    if third > (first + second) * (1 + INERTIA_TOLERANCE):
        found = f"principal moments {first:.6g}, {second:.6g} and {third:.6g} kg m^2"
        expected = "moments of a rigid body: none larger than the sum of the other two"
        raise KeyProblem(path, found, expected)


def _check_start(mechanism: SixAxisMechanism) -> None:
    """Raise `KeyProblem` unless there is either a valid approach or a valid start."""
    approach, start = mechanism.approach, mechanism.start
    if (approach is None) == (start is None):
        if start is None:
            raise KeyProblem(
                ("approach",), "nothing", "[approach], or [start] with the states of both bodies"
            )
        raise KeyProblem(("start",), "[approach] as well", "either [start] or [approach]")
    if start is not None:
        _check_states(start)
    if approach is None:
        return
    if not mechanism.contact:
        raise KeyProblem(
            ("contact",), "nothing", "[contact.NAME], because [approach] needs a contact that ends it"
        )
    angle = float(np.linalg.norm(approach.attitude))
    if angle > MAX_ATTITUDE:
        expected = f"a rotation vector of at most {MAX_ATTITUDE:g} rad"
        raise KeyProblem(("approach", "attitude"), f"a rotation by {angle:.4g} rad", expected)
    if not approach.velocity[2] < 0:
        expected = "a number < 0 m/s: the z axis of T points to the chaser, which moves along -z"
        raise KeyProblem(("approach", "velocity", 2), format_value(approach.velocity[2]), expected)
    _check_sides(mechanism)


def _check_states(start: Start) -> None:
    """Raise `KeyProblem` unless the attitudes at the start are unit quaternions."""
    for name, state in (("target", start.target), ("chaser", start.chaser)):
        norm = float(np.linalg.norm(state.attitude))
        if not abs(norm - 1) <= QUATERNION_TOLERANCE:
            expected = f"a quaternion (w, x, y, z) of norm 1 within {QUATERNION_TOLERANCE:g}"
            raise KeyProblem(("start", name, "attitude"), f"a quaternion of norm {norm:.8g}", expected)


def _check_sides(mechanism: SixAxisMechanism) -> None:
    """Check that each body lies on its side of the interface. Raise `KeyProblem` for a reversed z axis."""
    for name, body, side in (("target", mechanism.target, 1.0), ("chaser", mechanism.chaser, -1.0)):
        axis = _rotate(body.interface_rotation, np.array([0.0, 0.0, 1.0]))
        projection = float(axis @ np.asarray(body.interface))
        if projection * side < 0:
            where = "behind T, at negative z" if side > 0 else "beyond C, at positive z"
            found = f"a centre of mass at z = {-projection:g} m of the interface frame"
            raise KeyProblem((name, "interface"), found, f"a centre {where}: z points from target to chaser")


def _rotate(rotation: list[float], vector: np.ndarray) -> np.ndarray:
    """Rotate `vector` by the rotation vector `rotation` [rad] (Rodrigues' formula)."""
    angle = float(np.linalg.norm(rotation))
    if angle == 0:
        return vector
    axis = np.asarray(rotation, float) / angle
    perpendicular = np.cross(axis, vector)
    return vector + np.sin(angle) * perpendicular + (1 - np.cos(angle)) * np.cross(axis, perpendicular)


def _check_space(simulator: Simulator) -> None:
    """Raise `KeyProblem` unless the motion simulator's keys suit its `space` (kind of axes) and are valid."""
    path: KeyPath = ("rig", "simulator")
    required, optional = KEYS_OF_SPACES[simulator.space]
    for key in sorted({key for pair in KEYS_OF_SPACES.values() for keys in pair for key in keys}):
        value = getattr(simulator, key)
        if key in required and value is None:
            raise KeyProblem((*path, key), "nothing", f'a value (space = "{simulator.space}" needs it)')
        if key not in (*required, *optional) and value is not None:
            found = "a table" if key == "target_robot" else format_value(value)
            raise KeyProblem((*path, key), found, f'nothing (space = "{simulator.space}" does not use it)')
    if simulator.stroke is not None and not simulator.stroke[0] < simulator.stroke[1]:
        expected = "[shortest, longest] leg length, in increasing order"
        raise KeyProblem((*path, "stroke"), format_value(simulator.stroke), expected)
    robot = simulator.target_robot
    for key in PER_AXIS_KEYS if robot else ():
        unused = key != "delay" and key not in KEYS_OF_MODELS[simulator.model]
        if unused and getattr(robot, key) is not None:
            expected = f"nothing (model {simulator.model} does not use it)"
            raise KeyProblem((*path, "target_robot", key), format_value(getattr(robot, key)), expected)


def _check_hold(mechanism: SixAxisMechanism) -> None:
    """Raise `KeyProblem` for contact damping or friction if an ideal simulator has a zero-order hold."""
    # Such a simulator jumps at the ticks, where its velocity is not defined.
    rig = mechanism.rig
    dissipates = any(contact.damping or contact.friction or contact.dry_friction
                     for contact in mechanism.contact.values())  # fmt: skip
    if rig.simulator.model == "ideal" and rig.command_hold == "zoh" and dissipates:
        expected = '"linear", because the model ideal with "zoh" supports neither damping nor friction'
        raise KeyProblem(("rig", "command_hold"), format_value(rig.command_hold), expected)


def _check_sensor(rig: Rig, uncertain: Collection[str]) -> None:
    """Raise `KeyProblem` if a key of the force sensor (crosstalk, filter, tool, gravity) is invalid."""
    sensor, path = rig.force_sensor, ("rig", "force_sensor")
    check_sensor_filter(sensor, uncertain)
    mixing = np.eye(6) + np.asarray(sensor.crosstalk)
    if not np.linalg.cond(mixing) < 100:
        found = "channels that are nearly identical"
        expected = "a matrix E such that 1 + E has a condition number below 100"
        raise KeyProblem((*path, "crosstalk"), found, expected)
    if sensor.side == "fixed":
        for key, entry in (("tool", sensor.tool), ("gravity", any(sensor.gravity) or None)):
            if entry is not None:
                value = "a table" if key == "tool" else format_value(sensor.gravity)
                expected = 'nothing (a fixed sensor carries no tool that moves: unset it, or side = "moving")'
                raise KeyProblem((*path, key), value, expected)
        return
    if sensor.tool is None:
        raise KeyProblem((*path, "tool"), "nothing", 'a table with mass and com (side = "moving" needs it)')
    for key in ("inertia", "inertia_assumed"):
        entry = getattr(sensor.tool, key)
        if entry is not None:
            _check_inertia((*path, "tool", key), entry, massless=True)


def _check_uncertainty(mechanism: SixAxisMechanism, path: str) -> Span:
    """Return the smallest and largest draw of an uncertain key; raise `KeyProblem` if a draw is invalid."""
    low, high = check_uncertainty(mechanism, path)
    where, uncertainty = ("uncertainty", path), mechanism.uncertainty[path]
    if path.endswith((".inertia", ".inertia_assumed")) and uncertainty.independent and low.ndim == 2:
        expected = "false, or three moments: independent rows are not symmetric"
        raise KeyProblem((*where, "independent"), "true", expected)
    if path.endswith(".stiffness_matrix") and uncertainty.independent:
        raise KeyProblem((*where, "independent"), "true", "false: independent entries are not symmetric")
    if path == "rig.simulator.stroke" and uncertainty.independent and not high[0] < low[1]:
        raise KeyProblem((*where, "independent"), "true", "false (draws may reverse the strokes' order)")
    if path == "approach.velocity" and uncertainty.distribution != "normal" and not high[2] < 0:
        raise KeyProblem(where, f"a z component of up to {high[2]:g} m/s", "only draws < 0 m/s")
    return low, high
