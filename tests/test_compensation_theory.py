"""Compensators compared with the closed forms of model.md, section 6, items 4, 5, 6 and 8."""

import dataclasses
import functools
from math import pi
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from endless import OMEGA, STIFFNESS, characteristic_root, decay, growth, persistent, spring, without_period
from lanes import (
    IDEAL,
    MASS,
    SECOND_ORDER,
    first_contact,
    grid,
    mechanism,
    nominal_gains,
    per_lane,
    run_rollout,
    spread,
    validated,
)

from jaxhil.laws.phase_lead.simulation import PhaseLead
from jaxhil.laws.response_error.simulation import ResponseError
from jaxhil.laws.simulation_base import Compensator
from jaxhil.simulation.loop_construction import build_loop

PHASES = (np.arange(8) + 0.5) / 8

# Item 4.

FINE = 2.5e-4


def fixed_gains(parsed, **values):
    """Return response-error gains with known stiffness and without identification."""
    identification = {"initial_stiffness": STIFFNESS, "stiffness_covariance": 0.0, "damping_covariance": 0.0}
    inactive = {
        "contact_threshold": 0.0,
        "forgetting": 1.0,
        "response_error_damping": 0.0,
        "lead_filter": FINE / 2,
    }
    return nominal_gains(parsed, "response_error", **(identification | inactive | values))


# (kappa, T_lead / tau_f, whether the measured position is delayed)
COMPENSATIONS = [(0, 0, 0), (0, 1, 0), (0.5, 0, 0), (0.5, 1, 0), (1, 1, 0), (1, 0.5, 0), (1, 0, 0), (1, 1, 1)]


@pytest.mark.parametrize("model", ["first_order", "second_order"])
def test_net_delay_with_response_error_compensator_matches_closed_form(model):
    simulator = {"first_order": {"time_constant": 0.006}, "second_order": SECOND_ORDER}[model]
    parsed = validated(
        mechanism({"stiffness": [STIFFNESS]}, simulator | {"model": model}, 0.006, period=FINE)
    )
    index, scale, phase = grid(np.arange(len(COMPENSATIONS)), [0.5, 0.25, 0.125], PHASES)
    kappa, lead, late = np.array(COMPENSATIONS)[index.astype(int)].T
    lag, transport, force_delay, position_delay = (
        0.006 * scale,
        0.003 * scale,
        0.006 * scale,
        0.004 * scale * late,
    )
    ones, zeros = np.ones_like(lag), np.zeros_like(lag)
    if model == "first_order":
        numerator, denominator = ones[None], np.stack([lag, ones])
    else:
        numerator, denominator = np.stack([zeros, ones]), np.stack([(lag / 1.6) ** 2, lag, ones])
    scenario = spread(
        parsed,
        len(index),
        phase=phase,
        simulator__delay=transport,
        simulator__numerator=numerator,
        simulator__denominator=denominator,
        force_sensor__delay=force_delay,
        position_sensor__delay=position_delay,
    )
    gains = fixed_gains(parsed) | {
        "phase_lead": lead * force_delay,
        "response_error": kappa,
        "identification_delay": force_delay,
    }
    restitution = first_contact(parsed, scenario, "response_error", gains)["restitution"].reshape(
        -1, len(PHASES)
    )
    net_delay = 2 * np.log(restitution.mean(axis=1)) / (pi * OMEGA)
    expected = (1 - lead) * force_delay + (1 - kappa) * (lag + transport) - kappa * position_delay
    expected = expected.reshape(-1, len(PHASES))[:, 0]
    # Both the formula and the bound neglect terms of third order in the lags; T contributes 1e-7 s.
    lags = (lag + transport + force_delay + position_delay).reshape(-1, len(PHASES))[:, 0]
    assert np.all(np.abs(net_delay - expected) < 0.5 * OMEGA**2 * lags**3 + 5e-7)
    # The bound is between 0.2 % and 8 % of the lags.
    assert np.ptp(expected) > 0.007


# Cases for items 5 and 6 of model.md, section 6, with an endless contact.

DAMPING = 2 * 0.05 * MASS * OMEGA
MARGIN = np.array([0.8, 0.95, 1.0, 1.05, 1.2])


def critical(damping):
    """Return the critical frequency omega_c and delay tau_c of M x'' + b x'(t - tau) + k x(t - tau) = 0."""
    squared = damping**2 + np.sqrt(damping**4 + 4 * MASS**2 * STIFFNESS**2)
    omega = np.sqrt(squared / (2 * MASS**2))
    return omega, np.arctan(damping * omega / STIFFNESS) / omega


