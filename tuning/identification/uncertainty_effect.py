"""Effect of a mechanism file's uncertainty on the restitution e and on its error e - e*.

e* is the restitution of the ideal contact (without delays), and e is the restitution on the rig. M is the
equivalent mass, v the speed, v_0 the approach speed, w the contact frequency [rad/s]. To first order, a
change dF of the contact force changes the restitution by

    d e* = -(integral of dF v dt) / (M v_0^2 e*).

An additional delay tau of the force adds the energy tau (integral of F^2 dt) / M, so that

    e = e* + J tau,    J = (integral of F^2 dt) / (M^2 v_0^2 e*).

For a linear spring, J tau is (pi/2) w tau. Errors of damping and force delay can cancel in e, but not in e -
e*: the tuning assumes the wrong e*.

Without compensation, the rebound on the rig is faster by the factor c = 1 + J tau / e*, and d e = c (d e* + J
d tau). With gains that compensate for the delay, c = 1. The result is the larger of both effects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np

from jaxhil.contact.laws import CONTACT_KEYS
from jaxhil.errors import InputError
from jaxhil.mechanism.sensor_filter import low_frequency_delay
from jaxhil.mechanism.structs import Contact, Mechanism
from jaxhil.mechanism.uncertainty import draw
from tuning.identification import mechanism_models
from tuning.identification.contact_laws import Law
from tuning.identification.parameters import CUTOFF_KEY

EFFECT_DRAWS = 1024  # number of draws from the uncertainty of the file
EFFECT_PROBABILITY = 0.99  # probability that an effect is below its bound
CONTACT_STEPS = 400  # number of integration steps in the estimated duration of a contact
# maximum duration of a contact, divided by the estimate; a longer contact is assumed to have no rebound
MAX_CONTACT_DURATION_RATIO = 4.0
RELATIVE_DIFFERENCE_STEP = 1e-4  # relative step of finite differences for a parameter of the motion simulator
MAX_DEPTH = 1.0  # maximum depth [m]; a deeper contact is assumed to have no rebound
FORCE_DELAY_KEY, SIMULATOR_PREFIX = "rig.force_sensor.delay", "rig.simulator."
IDENTIFIED_SOURCE_PREFIX = "identified from"  # beginning of the `source` of an identified file
FORCE_DELAY_KEYS = (FORCE_DELAY_KEY, "rig.force_sensor.time_constant", CUTOFF_KEY)
CONTACT_KEYS = (
    *("contact.stiffness", "contact.damping"),
    *(f"contact.{key.name}" for key in CONTACT_KEYS.values() if key.default is None),
)


class UncertaintyEffect(NamedTuple):
    """Bounds that the effects of uncertain parameters exceed with a probability of 1 %."""

    restitution: float  # bound on the change of e
    error: float  # bound on the change of e - e*
    parts: dict[str, float]  # bound on the change of e due to each parameter alone, by key


class _IdealContact(NamedTuple):
    """Restitution of the ideal contact with nominal parameters, and its sensitivities."""

    restitution: float  # e*
    coefficient_sensitivity: np.ndarray  # derivatives of e* with respect to the coefficients of the law
    delay_sensitivity: float  # derivative of e - e* with respect to the force delay [1/s]


def compute_uncertainty_effect(mechanism: Mechanism) -> UncertaintyEffect:
    """Compute how much uncertain identified parameters change the restitution e and its error e - e*.

    The identified parameters are those in the file's `[correlation]` or, without this table, those with a
    normal distribution in `[uncertainty]`. All other parameters in `[uncertainty]` are ignored.

    Returns:
        The 99 % quantiles of the effects; 0 if the file does not come from an identification. If
        `[contact]` lists several contacts, the result is for the contact with the largest effects.
    """
    keys = _list_identified_keys(mechanism)
    if not keys:
        return UncertaintyEffect(0.0, 0.0, {})
    try:
        law = mechanism_models.make_regression_law(mechanism.contact)
    except InputError:
        return UncertaintyEffect(0.0, 0.0, {})
    drawn = draw(mechanism, EFFECT_DRAWS, 0)
    worst = UncertaintyEffect(0.0, 0.0, {})
    for entry in range(len(mechanism.contact.stiffness)):
        contact, frequency = _simulate_ideal_contact(mechanism, law, entry)
        if contact is None:
            continue
        changes = {
            key: _compute_change(mechanism, contact, entry, frequency, key, drawn[key]) for key in keys
        }
        gain = _compute_gain(mechanism, contact, frequency)
        ideal, error = np.sum(list(changes.values()), axis=0)
        restitution, differences = _combine_changes(ideal, error, gain)
        entry_effect = UncertaintyEffect(
            _compute_effect_quantile(restitution),
            max(_compute_effect_quantile(difference) for difference in differences),
            {key: _compute_effect_quantile(a + b) for key, (a, b) in changes.items()},
        )
        if max(entry_effect[:2]) > max(worst[:2]):
            worst = entry_effect
    return worst


def compute_change_effects(
    mechanism: Mechanism, changes: Mapping[int, np.ndarray], added_delays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute how much changes of the contact law and of the force delay change e and e - e*.

    Args:
        mechanism: Mechanism with the nominal parameters.
        changes: Changes of the coefficients of `make_regression_law`, (cases, coefficients); key i is the
            index of a contact in the lists of `[contact]`.
        added_delays: Changes of the total force delay [s], (cases,).

    Returns:
        The magnitudes of both effects for each case: the largest of all contacts in the lists.
    """
    law = mechanism_models.make_regression_law(mechanism.contact)
    on_restitution, on_error = np.zeros((2, len(added_delays)))
    for entry, change in changes.items():
        contact, frequency = _simulate_ideal_contact(mechanism, law, entry)
        if contact is None:
            continue
        ideal = change @ contact.coefficient_sensitivity
        gain = _compute_gain(mechanism, contact, frequency)
        restitution, differences = _combine_changes(ideal, added_delays * contact.delay_sensitivity, gain)
        on_restitution = np.maximum(on_restitution, np.abs(restitution))
        on_error = np.maximum(on_error, np.max(np.abs(differences), axis=0))
    return on_restitution, on_error


