"""Probe push on the hardware: closed form, and unchanged results without a push."""

import jax.numpy as jnp
import numpy as np
import pytest
from lanes import IDEAL, SECOND_ORDER, mechanism, nominal_gains, run_record, run_rollout, validated
from scipy import signal
from scipy.integrate import quad

from jaxhil.mechanism.sensor_filter import find_modes
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.probe import Probe, Push
from jaxhil.simulation.scenario import build_scenarios

PUSH = Push(jnp.array(3.0), jnp.array(0.05), jnp.array(0.02))
TIMES = np.array([-0.01, 0.0, 0.04, 0.0433, 0.05, 0.0571, 0.06, 0.065, 0.2])


def test_probe_push_is_a_half_sine():
    expected = 3 * np.maximum(0, np.sin(np.pi * np.clip(TIMES - 0.04, 0, 0.02) / 0.02))
    np.testing.assert_allclose([PUSH.force(jnp.array(t)) for t in TIMES], expected, atol=1e-14)


@pytest.mark.parametrize("lag", [1e-3, 0.01, 0.1])
def test_lagged_reading_of_probe_push_equals_convolution_with_sensor_lag(lag):
    for time in TIMES:
        expected, _ = quad(
            lambda s, time=time: float(PUSH.force(jnp.array(s))) * np.exp(-(time - s) / lag) / lag,
            0.04,
            max(0.04, min(time, 0.06)),
        )
        assert float(PUSH.lagged(jnp.array(time), jnp.array(lag))) == pytest.approx(expected, abs=1e-9)


@pytest.mark.slow
def test_filtered_reading_of_probe_push_equals_convolution_with_impulse_response():
    modes, cutoff = find_modes("bessel", 3), 250.0
    prototype = signal.besselap(3, norm="mag")
    residues, poles, _ = signal.residue(prototype[2], np.poly(prototype[1]))
    for time in TIMES:
        expected, _ = quad(
            lambda s, time=time: (
                3.0
                * np.sin(np.pi * (s - 0.04) / 0.02)
                * cutoff
                * (residues @ np.exp(poles * cutoff * (time - s))).real
            ),
            0.04,
            max(0.04, min(time, 0.06)),
        )
        reading = PUSH.filtered(jnp.array(time), modes, jnp.array(cutoff))
        assert float(reading) == pytest.approx(expected, abs=1e-9)


def test_sensor_without_lag_reads_the_probe_push():
    for time in TIMES:
        reading = PUSH.lagged(jnp.array(time), jnp.array(0.0))
        assert float(reading) == float(PUSH.force(jnp.array(time)))


def run(parsed, *push, **table):
    """Return metrics of a run with a push of the given force [N] at 0.06 s of the contact."""
    probed = with_push(build_scenarios(parsed), *push, **table)
    return run_rollout(build_loop(parsed, "none", probed), nominal_gains(parsed, "none"), probed)


def recorded(parsed, scenarios):
    """Return metrics of a run with simulated approach, with or without a probe."""
    loop = build_loop(parsed, "none", scenarios)
    return run_record(loop, nominal_gains(parsed, "none"), scenarios, 400)[0]


def with_push(scenarios, size=0.0, share=0.25, depth=None, span=0.1):
    """Return scenarios with a push of the given force [N] at the fraction `share` of 0.16 s."""
    shape = scenarios.phase.shape
    full = np.full(shape, 1.0)
    push = Push(size * full, share * 0.16 * full, 0.02 * full)
    table = np.zeros((shape[0], 5, shape[1])) if depth is None else depth
    return scenarios._replace(probe=Probe(push, table, span * full))


@pytest.mark.parametrize("simulator", [IDEAL, SECOND_ORDER], ids=["ideal", "second order"])
def test_probe_push_of_zero_changes_nothing(simulator):
    parsed = validated(mechanism({}, simulator, 0.004))
    scenarios = build_scenarios(parsed)
    plain = recorded(parsed, scenarios)
    probed = recorded(parsed, with_push(scenarios))
    for name in ("restitution", "peak_force", "peak_command", "duration", "approach_velocity"):
        np.testing.assert_array_equal(getattr(probed, name), getattr(plain, name), err_msg=name)


def test_early_probe_push_takes_energy_and_late_push_gives_energy():
    parsed = validated(mechanism({}, IDEAL, 0.0))
    plain, early, late = (run(parsed, *push).restitution[0, 0] for push in ((0.0,), (5.0, 0.25), (5.0, 0.75)))
    assert early < plain - 1e-3 and late > plain + 1e-3


def test_trajectory_error_is_rms_deviation_from_reference_trajectory():
    # In ideal linear contact without delay, x_d is the sine. The second reference trajectory is 1 mm deeper.
    parsed = validated(mechanism({}, IDEAL, 0.0))
    shape = build_scenarios(parsed).phase.shape
    omega = np.sqrt(parsed.contact.stiffness[0] / parsed.bodies.mass)
    span = np.pi / omega
    sine = parsed.approach.velocity / omega * np.sin(np.linspace(0, np.pi, 513))
    table = np.broadcast_to(sine[None, :, None], (shape[0], 513, shape[1]))
    on = run(parsed, depth=table, span=span).trajectory_error[0, 0]
    off = run(parsed, depth=table + 1e-3, span=span).trajectory_error[0, 0]
    # The sampled loop has a small error of its own: the semi-implicit rule delays it by half a period.
    assert on < 1e-2 * np.max(sine)
    assert off == pytest.approx(1e-3, rel=0.02)
