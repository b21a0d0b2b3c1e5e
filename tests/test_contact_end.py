"""Sensor noise does not change the mean restitution through the detection of a contact's end.

A contact ends when its command has decayed; a noisy command gets 0.1 s for the decay. The mean over many
seeds is compared with the contact without noise: in the simulation, with the exported Python controller, and
with the C controller on a rig with its own plant and its own end detection.
"""

import math
import subprocess
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c99_cases import COMPILER, compiled, write_sources
from gain_documents import sign
from lanes import mechanism, nominal_gains, per_lane, run_rollout, spread, validated
from rig_lock_step import closed_loop, controller

import jaxhil
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import KnownConstants
from jaxhil.mechanism.file import builtin_names, to_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.contact_tracking import MAX_DECAY_WAIT, build_end_conditions
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import build_scenarios
from jaxhil.simulation.sensors import white_noise
from tuning.bundle.bundle import build_limits_section
from tuning.gain_file import build_document
from tuning.gains.tasks import build_task
from tuning.rig.contact_detector import ContactDetector
from tuning.rig.numerical_model import NumericalModel
from tuning.rig.plant import RigHardware
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.calibration import calibrate

BIAS = 0.002  # largest bias of the mean restitution, in addition to three standard errors
LOUDEST = 5.0  # largest noise amplification of the gains
TICKS = 4000  # ticks of noise per run; same value as in noisy_plant.c
PLANT = Path(__file__).with_name("noisy_plant.c")


def heavy_mechanisms(**sensor: float) -> Mechanism:
    """Return mechanisms of 420 and 6500 kg with soft, damped contact and slow decay of the command."""
    raw = mechanism(
        {"stiffness": [18e3], "damping": [320.0]},
        {"model": "second_order", "natural_frequency": 9.0, "damping_ratio": 0.7, "delay": 0.002},
        0.00115,
        period=1e-3,
        velocity=0.012,
        force_sensor=sensor,
        command_latency=1,
    )
    raw["bodies"] = {"chaser_mass": 420.0, "target_mass": 6500.0}
    return validated(raw)


# Gains with which the command is far from 0 when the force ends.
SLOW_END = {"phase_lead": 0.0034, "response_error": 1.35}
# Gains from `jaxhil tune`: an rms error of 0.004 with noise, below 0.001 without.
TUNED = {
    "phase_lead": 3.385e-5,
    "response_error": 1.21745,
    "response_error_damping": 0.04961,
    "identification_delay": 0.021283,
    "stiffness_covariance": 918337.0,
    "contact_threshold": 4.0,
}


def amplification(name: str, gains: dict[str, float], period: float) -> float:
    """Return the noise amplification of a compensator."""
    leaves = {key: jnp.asarray(value) for key, value in gains.items()}
    return float(COMPENSATORS[name].noise_amplification(leaves, KnownConstants(jnp.asarray(period), jnp.inf)))


def loud_gains(parsed: Mechanism, name: str) -> dict[str, float]:
    """Return the literature's gains with a lead filter that amplifies noise at most `LOUDEST`-fold."""
    gains, period = nominal_gains(parsed, name), parsed.rig.control_period
    if "lead_filter" not in gains:
        return gains
    low, high = 1e-4 * period, 100 * period
    for _ in range(50):
        middle = math.sqrt(low * high)
        louder = amplification(name, {**gains, "lead_filter": middle}, period) > LOUDEST
        low, high = (middle, high) if louder else (low, middle)
    return {**gains, "lead_filter": high}


def restitutions(parsed: Mechanism, name: str, gains: dict[str, float], seeds: int, run=run_rollout):
    """Return the restitution (contacts, seeds), NaN for a contact that did not end."""
    lanes = np.arange(seeds)
    key = np.stack([np.full(seeds, 20), lanes]).astype(np.uint32)
    scenario = spread(parsed, seeds)._replace(key=key)
    metrics = run(build_loop(parsed, name, scenario), per_lane(gains, seeds), scenario)
    contacts = parsed.approach.contacts
    ended = np.asarray(metrics.status)[:contacts] == OK
    return np.where(ended, np.asarray(metrics.restitution)[:contacts], np.nan)


