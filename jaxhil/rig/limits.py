"""Limits that a gain file may set for the rig: names, units, bounds and defaults.

`jaxhil export` computes the limits and writes them into the file under its digest. No file can set them
beyond their bounds; where it has none, or null, the default holds. The defaults of limits of signals are the
absolute bounds (`bounds`).
"""

from collections.abc import Mapping
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

HELD_READINGS = 0.0, 1000.0  # ticks in a row
TICK_COUNTS = 0.0, 1e6  # ticks; more than the longest gap that the clock counts
# of energies or restitutions; the upper bound is never reached, however slow the approach
RATIOS = 0.0, 1e300
FEATURES = -1e3, 1e3  # p, w and z of the expected restitution (`watchdog`)
COEFFICIENTS = -1e9, 1e9  # of the polynomial in p, w and z


class Limit(NamedTuple):
    """Limit with unit, default and bounds."""

    unit: str  # "1" if it has none
    default: float  # value where a file has none
    lowest: float  # lower bound
    highest: float  # upper bound
    meaning: str  # one line

    def admits(self, value: float) -> bool:
        """Return whether the value is within the bounds."""
        return self.lowest <= value <= self.highest


LIMITS: dict[str, Limit] = {
    "force_range": Limit("N", FORCES[1], *FORCES, "a force reading of this size is out of range"),
    "measured_lowest": Limit("m", POSITIONS[0], *POSITIONS, "least position that the sensor may read"),
    "measured_highest": Limit("m", POSITIONS[1], *POSITIONS, "largest position that the sensor may read"),
    "held_readings": Limit("1", 0.0, *HELD_READINGS, "largest number of bad readings in a row"),
    "force_stuck_travel": Limit("m", DISTANCES[1], *DISTANCES, "travel in contact under one force reading"),
    "position_stuck_travel": Limit(
        "m", DISTANCES[1], *DISTANCES, "the model's travel under one position reading"
    ),
    "free_distance": Limit("m", 0.0, *DISTANCES, "distance from a surface that counts as out of contact"),
    "settling": Limit("s", 0.0, 0.0, 100.0, "time in which force and command decay after contact"),
    "free_force": Limit("N", FORCES[1], *FORCES, "largest force reading out of contact"),
    "late_fraction": Limit(
        "1", 0.25, 0.0, 1.0, "lateness or earliness of a tick, in periods, that is flagged; late: below 0.5"
    ),
    "missed_in_a_row": Limit("1", TICK_COUNTS[1], *TICK_COUNTS, "largest number of missed ticks in a row"),
    "tare_ticks": Limit("1", 0.0, *TICK_COUNTS, "readings that a tare averages"),
    "tare_spread": Limit("N", FORCES[1], *FORCES, "largest difference between readings of a tare"),
    "bias_limit": Limit("N", FORCES[1], *FORCES, "largest bias that a tare may find"),
    "force_limit": Limit("N", FORCES[1], *FORCES, "largest force on the numerical model"),
    "force_slew": Limit(
        "N/s", FORCE_SLEWS[1], *FORCE_SLEWS, "fastest change of the force on the numerical model"
    ),
    "limited_in_a_row": Limit("1", 0.0, *HELD_READINGS, "largest number of ticks in a row with a cut change"),
    "command_lowest": Limit("m", POSITIONS[0], *POSITIONS, "least position command"),
    "command_highest": Limit("m", POSITIONS[1], *POSITIONS, "largest position command"),
    "velocity_limit": Limit("m/s", SPEEDS[1], *SPEEDS, "fastest change of the position command"),
    "start_distance": Limit(
        "m", 0.0, *DISTANCES, "distance of a run's first command from the measured position, out of contact"
    ),
    "deceleration": Limit("m/s^2", DECELERATIONS[1], *DECELERATIONS, "braking and starting after a trip"),
    "retreat_velocity": Limit("m/s", 0.0, *SPEEDS, "speed out of contact after a trip"),
    "equivalent_mass": Limit("kg", 0.0, 0.0, MASSES[1], "mass of the model; 0: no energies are audited"),
    "fading": Limit("N", 0.0, *FORCES, "force reading that counts as no contact"),
    "longest_contact": Limit("s", 1e5, 0.0, 1e5, "longest contact"),
    "energy_balance": Limit(
        "1", RATIOS[1], *RATIOS, "largest error of the energy, over that of the approach"
    ),
    "restitution_margin": Limit("1", RATIOS[1], *RATIOS, "largest difference from the expected restitution"),
    "alignment": Limit("s", 0.0, *TIMES, "delay of the force reading against the position reading"),
    "reference_stiffness": Limit("N/m", 1.0, 1e-3, STIFFNESSES[1], "stiffness at which p is 0"),
    "reference_velocity": Limit("m/s", 1.0, 1e-6, SPEEDS[1], "approach speed at which w is 0"),
    "softness_lowest": Limit("1", 0.0, *FEATURES, "least p"),
    "softness_highest": Limit("1", 0.0, *FEATURES, "largest p"),
    "speed_lowest": Limit("1", 0.0, *FEATURES, "least w"),
    "speed_highest": Limit("1", 0.0, *FEATURES, "largest w"),
    "loss_lowest": Limit("1", 0.0, *FEATURES, "least z"),
    "loss_highest": Limit("1", 0.0, *FEATURES, "largest z"),
    "expected_1": Limit("1", 1.0, *COEFFICIENTS, "expected restitution at p = w = z = 0"),
    **{
        f"expected_{term}": Limit("1", 0.0, *COEFFICIENTS, f"coefficient of {' '.join(term)}")
        for term in ("p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
    },
}


def complete_limits(limits: Mapping[str, float]) -> dict[str, float]:
    """Return all limits, defaults included. Raise ValueError if two of them contradict each other."""
    values = {name: limits.get(name, limit.default) for name, limit in LIMITS.items()}
    for low, high in (("measured_lowest", "measured_highest"), ("command_lowest", "command_highest")):
        if not values[low] < values[high]:
            raise ValueError(f"{low} {values[low]!r} is not below {high} {values[high]!r}")
    if values["retreat_velocity"] > values["velocity_limit"]:
        raise ValueError(
            f"retreat_velocity {values['retreat_velocity']!r} is above velocity_limit "
            f"{values['velocity_limit']!r}"
        )
    return values


NO_LIMITS: Mapping[str, float] = MappingProxyType(complete_limits({}))
