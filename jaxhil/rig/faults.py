"""Faults that the controller detects on the rig, and its reactions.

Each fault is one bit, which is set in `Controller.faults` on the tick on which the fault occurs.
Documentation, exports and error texts are made from `FAULTS`. The bits are the same in the C controller.

A *trip* is latched until `reset`: the force ramps to 0 and the position command comes to rest out of contact.
"""

from collections.abc import Sequence
from typing import NamedTuple


class Fault(NamedTuple):
    """Entry of the fault table: bit, name, condition and the controller's reaction."""

    bit: int  # bit in `Controller.faults`
    name: str  # name in texts and exports
    condition: str  # when the bit is set
    reaction: str  # what the controller does


FORCE_NOT_FINITE = 0x1
POSITION_NOT_FINITE = 0x2
MODEL_NOT_FINITE = 0x4
FORCE_OUT_OF_RANGE = 0x8
POSITION_OUT_OF_RANGE = 0x10
FORCE_STUCK = 0x20
POSITION_STUCK = 0x40
FORCE_IN_FLIGHT = 0x80
LATE_TICK = 0x100
MISSED_TICK = 0x200
CLOCK = 0x400
FORCE_LIMIT = 0x800
FORCE_SLEW = 0x1000
STROKE = 0x2000
VELOCITY_LIMIT = 0x4000
COMMAND_NOT_FINITE = 0x8000
RESTITUTION = 0x10000
ENERGY_BALANCE = 0x20000
CONTACT_TOO_LONG = 0x40000
EMERGENCY_STOP = 0x80000
TARE = 0x100000
LAW_IN_DOUBT = 0x200000
EARLY_TICK = 0x400000
UNUSABLE = 1 << 30  # only in C: gains or limits are invalid; Python raises an error instead

BRIDGED = "the last good reading is used; more than `held_readings` successive bad readings trip"
BRIDGED_AFTER_FIRST = f"{BRIDGED}, and so does a bad reading on a run's first tick"
TRIPS = "trips"

FAULTS = (
    Fault(FORCE_NOT_FINITE, "force_not_finite", "the measured force is not a finite number", BRIDGED),
    Fault(
        POSITION_NOT_FINITE,
        "position_not_finite",
        "the measured position is not a finite number",
        BRIDGED_AFTER_FIRST,
    ),
    Fault(
        MODEL_NOT_FINITE,
        "model_not_finite",
        "the numerical model's position, velocity or acceleration is not a finite number",
        TRIPS,
    ),
    Fault(
        FORCE_OUT_OF_RANGE, "force_out_of_range", "the measured force is at or beyond `force_range`", BRIDGED
    ),
    Fault(
        POSITION_OUT_OF_RANGE,
        "position_out_of_range",
        "the measured position is outside `measured_lowest` to `measured_highest`",
        BRIDGED_AFTER_FIRST,
    ),
    Fault(
        FORCE_STUCK,
        "force_stuck",
        "in contact, the force reading has not changed by a bit while the measured position moved by more "
        "than `force_stuck_travel` (with a force of 0: moved deeper by more than this travel)",
        TRIPS,
    ),
    Fault(
        POSITION_STUCK,
        "position_stuck",
        "the position reading has not changed by a bit while the numerical model moved by more than "
        "`position_stuck_travel`",
        TRIPS,
    ),
    Fault(
        FORCE_IN_FLIGHT,
        "force_in_flight",
        "the force reading exceeds `free_force` although the mechanism has been farther than "
        "`free_distance` from contact for longer than `settling`: a bias, or a misplaced surface",
        "flagged; more than `held_readings` successive ticks trip",
    ),
    Fault(
        LATE_TICK,
        "late_tick",
        "the time since the last tick exceeds the period by more than the share `late_fraction`, and is at "
        "most 1.5 periods",
        "flagged and counted",
    ),
    Fault(
        MISSED_TICK,
        "missed_tick",
        "more than 1.5 periods have passed since the last tick",
        "flagged and counted; the compensator makes one step; more than `missed_in_a_row` successive missed "
        "ticks trip",
    ),
    Fault(
        CLOCK,
        "clock",
        "the tick's time is not finite or not later than the last tick's; or within about 100 ticks (with "
        "missed ticks) the time has drifted by more than 1.5 periods from the number of ticks",
        TRIPS,
    ),
    Fault(FORCE_LIMIT, "force_limit", "the compensated force is beyond `force_limit`", TRIPS),
    Fault(
        FORCE_SLEW,
        "force_slew",
        "the compensated force changes faster than `force_slew`",
        "the change is limited; more than `limited_in_a_row` successive limited changes trip",
    ),
    Fault(STROKE, "stroke", "the position command is outside `command_lowest` to `command_highest`", TRIPS),
    Fault(
        VELOCITY_LIMIT,
        "velocity_limit",
        "the position command changes faster than `velocity_limit`",
        "the change is limited; more than `limited_in_a_row` successive limited changes trip, except while "
        "the command approaches the numerical model at the beginning of a run and after `reset`",
    ),
    Fault(COMMAND_NOT_FINITE, "command_not_finite", "the compensated force is not a finite number", TRIPS),
    Fault(
        RESTITUTION,
        "restitution",
        "watchdog: a contact's restitution differs from the expected restitution by more than "
        "`restitution_margin`",
        TRIPS,
    ),
    Fault(
        ENERGY_BALANCE,
        "energy_balance",
        "watchdog: during a contact, the change of the numerical model's kinetic energy differs from the "
        "work of the controller's force: the model integrates a different force",
        TRIPS,
    ),
    Fault(
        CONTACT_TOO_LONG,
        "contact_too_long",
        "watchdog: a contact has lasted longer than `longest_contact`",
        TRIPS,
    ),
    Fault(EMERGENCY_STOP, "emergency_stop", "the rig has called `emergency_stop(True)`", TRIPS),
    Fault(
        TARE,
        "tare",
        "the force readings of a tare are not finite, differ by more than `tare_spread`, or have a mean "
        "beyond `bias_limit`",
        TRIPS,
    ),
    Fault(
        LAW_IN_DOUBT,
        "law_in_doubt",
        "watchdog: a contact has ended, and the compensator's status was unsure, too short or noisy on more "
        "than 40 % of its ticks, or unexplained or saturated on its last tick, or no force was measured",
        "flagged; `last_contact` names the status",
    ),
    Fault(
        EARLY_TICK,
        "early_tick",
        "the time since the last tick is shorter than the period by more than the share `late_fraction`: a "
        "repeated tick, or a tick after a late tick",
        "flagged",
    ),
)


def fault_names(bits: int, faults: Sequence[Fault] = FAULTS) -> list[str]:
    """Return the names of the faults whose bits are set; `faults` is the controller's fault table."""
    return [fault.name for fault in faults if bits & fault.bit]
