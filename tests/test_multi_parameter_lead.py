"""Multi-parameter lead: pole placement by the characteristic equation, and the simulated loop."""

import itertools
from math import log, pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from endless import OMEGA, STIFFNESS, without_period
from lanes import IDEAL, first_contact, grid, mechanism, spread, validated
from noise_cases import check_amplification

from jaxhil.errors import InputError
from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.laws.multi_parameter_lead.simulation import pole_placement
from jaxhil.laws.simulation_base import KnownConstants
from jaxhil.mechanism.file import builtin_names, load

FREQUENCIES = [0.5, 6.0, 18.8, 300.0]
DELAYS = [0.0, 1e-4, 0.008, 0.05]
DESIRED = np.array([0.6, 0.8, 0.95, 1.0, 1.05])
PHASES = (np.arange(8) + 0.5) / 8


@pytest.mark.parametrize(
    ("frequency", "delay", "restitution"), list(itertools.product(FREQUENCIES, DELAYS, [0.1, 0.7, 1.0, 1.2]))
)
def test_pole_placed_by_lead_is_a_root_of_the_characteristic_equation(frequency, delay, restitution):
    gain, rate = pole_placement(frequency, delay, restitution)
    ratio = -log(restitution) / np.sqrt(pi**2 + log(restitution) ** 2)
    root = frequency * (-ratio + 1j * np.sqrt(1 - ratio**2))
    assert np.exp(pi * root.real / root.imag) == pytest.approx(restitution, rel=1e-12)
    shift = np.exp(-root * delay)
    value = root**2 + frequency**2 * (gain + rate * root) * shift
    size = frequency**2 * (abs(gain) + abs(rate * root)) * abs(shift) + abs(root) ** 2
    assert abs(value) < 1e-9 * size
    # With other gains this number is no root, because the equation is linear in both gains.
    assert abs(value + frequency**2 * 1e-3 * shift) > 1e-4 * frequency**2 * abs(shift)


@pytest.mark.parametrize(("frequency", "delay"), list(itertools.product(FREQUENCIES, DELAYS)))
def test_pole_placement_for_undamped_contact_matches_closed_form(frequency, delay):
    angle = frequency * delay
    expected = np.cos(angle), np.sin(angle) / frequency
    assert pole_placement(frequency, delay, 1.0) == pytest.approx(expected, rel=0, abs=1e-12)


@pytest.mark.parametrize("bad", [(0.0, 0.01, 1.0), (1.0, np.inf, 1.0), (1.0, 0.01, 0.0), (1.0, 0.01, np.nan)])
def test_pole_placement_rejects_nonpositive_and_nonfinite_arguments(bad):
    with pytest.raises(InputError, match=r"^pole_placement: \w+: found .*, expected finite numbers > "):
        pole_placement(*bad)


def place_poles(phases):
    """Return gains and omega tau, with one lane for each combination of desired restitution and omega tau."""
    phase, desired = grid(phases, DESIRED)
    gain, rate = np.transpose(
        [pole_placement(OMEGA, p / OMEGA, e) for p, e in zip(phase, desired, strict=True)]
    )
    return {"force_gain": gain, "force_rate_gain": rate}, phase


def test_simulated_loop_has_the_pole_placed_by_lead():
    gains, phase = place_poles([0.1, 0.3])
    result = without_period("multi_parameter_lead", 1.6, gains, force_sensor__delay=phase / OMEGA)
    np.testing.assert_allclose(np.exp(result), np.tile(DESIRED, 2), rtol=0, atol=1e-5)


def test_contact_with_placed_pole_has_the_desired_restitution():
    phases, periods = np.array([0.05, 0.1, 0.2, 0.4]), np.array([5e-4, 2.5e-4])
    gains, phase = place_poles(phases)
    parsed = validated(mechanism({"stiffness": [STIFFNESS]}, IDEAL, 0.0, period=periods[1]))
    period, lane, start = grid(periods, np.arange(len(phase)), PHASES)
    lane = lane.astype(int)
    delay = phase[lane] / OMEGA
    gains = {name: value[lane] for name, value in gains.items()} | {"lead_filter": period / 2}
    scenario = spread(parsed, len(lane), phase=start, control_period=period, force_sensor__delay=delay)
    restitution = first_contact(parsed, scenario, "multi_parameter_lead", gains)["restitution"]
    coarse, fine = restitution.reshape(2, len(phases), len(DESIRED), len(PHASES)).mean(axis=-1)
    # Onset and end of the contact are no oscillation: they leave an error of third order in omega tau.
    error = np.abs(2 * fine - coarse - DESIRED)
    assert np.all(error < 0.1 * phases[:, None] ** 3)
    # The error is far below the uncompensated one, where e is about exp(pi omega tau/2).
    assert np.all(error < 0.01 * (np.exp(pi * phases / 2) - 1)[:, None])


def test_nominal_multi_parameter_lead_gains_are_within_bounds_for_long_delays():
    delays = np.linspace(0.0, 0.5, 11)
    overrides = [[f"rig.force_sensor.delay={delay}"] for delay in delays]
    overrides += [["rig.command_hold=zoh", "rig.simulator.model=ideal", "rig.force_sensor.delay=0.0"]]
    signs = set()
    for name, override in itertools.product(builtin_names(), overrides):
        if "rig.simulator.model=ideal" in override and load(name).mechanism.contact.law != "linear":
            override = ["rig.force_sensor.delay=0.0"]
        made = load(name, override).mechanism
        nominal = literature_gains(made, "multi_parameter_lead")
        for gain in COMPENSATORS["multi_parameter_lead"].gains:
            assert gain.lower(made) <= nominal[gain.name] <= gain.upper(made)
            assert gain.lower(made) < gain.upper(made)
        signs.add((nominal["force_gain"] > 0, nominal["force_rate_gain"] > 0))
    assert len(signs) == 4


def test_noise_amplification_of_multi_parameter_lead_matches_runtime():
    check_amplification(
        "multi_parameter_lead",
        [
            {"force_gain": 1.0, "force_rate_gain": 0.008, "lead_filter": 0.001},
            {"force_gain": 0.7, "force_rate_gain": 0.02, "lead_filter": 0.0005},
            {"force_gain": -0.4, "force_rate_gain": 0.03, "lead_filter": 0.007},
        ],
    )


def test_phase_lead_is_a_special_case_of_multi_parameter_lead():
    constants = KnownConstants(jnp.asarray(1e-3), jnp.asarray(jnp.inf))
    ours = {"force_gain": 1.0, "force_rate_gain": 0.008, "lead_filter": 0.0013}
    theirs = {"phase_lead": 0.008, "lead_filter": 0.0013}
    result = COMPENSATORS["multi_parameter_lead"].prepare(jax.tree.map(jnp.asarray, ours), constants)
    expected = COMPENSATORS["phase_lead"].prepare(jax.tree.map(jnp.asarray, theirs), constants)
    np.testing.assert_allclose(np.array(result), np.array(expected), rtol=1e-14)
