"""Estimates with 95 % intervals, from posterior draws and from the noise of the sensors at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.number_ranges import numeric_keys
from tuning.identification.contact_fit import ContactFit
from tuning.identification.parameters import CUTOFF_KEY
from tuning.identification.result import ParameterEstimate

DAMPING_KEY, FORCE_DELAY_KEY = "contact.damping", "rig.force_sensor.delay"
# Draws accumulate at 0 if a share above the first number lies below the second number of standard deviations.
MAX_SHARE_AT_ZERO, ZERO_WIDTH_SIGMAS = 0.005, 0.1


def make_estimates(draws_by_key, motion, contact, force, position, fixed) -> tuple[ParameterEstimate, ...]:
    """Return the estimates of all parameters: drawn parameters, sensor noise, and fixed parameters.

    Args:
        draws_by_key: Posterior draws of each parameter.
        motion: Fit of the motion simulator, or None.
        contact: Fit of the contact, or None.
        force: Noise of the force sensor at rest, or None.
        position: Noise of the position sensor at rest, or None.
        fixed: Values of the fixed parameters by key.
    """
    at_bound = select_dampings_at_zero(draws_by_key)
    from_draws = [_estimate_from_draws(key, values, at_bound) for key, values in draws_by_key.items()]
    direct = []
    if force is not None and not force.silent:
        direct.append(_make_normal_estimate("rig.force_sensor.noise_std", force.std, force.std_std))
        direct.append(_make_normal_estimate("rig.force_sensor.bias", force.mean, force.mean_std))
        if force.walk:
            direct.append(_make_normal_estimate("rig.force_sensor.bias_random_walk", *force.walk))
    elif contact is not None:
        std = contact.readings.std
        direct.append(
            _make_normal_estimate(
                "rig.force_sensor.noise_std", std, std / np.sqrt(2.0 * contact.degrees_of_freedom)
            )
        )
        if force is None or contact.readings.zone:
            bias = contact.draws()[:, contact.posterior.names.index("bias")]
            direct.append(
                _make_normal_estimate("rig.force_sensor.bias", float(bias.mean()), float(bias.std()))
            )
    if force is not None and force.quantum:
        direct.append(_make_normal_estimate("rig.force_sensor.quantum", force.quantum, 0.0))
    if position is not None and not position.silent:
        direct.append(_make_normal_estimate("rig.position_sensor.noise_std", position.std, position.std_std))
        if position.quantum:
            direct.append(_make_normal_estimate("rig.position_sensor.quantum", position.quantum, 0.0))
    elif motion is not None:
        count = sum(len(spectrum.frequency) for spectrum in motion.spectra)
        std = motion.noise_std
        direct.append(
            _make_normal_estimate("rig.position_sensor.noise_std", std, std / np.sqrt(2.0 * max(count, 1)))
        )
    direct += [
        ParameterEstimate(key, value, 0.0, value, value, get_unit(key), is_fixed=True)
        for key, value in fixed.items()
    ]
    return (*from_draws, *direct)


def accumulates_at_zero(values: np.ndarray) -> bool:
    """Return whether the draws accumulate at 0, the lower bound of the parameter."""
    return bool(np.mean(values <= ZERO_WIDTH_SIGMAS * values.std()) > MAX_SHARE_AT_ZERO)


def select_dampings_at_zero(draws_by_key: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Select the damping coefficients [N s/m] whose draws accumulate at 0; return their draws by key."""
    return {
        key: values
        for key, values in draws_by_key.items()
        if key.startswith(DAMPING_KEY) and accumulates_at_zero(values)
    }


def shift_to_zero_damping(values: np.ndarray, at_bound: Mapping[str, np.ndarray]) -> np.ndarray:
    """Shift the draws of a parameter to the values that a linear regression predicts for zero damping.

    Args:
        values: Draws of the parameter.
        at_bound: Draws of the damping coefficients that are assumed to be zero, by key.
    """
    damping = np.column_stack(list(at_bound.values()))
    slope = np.linalg.lstsq(damping - damping.mean(axis=0), values - values.mean(), rcond=None)[0]
    return values - damping @ slope


