"""Controller with every limit set, for tests of the runtime's guards."""

from gain_documents import gain_document, sign

from jaxhil.rig import Controller
from jaxhil.rig.limits import LIMITS

PERIOD = 1e-3
LIMITED = {
    "force_range": 2000.0,
    "measured_lowest": -0.05,
    "measured_highest": 0.01,
    "held_readings": 2.0,
    "force_stuck_travel": 2e-4,
    "position_stuck_travel": 1e-4,
    "free_distance": 5e-4,
    "settling": 0.01,
    "free_force": 5.0,
    "late_fraction": 0.25,
    "missed_in_a_row": 3.0,
    "tare_ticks": 50.0,
    "tare_spread": 4.0,
    "bias_limit": 20.0,
    "force_limit": 1000.0,
    "force_slew": 1e5,
    "limited_in_a_row": 4.0,
    "command_lowest": -0.04,
    "command_highest": 0.008,
    "velocity_limit": 0.02,
    "deceleration": 0.5,
    "retreat_velocity": 0.01,
}


def limited(name: str = "none", **changed: float | None) -> Controller:
    document = gain_document(name)
    limits = {**LIMITED, **changed}
    document["limits"] = {name: {"value": value, "unit": LIMITS[name].unit} for name, value in limits.items()}
    return Controller.from_dict(sign(document))
