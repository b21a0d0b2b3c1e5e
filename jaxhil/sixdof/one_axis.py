"""Conversion of a six-axis mechanism to the one-axis mechanism of its first touch.

To first order in the rotation, a contact without friction equals a contact with one axis along the normal of
the first touch. Its mass is the effective mass at this touch (notebooks/guide/six_axes.md, section 1). An
impulse along the normal moves all axes of the motion simulator. The motion along the normal is the weighted
sum of the axes' motions. The weight (share) of an axis is the product of three numbers. These are the axis'
component of the wrench of a unit force along the normal, the axis' component of the twist that this wrench
causes, and the effective mass.
"""

import math
from typing import Any, NamedTuple

import jax
import msgspec
import numpy as np

from jaxhil.errors import InputError
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from jaxhil.mechanism.number_ranges import numeric_keys, value_at
from jaxhil.mechanism.six_axes import KEYS_IN_SIX_AXES, SixAxisMechanism
from jaxhil.mechanism.six_axes_rig import PER_AXIS_KEYS
from jaxhil.mechanism.structs import SCHEMA, Mechanism
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import APPROACH_DURATION, build_scenarios
from jaxhil.sixdof.building_contacts import candidate_names
from jaxhil.sixdof.first_touch import advance_free_flight
from jaxhil.sixdof.ideal_run import IdealEpisode
from jaxhil.sixdof.relative import States, mass_matrix, relative
from jaxhil.sixdof.run import Episode
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.vectors import components

RIG_KEYS = ("control_period", "integrator", "command_latency", "command_hold", "missed_tick_probability")
EQUAL_LAGS = 1e-9  # difference of lags below which two axes are equal [s]


class OneAxisContact(NamedTuple):
    """Result of `convert_to_one_axis`: a one-axis mechanism, and the six-axis keys without equivalent."""

    mechanism: Mechanism
    left_out: tuple[str, ...]  # keys of the six-axis file that the one-axis file cannot contain


def convert_to_one_axis(mechanism: SixAxisMechanism, episode: Episode | IdealEpisode) -> OneAxisContact:
    """Convert a frictionless six-axis mechanism to a one-axis mechanism along the first touch's normal.

    Args:
        mechanism: mechanism with an approach, whose ideal contact is a single touch without friction.
        episode: first episode of this mechanism, on the rig or in the ideal contact.

    Returns:
        The one-axis mechanism, and the keys of the six-axis file that it cannot contain.

    Raises:
        InputError: If no one-axis contact is equivalent to the mechanism's contact; the message has one line.
    """
    _check_has_equivalent(mechanism, episode)
    with jax_context():
        scenario = build_scenarios(mechanism)
        assert mechanism.approach is not None
        before = APPROACH_DURATION + mechanism.approach.phase * mechanism.rig.control_period
        states = advance_free_flight(scenario.bodies, scenario.start, 0 * scenario.duration + before)
        name, lever = _find_touch(mechanism, scenario, states, episode)
        # Twist that a unit force along the normal causes per second, and the axes' shares of the motion.
        twist = np.linalg.solve(np.asarray(mass_matrix(scenario.bodies, states))[..., 0], lever)
        shares = lever * twist / np.dot(lever, twist)
    contact, normal = mechanism.contact[name], lever[:3]
    uncertainty, left_out = _convert_uncertainty(mechanism, name)
    raw = {
        "schema": SCHEMA,
        "name": f"{mechanism.name[:90]}-one-axis",
        "source": f"first touch of {mechanism.name}, effective mass along its normal; {mechanism.source}",
        "bodies": {"equivalent_mass": episode.effective_mass},
        "approach": {"velocity": episode.approach_velocity, "phase": mechanism.approach.phase},
        "contact": {
            "law": contact.law,
            "stiffness": [contact.stiffness],
            "damping": [contact.damping],
            **_convert_contact_keys(contact),
        },
        "rig": {
            **{key: getattr(mechanism.rig, key) for key in RIG_KEYS},
            "simulator": _convert_simulator(mechanism, shares),
            "force_sensor": _convert_force_sensor(mechanism, normal),
            "position_sensor": _convert_position_sensor(mechanism, lever),
        },
        "uncertainty": uncertainty,
    }
    return OneAxisContact(from_plain_data(raw, mechanism.name), left_out)


def _check_has_equivalent(mechanism: SixAxisMechanism, episode: Episode | IdealEpisode) -> None:
    """Raise `InputError` if no one-axis contact is equivalent to the contact of this mechanism."""

    def reject(key: str, found: str, expected: str) -> None:
        raise InputError(f"{mechanism.name}: {key}: found {found}, expected for a one-axis file: {expected}")

    if mechanism.approach is None:
        reject("start", "explicit states", "[approach]")
    for name in mechanism.latch:
        reject(f"latch.{name}", "a latch", "no latch, because a latch holds all six axes")
    for name, contact in mechanism.contact.items():
        if contact.friction is not None and contact.friction.coefficient > 0:
            found, key = f"{contact.friction.coefficient:g}", f"contact.{name}.friction.coefficient"
            reject(key, found, "0, because friction couples the axes")
    touches = episode.reference_touches
    if touches != 1:
        expected = "one, because each touch has its own normal"
        reject("contact", f"{touches} touches in the ideal contact", expected)
    simulator = mechanism.rig.simulator
    robot = simulator.target_robot
    lists = [[getattr(simulator, key), robot and getattr(robot, key)] for key in PER_AXIS_KEYS]
    values = [[entry for part in parts if part for entry in part] for parts in lists]
    if simulator.space != "task" and any(np.ptp(entries or [0.0]) > 0 for entries in values):
        reject("rig.simulator", "axes with different dynamics", "equal axes of legs or robots")


