"""Limits that a six-axis gain file may set for the rig: names, units, bounds and defaults.

As on one axis (`jaxhil.rig.limits`), no file can set a limit beyond its bounds, and the default replaces a
missing limit or null. A limit on a distance or speed applies to the norm of the vector; a limit on a force or
torque applies to each channel.
"""

from collections.abc import Mapping
from types import MappingProxyType

from jaxhil.rig.bounds import DECELERATIONS, DISTANCES, FORCE_SLEWS, FORCES, POSITIONS, SPEEDS, TIMES
from jaxhil.rig.limits import HELD_READINGS, LIMITS, RATIOS, TICK_COUNTS, Limit, complete_limit_table
from jaxhil.rig.six_axes.vectors import COORDINATES

ANGLES = 0.0, 6.3  # [rad]
ROTATIONS = -6.3, 6.3  # a coordinate of a rotation vector [rad]
DURATIONS = 0.0, 1e5  # [s]


def _pose_limits(name: str, side: str, meaning: str) -> dict[str, Limit]:
    """Return the limits `<name>_<side>_<coordinate>`; `side` is "lowest" or "highest"."""
    limits = {}
    for axis in COORDINATES:
        unit, bounds = ("rad", ROTATIONS) if axis.startswith("r") else ("m", POSITIONS)
        default = bounds[0] if side == "lowest" else bounds[1]
        limits[f"{name}_{side}_{axis}"] = Limit(unit, default, *bounds, f"{meaning} of {axis}")
    return limits


SIX_AXIS_LIMITS: dict[str, Limit] = {
    "force_range": Limit("N", FORCES[1], *FORCES, "a force reading of this size is out of range"),
    "torque_range": Limit("N m", FORCES[1], *FORCES, "a torque reading of this size is out of range"),
    **_pose_limits("measured", "lowest", "lowest reading"),
    **_pose_limits("measured", "highest", "highest reading"),
    "held_readings": Limit("1", 0.0, *HELD_READINGS, "largest number of bad readings in a row"),
    "force_stuck_travel": Limit("m", DISTANCES[1], *DISTANCES, "hardware travel with an unchanged reading"),
    "position_stuck_travel": Limit(
        "m",
        DISTANCES[1],
        *DISTANCES,
        "model's travel along an axis with an unchanged reading",
    ),
    "rotation_stuck_travel": Limit(
        "rad",
        ANGLES[1],
        *ANGLES,
        "model's rotation about an axis with an unchanged reading",
    ),
    "settling": Limit("s", 0.0, 0.0, 100.0, "time in which wrench and command decay after contact"),
    "late_fraction": LIMITS["late_fraction"],
    "missed_in_a_row": LIMITS["missed_in_a_row"],
    "tare_ticks": Limit("1", 0.0, *TICK_COUNTS, "readings that a tare averages"),
    "tare_force_spread": Limit("N", FORCES[1], *FORCES, "largest difference between forces of a tare"),
    "tare_torque_spread": Limit("N m", FORCES[1], *FORCES, "largest difference between torques of a tare"),
    "force_bias_limit": Limit("N", FORCES[1], *FORCES, "largest bias of a force that a tare may find"),
    "torque_bias_limit": Limit("N m", FORCES[1], *FORCES, "largest bias of a torque that a tare may find"),
    "force_limit": Limit("N", FORCES[1], *FORCES, "largest force on the numerical model, per channel"),
    "torque_limit": Limit("N m", FORCES[1], *FORCES, "largest torque on the numerical model, per channel"),
    "force_slew": Limit("N/s", FORCE_SLEWS[1], *FORCE_SLEWS, "fastest change of a force on the model"),
    "torque_slew": Limit("N m/s", FORCE_SLEWS[1], *FORCE_SLEWS, "fastest change of a torque on the model"),
    "limited_in_a_row": LIMITS["limited_in_a_row"],
    **_pose_limits("command", "lowest", "lowest command"),
    **_pose_limits("command", "highest", "highest command"),
    "velocity_limit": Limit("m/s", SPEEDS[1], *SPEEDS, "fastest translation of the pose command"),
    "angular_velocity_limit": Limit("rad/s", SPEEDS[1], *SPEEDS, "fastest rotation of the pose command"),
    "start_distance": Limit(
        "m",
        0.0,
        *DISTANCES,
        "distance of a run's first command from the measured pose, out of contact",
    ),
    "start_angle": Limit(
        "rad", 0.0, *ANGLES, "angle of a run's first command from the measured pose, out of contact"
    ),
    "deceleration": Limit(
        "m/s^2", DECELERATIONS[1], *DECELERATIONS, "acceleration and deceleration after a trip"
    ),
    "angular_deceleration": Limit(
        "rad/s^2", DECELERATIONS[1], *DECELERATIONS, "angular acceleration and deceleration after a trip"
    ),
    "retreat_velocity": Limit("m/s", 0.0, *SPEEDS, "speed of the retreat after a trip"),
    "retreat_angular_velocity": Limit("rad/s", 0.0, *SPEEDS, "angular speed of the retreat"),
    "retreat_distance": Limit(
        "m", 0.0, *DISTANCES, "length of the retreat; a rotation counts as the distance covered in its time"
    ),
    "fading": Limit("N", 0.0, *FORCES, "largest measured force that counts as no contact"),
    "longest_contact": Limit("s", DURATIONS[1], *DURATIONS, "longest duration of a contact"),
    "unpaid_impulse": Limit(
        "1", RATIOS[1], *RATIOS, "largest impulse still owed after a contact, divided by its impulse"
    ),
    "momentum_error": Limit(
        "1", RATIOS[1], *RATIOS, "largest momentum error of the model in a contact, divided by its impulse"
    ),
    "energy_gain": Limit(
        "1", RATIOS[1], *RATIOS, "largest energy that a contact releases, divided by the approach energy"
    ),
    "lag_lowest": Limit("s", 0.0, *TIMES, "smallest lag of the hardware behind the model"),
    "lag_highest": Limit("s", TIMES[1], *TIMES, "largest lag of the hardware behind the model"),
}

# RANGES: pairs of limits of which the first must be below the second; ORDER: must not be above the second.
SIX_AXIS_RANGES = tuple(
    (f"{name}_lowest_{axis}", f"{name}_highest_{axis}")
    for name in ("measured", "command")
    for axis in COORDINATES
)
SIX_AXIS_ORDER = (
    ("retreat_velocity", "velocity_limit"),
    ("retreat_angular_velocity", "angular_velocity_limit"),
    ("lag_lowest", "lag_highest"),
)


def complete_six_axis_limits(limits: Mapping[str, float]) -> dict[str, float]:
    """Return all limits including defaults. Raise ValueError if two limits contradict each other."""
    return complete_limit_table(limits, SIX_AXIS_LIMITS, SIX_AXIS_RANGES, SIX_AXIS_ORDER)


NO_SIX_AXIS_LIMITS: Mapping[str, float] = MappingProxyType(complete_six_axis_limits({}))
