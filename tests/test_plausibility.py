"""Plausibility of a mechanism file: summary and warnings."""

import math

import numpy as np
import pytest
from plausibility_rigs import MASS, SPEED, STIFFNESS, behind, rig
from scipy.special import beta
from user_registered_laws import SquaredSpring

import jaxhil
import tuning
from jaxhil.mechanism.file import builtin_names, suite_names
from jaxhil.simulation.plausibility import check_run, compute_bandwidth, summarise_mechanism
from jaxhil.simulation.scenario import build_scenarios

# Control rates below 1 kHz [Hz].
SLOW_RATES = {
    "suite-long": 500.0,
    "robot-34ms": 500.0,
    "robot-50ms": 250.0,
    "robot-150ms": 250.0,
    "two-robots-250hz": 250.0,
}


@pytest.mark.parametrize("name", [*builtin_names(), *suite_names()])
def test_builtin_mechanisms_give_no_plausibility_warning(name):
    mechanism = jaxhil.load(name)
    result = summarise_mechanism(mechanism)
    assert result.warnings == ()
    slow = name in SLOW_RATES
    assert result.equivalent_mass == mechanism.bodies.mass
    assert result.control_rate == SLOW_RATES.get(name, 1e3)
    assert all((0.06 if slow else 1.5) < one.frequency < 10 for one in result.contacts)
    check_run(mechanism, drawn=True)


def test_mechanism_summary_states_frequency_peak_force_and_duration():
    assert summarise_mechanism(rig(rig__force_sensor__range=200.0)).line("mine") == (
        "mine: equivalent mass 300 kg; contact at 3 Hz, 1/333 of the control rate (1000 Hz) and 0.29 of the "
        "motion simulator's bandwidth (10.5 Hz); peak force 28.3 N (0.14 of the sensor's range (200 N)); "
        "the run lasts about 0.197 s"
    )
    line = summarise_mechanism(jaxhil.load("varying")).line("varying")
    assert "contact at 3, 5.2, 2.12 Hz, at most 1/192 of the control rate" in line
    assert "(the sensor has no range)" in line
    many = jaxhil.load(
        "varying", {"contact.stiffness": [1e5 * n for n in range(1, 8)], "approach.contacts": 7}
    )
    assert "contact at 2.69 to 7.12 Hz, " in summarise_mechanism(many).line("many")
    assert "motion simulator" not in summarise_mechanism(behind(model="ideal")).line("ideal")


def test_mechanism_summary_lists_each_distinct_contact_once_in_file_order():
    result = summarise_mechanism(
        jaxhil.load("varying", {"contact.stiffness": [2e5, 1e5, 2e5, 3e5], "approach.contacts": 9})
    )
    assert [one.number for one in result.contacts] == [1, 2, 4]
    omega = np.sqrt(np.array([2e5, 1e5, 3e5]) / 350.0)
    np.testing.assert_allclose([one.frequency for one in result.contacts], omega / (2 * np.pi), rtol=1e-12)


def power_law(stiffness, exponent):
    """Return peak force and duration of M d'' = -k d^n, in closed form."""
    order = exponent + 1
    deepest = (order * MASS * SPEED**2 / (2 * stiffness)) ** (1 / order)
    # The duration is 2 int_0^d_m dd / sqrt(v^2 - ...), with d = d_m s^(1/(n+1)).
    duration = 2 * deepest / SPEED / order * beta(1 / order, 0.5)
    return stiffness * deepest**exponent, duration


def test_mechanism_summary_of_every_contact_law_matches_ideal_contact():
    jaxhil.register(SquaredSpring())
    spring = SPEED * math.sqrt(STIFFNESS * MASS), math.pi * math.sqrt(MASS / STIFFNESS)
    laws = {
        "linear": ({}, *spring),
        "kelvin_voigt": ({}, *spring),
        # Up to the largest depth, three equal slopes equal one slope.
        "piecewise_linear": ({"stiffness": [[STIFFNESS] * 3], "depths": [1e-5, 2e-4]}, *spring),
        "hunt_crossley": ({"stiffness": [6e6]}, *power_law(6e6, 1.5)),
        "depth_damped": (
            {"stiffness": [4e8], "exponent": 2.0, "reference_depth": 1e-4},
            *power_law(4e8, 2.0),
        ),
        "squared_spring": ({"stiffness": [4e8]}, *power_law(4e8, 2.0)),
        # With so large a reference depth the contact does not stiffen.
        "hardening": ({"reference_depth": 10.0}, *spring),
        "elastoplastic": ({"unloading_ratio": 4.0}, spring[0], 0.75 * spring[1]),
        "preloaded": ({}, *spring),
    }
    for law, (keys, peak, duration) in laws.items():
        [contact] = summarise_mechanism(
            rig({"contact": {"law": law, "stiffness": [STIFFNESS], **keys}})
        ).contacts
        assert contact.peak_force == pytest.approx(peak, rel=1e-6), law
        assert contact.duration == pytest.approx(duration, rel=1e-6), law
        assert contact.frequency == pytest.approx(1 / (2 * duration), rel=1e-6), law


