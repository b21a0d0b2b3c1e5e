"""Noise amplification of a compensator's filter and of a loop in contact."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK, mechanism, nominal_gains, per_lane, run_record, spread, validated
from noise_cases import amplification
from scipy.signal import bilinear, lfilter

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import KnownConstants
from jaxhil.simulation.loop_construction import build_loop

NAMES = ("phase_lead", "lead_filter")
GAINS = np.array([[0.004, 0.001], [0.0077, 0.0031], [0.002, 0.0008]])
TICKS, LANES, DEVIATION = 3000, 16, 2.0


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def _amplified(compensator, gains, period):
    def value(gains):
        return COMPENSATORS[compensator].noise_amplification(gains, KnownConstants(period, jnp.inf))

    return value(gains), jax.jacfwd(value)(gains) if gains else {}


def amplify(compensator, gains, period=1e-3):
    """Return the noise amplification and its derivative with respect to every gain."""
    gains = {name: np.asarray(value, float) for name, value in gains.items()}
    return _amplified(compensator, gains, np.asarray(period))


@pytest.mark.parametrize("compensator", ["phase_lead", "response_error"])
def test_noise_amplification_equals_amplification_by_compensator_filter(compensator):
    for gains in GAINS:
        values = dict(zip(NAMES, gains, strict=True))
        ours, slopes = amplify(compensator, values)
        np.testing.assert_allclose(ours, amplification(gains), rtol=1e-12)
        numerator, denominator = bilinear([sum(gains), 1], [gains[1], 1], 1e3)
        noise = np.random.default_rng(2).normal(size=1_000_000)
        np.testing.assert_allclose(ours, np.std(lfilter(numerator, denominator, noise)), rtol=4e-3)
        for gain in NAMES:
            step = 1e-5 * values[gain]
            low, high = (amplify(compensator, {**values, gain: values[gain] + h})[0] for h in (-step, step))
            np.testing.assert_allclose(slopes[gain], (high - low) / (2 * step), rtol=1e-7)


def test_noise_amplification_is_1_without_compensation_or_lead():
    assert amplify("none", {})[0] == 1
    no_lead = {"phase_lead": 0, "lead_filter": 0.003}
    np.testing.assert_allclose(amplify("phase_lead", no_lead)[0], 1, rtol=1e-14)


LEAD_ALONE = {"response_error": 0.0, "response_error_damping": 0.0}


def noisy_contact(velocity, damping=0.0, bodies=None, lanes=LANES, ticks=TICKS, **values):
    """Return gains of response_error, and F_c and true force [N] of a noisy contact, (ticks, lanes)."""
    contact, sensor = {"damping": [damping]}, {"noise_std": DEVIATION}
    raw = mechanism(contact, period=1e-3, velocity=velocity, force_sensor=sensor)
    parsed = validated(raw | ({"bodies": bodies} if bodies else {}))
    scenario = spread(parsed, lanes, key=np.stack([np.zeros(lanes), np.arange(lanes)]))
    gains = nominal_gains(parsed, "response_error", **values)
    loop = build_loop(parsed, "response_error", scenario)
    _, seen = run_record(loop, per_lane(gains, lanes), scenario, ticks)
    return gains, np.asarray(seen.command)[:ticks], np.asarray(seen.plant_signals.force)[:ticks]


def steady_contact(**values):
    """Return gains, and the deviation of F_c from a straight line [N], (ticks, lanes).

    A heavy body hardly moves during a contact of some seconds under a slowly rising force.
    """
    gains, command, force = noisy_contact(1e-3, bodies={"equivalent_mass": 1e9}, **values)
    assert force[500:].min() > 3 * DEVIATION
    command, time = command[500:], np.arange(TICKS - 500)
    line = np.polynomial.polynomial.polyfit(time, command, 1)
    return gains, command - np.polynomial.polynomial.polyval(time, line).T


def test_noise_amplification_matches_simulated_loop_in_steady_contact():
    gains, whole = steady_contact()
    _, lead = steady_contact(**LEAD_ALONE)
    expected = amplify("response_error", gains)[0]
    assert expected > 3
    # 40000 samples, with anticorrelated neighbours.
    np.testing.assert_allclose(np.std(lead) / DEVIATION, expected, rtol=0.005)
    np.testing.assert_allclose(np.std(whole) / DEVIATION, expected, rtol=0.01)
    # The same noise through the identification adds independently a tenth, 0.5 % of the sum.
    assert 0 < np.std(whole - lead) < 0.15 * np.std(lead)


def test_identification_increases_noise_amplification_early_in_contact():
    """The increase depends on the initial covariance and ends after a tenth of the contact.

    The contact threshold is so high that noise alone hardly ever exceeds it.
    """

    def noise(**values):
        gains, command, force = noisy_contact(0.005, 300.0, lanes=128, ticks=400, **values)
        first = np.flatnonzero((force > 0).all(axis=1))[0]
        last = first + np.flatnonzero((force[first:] == 0).any(axis=1))[0]
        spans = np.array_split(np.std(command, axis=1)[first : last - 1], 10)
        expected = amplify("response_error", gains)[0] * DEVIATION
        return gains, np.array([np.sqrt(np.mean(span**2)) for span in spans]) / expected

    # The noise level is an array with one value for each tenth of the contact.
    np.testing.assert_allclose(noise(**LEAD_ALONE)[1], 1, atol=0.1)
    gains, noise_level = noise()
    covariance = gains["stiffness_covariance"]
    fixed, large, huge = (noise(stiffness_covariance=covariance * times)[1] for times in (0, 10, 1e4))
    assert fixed[0] < 1 < 1.1 < noise_level[0] < large[0] < huge[0] < 1.6
    assert max(max(spans[1:]) for spans in (noise_level, large, huge)) < 1.1