def test_contact_stability_changes_at_critical_delay():
    delay = MARGIN * critical(DAMPING)[1]
    result = growth(
        persistent(spring(), "none", 2.5, {}, contact__damping=np.full(5, DAMPING), force_sensor__delay=delay)
    )
    root = np.full(5, 1j * OMEGA)
    for _ in range(50):
        shift = np.exp(-root * delay)
        value = MASS * root**2 + (DAMPING * root + STIFFNESS) * shift
        root -= value / (2 * MASS * root + (DAMPING - delay * (DAMPING * root + STIFFNESS)) * shift)
    np.testing.assert_allclose(result, pi * root.real / root.imag, rtol=0, atol=1.5e-4)
    assert np.all(result[:2] < -0.007) and np.all(result[3:] > 0.007)


def test_contact_stability_changes_at_critical_lag():
    lag = MARGIN * DAMPING / STIFFNESS
    leaves = {"simulator__denominator": np.stack([lag, np.ones(5)]), "contact__damping": np.full(5, DAMPING)}
    result = growth(
        persistent(spring({"model": "first_order", "time_constant": 1.0}), "none", 2.5, {}, **leaves)
    )
    roots = [np.roots([MASS * T, MASS, DAMPING, STIFFNESS]) for T in lag]
    roots = np.array([r[np.argmax(r.imag)] for r in roots])
    np.testing.assert_allclose(result, pi * roots.real / roots.imag, rtol=0, atol=2e-6)
    assert np.all(result[:2] < -0.007) and abs(result[2]) < 1e-6 and np.all(result[3:] > 0.007)


# First-order lead: omega tau, and the damping as a multiple of the critical damping.
LEADS = np.array([[0.1, 0], [0.2, 0], [0.3, 0], *([a, m] for a in (0.4, 0.6) for m in (0.8, 1.0, 1.2))]).T


@functools.cache
def first_order_leads():
    """Return the growth for T -> 0 of endless contacts under phase lead, and that of the dominant roots."""
    angle, multiple = LEADS
    # At the threshold (k + j omega b)(1 + j theta) e^(-j theta) is real and M omega^2, theta = omega tau:
    # b omega/k = tan(theta - atan theta), about theta^3/3, twice the damping ratio.
    short = angle - np.arctan(angle)
    threshold = OMEGA * np.sqrt(np.sqrt(1 + angle**2) / np.cos(short))
    omega = np.where(multiple > 0, threshold, OMEGA)
    damping, delay = multiple * STIFFNESS * np.tan(short) / omega, angle / omega
    leaves = {"contact__damping": damping, "force_sensor__delay": delay}
    result = without_period("phase_lead", 2.5, {"phase_lead": delay}, **leaves)

    def root(b, tau):
        return characteristic_root(
            lambda s: MASS * s**2 + (b * s + STIFFNESS) * (1 + tau * s) * np.exp(-s * tau)
        )

    return result, np.array([decay(root(b, tau)) for b, tau in zip(damping, delay, strict=True)])


def test_growth_with_first_order_lead_matches_characteristic_root():
    result, expected = first_order_leads()
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-4)


def test_contact_with_first_order_lead_diverges_without_damping():
    angle = LEADS[0, :3]
    ratio = first_order_leads()[0][:3] / (pi / 6 * angle**3)
    assert np.all(np.abs(ratio - 1) < 0.01 + 0.7 * angle**2)


def test_contact_with_first_order_lead_is_stable_above_critical_damping():
    result = first_order_leads()[0][3:].reshape(2, 3)
    assert np.all(np.abs(result[:, 1]) < 1e-4)
    assert np.all(result[:, 0] > 4e-3) and np.all(result[:, 2] < -4e-3)


