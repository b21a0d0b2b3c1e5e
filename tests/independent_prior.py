"""Prior of a campaign of the second generator: a mechanism file with wrong values and missing keys."""

import numpy as np


def mechanism_file(rig, speed, kind, factors):
    """Return a mechanism file with the rig's values times `factors`, without the kind's unknown keys."""
    frequency, ratio = (4.0 / rig.window / np.pi, 0.9) if rig.window else (rig.frequency, rig.ratio)
    values = {
        "bodies.equivalent_mass": rig.mass,
        "approach.velocity": speed,
        "contact.law": '"kelvin_voigt"',
        "contact.stiffness": [float(rig.stiffness * factors[0])],
        "contact.damping": [float(rig.damping * factors[1])],
        "rig.control_period": rig.period,
        "rig.integrator": f'"{rig.integrator}"',
        "rig.simulator.model": '"second_order"',
        "rig.simulator.natural_frequency": frequency * factors[2],
        "rig.simulator.damping_ratio": ratio * factors[3],
        "rig.simulator.delay": rig.drive_delay * factors[5],
        "rig.force_sensor.delay": rig.force_delay * factors[4],
        "rig.force_sensor.time_constant": 1 / (2 * np.pi * rig.cutoff) if rig.filter_order == 1 else 0.0,
        "rig.force_sensor.dead_zone": rig.dead_zone,
        "rig.position_sensor.delay": rig.position_delay,
    }
    if kind.states_filter:
        cutoff = rig.cutoff * factors[2]
        low_pass = f'{{ kind = "butterworth", order = {rig.filter_order}, cutoff = {cutoff} }}'
        values["rig.force_sensor.filter"] = low_pass
    if kind.states_walk:
        values["rig.force_sensor.bias_random_walk"] = kind.walk * factors[2]
    if kind.states_window:
        second_order = ("rig.simulator.natural_frequency", "rig.simulator.damping_ratio")
        values = {key: value for key, value in values.items() if key not in second_order}
        values |= {
            "rig.simulator.model": '"moving_average"',
            "rig.simulator.window": rig.window * factors[2],
        }
    if kind.states_cut:
        values |= {
            "rig.force_sensor.dead_zone_kind": '"cut"',
            "rig.force_sensor.dead_zone": rig.dead_zone * factors[2],
        }
    lines = ['schema = "jaxhil/mechanism/1"', 'name = "afternoon"']
    return "\n".join(lines + [f"{key} = {value}" for key, value in values.items() if key not in kind.unknown])
