"""Errors of the six-axis impulse ledger if one parameter of the rig differs from the specified value.

Only one parameter at a time is wrong: bias of the force sensor, mass of the tool, mass matrix or force delay.
"""

import functools

import jax.numpy as jnp
import pytest
from six_axis_ranges import WIDE, load_wide
from test_six_axis_ledger import LAW, check_good, evaluated, rms

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.laws.impulse_ledger.simulation_six_axes import ImpulseLedger
from jaxhil.mechanism.file import load_any
from jaxhil.sixdof.equations import solve

WRONG_MASS = "impulse_ledger_with_wrong_mass"
# Largest rms energy errors, divided by the undisturbed error except for `probe-drogue`, the only mechanism
# with a tool on its sensor.
LIMITS = {
    "probe-drogue": {"bias": 0.055, "tool": 0.055, "mass": 0.06, "delay": 0.13},
    "ring-capture": {"bias": 1.3, "mass": 1.5, "delay": 4.0},
    "hydraulic-hexapod": {"bias": 1.3, "mass": 1.5, "delay": 4.6},
    "petals": {"bias": 1.3, "mass": 1.5, "delay": 4.0},
}
WRONG_DELAY = 1e-3  # true force delay minus the specified force delay [s]
# Largest undisturbed twist error of the scenarios that count. The only larger error, 0.99 in `ring-capture`,
# would hide the effect of the wrong parameter.
LARGEST_USUAL_ERROR = 0.3


class LedgerWithWrongMass(ImpulseLedger):
    """Impulse ledger that assumes masses and inertias 10 % above those of the numerical model."""

    name = WRONG_MASS

    def prepare(self, gains, constants):
        mass, inverse, correction = constants[1:]
        unit = jnp.broadcast_to(jnp.eye(6).reshape(6, 6, *[1] * gains["settle"].ndim), mass.shape)
        tool = unit - solve(correction, unit)  # M_t M^-1
        wrong = (1.1 * mass, inverse / 1.1, solve(unit - tool / 1.1, unit))
        return super().prepare(gains, type(constants)(constants.control_period, *wrong))


def biased(scenarios):
    sensor = scenarios.sensor
    errors = sensor.errors._replace(bias=sensor.errors.bias.at[2].set(5.0))
    return scenarios._replace(sensor=sensor._replace(errors=errors))


def light_tool(scenarios):
    tool = scenarios.sensor.assumed_tool
    return scenarios._replace(
        sensor=scenarios.sensor._replace(assumed_tool=tool._replace(mass=0.98 * tool.mass))
    )


@functools.cache
def simulated(name, wrong):
    """Return the metrics of the scenarios if a parameter, or None, is wrong."""
    mechanism = load_wide(name)
    scenario = {"bias": biased, "tool": light_tool}.get(wrong)
    change = {}
    if wrong == "delay":
        change["identification_delay"] = (
            literature_gains(mechanism, LAW)["identification_delay"] - WRONG_DELAY
        )
    law = WRONG_MASS if wrong == "mass" else LAW
    [metrics] = evaluated(mechanism, law, change, scenario=scenario)
    check_good(metrics)
    return metrics


def energy_error(name, wrong):
    """Return the rms energy error if a parameter, or None, is wrong."""
    counts = simulated(name, None)["twist_error"] < LARGEST_USUAL_ERROR
    return rms(simulated(name, wrong)["energy_error"][counts])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "wrong"), [(name, wrong) for name in LIMITS for wrong in LIMITS[name]])
def test_ledger_errors_stay_small_if_one_rig_parameter_is_wrong(name, wrong, monkeypatch):
    monkeypatch.setitem(SIX_AXIS_COMPENSATORS, WRONG_MASS, LedgerWithWrongMass())
    error, undisturbed = energy_error(name, wrong), energy_error(name, None)
    print(f"{name}, {wrong}: energy error {error:.4f}, undisturbed {undisturbed:.4f}")
    assert error <= LIMITS[name][wrong] * (1 if name == "probe-drogue" else undisturbed)


def delayed(delay):
    """Return a function that sets the force delay [s] of scenarios."""

    def change(scenarios):
        sensor = scenarios.sensor
        return scenarios._replace(sensor=sensor._replace(delay=0 * sensor.delay + delay))

    return change


@pytest.mark.slow
def test_wrong_force_delay_costs_the_energy_that_a_perfect_rig_with_this_delay_costs():
    """Compare with a rig whose only defect is the wrong part of the delay.

    A force that is read too late looks like a contact with less damping, so no compensator can correct it.
    """
    name = "hydraulic-hexapod"
    perfect = {f'uncertainty."{key}"': None for key in load_wide(name).uncertainty if key.startswith("rig.")}
    perfect |= {"rig.simulator": {"model": "ideal"}, "rig.force_sensor.delay": WRONG_DELAY}
    perfect |= dict.fromkeys(("rig.force_sensor.noise_std", "rig.position_sensor.noise_std"), 0.0)
    mechanism = load_any(WIDE / f"{name}.toml", perfect).mechanism
    late, undelayed = (
        evaluated(mechanism, "none", scenario=delayed(delay))[0]["energy_error"]
        for delay in (WRONG_DELAY, 0.0)
    )
    change = simulated(name, "delay")["energy_error"] - simulated(name, None)["energy_error"]
    print(f"{name}: rms change of energy error {rms(change):.4f}, perfect rig {rms(late - undelayed):.4f}")
    assert rms(undelayed) < 0.01 * rms(late)
    assert 0.9 * rms(late - undelayed) < rms(change) < 1.15 * rms(late - undelayed)
    assert rms(change - (late - undelayed)) < 0.25 * rms(late)
