"""Limits that a gain file may set for the rig: names, units, bounds and defaults.

`jaxhil export` computes the limits and writes them into the gain file, whose digest covers them. No file can
set a limit beyond its bounds. A limit that is missing or null has its default, which for most signals is the
widest value that the bounds allow (`bounds`).
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from jaxhil.rig.bounds import (
    DECELERATIONS,
    DISTANCES,
    FORCE_SLEWS,
    FORCES,
    MASSES,
    POSITIONS,
    SPEEDS,
    STIFFNESSES,
    TIMES,
)

HELD_READINGS = 0.0, 1000.0  # successive ticks
# bounds of limits on numbers of ticks; the upper one exceeds the longest gap that the clock counts
TICK_COUNTS = 0.0, 1e6
# ratios of energies or restitutions [1]. No ratio reaches the upper bound, even in a very slow approach.
RATIOS = 0.0, 1e300
FEATURE_BOUNDS = -1e3, 1e3  # p, w and z of the expected restitution (`watchdog`) [1]
COEFFICIENTS = -1e9, 1e9  # coefficients of the polynomial in p, w and z [1]


class Limit(NamedTuple):
    """Specification of one limit: unit, default and bounds."""

    unit: str  # "1" if dimensionless
    default: float  # value if the gain file has none
    lowest: float  # lower bound
    highest: float  # upper bound
    meaning: str  # description in one line

    def admits(self, value: float) -> bool:
        """Return whether the value is within the bounds."""
        return self.lowest <= value <= self.highest


LIMITS: dict[str, Limit] = {
    "force_range": Limit("N", FORCES[1], *FORCES, "smallest magnitude of a force out of range"),
    "measured_lowest": Limit("m", POSITIONS[0], *POSITIONS, "least position that the sensor may read"),
    "measured_highest": Limit("m", POSITIONS[1], *POSITIONS, "largest position that the sensor may read"),
    "held_readings": Limit("1", 0.0, *HELD_READINGS, "largest number of successive bad readings"),
    "force_stuck_travel": Limit(
        "m", DISTANCES[1], *DISTANCES, "largest travel in contact while the force reading does not change"
    ),
    "position_stuck_travel": Limit(
        "m",
        DISTANCES[1],
        *DISTANCES,
        "largest travel of the model while the position reading does not change",
    ),
    "free_distance": Limit("m", 0.0, *DISTANCES, "distance from a surface beyond which contact is ruled out"),
    "settling": Limit("s", 0.0, 0.0, 100.0, "time in which force and force command decay after a contact"),
    "free_force": Limit("N", FORCES[1], *FORCES, "largest force reading out of contact"),
    "late_fraction": Limit(
        "1", 0.25, 0.0, 1.0, "accepted lateness or earliness of a tick, in periods; a tick 0.5 late is missed"
    ),
    "missed_in_a_row": Limit("1", TICK_COUNTS[1], *TICK_COUNTS, "largest number of successive missed ticks"),
    "tare_ticks": Limit("1", 0.0, *TICK_COUNTS, "number of readings that a tare averages"),
    "tare_spread": Limit("N", FORCES[1], *FORCES, "largest difference between the readings of a tare"),
    "bias_limit": Limit("N", FORCES[1], *FORCES, "largest bias that a tare may find"),
    "force_limit": Limit("N", FORCES[1], *FORCES, "largest force on the numerical model"),
    "force_slew": Limit(
        "N/s", FORCE_SLEWS[1], *FORCE_SLEWS, "fastest change of the force on the numerical model"
    ),
    "limited_in_a_row": Limit("1", 0.0, *HELD_READINGS, "largest number of successive limited changes"),
    "command_lowest": Limit("m", POSITIONS[0], *POSITIONS, "least position command"),
    "command_highest": Limit("m", POSITIONS[1], *POSITIONS, "largest position command"),
    "velocity_limit": Limit("m/s", SPEEDS[1], *SPEEDS, "fastest change of the position command"),
    "start_distance": Limit(
        "m", 0.0, *DISTANCES, "largest distance of a run's first command from the drives, out of contact"
    ),
    "deceleration": Limit(
        "m/s^2", DECELERATIONS[1], *DECELERATIONS, "acceleration of the position command after a trip"
    ),
    "retreat_velocity": Limit("m/s", 0.0, *SPEEDS, "speed of the retreat from contact after a trip"),
    "equivalent_mass": Limit("kg", 0.0, 0.0, MASSES[1], "mass of the model; 0 disables the energy audit"),
    "fading": Limit("N", 0.0, *FORCES, "largest force reading that counts as no force"),
    "longest_contact": Limit("s", 1e5, 0.0, 1e5, "longest duration of a contact"),
    "energy_balance": Limit(
        "1", RATIOS[1], *RATIOS, "largest energy error, divided by the energy of the approach"
    ),
    "restitution_margin": Limit("1", RATIOS[1], *RATIOS, "largest difference from the expected restitution"),
    "alignment": Limit("s", 0.0, *TIMES, "delay of the force reading relative to the position reading"),
    "reference_stiffness": Limit("N/m", 1.0, 1e-3, STIFFNESSES[1], "stiffness at which softness p is 0"),
    "reference_velocity": Limit("m/s", 1.0, 1e-6, SPEEDS[1], "approach speed at which speed w is 0"),
    "softness_lowest": Limit("1", 0.0, *FEATURE_BOUNDS, "lower bound of the softness p"),
    "softness_highest": Limit("1", 0.0, *FEATURE_BOUNDS, "upper bound of the softness p"),
    "speed_lowest": Limit("1", 0.0, *FEATURE_BOUNDS, "lower bound of the relative speed w"),
    "speed_highest": Limit("1", 0.0, *FEATURE_BOUNDS, "upper bound of the relative speed w"),
    "loss_lowest": Limit("1", 0.0, *FEATURE_BOUNDS, "lower bound of the damping ratio z"),
    "loss_highest": Limit("1", 0.0, *FEATURE_BOUNDS, "upper bound of the damping ratio z"),
    "expected_1": Limit("1", 1.0, *COEFFICIENTS, "expected restitution at p = w = z = 0"),
    **{
        f"expected_{term}": Limit(
            "1", 0.0, *COEFFICIENTS, f"coefficient of {' '.join(term)} in the expected restitution"
        )
        for term in ("p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
    },
}


# Pairs of limits of which the first is below the second, or not above it.
RANGES = (("measured_lowest", "measured_highest"), ("command_lowest", "command_highest"))
ORDER = (("retreat_velocity", "velocity_limit"),)


def complete_limits(limits: Mapping[str, float]) -> dict[str, float]:
    """Return all limits including defaults. Raise ValueError if two limits contradict each other."""
    return complete_limit_table(limits, LIMITS, RANGES, ORDER)


def complete_limit_table(
    limits: Mapping[str, float],
    table: Mapping[str, Limit],
    ranges: Sequence[tuple[str, str]],
    order: Sequence[tuple[str, str]],
) -> dict[str, float]:
    """Return all limits of a table including defaults. Raise ValueError if two limits contradict each other.

    Args:
        limits: limits that have been set, by name.
        table: all limits by name.
        ranges: pairs of limits of which the first is below the second.
        order: pairs of limits of which the first is not above the second.
    """
    values = {name: limits.get(name, limit.default) for name, limit in table.items()}
    for low, high in ranges:
        if not values[low] < values[high]:
            raise ValueError(f"{low} {values[low]!r} is not below {high} {values[high]!r}")
    for low, high in order:
        if values[low] > values[high]:
            raise ValueError(f"{low} {values[low]!r} is above {high} {values[high]!r}")
    return values


NO_LIMITS: Mapping[str, float] = MappingProxyType(complete_limits({}))
