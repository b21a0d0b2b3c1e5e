"""Gains of the impulse ledger in six axes: units, bounds and nominal values.

No nominal value depends on the contact. Tuning changes only `velocity_gain` and `position_gain`, because the
objective is insensitive to the other gains near their optimum. The gains from `identification_delay` on
follow from the mechanism file.
"""

from collections.abc import Callable
from typing import Any

from jaxhil.laws.shared.nominal_values import force_delay
from jaxhil.laws.simulation_base import Gain
from jaxhil.laws.six_axis_base import lag_leads

POSE_FILTER = 3e-3  # lag of the pose filter if the position sensor has noise or a quantum [s]


def _fixed(name: str, unit: str, lower: float, upper: float, nominal: float) -> Gain:
    """Create a gain that tuning does not change."""
    return Gain(name, unit, lambda m: lower, lambda m: upper, lambda m: nominal, tuned=lambda m: False)


def _from_file(name: str, unit: str, upper: Callable[[Any], float], nominal: Callable[[Any], float]) -> Gain:
    """Create a gain whose nominal value follows from the mechanism file; tuning does not change it."""
    return Gain(name, unit, lambda m: 0.0, upper, nominal, tuned=lambda m: False)


def reading_delay(mechanism: Any) -> float:
    """Return the force measurement's delay minus the pose measurement's delay [s], at least 0."""
    return max(force_delay(mechanism) - mechanism.rig.position_sensor.delay, 0.0)


def noise(mechanism: Any, part: slice) -> float:
    """Return the largest standard deviation of noise plus rounding in channels `part` of the force sensor."""
    sensor = mechanism.rig.force_sensor
    pairs = zip(sensor.noise_std[part], sensor.quantum[part], strict=True)
    return max((deviation**2 + quantum**2 / 12) ** 0.5 for deviation, quantum in pairs)


def pose_filter(mechanism: Any) -> float:
    """Return the lag of the pose filter [s]; 0 if the position sensor has no noise and no quantum."""
    sensor = mechanism.rig.position_sensor
    return POSE_FILTER if any(sensor.noise_std) or any(sensor.quantum) else 0.0


def _velocity_gain_limit(mechanism: Any) -> float:
    return 0.8 / mechanism.rig.control_period


GAINS: tuple[Gain, ...] = (
    Gain(
        "velocity_gain", "1/s", lambda m: 10.0, _velocity_gain_limit,
        lambda m: min(200.0, _velocity_gain_limit(m)), logarithmic=True,
    ),
    Gain("position_gain", "1/s", lambda m: 0.0, lambda m: 30.0, lambda m: 10.0),
    _fixed("direction_pole", "1", 0.0, 0.95, 0.5),
    _fixed("stiffness_spread", "1/s^2", 1.0, 1e4, 400.0),
    _fixed("damping_spread", "1/s", 0.01, 100.0, 3.0),
    _fixed("force_spread", "1/s", 0.01, 100.0, 1.0),
    _fixed("curvature_spread", "1/s^2", 0.0, 500.0, 200.0),
    _fixed("forgetting", "1", 0.9, 1.0, 0.97),
    _fixed("correction_limit", "1", 0.5, 10.0, 2.0),
    _fixed("release_time", "s", 0.0, 0.1, 0.015),
    _fixed("settle", "s", 0.0, 1.0, 0.012),
    _from_file("identification_delay", "s", lambda m: 2 * force_delay(m) + 0.02, reading_delay),
    _from_file("pose_filter", "s", lambda m: 0.02, pose_filter),
    _from_file("force_noise", "N", lambda m: 1e3 + noise(m, slice(3)), lambda m: noise(m, slice(3))),
    _from_file("torque_noise", "N m", lambda m: 1e3 + noise(m, slice(3, 6)), lambda m: noise(m, slice(3, 6))),
    *lag_leads(equalise=True),
)  # fmt: skip