def with_noise(parsed: Mechanism, std: float) -> Mechanism:
    """Return the mechanism with this force sensor noise [N]."""
    raw = to_plain_data(parsed)
    raw["rig"]["force_sensor"]["noise_std"] = std
    return validated(raw)


def peak_force(parsed: Mechanism) -> float:
    """Return the largest force [N] of the first contact without delays."""
    return float(jaxhil.simulate(parsed, "none").contacts[0].reference_peak_force)


def check_means(parsed: Mechanism, name: str, shares: tuple[float, ...], seeds: int) -> None:
    """Check the mean restitution of the first contact for noise of these shares of the peak force.

    Noise may bias a compensator, or a sensor with a dead zone. The same contact is therefore also simulated
    for ten times as long after its end and must have the same mean.
    """
    gains = loud_gains(parsed, name)
    quiet = with_noise(parsed, 0.0)
    (free,) = restitutions(quiet, name, gains, 1)[0]
    for share in shares:
        noisy = with_noise(parsed, share * peak_force(quiet))
        (over,) = restitutions(noisy, name, gains, seeds)[:1]
        if abs(np.mean(over) - free) <= BIAS + 3 * np.std(over) / math.sqrt(seeds):
            continue
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("jaxhil.simulation.contact_tracking.MAX_DECAY_WAIT", 10 * MAX_DECAY_WAIT)
            (later,) = restitutions(noisy, name, gains, seeds, jax.jit(rollout, static_argnums=0))[:1]
        assert abs(np.mean(later - over)) <= BIAS + 3 * np.std(later - over) / math.sqrt(seeds), (name, share)


@pytest.mark.slow
def test_mean_restitution_does_not_depend_on_noise():
    check_means(jaxhil.load("suite-noisy"), "response_error", (0.003, 0.03, 0.1), 1000)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPENSATORS)
@pytest.mark.parametrize("built_in", builtin_names())
def test_mean_restitution_does_not_depend_on_noise_for_any_mechanism(built_in, name):
    parsed = jaxhil.load(built_in)
    if hasattr(parsed, "contact"):
        check_means(parsed, name, (0.003, 0.03, 0.1), 1000)


@pytest.mark.parametrize("name", ["phase_lead", "response_error", "smith_predictor"])
def test_contact_counts_as_ended_only_after_its_whole_impulse(name):
    """Without noise, the model's velocity no longer changes after the detected end."""
    parsed = heavy_mechanisms()
    gains = nominal_gains(parsed, name)
    over, later = continue_contact(parsed, name, gains, 10.0)
    assert abs(later - over) < 2e-5


def continue_contact(
    parsed: Mechanism, name: str, gains: dict[str, float], factor: float
) -> tuple[float, float]:
    """Return the first contact's restitution, and the value after `factor` times the longest wait."""
    law, plant, detector = controller(parsed, name, gains), RigHardware(parsed), ContactDetector(parsed)
    model = NumericalModel(to_plain_data(parsed))
    position, velocity = model.start
    model.place(position, velocity)
    plant.begin(position, velocity, law.position_command(position, velocity, 0.0), 0)
    result, ticks_to_wait = None, math.ceil(factor * MAX_DECAY_WAIT / parsed.rig.control_period)
    while ticks_to_wait > 0:
        reading, measured = plant.read()
        force = law.step(reading, model.position, model.velocity, measured)
        if result is None:
            result = detector.observe(model.position, model.velocity, force, plant.force, reading)
        else:
            ticks_to_wait -= 1
        model.integrate(force)
        plant.move(law.position_command(model.position, model.velocity, model.acceleration))
    return result.restitution, abs(model.velocity) / velocity


