"""Faults that the six-axis controller detects, and its reactions.

A fault that also exists on one axis has the same bit and the same name for six axes (`jaxhil.rig.faults`).
Documentation, exports and error texts are generated from the table `SIX_AXIS_FAULTS`.
"""

from jaxhil.rig.faults import (
    CLOCK,
    COMMAND_NOT_FINITE,
    CONTACT_TOO_LONG,
    EARLY_TICK,
    EMERGENCY_STOP,
    FAULTS,
    FORCE_LIMIT,
    FORCE_NOT_FINITE,
    FORCE_OUT_OF_RANGE,
    FORCE_SLEW,
    FORCE_STUCK,
    LATE_TICK,
    LAW_IN_DOUBT,
    MISSED_TICK,
    MODEL_NOT_FINITE,
    POSITION_NOT_FINITE,
    POSITION_OUT_OF_RANGE,
    POSITION_STUCK,
    STROKE,
    TARE,
    TRIPS,
    VELOCITY_LIMIT,
    Fault,
)

UNPAID_IMPULSE = 0x800000
MOMENTUM = 0x1000000
ENERGY_GAIN = 0x2000000
LAG = 0x4000000

# Descriptions, by bit, of the faults whose conditions are different with one axis.
CONDITIONS = {
    FORCE_NOT_FINITE: "a channel of the measured wrench is not a finite number",
    POSITION_NOT_FINITE: "a coordinate of the measured pose is not a finite number",
    MODEL_NOT_FINITE: "pose or twist of the numerical model is not finite",
    FORCE_OUT_OF_RANGE: "a channel of the measured wrench is at or beyond `force_range` or `torque_range`",
    POSITION_OUT_OF_RANGE: "a coordinate of the measured pose is outside `measured_lowest_...` to "
    "`measured_highest_...`",
    FORCE_STUCK: "a nonzero reading of a force or torque channel has not changed by a bit while the hardware "
    "moved by more than `force_stuck_travel`",
    POSITION_STUCK: "a coordinate's reading has not changed by a bit while the numerical model moved along "
    "it by more than `position_stuck_travel`, or turned by more than `rotation_stuck_travel`",
    FORCE_LIMIT: "a channel of the compensated wrench is beyond `force_limit` or `torque_limit`",
    FORCE_SLEW: "a channel of the compensated wrench changes faster than `force_slew` or `torque_slew`",
    STROKE: "a coordinate of the pose command is outside `command_lowest_...` to `command_highest_...`",
    VELOCITY_LIMIT: "the pose command moves faster than `velocity_limit` or `angular_velocity_limit`",
    COMMAND_NOT_FINITE: "the compensated wrench is not finite",
    TARE: "the readings of a tare are not finite, differ by more than `tare_force_spread` or "
    "`tare_torque_spread`, or have a mean beyond `force_bias_limit` or `torque_bias_limit`",
}
SAME_AS_ON_ONE_AXIS = (
    LATE_TICK | MISSED_TICK | CLOCK | CONTACT_TOO_LONG | EMERGENCY_STOP | LAW_IN_DOUBT | EARLY_TICK
)
WATCHDOG = (
    Fault(
        UNPAID_IMPULSE,
        "unpaid_impulse",
        "watchdog: after a contact the compensator still owes more than the fraction `unpaid_impulse` of the "
        "contact's impulse",
        TRIPS,
    ),
    Fault(
        MOMENTUM,
        "momentum",
        "watchdog: during a contact the change of the numerical model's momentum differs from the impulse of "
        "the controller's wrench: the model has a different mass, frame, sign or reference point",
        TRIPS,
    ),
    Fault(
        ENERGY_GAIN,
        "energy_gain",
        "watchdog: a contact has increased the numerical model's kinetic energy by more than the fraction "
        "`energy_gain`",
        TRIPS,
    ),
    Fault(
        LAG,
        "lag",
        "watchdog: at the onset of a contact the hardware's lag behind the numerical model is outside "
        "`lag_lowest` to `lag_highest`",
        TRIPS,
    ),
)
SIX_AXIS_FAULTS = (
    *(
        fault._replace(condition=CONDITIONS.get(fault.bit, fault.condition))
        for fault in FAULTS
        if fault.bit in CONDITIONS or fault.bit & SAME_AS_ON_ONE_AXIS
    ),
    *WATCHDOG,
)
