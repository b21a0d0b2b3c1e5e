"""The limits that a gain file may carry for the rig: names, units, and what holds without them.

A gain file without limits gives the bare law: nothing is limited but what is not finite. `jaxhil export`
works the limits out and writes them under the file's digest; null there is no limit, infinity here.
"""

from collections.abc import Mapping
from math import inf
from types import MappingProxyType
from typing import NamedTuple

MINUTE = 1e-30  # where 0 would be divided by


class Limit(NamedTuple):
    """One limit."""

    unit: str  # of its value
    default: float  # its value where a file has none
    lowest: float  # its least value
    meaning: str  # what it is


LIMITS: dict[str, Limit] = {
    "force_range": Limit("N", inf, 0.0, "a force reading of this size is out of range"),
    "measured_lowest": Limit("m", -inf, -inf, "least position that the sensor may read"),
    "measured_highest": Limit("m", inf, -inf, "largest position that the sensor may read"),
    "held_readings": Limit("1", 0.0, 0.0, "bad readings in a row that are bridged"),
    "force_stuck_travel": Limit("m", inf, 0.0, "travel in contact under one force reading"),
    "position_stuck_travel": Limit("m", inf, 0.0, "the model's travel under one position reading"),
    "free_distance": Limit("m", 0.0, 0.0, "distance from a surface that counts as out of contact"),
    "settling": Limit("s", 0.0, 0.0, "time that force and command need to die out after contact"),
    "free_force": Limit("N", inf, 0.0, "largest force reading out of contact"),
    "late_fraction": Limit("1", 0.5, 0.0, "lateness of a tick, in periods, that is flagged"),
    "missed_in_a_row": Limit("1", inf, 0.0, "missed ticks in a row that are bridged"),
    "tare_ticks": Limit("1", 0.0, 0.0, "readings that a tare averages"),
    "tare_spread": Limit("N", inf, 0.0, "largest difference between readings of a tare"),
    "bias_limit": Limit("N", inf, 0.0, "largest bias that a tare may find"),
    "force_limit": Limit("N", inf, 0.0, "largest force on the numerical model"),
    "force_slew": Limit("N/s", inf, 0.0, "fastest change of the force on the numerical model"),
    "limited_in_a_row": Limit("1", 0.0, 0.0, "ticks in a row at which a rate may be cut"),
    "command_lowest": Limit("m", -inf, -inf, "least position command"),
    "command_highest": Limit("m", inf, -inf, "largest position command"),
    "velocity_limit": Limit("m/s", inf, 0.0, "fastest change of the position command"),
    "deceleration": Limit("m/s^2", inf, 0.0, "braking and starting after a trip"),
    "retreat_velocity": Limit("m/s", 0.0, 0.0, "speed of the way out of contact after a trip"),
    "equivalent_mass": Limit("kg", 0.0, 0.0, "the model's; 0: no energies are audited"),
    "fading": Limit("N", 0.0, 0.0, "force on the numerical model that counts as died out"),
    "longest_contact": Limit("s", inf, 0.0, "longest contact"),
    "energy_balance": Limit("1", inf, 0.0, "energy out of balance, of the approach's"),
    "restitution_margin": Limit("1", inf, 0.0, "largest difference from the expected restitution"),
    "alignment": Limit("s", 0.0, 0.0, "delay of the force reading against the position reading"),
    "reference_stiffness": Limit("N/m", 1.0, MINUTE, "stiffness at which p is 0"),
    "reference_velocity": Limit("m/s", 1.0, MINUTE, "approach speed at which w is 0"),
    "softness_lowest": Limit("1", 0.0, -inf, "least p"),
    "softness_highest": Limit("1", 0.0, -inf, "largest p"),
    "speed_lowest": Limit("1", 0.0, -inf, "least w"),
    "speed_highest": Limit("1", 0.0, -inf, "largest w"),
    "loss_lowest": Limit("1", 0.0, -inf, "least z"),
    "loss_highest": Limit("1", 0.0, -inf, "largest z"),
    "expected_1": Limit("1", 1.0, -inf, "expected restitution at p = w = z = 0"),
    **{
        f"expected_{term}": Limit("1", 0.0, -inf, f"coefficient of {' '.join(term)} in it")
        for term in ("p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
    },
}


def complete(limits: Mapping[str, float]) -> dict[str, float]:
    """All limits, those that are not given at their defaults. Raises ValueError for limits that clash."""
    found = {name: limits.get(name, one.default) for name, one in LIMITS.items()}
    for low, high in (("measured_lowest", "measured_highest"), ("command_lowest", "command_highest")):
        if not found[low] < found[high]:
            raise ValueError(f"{low} {found[low]!r} is not below {high} {found[high]!r}")
    if found["retreat_velocity"] > found["velocity_limit"]:
        raise ValueError(
            f"retreat_velocity {found['retreat_velocity']!r} is above velocity_limit "
            f"{found['velocity_limit']!r}"
        )
    return found


NO_LIMITS: Mapping[str, float] = MappingProxyType(complete({}))