def _find_touch(
    mechanism: SixAxisMechanism, scenario: Scenario, states: States, episode: Episode | IdealEpisode
) -> tuple[str, np.ndarray]:
    """Return the name of the first touch's contact, and the wrench of a unit force along its normal, (6,).

    The wrench is about the origin of C. `states` are the states of the bodies at the first touch.
    """
    pose, _ = relative(scenario.bodies, states)
    depths = [
        np.asarray(group.candidates.touch(jax.tree.map(lambda leaf: leaf[None], pose)).depth)[:, 0]
        for group in scenario.groups
    ]
    touching = candidate_names(mechanism)[int(np.argmax(np.concatenate(depths)))]
    position = np.ravel(components(pose.position))
    normal = np.array(episode.normal)
    return touching.partition("[")[0], np.concatenate(
        [normal, np.cross(np.array(episode.point) - position, normal)]
    )


def _convert_contact_keys(contact: Any) -> dict[str, Any]:
    """Return the contact's values of keys that only some laws have, by the keys' names in one-axis files."""
    values = {name: getattr(contact, key.name) for name, key in KEYS_IN_SIX_AXES.items()}
    return {name: value for name, value in values.items() if value is not None}


def _convert_simulator(mechanism: SixAxisMechanism, shares: np.ndarray) -> dict[str, Any]:
    """Return the motion simulator along the normal, with the axes' mean properties and mean lag.

    The means are weighted by the axes' `shares` in the motion along the normal. The delay is chosen so that
    the lag in uniform motion equals the weighted mean of the axes' lags.
    """
    simulator = mechanism.rig.simulator
    raw = to_plain_data(mechanism)["rig"]["simulator"]
    keys = ("model", "coefficients", "numerator", "denominator")
    result = {key: raw[key] for key in keys if key in raw}

    def mean(values: Any) -> float:
        return float(values[0]) if np.ptp(values) == 0 else float(np.dot(shares, values))

    lag, model_lag = 0.0, 0.0
    if simulator.natural_frequency is not None and simulator.damping_ratio is not None:
        frequency, ratio = np.array(simulator.natural_frequency), np.array(simulator.damping_ratio)
        result |= {"natural_frequency": mean(frequency), "damping_ratio": mean(ratio)}
        lag = mean(ratio / (math.pi * frequency))
        model_lag = result["damping_ratio"] / (math.pi * result["natural_frequency"])
    elif simulator.time_constant is not None:
        result["time_constant"] = mean(simulator.time_constant)
    elif simulator.window is not None:
        result["window"] = mean(simulator.window)
    delay = mean(simulator.delay)
    result["delay"] = delay if abs(lag - model_lag) < EQUAL_LAGS else max(0.0, delay + lag - model_lag)
    return result


def _convert_force_sensor(mechanism: SixAxisMechanism, normal: np.ndarray) -> dict[str, Any]:
    """Return the force sensor along the normal, with the errors of the three force channels."""
    sensor = mechanism.rig.force_sensor

    def along(values: list[float]) -> float:
        return float(np.linalg.norm(normal * np.array(values[:3])))

    return {
        **{key: getattr(sensor, key) for key in ("delay", "jitter", "loss_probability", "time_constant")},
        "bias": float(np.dot(normal, sensor.bias[:3])),
        "range": min(sensor.range[:3]),
        **{
            key: along(getattr(sensor, key))
            for key in ("noise_std", "bias_random_walk", "quantum", "dead_zone")
        },
        "dead_zone_kind": sensor.dead_zone_kind,
        **({} if sensor.filter is None else {"filter": msgspec.to_builtins(sensor.filter)}),
    }


def _convert_position_sensor(mechanism: SixAxisMechanism, lever: np.ndarray) -> dict[str, Any]:
    """Return the position sensor along the normal, with the noise of all six coordinates."""
    sensor = mechanism.rig.position_sensor
    return {
        "delay": sensor.delay,
        "noise_std": float(np.linalg.norm(lever * np.array(sensor.noise_std))),
        "quantum": float(np.linalg.norm(lever[:3] * np.array(sensor.quantum[:3]))),
    }


def _convert_uncertainty(
    mechanism: SixAxisMechanism, name: str
) -> tuple[dict[str, dict[str, Any]], tuple[str, ...]]:
    """Return the uncertainty table of the one-axis file, and the six-axis keys without equivalent.

    `name` is the name of the contact. The uncertainty of a list is converted only if it is one factor for
    all entries.
    """
    table: dict[str, dict[str, Any]] = to_plain_data(mechanism).get("uncertainty", {})
    one_axis_name = {key.name: name for name, key in KEYS_IN_SIX_AXES.items()}
    converted, left_out = {}, []
    for path, entry in table.items():
        parts = path.split(".")
        if path.startswith(f"contact.{name}.") and len(parts) == 3:
            key = f"contact.{one_axis_name.get(parts[2], parts[2])}"
        else:
            key = path
        has_factor = "factor" in entry and not entry.get("independent", False)
        if key in numeric_keys() and (has_factor or np.ndim(value_at(mechanism, path)) == 0):
            converted[key] = entry
        else:
            left_out.append(path)
    sensor = mechanism.rig.force_sensor
    if sensor.tool is not None and sensor.tool.mass > 0:
        left_out.append("rig.force_sensor.tool")
    if np.any(np.array(sensor.crosstalk) != 0):
        left_out.append("rig.force_sensor.crosstalk")
    if mechanism.correlation is not None:
        left_out.append("correlation")
    return converted, tuple(left_out)
