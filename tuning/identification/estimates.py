"""Estimates with 95 % intervals, from posterior draws and from the sensors' noise at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.structs import numeric_keys
from tuning.identification.contact_fit import ContactFit
from tuning.identification.result import Estimate

DAMPING_KEY, FORCE_DELAY_KEY = "contact.damping", "rig.force_sensor.delay"
ZERO_WIDTH_SIGMAS, MAX_SHARE_AT_ZERO = (
    0.1,
    0.005,
)  # draws pile up at 0 if more than this share lies within this many std of 0


def make_estimates(found, motion, contact, force, position, fixed) -> tuple[Estimate, ...]:
    """Return the estimates of the parameters with draws, then of the noise and the fixed parameters."""
    at_bound = select_dampings_at_zero(found)
    from_draws = [_estimate_from_draws(key, values, at_bound) for key, values in found.items()]
    direct = []
    if force is not None and not force.silent:
        direct.append(_make_normal_estimate("rig.force_sensor.noise_std", force.std, force.std_std))
        direct.append(_make_normal_estimate("rig.force_sensor.bias", force.mean, force.mean_std))
    elif contact is not None:
        std = contact.readings.std
        direct.append(
            _make_normal_estimate("rig.force_sensor.noise_std", std, std / np.sqrt(2.0 * contact.freedom))
        )
        if force is None:
            bias = contact.posterior.draws[:, contact.posterior.names.index("bias")]
            direct.append(
                _make_normal_estimate("rig.force_sensor.bias", float(bias.mean()), float(bias.std()))
            )
    if force is not None and force.quantum:
        direct.append(_make_normal_estimate("rig.force_sensor.quantum", force.quantum, 0.0))
    if position is not None:
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
        Estimate(key, value, 0.0, value, value, get_unit(key), is_fixed=True) for key, value in fixed.items()
    ]
    return (*from_draws, *direct)


def accumulates_at_zero(values: np.ndarray) -> bool:
    """Return whether draws that cannot be negative accumulate at 0, so that 0 is as probable as any value."""
    return bool(np.mean(values <= ZERO_WIDTH_SIGMAS * values.std()) > MAX_SHARE_AT_ZERO)


def select_dampings_at_zero(found: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the draws of the damping coefficients [N s/m] that accumulate at 0, by key."""
    return {
        key: values
        for key, values in found.items()
        if key.startswith(DAMPING_KEY) and accumulates_at_zero(values)
    }


def shift_to_zero_damping(values: np.ndarray, at_bound: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return draws moved to zero damping coefficients `at_bound`, by linear regression."""
    damping = np.column_stack(list(at_bound.values()))
    slope = np.linalg.lstsq(damping - damping.mean(axis=0), values - values.mean(), rcond=None)[0]
    return values - damping @ slope


def find_shortest_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the shortest interval with 95 % of the draws; it includes 0 if they accumulate there."""
    ordered = np.sort(values)
    inside = int(np.ceil(0.95 * len(ordered)))
    first = int(np.argmin(ordered[inside - 1 :] - ordered[: len(ordered) - inside + 1]))
    return float(ordered[first]), float(ordered[first + inside - 1])


def _estimate_from_draws(key: str, values: np.ndarray, at_bound: Mapping[str, np.ndarray] = {}) -> Estimate:
    """Return the estimate of a parameter from its draws.

    `at_bound` holds the dampings whose draws accumulate at 0. Their interval is one-sided. The logs hardly
    separate them from the force delay, so its interval includes the delays that belong to zero damping.
    """
    low, high = np.quantile(values, (0.025, 0.975))
    if key in at_bound:
        low, high = 0.0, np.quantile(values, 0.95)
    elif at_bound and key.startswith((DAMPING_KEY, FORCE_DELAY_KEY)):
        low, high = find_shortest_interval(values)
    if at_bound and key.startswith(FORCE_DELAY_KEY):
        ends = np.quantile(shift_to_zero_damping(values, at_bound), (0.025, 0.975))
        low, high = min(low, ends[0]), max(high, ends[1])
    return Estimate(
        key, float(values.mean()), float(values.std(ddof=1)), float(low), float(high), get_unit(key)
    )


def _make_normal_estimate(key: str, value: float, std: float) -> Estimate:
    return Estimate(key, value, std, value - 1.96 * std, value + 1.96 * std, get_unit(key))


def get_unit(key: str) -> str:
    """Return the SI unit of a key, with or without the index of a list's entry."""
    parts = key.split(".")
    while parts[-1].isdigit():
        parts.pop()
    return numeric_keys()[".".join(parts)].unit


def estimate_combinations(
    found: Mapping[str, np.ndarray], contact: ContactFit | None
) -> tuple[Estimate, ...]:
    """Return the combinations that the logs determine better than their parts.

    These are sums of delays, and the damping minus stiffness times delay ("apparent damping").
    """
    combined, at_bound = [], select_dampings_at_zero(found)
    motion, force = (found.get(key) for key in ("rig.simulator.delay", "rig.force_sensor.delay"))
    lag = found.get("rig.force_sensor.time_constant")
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
    damping, stiffness = found.get("contact.damping.0"), found.get("contact.stiffness.0")
    if contact is None or not find_contact_law(contact.law.name).is_linear:
        return tuple(combined)
    if force is not None and damping is not None and stiffness is not None:
        apparent = replace(
            _estimate_from_draws("contact.damping", damping - stiffness * force), key="apparent damping"
        )
        combined.append(apparent)
    return tuple(combined)
