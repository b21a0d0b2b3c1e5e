"""One-axis file of a six-axis contact: equal restitution without friction; one-line error messages."""

import numpy as np
import pytest

import jaxhil as package
from jaxhil.errors import InputError
from jaxhil.mechanism.file import load
from jaxhil.sixdof.one_axis import convert_to_one_axis
from jaxhil.sixdof.run import Episode

SPRING = {"distribution": "loguniform", "factor": [0.5, 2.0]}
# A ball that hits a plane 0.36 m beside the line through the centres of mass, on axes with different lags.
OFF_CENTRE = {
    "approach": {"offset": [0.0, 0.0], "velocity": [0.0, 0.0, -0.005], "phase": 0.25, "duration": 2.0},
    "contact": {
        "far": {
            "chaser": {"shape": "sphere", "centre": [0.0, 0.0, 0.5], "radius": 0.02},
            "target": {"shape": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]},
            "law": "linear", "stiffness": 1.0,
        },
        "ball": {
            "chaser": {"shape": "sphere", "centre": [0.3, -0.2, 0.0], "radius": 0.02},
            "target": {"shape": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]},
            "law": "kelvin_voigt", "stiffness": 6e4, "damping": 150.0,
        },
    },
    "rig.force_sensor": {"delay": 0.004, "noise_std": {"force": 0.5, "torque": 0.05}, "range": 500.0,
                         "bias_random_walk": {"force": 0.2, "torque": 0.05}},
    "rig.position_sensor": {"delay": 0.001, "noise_std": {"translation": 3e-6, "rotation": 1e-5}},
    "uncertainty": {
        "contact.ball.stiffness": SPRING,
        "rig.force_sensor.delay": {"distribution": "normal", "std": 0.0005},
        "rig.simulator.natural_frequency": {"distribution": "uniform", "factor": [0.8, 1.2]},
        "approach.offset": {"distribution": "uniform", "low": -0.01, "high": 0.01, "independent": True},
    },
}  # fmt: skip


def first_touch(**changes):
    """Return the metrics of a first touch; those that the tests do not use are 1."""
    values = dict.fromkeys(Episode._fields, 1.0) | {"reference_touches": 1, "effective_mass": 250.0}
    values |= {"approach_velocity": 0.005, "point": (0.3, -0.2, 0.0), "normal": (0.0, 0.0, 1.0)}
    return Episode(**{**values, **changes})


def test_one_axis_file_has_the_values_of_the_first_touch():
    mechanism = package.load("probe-drogue", OFF_CENTRE)
    converted, left_out = convert_to_one_axis(mechanism, first_touch())
    assert converted.bodies.equivalent_mass == 250.0 and converted.approach.velocity == 0.005
    assert converted.approach.phase == 0.25 and converted.name == "probe-drogue-one-axis"
    contact, rig = converted.contact, converted.rig
    assert (contact.law, contact.stiffness, contact.damping) == ("kelvin_voigt", [6e4], [150.0])
    assert rig.force_sensor.bias_random_walk == 0.2
    assert rig.force_sensor.noise_std == 0.5 and rig.force_sensor.range == 500.0
    # The position along the normal is z + 0.3 (-ry) + (-0.2) rx, to first order.
    noise = np.hypot(3e-6, 1e-5 * np.hypot(0.3, 0.2))
    assert rig.position_sensor.noise_std == pytest.approx(noise) and rig.position_sensor.delay == 0.001
    # Translations of 14 Hz and 3 ms, rotations of 11 Hz and 5.3 ms, the mean lag of all.
    simulator = rig.simulator
    assert 11 < simulator.natural_frequency < 14 and simulator.damping_ratio == 0.8
    lag = simulator.delay + simulator.damping_ratio / (np.pi * simulator.natural_frequency)
    assert 0.8 / (14 * np.pi) + 0.003 < lag < 0.8 / (11 * np.pi) + 0.0053
    kept_keys = {"contact.stiffness", "rig.force_sensor.delay", "rig.simulator.natural_frequency"}
    assert set(converted.uncertainty) == kept_keys and left_out == ("approach.offset",)


