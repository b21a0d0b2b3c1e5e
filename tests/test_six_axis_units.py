"""Plausibility of units: numbers that seem to have a wrong unit are reported with the required unit."""

import pytest

from jaxhil.mechanism.file import load_any, six_axis_names
from jaxhil.sixdof.units import unit_warnings


def warnings_of(name, changes):
    return unit_warnings(load_any(name, changes | {"uncertainty": {}}).mechanism)


@pytest.mark.parametrize("name", six_axis_names())
def test_six_axis_builtin_mechanisms_give_no_plausibility_warning(name):
    assert warnings_of(name, {}) == ()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"target.interface": [50.0, -20.0, 1200.0]}, "target.interface: found 1.2e+03 m for a radius"),
        ({"chaser.inertia": [1.5e8, 1.8e8, 1.1e8]}, "chaser.inertia: found a radius of gyration of 655 m"),
        (
            {"chaser.inertia": [1.5e-5, 1.8e-5, 1.1e-5]},
            "chaser.interface: found 1 m for a radius",
        ),
        (
            {"chaser.mass": 0.42},
            "of 20.7 m, expected about the size of the body: mass in kg, inertia in",
        ),
        ({"approach.attitude": [0.5, 0.4, 0.2]}, "approach.attitude: found 0.671 rad, expected at most 0.3"),
        (
            {"approach.velocity": [0.1, 0.2, -2.5]},
            "approach.velocity: found 2.51 m/s, expected at most 1 m",
        ),
        ({"approach.angular_velocity": [0.17, -0.11, 0.06]}, "found 0.211 rad/s, expected at most 0.1 rad/s"),
        ({"rig.force_sensor.gravity": [0, 0, -9806.65]}, "gravity: found 9807 m/s^2, expected at most 10 m"),
        ({"rig.force_sensor.tool.mass": 12000.0}, "tool.mass: found 1.2e+04 kg, expected at most 420 kg"),
        ({"rig.force_sensor.tool.com": [10.0, 20.0, 150.0]}, "tool.com: found 152 m, expected at most 2 m"),
    ],
)
def test_six_axis_values_far_from_any_docking_are_reported(changes, reason):
    warnings = warnings_of("probe-drogue", changes)
    assert any(reason in warning for warning in warnings), warnings