def test_identification_with_misaligned_force_is_biased_as_predicted():
    damping = 2 * np.tile([0.02, 0.05, 0.1], 2) * MASS * OMEGA
    # At the critical delay the motion is a pure oscillation, as the formulas assume.
    omega, delay = critical(damping)
    aligned = np.repeat([0.0, 1.0], 3) * delay
    parsed = spring(period=FINE)
    off = {"phase_lead": 0.0, "response_error": 0.0, "velocity_filter": FINE / 2}
    gains = fixed_gains(parsed, stiffness_covariance=1e12, damping_covariance=1e8, **off)
    gains |= {"initial_stiffness": 0.0, "identification_delay": aligned}
    leaves = {"contact__damping": damping, "force_sensor__delay": delay}
    stiffness, result = persistent(parsed, "response_error", 1.5, gains, **leaves).identified
    misalignment = omega * (delay - aligned)
    biased = STIFFNESS * np.cos(misalignment) + damping * omega * np.sin(misalignment)
    assert np.ptp(biased) > 0.02 * STIFFNESS
    np.testing.assert_allclose(stiffness[-1], biased, rtol=0, atol=2e-3 * STIFFNESS)
    biased = damping * np.cos(misalignment) - STIFFNESS / omega * np.sin(misalignment)
    assert np.all(np.abs(biased[:3]) < 1e-9) and np.all(biased[3:] == damping[3:])
    np.testing.assert_allclose(result[-1] / damping, biased / damping, rtol=0, atol=2e-3)


# Cases for item 8 of model.md, section 6: effect of clamping F_c at zero.


class Clamped(Compensator):
    """Compensator that clamps the output of `inner` to max(0, F_c).

    During the first `blind` ticks, the output is the measured force.
    """

    name: ClassVar[str] = "clamped"
    knows: ClassVar[tuple] = ()
    gains: ClassVar[tuple] = ()
    inner: Compensator
    blind: int = 0

    def prepare(self, gains, constants):
        return self.inner.prepare(gains, constants)

    def init(self, gains, constants, ring):
        return self.inner.init(gains, constants, ring), jnp.zeros_like(constants.control_period)

    def restart(self, gains, state, begins, fresh):
        return self.inner.restart(gains, state[0], begins, fresh), jnp.where(begins, 0, state[1])

    def step(self, prepared, state, signals, tick):
        command, inner = self.inner.step(prepared, state[0], signals, tick)
        touched = state[1] + jnp.where(signals.position_measured > 0, 1, 0).astype(state[1].dtype)
        command = jnp.where(touched > self.blind, command, signals.force_measured)
        return jnp.where(command > 0, command, 0), (inner, touched)


CLAMP_PHASES = np.array([0.05, 0.1, 0.2])


def clamped_and_not(name, law, blind, gains, **leaves):
    """Return the restitution without and with the clamp, averaged over the contact phases CLAMP_PHASES."""
    parsed = validated(mechanism({"stiffness": [STIFFNESS]}, IDEAL, 0.0, period=FINE))
    leaves = {key: np.repeat(value, len(PHASES)) for key, value in leaves.items()}
    gains = {key: np.repeat(value, len(PHASES)) if np.ndim(value) else value for key, value in gains.items()}
    phase = np.tile(PHASES, len(CLAMP_PHASES))
    scenario = spread(parsed, len(phase), phase=phase, **leaves)
    loop = build_loop(parsed, name, scenario)
    gains = per_lane(gains, len(phase))
    results = []
    for compensator in (law, Clamped(law, blind)):
        metrics = run_rollout(dataclasses.replace(loop, compensator=compensator), gains, scenario)
        results.append(np.asarray(metrics.restitution)[0].reshape(-1, len(PHASES)).mean(axis=1))
    return results


@pytest.mark.parametrize("blind", [0, 40])
def test_contact_with_clamped_response_error_diverges_as_predicted(blind):
    gains = fixed_gains(validated(mechanism({}, IDEAL, 0.0, period=FINE)), phase_lead=0.0)
    lag = CLAMP_PHASES / OMEGA
    free, clamped = clamped_and_not("response_error", ResponseError(), blind, gains, simulator__delay=lag)
    # The gate opens with a mean delay of one period, unless it is open before the compensator may act.
    squared = 1 + CLAMP_PHASES**2 + 2 * CLAMP_PHASES * OMEGA * max(blind, 1) * FINE
    assert clamped == pytest.approx(np.sqrt(squared), abs=4e-4)
    # Without the clamp, the pulling force while x_a is still in contact compensates for the late onset.
    assert np.all(np.abs(free - 1) < 0.1 * CLAMP_PHASES**2)


def test_contact_diverges_more_with_clamped_than_with_unclamped_phase_lead():
    delay = CLAMP_PHASES / OMEGA
    gains = {"phase_lead": delay, "lead_filter": FINE / 2}
    free, clamped = clamped_and_not("phase_lead", PhaseLead(), 0, gains, force_sensor__delay=delay)
    # The numbers of model.md, up to the filter's first-order error.
    assert (free[-1], clamped[-1]) == pytest.approx((1.0041, 1.0244), abs=8e-4)
    assert np.all(clamped - 1 > 3 * (free - 1))