def test_summary_frequency_of_damped_spring_equals_undamped_frequency():
    damped = {"contact.damping": [3 * math.sqrt(STIFFNESS * MASS)]}
    for tension in (False, True):
        [contact] = summarise_mechanism(rig(damped, contact__tension=tension)).contacts
        assert contact.frequency == pytest.approx(math.sqrt(STIFFNESS / MASS) / (2 * math.pi))
        # This contact is overdamped with tension, so the bodies never separate.
        assert math.isinf(contact.duration) == tension


def test_estimated_number_of_ticks_of_a_run_is_close_to_simulation():
    run = jaxhil.simulate("varying", "phase_lead")
    assert run.summary == summarise_mechanism(run.mechanism)
    assert run.summary.duration == pytest.approx(run.time[-1], rel=0.25)


SIMULATORS = [
    {"model": "first_order", "time_constant": 0.01},
    {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8},
    {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.1},
    {"model": "third_order", "coefficients": [0.02, 1.6e-4, 5e-7]},
    {"model": "transfer_function", "numerator": [0.004, 1.0], "denominator": [1.5e-4, 0.02, 1.0]},
    {
        "model": "transfer_function",
        "numerator": [1.0],
        "denominator": np.poly(np.full(20, -30.0)).tolist(),
    },
]


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda one: one["model"])
def test_simulator_bandwidth_is_frequency_of_3_db_attenuation(simulator):
    if len(simulator.get("denominator", ())) > 20:
        simulator = simulator | {"numerator": [simulator["denominator"][-1]]}
    made = build_scenarios(behind(**simulator)).simulator
    frequency = compute_bandwidth(made)

    def gain(at):
        return abs(
            np.polyval(made.numerator[:, 0], 2j * np.pi * at)
            / np.polyval(made.denominator[:, 0], 2j * np.pi * at)
        )

    assert gain(frequency) == pytest.approx(math.sqrt(0.5), rel=1e-5)
    assert all(gain(share * frequency) > math.sqrt(0.5) for share in np.linspace(0, 0.99, 100))


def test_ideal_simulator_has_no_bandwidth():
    assert compute_bandwidth(build_scenarios(behind(model="ideal")).simulator) == math.inf


@pytest.mark.parametrize(
    ("key", "plausible", "implausible", "said"),
    [
        # Contact of 300 kg at 5 Hz, and similar mechanisms.
        ("rig.control_period", 0.03333, 0.03334, "contact.stiffness: found a contact frequency of 3 Hz"),
        (
            "contact.stiffness",
            [2.9608e7],
            [2.9609e7],
            "frequency of 50 Hz (contact 1), expected at most 50 Hz",
        ),
        (
            "contact.stiffness",
            [266.48],
            [168.0],
            "frequency of 0.119 Hz (contact 1), which lasts 4.2 s, expected at least 0.15 Hz (is the "
            "stiffness in N/mm, or a mass in g? then it is 3.8 Hz)",
        ),
        (
            "bodies.equivalent_mass",
            1.19e5,
            1.21e5,
            "frequency of 0.149 Hz (contact 1), which lasts",
        ),
        (
            "rig.simulator.natural_frequency",
            50.0,
            75.4,
            "natural_frequency: found 75.4 Hz, expected at most 50 Hz (is it in rad/s? then it is 12 Hz)",
        ),
        (
            "rig.force_sensor.dead_zone",
            28.0,
            29.0,
            "found 29 N, expected less than 28.3 N, the peak force of ideal contact 1 (is it in mN?)",
        ),
        ("rig.force_sensor.bias", -28.0, -29.0, "bias: found -29 N, expected less than 28.3 N"),
        ("rig.force_sensor.noise_std", 28.0, 500.0, "noise_std: found 500 N, expected less than 28.3 N"),
        (
            "rig.position_sensor.quantum",
            2.6e-4,
            2.7e-4,
            "quantum: found 0.00027 m, expected less than 0.000265 m, about the depth of ideal contact 1",
        ),
        (
            "rig.contact_plane",
            -0.1,
            -0.4,
            "found 0.4 m, expected at most 0.1 m (is it in mm?)",
        ),
        ("approach.velocity", 1.0, 1.001, "approach.velocity: found 1.001 m/s, expected at most 1 m/s"),
        (
            "rig.force_sensor.range",
            28.3,
            28.2,
            "range: found 28.2 N, expected more than 28.3 N, the peak force of ideal contact 1",
        ),
        (
            "rig.simulator.delay",
            0.162,
            0.167,
            "rig.simulator.delay: found 0.167 s, expected less than 0.16",
        ),
        (
            "rig.force_sensor.delay",
            0.162,
            0.163,
            "rig.force_sensor.delay: found 0.167 s with its lag and the",
        ),
        ("rig.force_sensor.time_constant", 0.158, 0.159, "rig.force_sensor.delay: found 0.167 s with its"),
        (
            "rig.position_sensor.delay",
            0.162,
            0.163,
            "rig.position_sensor.delay: found 0.167 s with the motion",
        ),
    ],
)
def test_implausible_mechanism_values_give_a_warning(key, plausible, implausible, said):
    others = {"rig.force_sensor.delay": 0.0} if key == "rig.simulator.delay" else {}
    assert summarise_mechanism(rig(others, **{key: plausible})).warnings == ()
    [warning] = summarise_mechanism(rig(others, **{key: implausible})).warnings
    assert said in warning and ", expected " in warning and warning.isprintable()