def _compute_gain(mechanism: Mechanism, contact: _IdealContact, frequency: float) -> float:
    """Return the factor by which the delays speed up the rebound without compensation."""
    delay = _compute_total_force_delay(mechanism, frequency)
    return 1.0 + contact.delay_sensitivity * delay / contact.restitution


def _combine_changes(ideal: Any, error: Any, gain: float) -> tuple[Any, tuple[Any, Any]]:
    """Return the change of e, and the changes of e - e* with and without compensation.

    Args:
        ideal: Changes of e*.
        error: Changes of e - e* with compensation.
        gain: Factor by which the delays speed up the rebound without compensation.
    """
    restitution = gain * (ideal + error)
    return restitution, (error, restitution - ideal)


def _list_identified_keys(mechanism: Mechanism) -> list[str]:
    """Return the keys of the parameters whose uncertainty comes from an identification."""
    if not mechanism.source.startswith(IDENTIFIED_SOURCE_PREFIX):
        return []
    if mechanism.correlation is not None:
        keys = mechanism.correlation.keys
    else:
        keys = [key for key, entry in mechanism.uncertainty.items() if entry.distribution == "normal"]
    return [
        key for key in keys if key in (*FORCE_DELAY_KEYS, *CONTACT_KEYS) or key.startswith(SIMULATOR_PREFIX)
    ]