@pytest.mark.parametrize(
    ("changes", "touch", "reason"),
    [
        (
            {"contact.ball.friction": {"law": "regularised", "coefficient": 0.1, "slip": 0.01}},
            {},
            "contact.ball.friction.coefficient: found 0.1, expected for a one-axis file: 0, because",
        ),
        (
            {"latch.head": {"chaser": [0, 0, 0], "depth": 0.001, "angle": 0.1, "stiffness": [1e5] * 6}},
            {},
            "latch.head: found a latch, expected for a one-axis file: no latch",
        ),
        ({}, {"reference_touches": 2}, "contact: found 2 touches in the ideal contact, expected for a"),
        ({}, {"reference_touches": 0}, "contact: found 0 touches"),
    ],
)
def test_contact_without_one_axis_equivalent_is_rejected(changes, touch, reason):
    mechanism = package.load("probe-drogue", OFF_CENTRE | changes)
    with pytest.raises(InputError) as caught:
        convert_to_one_axis(mechanism, first_touch(**touch))
    assert str(caught.value).startswith(f"probe-drogue: {reason}") and str(caught.value).isprintable()


def test_one_axis_option_is_rejected_for_one_axis_mechanism(jaxhil, tmp_path):
    ran = jaxhil("simulate", "rig-300kg", "--one-axis", tmp_path / "new.toml")
    assert ran.code == 2 and "--one-axis: found" in ran.err and ran.err.count("\n") == 1
    assert not (tmp_path / "new.toml").exists()


def test_one_axis_option_does_not_overwrite_a_file(jaxhil, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("mine")
    ran = jaxhil("simulate", "probe-drogue", "--reference", "--one-axis", path)
    assert ran.code == 2 and "--one-axis: " in ran.err and "no file is overwritten" in ran.err
    assert path.read_text() == "mine"


@pytest.mark.slow
@pytest.mark.parametrize("compensator", ["none", "phase_lead"])
def test_one_axis_file_has_the_restitution_of_the_off_centre_contact(jaxhil, tmp_path, compensator):
    keys = "force_sensor.noise_std", "force_sensor.bias_random_walk", "position_sensor.noise_std"
    quiet = {f"rig.{key}": [0.0] * 6 for key in keys}
    mechanism = package.load("probe-drogue", OFF_CENTRE | quiet)
    run = package.simulate(mechanism, compensator)
    [episode] = run.episodes
    converted, _ = convert_to_one_axis(mechanism, episode)
    [contact] = package.simulate(converted, compensator).contacts
    assert contact.reference_restitution == pytest.approx(episode.reference_restitution, rel=3e-3)
    assert contact.restitution == pytest.approx(episode.restitution, rel=0.01)
    print(f"\n{compensator}: e {contact.restitution:.4f}, six axes {episode.restitution:.4f}", end="")


@pytest.mark.slow
def test_simulate_writes_a_one_axis_file_that_loads(jaxhil, tmp_path):
    path = tmp_path / "one.toml"
    without = ["--unset", "contact.tip.friction"]
    ran = jaxhil("simulate", "probe-drogue", "--reference", "--one-axis", path, *without)
    assert ran.code == 0 and "without approach.offset, approach.attitude, rig.force_sensor.tool" in ran.err
    mechanism = load(str(path)).mechanism
    assert mechanism.contact.law == "hunt_crossley" and mechanism.contact.stiffness == [3e6]
    ran = jaxhil("simulate", "probe-drogue", "--reference", "--one-axis", tmp_path / "two.toml")
    assert ran.code == 2 and "friction.coefficient: found 0.15, expected for a one-axis file: 0" in ran.err


@pytest.mark.slow
@pytest.mark.parametrize(
    "sensor",
    [
        {"dead_zone": [0.0, 0.0, 8.0, 0.0, 0.0, 0.0], "dead_zone_kind": "cut"},
        {"filter": {"kind": "bessel", "order": 4, "cutoff": 40.0}},
    ],
)
def test_cut_dead_zone_and_filter_of_a_central_contact_act_as_with_one_axis(sensor):
    ball = OFF_CENTRE["contact"]["ball"]
    central = ball | {"chaser": ball["chaser"] | {"centre": [0.0, 0.0, 0.0]}}
    changes = {
        "contact": OFF_CENTRE["contact"] | {"ball": central},
        "rig.force_sensor": {"delay": 0.004, **sensor},
        "rig.position_sensor": {},
    }
    mechanism = package.load("probe-drogue", OFF_CENTRE | changes)
    [episode] = package.simulate(mechanism, "none").episodes
    converted, _ = convert_to_one_axis(mechanism, episode)
    [contact] = package.simulate(converted, "none").contacts
    assert contact.restitution == pytest.approx(episode.restitution, rel=1e-4)