def test_warning_names_the_implausible_contact():
    stiffness = {"contact.stiffness": [1e5, 1e9, 1.0], "approach.contacts": 3}
    fast, slow, late = summarise_mechanism(rig(stiffness)).warnings
    assert "291 Hz (contact 2), expected at most 100 Hz, 1/10 of the control rate" in fast
    assert "0.00919 Hz (contact 3)" in slow and "the duration of contact 2" in late


def test_damping_key_of_an_undamped_contact_law_gives_a_warning():
    [warning] = summarise_mechanism(rig(contact__law="linear", contact__damping=[0.0, 4.0])).warnings
    assert warning == "contact.damping: found 4 N s/m, expected 0: law linear has no damping"


def test_tune_prints_mechanism_summary_on_request(capsys):
    sensor = rig(rig__force_sensor__range=10.0)
    for progress in (False, True):
        with pytest.raises(jaxhil.InputError, match="objective"):
            tuning.tune([sensor, sensor], "phase_lead", objective="mean", progress=progress)
        message = capsys.readouterr()
        assert message.out == "" and len(message.err.splitlines()) == 4 * progress
    line, warning, *_ = message.err.splitlines()
    assert line == summarise_mechanism(sensor).line("rig-300kg")
    assert warning == f"warning: rig-300kg: {summarise_mechanism(sensor).warnings[0]}"


def test_simulate_output_begins_with_mechanism_summary_line(jaxhil):
    ran = jaxhil("simulate", "rig-300kg", "--set", "rig.force_sensor.range=10")
    assert ran.out.startswith("rig-300kg: equivalent mass 300 kg; contact at 3 Hz, ")
    assert ran.err == (
        "warning: rig-300kg: rig.force_sensor.range: found 10 N, expected more than 28.3 N, the "
        "peak force of ideal contact 1 (is it in kN?)\n"
    )
    result = jaxhil("simulate", "rig-300kg", "--json", "--set", "rig.force_sensor.range=1e9").document[
        "meaning"
    ]
    assert result["contacts"] == [
        {
            "number": 1,
            "frequency": pytest.approx(3.0, rel=1e-5),
            "duration": pytest.approx(1 / 6, rel=1e-5),
            "peak_force": pytest.approx(28.27, rel=1e-3),
        }
    ]
    assert result["force_range"] == 1e9 and result["warnings"] == []


@pytest.mark.parametrize("command", ["simulate", "tune", "compare"])
def test_unset_option_of_commands_removes_keys(jaxhil, command):
    ran = jaxhil(command, "rig-300kg", "--set", "name=x", "--unset", "approach.velocity", "--unset", "rig")
    assert ran.code == 2 and ran.err.startswith(
        "jaxhil: rig-300kg: --set name=x --unset approach.velocity rig: approach.velocity: found nothing"
    )


def test_timeout_message_states_the_time_limit(jaxhil):
    ran = jaxhil("simulate", "rig-300kg", "--set", "rig.force_sensor.range=1e-6", "--json")
    assert ran.document["status"] == "timeout"
    assert ran.document["reason"] == "a contact was not over within 10 s, the limit of a contact"
    out = jaxhil("simulate", "rig-300kg", "--set", "rig.force_sensor.range=1e-6").out
    assert "Bad: the run ended with status 'timeout': a contact was not over within 10 s" in out