def find_shortest_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the ends of the shortest interval that contains 95 % of the draws."""
    ordered = np.sort(values)
    inside = int(np.ceil(0.95 * len(ordered)))
    first = int(np.argmin(ordered[inside - 1 :] - ordered[: len(ordered) - inside + 1]))
    return float(ordered[first]), float(ordered[first + inside - 1])


def _estimate_from_draws(
    key: str, values: np.ndarray, at_bound: Mapping[str, np.ndarray] = {}
) -> ParameterEstimate:
    """Return the estimate of a parameter from its posterior draws.

    `at_bound` contains the damping coefficients whose draws accumulate at 0. The interval of such a
    coefficient is one-sided. The logs hardly distinguish damping from force delay. The interval of the force
    delay therefore also includes the delays that would fit if the damping were 0. Every interval includes the
    estimate, which may exceed a quantile if nearly all draws are 0.
    """
    value = float(values.mean())
    low, high = np.quantile(values, (0.025, 0.975))
    if key in at_bound:
        low, high = 0.0, np.quantile(values, 0.95)
    elif at_bound and key.startswith((DAMPING_KEY, FORCE_DELAY_KEY)):
        low, high = find_shortest_interval(values)
    if at_bound and key.startswith(FORCE_DELAY_KEY):
        ends = np.quantile(shift_to_zero_damping(values, at_bound), (0.025, 0.975))
        low, high = min(low, ends[0]), max(high, ends[1])
    low, high = min(float(low), value), max(float(high), value)
    return ParameterEstimate(key, value, float(values.std(ddof=1)), low, high, get_unit(key))


def _make_normal_estimate(key: str, value: float, std: float) -> ParameterEstimate:
    return ParameterEstimate(key, value, std, value - 1.96 * std, value + 1.96 * std, get_unit(key))


def get_unit(key: str) -> str:
    """Return the SI unit of a mechanism key; the index of a list entry is ignored."""
    parts = key.split(".")
    while parts[-1].isdigit():
        parts.pop()
    return numeric_keys()[".".join(parts)].unit


def estimate_combinations(
    draws_by_key: Mapping[str, np.ndarray], contact: ContactFit | None
) -> tuple[ParameterEstimate, ...]:
    """Return estimates of parameter combinations that the logs determine better than single parameters.

    The combinations are sums of delays, and the "apparent damping" (damping - stiffness * force delay).
    """
    combined, at_bound = [], select_dampings_at_zero(draws_by_key)
    motion, force = (draws_by_key.get(key) for key in ("rig.simulator.delay", "rig.force_sensor.delay"))
    lag = draws_by_key.get("rig.force_sensor.time_constant")
    if (cutoff := draws_by_key.get(CUTOFF_KEY)) is not None and contact is not None:
        lag = contact.readings.modes.delay / (2.0 * np.pi * cutoff)
    if force is not None and lag is not None:
        force = force + lag
        combined.append(
            replace(_estimate_from_draws(FORCE_DELAY_KEY, force, at_bound), key="delay and lag of force")
        )
    if motion is not None and force is not None:
        combined.append(
            replace(
                _estimate_from_draws(FORCE_DELAY_KEY, motion + force, at_bound),
                key="delay of motion and force",
            )
        )
    damping, stiffness = draws_by_key.get("contact.damping.0"), draws_by_key.get("contact.stiffness.0")
    if contact is None or not find_contact_law(contact.law.name).is_linear:
        return tuple(combined)
    if force is not None and damping is not None and stiffness is not None:
        apparent = replace(
            _estimate_from_draws("contact.damping", damping - stiffness * force), key="apparent damping"
        )
        combined.append(apparent)
    return tuple(combined)
