"""Effects of a mechanism file that `monitor` does not model; `identify` models some of them."""

from __future__ import annotations

from jaxhil.errors import InputError
from jaxhil.mechanism.structs import Mechanism
from tuning.identification.validation import CheckResult

AVERAGE_KEY = "rig.simulator.model"
FILTER_KEY, CUT_ZONE_KEY = "rig.force_sensor.filter", "rig.force_sensor.dead_zone_kind"
WALK_KEY = "rig.force_sensor.bias_random_walk"


def list_unmodelled_effects(mechanism: Mechanism) -> dict[str, tuple[str, str]]:
    """Return name and description of each effect that `monitor` does not model, by key of the mechanism file.

    An effect also counts if it occurs only in the table `[uncertainty]`.
    """
    rig, sensor, effects = mechanism.rig, mechanism.rig.force_sensor, {}
    if rig.simulator.window is not None:
        effects[AVERAGE_KEY] = "motion simulator", f"a moving average over {rig.simulator.window:g} s"
    if sensor.dead_zone_kind == "cut" and sensor.dead_zone > 0.0:
        text = f"a cut dead zone of {sensor.dead_zone:g} N"
        effects[CUT_ZONE_KEY] = "dead zone of the force sensor", text
    if sensor.filter is not None:
        text = f"a {sensor.filter.kind} filter of order {sensor.filter.order}"
        effects[FILTER_KEY] = "filter of the force sensor", text
    for key, name, value, unit in (
        (WALK_KEY, "drift of the force sensor's bias", sensor.bias_random_walk, " N/sqrt(s)"),
        ("rig.force_sensor.jitter", "jitter of the force sensor", sensor.jitter, " s"),
        ("rig.force_sensor.loss_probability", "lost frames of the force sensor", sensor.loss_probability, ""),
        ("rig.missed_tick_probability", "missed ticks", rig.missed_tick_probability, ""),
    ):
        if key in mechanism.uncertainty:
            effects[key] = name, f"{key.rpartition('.')[2]} in [uncertainty]"
        elif value > 0.0:
            effects[key] = name, f"{key.rpartition('.')[2]} = {value:g}{unit}"
    return effects


def check_modelled_effects(mechanism: Mechanism) -> list[CheckResult]:
    """Return a failed check for each effect that a mechanism file contains and `identify` does not model.

    `identify` models a filter of the force sensor and a drift of its bias, unless a dead zone hides the onset
    of contact.
    """
    effects = list_unmodelled_effects(mechanism)
    for key in (AVERAGE_KEY, CUT_ZONE_KEY):
        effects.pop(key, None)
    if mechanism.rig.force_sensor.dead_zone == 0.0:
        effects.pop(FILTER_KEY, None)
        effects.pop(WALK_KEY, None)
    return [
        CheckResult(name, f"{text}, which `identify` does not model", True, 1.0)
        for name, text in effects.values()
    ]


def reject_unmodelled_effects(mechanism: Mechanism) -> None:
    """Raise `InputError` if a mechanism file has an effect that `monitor` does not predict."""
    for key, (_, text) in list_unmodelled_effects(mechanism).items():
        raise InputError(f"{key}: found {text}, expected none: monitor does not predict it")
