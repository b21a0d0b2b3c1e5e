"""Valid six-axis gain documents, and limits within which a usual run does not trip."""

import copy
import functools

from gain_documents import sign

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.rig.six_axes.limits import SIX_AXIS_LIMITS
from jaxhil.rig.six_axes.vectors import COORDINATES
from tuning.gain_file import build_document

LIMITS = {
    "force_range": 2000.0,
    "torque_range": 500.0,
    **{f"measured_lowest_{axis}": -0.5 for axis in COORDINATES},
    **{f"measured_highest_{axis}": 0.5 for axis in COORDINATES},
    "held_readings": 3.0,
    "force_stuck_travel": 0.001,
    "position_stuck_travel": 0.001,
    "rotation_stuck_travel": 0.001,
    "settling": 0.02,
    "missed_in_a_row": 4.0,
    "tare_ticks": 3.0,
    "tare_force_spread": 4.0,
    "tare_torque_spread": 1.0,
    "force_bias_limit": 20.0,
    "torque_bias_limit": 5.0,
    "force_limit": 1000.0,
    "torque_limit": 300.0,
    "force_slew": 1e5,
    "torque_slew": 3e4,
    "limited_in_a_row": 3.0,
    **{f"command_lowest_{axis}": -0.4 for axis in COORDINATES},
    **{f"command_highest_{axis}": 0.4 for axis in COORDINATES},
    "velocity_limit": 0.1,
    "angular_velocity_limit": 0.2,
    "start_distance": 0.002,
    "start_angle": 0.002,
    "deceleration": 0.5,
    "angular_deceleration": 1.0,
    "retreat_velocity": 0.02,
    "retreat_angular_velocity": 0.04,
    "retreat_distance": 0.01,
    "fading": 5.0,
    "longest_contact": 2.0,
    "unpaid_impulse": 0.1,
    "momentum_error": 0.05,
    "energy_gain": 0.1,
    "lag_lowest": 0.013,
    "lag_highest": 0.054,
}


@functools.cache
def _document(compensator, mechanism):
    loaded = load_any(mechanism)
    gains = literature_gains(loaded.mechanism, compensator)
    return build_document(compensator, gains, loaded.mechanism, loaded.sha256, {}, {}, 0, {})


def six_axis_document(compensator="impulse_ledger", mechanism="probe-drogue", limits=None, **gains):
    """Return a valid gain document with the nominal gains, except those in `gains`."""
    document = copy.deepcopy(_document(compensator, mechanism))
    for name, value in gains.items():
        document["gains"][name]["value"] = value
    if limits is not None:
        document["limits"] = {
            name: {"value": value, "unit": SIX_AXIS_LIMITS[name].unit} for name, value in limits.items()
        }
    return sign(document)
