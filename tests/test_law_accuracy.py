"""Errors of the impulse ledger with one set of gains, on scenarios outside the built-in mechanism sets.

Surface, sensor offset, preload, friction, duration and control period differ from the built-in sets. `pytest
-m slow -s tests/test_law_accuracy.py` prints root mean square, 99th percentile and maximum of |e - e*| in %.
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import pytest

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.transparency.probes import (
    LANES_PER_SCENARIO,
    ProbedScenarios,
    build_probed_scenarios,
    compute_probe_metrics,
)

pytestmark = pytest.mark.slow
LAW, SEED = "impulse_ledger", 0xACC  # seed of scenarios used for no tuning or evaluation
CONTACTS = 4


# Limits: rms, 99th percentile and maximum of a contact's error [%], and smallest transparency.
RMS, PERCENTILE, LARGEST, TRANSPARENCY = 0.5, 1.5, 3.0, 0.8


def uniform_override(path: str, low: float, high: float) -> str:
    """Return an override that draws a number uniformly between two values."""
    return f'uncertainty."{path}"={{distribution="uniform",low={low},high={high}}}'


PLANE = "rig.contact_plane=0.0", uniform_override("rig.contact_plane", -1e-3, 1e-3)
BIAS = "rig.force_sensor.bias=0.0", uniform_override("rig.force_sensor.bias", -5.0, 5.0)
FRICTION = "contact.friction=3.0", uniform_override("contact.friction", 0.0, 6.0)


def to_outcome(mechanism: Mechanism, gains: Mapping[str, Any], scenarios: Scenario) -> Outcome:
    loop = build_loop(mechanism, LAW, scenarios)
    # Run the lanes one after the other, so that one program serves every set of gains.
    lanes = scenarios.velocity.shape
    return evaluate(loop, {name: np.broadcast_to(value, lanes) for name, value in gains.items()}, scenarios)


def error_statistics(errors: Any) -> tuple[float, float, float]:
    """Return root mean square, 99th percentile and maximum of |e - e*| [%]."""
    size = 100 * np.abs(np.asarray(errors))
    return float(np.sqrt(np.mean(size**2))), float(np.percentile(size, 99)), float(np.max(size))


def printed(*what: object) -> None:
    print(*(f"{one:.2f}" if isinstance(one, float) else one for one in what), flush=True)


def copies_of(probed: ProbedScenarios, outcome: Outcome) -> Outcome:
    """Return scenario copies along a new axis: plain run, two pushes, damping perturbation."""
    number = len(probed.plain)
    return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], number, LANES_PER_SCENARIO), outcome)


@pytest.mark.parametrize("noise", ["0.5 %", "none"])
@pytest.mark.parametrize("suite", ["noisy", "damped", "hertz", "hardening", "layered"])
def test_impulse_ledger_is_accurate_with_surface_within_1_mm(suite, noise):
    clean = ("rig.force_sensor.noise_std=0.0",) if noise == "none" else ()
    mechanism = load(f"suite-{suite}", [*PLANE, *clean, f"approach.contacts={CONTACTS}"]).mechanism
    probed = build_probed_scenarios(mechanism, draw(mechanism, 200, SEED), SEED)
    in_place = probed.scenarios._replace(contact_plane=0 * probed.scenarios.contact_plane)
    gains = literature_gains(mechanism, LAW)
    copies = copies_of(probed, to_outcome(mechanism, gains, probed.scenarios))
    assert np.all(copies.good[..., 0])
    first, fourth = error_statistics(copies.error[0, :, 0]), error_statistics(copies.error[3, :, 0])
    specified = error_statistics(copies_of(probed, to_outcome(mechanism, gains, in_place)).error[3, :, 0])
    figures = {name: estimate.value for name, estimate in compute_probe_metrics(probed, copies).items()}
    printed(suite, "noise", noise, *first, "fourth", *fourth, "as specified", *specified, figures)
    assert first[0] < RMS and first[1] < PERCENTILE and first[2] < LARGEST
    assert fourth[0] < specified[0] + 0.05
    assert min(figures["early"], figures["late"]) > TRANSPARENCY


@pytest.mark.parametrize("noise", ["none", "0.5 % of its own peak", "0.15 N"])
@pytest.mark.parametrize("period", [2.5e-4, 1e-3, 4e-3])
def test_impulse_ledger_is_accurate_for_contacts_of_1_to_8_s(period, noise):
    sensor = "rig.force_sensor.noise_std=0.15"
    for damped in (False, True):
        damping = [f"contact.damping=[{2 * 0.05 * np.sqrt(414.5 * 350):.6g}]"] if damped else []
        mechanism = load("suite-long", [f"rig.control_period={period}", sensor, *damping]).mechanism
        scenarios = build_scenarios(mechanism, draw(mechanism, 32, SEED), SEED)
        peak = np.asarray(scenarios.velocity) * np.sqrt(np.asarray(scenarios.contact.stiffness)[0] * 350.0)
        std = {"none": 0 * peak, "0.15 N": 0 * peak + 0.15}.get(noise, 0.005 * peak)
        scenarios = scenarios._replace(force_sensor=scenarios.force_sensor._replace(noise_std=std))
        gains = literature_gains(mechanism, LAW)
        outcome = to_outcome(mechanism, {**gains, "force_noise": std}, scenarios)
        assert np.all(outcome.good[0])
        errors = error_statistics(outcome.error[0])
        excess = (outcome.peak_ratio[0] - 3) * outcome.reference_peak_force[0]
        beyond = int(np.sum(excess > 20 * std))
        kind = "damped" if damped else "elastic"
        printed(f"{1e3 * period:g} ms, noise {noise}, {kind}:", *errors, "peaks beyond:", beyond)
        assert errors[0] < {"none": 0.2, "0.15 N": 1.0}.get(noise, 0.3)
        assert not beyond


OFFSETS = {
    "preload": ("preload", ()),
    "friction": ("friction", ()),
    "bias": ("noisy", BIAS),
    "all": ("preload", FRICTION + BIAS),
}


@pytest.mark.parametrize("case", OFFSETS)
def test_impulse_ledger_is_accurate_with_preload_friction_and_bias(case):
    suite, changes = OFFSETS[case]
    mechanism = load(f"suite-{suite}", changes).mechanism
    scenarios = build_scenarios(mechanism, draw(mechanism, 200, SEED), SEED)
    outcome = to_outcome(mechanism, literature_gains(mechanism, LAW), scenarios)
    assert np.all(outcome.good[0])
    errors = error_statistics(outcome.error[0])
    printed(case, *errors)
    assert errors[0] < 0.8 and errors[2] < 2.0
