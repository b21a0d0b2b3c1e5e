"""What the rig of a mechanism file would read under the commands of a log. Nothing is fitted here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from jaxhil.errors import InputError
from jaxhil.mechanism.structs import Contact, Mechanism, Simulator
from tuning.identification import contact_laws
from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import lag_weights
from tuning.identification.motion import Motion
from tuning.identification.records import Run, Timing


class Transfer(NamedTuple):
    """A motion simulator, as `Motion` takes it."""

    fraction: tuple[np.ndarray, np.ndarray]  # numerator and denominator in descending powers of s
    delay: float  # s


@dataclass(frozen=True)
class Readings:
    """Without noise, (rows, lanes); a run shorter than the longest one is padded."""

    force: np.ndarray  # N, bias and dead zone included
    elastic: np.ndarray  # N, its part that does not depend on the rate
    rate: np.ndarray  # m/s, of the depth; 0 out of contact
    touching: np.ndarray  # 1 in contact, 0 out of it; between, where the sensor lags
    depth: np.ndarray  # m, when the force was
    position: np.ndarray  # m
    velocity: np.ndarray  # m/s, of the position that is read


def motion_of(mechanism: Mechanism, runs: Sequence[Run], timing: Timing, slack: float) -> Motion:
    """Of the rig's motion simulator under the commands of runs; `slack` [s]: by how much the sensors' delays
    may exceed the file's. Raises `InputError` for a G that passes some of the command at once."""
    rig = mechanism.rig
    longest = max(rig.force_sensor.delay, rig.position_sensor.delay) + slack + timing.control_period
    return Motion(transfer(rig.simulator), runs, timing, longest)


def readings(mechanism: Mechanism, runs: Sequence[Run], motion: Motion) -> Readings:
    """Of runs with at most one contact each, and their motion. Raises `InputError` for a law that no log can
    be held against."""
    rig, sensor, period = mechanism.rig, mechanism.rig.force_sensor, motion.period
    law, table = law_of(mechanism.contact)
    coefficients = table[np.minimum([entry(run) for run in runs], len(table) - 1)].T
    # A lag integrates the force from row to row.
    parts = (0.0,) if sensor.time_constant == 0.0 else (0.0, 0.5)
    moved = [motion.at(sensor.delay + part * period) for part in parts]
    columns = [_columns(law, coefficients, x - rig.contact_plane, v) for x, v in moved]
    force, elastic, rate, touching = _lagged(columns, period, sensor.time_constant)
    force = force + sensor.bias
    force = np.sign(force) * np.maximum(np.abs(force) - sensor.dead_zone, 0.0)
    position, velocity = motion.at(rig.position_sensor.delay)
    return Readings(force, elastic, rate, touching, moved[0][0] - rig.contact_plane, position, velocity)


def entry(run: Run) -> int:
    """Which entry of the contact lists a run's contact meets."""
    if run.contact_index is None or run.force_measured is None:
        return 0
    return max(int(run.contact_index[np.argmax(np.abs(np.nan_to_num(run.force_measured)))]), 0)


def transfer(simulator: Simulator) -> Transfer:
    """G(s) and the delay. Raises `InputError` where some of the command passes G at once."""
    above, below = [1.0], [1.0]
    if simulator.model == "transfer_function":
        above, below = simulator.numerator, simulator.denominator
    elif simulator.model == "third_order":
        below = [*reversed(simulator.coefficients or ()), 1.0]
    elif simulator.model == "second_order":
        w = 2.0 * np.pi * float(simulator.natural_frequency or 0.0)
        below = [1.0 / w**2, 2.0 * float(simulator.damping_ratio or 0.0) / w, 1.0]
    elif simulator.model == "first_order" and simulator.time_constant:
        below = [simulator.time_constant, 1.0]
    above, below = (np.trim_zeros(np.asarray(one, float), "f") for one in (above, below))
    if len(below) > 1 and len(above) == len(below):
        raise InputError(
            "rig.simulator.numerator: found one of the denominator's degree, allowed a smaller one"
        )
    return Transfer((above, below), simulator.delay)


def law_of(contact: Contact) -> tuple[Law, np.ndarray]:
    """A law as a sum of functions, and its coefficients: a row for each entry of the lists."""
    if np.isfinite(contact.clearance):
        raise InputError(f"contact.clearance: found {contact.clearance:g}, allowed inf: one surface")
    number = max(len(contact.stiffness), len(contact.damping))
    stiffness, damping = (
        [values[min(i, len(values) - 1)] for i in range(number)]
        for values in (contact.stiffness, contact.damping)
    )
    if contact.law == "piecewise_linear":
        return contact_laws.piecewise_linear(tuple(contact.depths)), np.column_stack([stiffness, damping])
    k, b = np.array(stiffness, float), np.array(damping, float)
    reference = float(contact.reference_depth or np.inf)
    if contact.law == "linear":
        return contact_laws.linear(), k[:, None]
    if contact.law == "kelvin_voigt":
        return contact_laws.kelvin_voigt(contact.tension), np.column_stack([k, b])
    if contact.law == "hunt_crossley":
        return contact_laws.hunt_crossley(contact.exponent), np.column_stack([k, k * b])
    if contact.law == "hardening":
        return contact_laws.hardening(), np.column_stack([k, k / reference**2, b])
    if contact.law == "depth_damped":
        return contact_laws.depth_damped(contact.exponent, reference), np.column_stack([k, b])
    allowed = "linear, kelvin_voigt, hunt_crossley, piecewise_linear, hardening, depth_damped"
    raise InputError(f"contact.law: found {contact.law}, allowed {allowed}")


def _columns(law: Law, coefficients: np.ndarray, depth: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Force, its part at no rate, rate and 1 where there is contact; 0 elsewhere."""
    inside = np.maximum(depth, 0.0)

    def force(v):
        functions = [*law.own(inside, v), *law.shared(inside, v)]
        return sum(c * one for c, one in zip(coefficients, functions, strict=True))

    total = force(rate)
    touching = (depth > 0.0) & (law.pulls | (total > 0.0))
    return touching * np.array([total, force(np.zeros_like(rate)), rate, np.ones_like(rate)])


def _lagged(columns: list[np.ndarray], period: float, time_constant: float) -> np.ndarray:
    """Columns at every row, and half a period before it, as a first-order lag gives them."""
    if time_constant == 0.0:
        return columns[0]
    pole, (now, half, last) = lag_weights(period / time_constant)
    drive = now * columns[0] + half * columns[1]
    drive[:, 1:] += last * columns[0][:, :-1]
    lagged: Any = lfilter([1.0], [1.0, -pole], drive, axis=1)
    return lagged