@pytest.mark.slow
def test_exported_python_controller_has_mean_restitution_of_simulation():
    parsed, seeds = heavy_mechanisms(noise_std=1.0), 200
    gains = nominal_gains(parsed, "response_error", **SLOW_END)
    (simulated,) = restitutions(parsed, "response_error", gains, seeds)
    result = [closed_loop(parsed, "response_error", gains, seed)[0][0].restitution for seed in range(40)]
    standard_error = math.hypot(np.std(simulated) / math.sqrt(seeds), np.std(result) / math.sqrt(len(result)))
    assert abs(np.mean(result) - np.mean(simulated)) < 1e-3 + 3 * standard_error
    assert np.std(result) == pytest.approx(np.std(simulated), rel=0.5)


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
def test_exported_c_controller_has_restitution_of_simulation(tmp_path):
    parsed, seeds = heavy_mechanisms(noise_std=1.0), 16
    gains = nominal_gains(parsed, "response_error", **SLOW_END)
    (simulated,) = restitutions(parsed, "response_error", gains, seeds)
    runs = run_in_c(tmp_path, parsed, export_gains(parsed, gains), seeds)
    # The C rig may detect the end a tick earlier or later, which includes one command more or less.
    assert np.median(np.abs(runs[:, 0] - simulated)) < 1e-6
    np.testing.assert_allclose(runs[:, 0], simulated, atol=1e-3)
    longer = run_in_c(tmp_path, parsed, export_gains(parsed, gains), 400, 60)[:, 0]
    (free,) = restitutions(heavy_mechanisms(), "response_error", gains, 1)[0]
    assert abs(np.mean(longer) - free) < 1e-3 + 3 * np.std(longer) / math.sqrt(len(longer))


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
def test_exported_watchdog_false_alarms_lie_within_stated_interval(tmp_path):
    parsed = heavy_mechanisms(noise_std=1.0)
    document = export_gains(parsed, nominal_gains(parsed, "response_error", **TUNED))
    result = calibrate(check_document(document), scenarios=1024, limit=0.02)
    document["limits"] = build_limits_section(result.limits)
    runs = run_in_c(tmp_path, parsed, sign(document), 1000, 60)
    alarms = int(np.count_nonzero(runs[:, 2]))
    stated = result.rates["false_alarms"]
    assert stated["runs"] > 200
    assert binomial_interval(alarms, len(runs), 0.99)[0] <= stated["high"], (alarms, stated)


def test_simulated_time_in_tuning_includes_wait_for_noisy_contact_end():
    noisy, free = (
        build_task(heavy_mechanisms(noise_std=std), "phase_lead", 8, 0).scenarios.time_limit
        for std in (1.0, 0.0)
    )
    np.testing.assert_allclose(noisy - free, MAX_DECAY_WAIT)


def export_gains(parsed: Mechanism, gains: dict[str, float]) -> dict[str, Any]:
    """Return the gain document of response_error with these gains."""
    return build_document("response_error", gains, parsed, "0" * 64, {}, {}, 0, {})


def run_in_c(folder, parsed: Mechanism, document: dict[str, Any], seeds: int, more: int = 0) -> np.ndarray:
    """Return restitution, last tick and faults of every seed's run; wait `more` ticks at the end."""
    scenario = build_scenarios(parsed)
    rig, contact, sensor = parsed.rig, parsed.contact, parsed.rig.force_sensor
    key = np.stack([np.full(seeds, 20), np.arange(seeds)]).astype(np.uint32)
    counts = np.broadcast_to(2 * np.arange(TICKS)[:, None], (TICKS, seeds)).astype(np.int32)
    arrays = [jnp.asarray(values) for values in (key, np.zeros(seeds, np.int32), counts)]
    noise = sensor.noise_std * np.asarray(white_noise(*arrays, np.float64))
    (folder / "noise").write_bytes(np.ascontiguousarray(noise.T).tobytes())
    write_sources(folder, document)
    (folder / "noisy_plant.c").write_text(PLANT.read_text())
    program = compiled(folder, "noisy_plant.c", "rig", "-O2")
    waits = build_end_conditions(scenario)
    numbers = (
        *(parsed.bodies.mass, parsed.approach.velocity, contact.stiffness[0], contact.damping[0]),
        *(rig.simulator.natural_frequency, rig.simulator.damping_ratio, rig.simulator.delay, sensor.delay),
        *(rig.command_latency, parsed.approach.phase, float(waits.max_force_free_ticks[0]) + more),
    )
    ran = subprocess.run(
        [program, *(repr(float(number)) for number in numbers), folder / "noise"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return np.array([line.split() for line in ran.stdout.splitlines()], float)