def _compute_change(
    mechanism: Mechanism, contact: _IdealContact, entry: int, frequency: float, key: str, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the changes of e* (ideal restitution) and e - e* (restitution error) per draw of a parameter.

    Args:
        mechanism: Mechanism with the nominal parameters.
        contact: Ideal contact and its sensitivities.
        entry: Index into the list-valued keys of `[contact]`.
        frequency: Contact frequency [Hz].
        key: Key of the parameter.
        values: Draws of the parameter.
    """
    no_change = np.zeros(len(values))
    if key in CONTACT_KEYS:
        nominal = np.array(mechanism_models.get_regression_coefficients(mechanism.contact, entry))
        name = key.removeprefix("contact.")
        contacts = [_replace_contact_value(mechanism.contact, name, value) for value in values.tolist()]
        moved = np.array(
            [mechanism_models.get_regression_coefficients(contact_entry, entry) for contact_entry in contacts]
        )
        return (moved - nominal) @ contact.coefficient_sensitivity, no_change
    if key == CUTOFF_KEY:
        low_pass = mechanism.rig.force_sensor.filter
        added_delay = low_frequency_delay(low_pass) * (low_pass.cutoff / values - 1.0) if low_pass else 0.0
        return no_change, no_change + added_delay * contact.delay_sensitivity
    if key in FORCE_DELAY_KEYS:
        added_delay = values - getattr(mechanism.rig.force_sensor, key.rpartition(".")[2])
        return no_change, added_delay * contact.delay_sensitivity
    name = key.removeprefix(SIMULATOR_PREFIX)
    value = getattr(mechanism.rig.simulator, name)
    if not isinstance(value, float):
        return no_change, no_change
    low, high = (
        _compute_motion_lag(_replace_simulator_value(mechanism, name, value + side), frequency)
        for side in (0.0, RELATIVE_DIFFERENCE_STEP * max(value, 1e-3))
    )
    return no_change, (values - value) * (high - low) / (
        RELATIVE_DIFFERENCE_STEP * max(value, 1e-3)
    ) * contact.delay_sensitivity


def _replace_contact_value(contact: Contact, name: str, value: Any) -> Contact:
    return msgspec.structs.replace(contact, **{name: value})


def _replace_simulator_value(mechanism: Mechanism, name: str, value: float) -> Mechanism:
    simulator = msgspec.structs.replace(mechanism.rig.simulator, **{name: value})
    rig = msgspec.structs.replace(mechanism.rig, simulator=simulator)
    return msgspec.structs.replace(mechanism, rig=rig)


def _compute_motion_lag(mechanism: Mechanism, frequency: float) -> float:
    """Return the phase delay [s] from the command to the position reading, at the contact frequency [Hz]."""
    model = mechanism_models.make_motion_model(mechanism)
    angle = float(np.angle(model.response(np.array([2j * np.pi * frequency]))[0]))
    return -angle / (2.0 * np.pi * frequency)


def _compute_total_force_delay(mechanism: Mechanism, frequency: float) -> float:
    """Return the delay [s] from the command to the force reading, at the contact frequency [Hz]."""
    sensor = mechanism.rig.force_sensor
    total = _compute_motion_lag(mechanism, frequency) + sensor.delay + sensor.time_constant
    total += low_frequency_delay(sensor.filter)
    return max(total - mechanism.rig.position_sensor.delay, 0.0)


def _compute_effect_quantile(values: np.ndarray) -> float:
    return float(np.quantile(np.abs(values), EFFECT_PROBABILITY))


def _simulate_ideal_contact(mechanism: Mechanism, law: Law, entry: int) -> tuple[_IdealContact | None, float]:
    """Simulate the ideal contact with the parameters at index `entry` of the lists in `[contact]`.

    Returns:
        The contact (None if there is no rebound), and the contact frequency [Hz].
    """
    mass, speed = mechanism.bodies.mass, mechanism.approach.velocity
    coefficients = np.array(mechanism_models.get_regression_coefficients(mechanism.contact, entry))

    def force(depth: float, rate: float) -> float:
        functions = law.entry_functions(np.array([max(depth, 0.0)]), np.array([rate]))
        total = float(sum(c * column[0] for c, column in zip(coefficients, functions, strict=True)))
        return total if law.pulls else max(total, 0.0)

    deepest = _find_max_depth(force, 0.5 * mass * speed**2)
    if deepest is None:
        return None, 0.0
    step = np.pi * deepest / speed / CONTACT_STEPS
    states = [(0.0, speed)]
    for _ in range(round(MAX_CONTACT_DURATION_RATIO * CONTACT_STEPS)):
        states.append(_take_runge_kutta_step(force, mass, states[-1], step))
        if states[-1][0] <= 0.0:
            break
    depth, rate = np.array(states).T
    # The last step ends out of contact; only the part of the step in contact is integrated.
    last, past = depth[-2:]
    weights = np.full(len(depth) - 1, step)
    weights[-1] *= min(last / max(last - past, 1e-300), 1.0)
    restitution = -float(rate[-1]) / speed
    if past > 0.0 or restitution <= 0.0:
        return None, 0.0
    middle, moving = (0.5 * (values[1:] + values[:-1]) for values in (depth, rate))
    middle = np.maximum(middle, 0.0)
    columns = np.array(
        [np.broadcast_to(column, middle.shape) for column in law.entry_functions(middle, moving)]
    )
    total = coefficients @ columns
    touching = np.ones(len(middle), bool) if law.pulls else total > 0.0
    scale = mass * speed**2 * restitution
    by_coefficient = -(columns * touching) @ (moving * weights) / scale
    by_delay = float(np.sum(np.where(touching, total, 0.0) ** 2 * weights)) / mass / scale
    return _IdealContact(restitution, by_coefficient, by_delay), speed / deepest / (2.0 * np.pi)


def _find_max_depth(force: Any, energy: float) -> float | None:
    """Return the depth [m] where the elastic force has absorbed `energy` [J]; None if above `MAX_DEPTH`."""
    depth, work = 1e-9, 0.0
    while work < energy:
        work += force(1.005 * depth, 0.0) * 0.01 * depth
        depth *= 1.01
        if depth > MAX_DEPTH:
            return None
    return depth


def _take_runge_kutta_step(
    force: Any, mass: float, state: tuple[float, float], step: float
) -> tuple[float, float]:
    """Return the depth [m] and rate [m/s] after one Runge-Kutta step of `step` [s]."""
    depth, rate = state
    k1 = -force(depth, rate) / mass
    k2 = -force(depth + 0.5 * step * rate, rate + 0.5 * step * k1) / mass
    k3 = -force(depth + 0.5 * step * (rate + 0.5 * step * k1), rate + 0.5 * step * k2) / mass
    k4 = -force(depth + step * (rate + 0.5 * step * k2), rate + step * k3) / mass
    return (
        depth + step * (rate + step * (k1 + k2 + k3) / 6.0),
        rate + step * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0,
    )
