"""Excitation design: minimum variance within limits, low crest factors, correct predictions."""

from functools import partial

import campaign_kinds
import campaign_rigs
import campaigns
import numpy as np
import pytest
from scipy import optimize

from jaxhil.errors import InputError
from jaxhil.rig import digest
from jaxhil.simulation.gain_choice import choose_gains
from tuning.identification import contact_fit, contact_runs, free_motion
from tuning.identification.design import powers, waveform
from tuning.identification.design.excitation import MULTISINE_PERIODS, design_excitation, differentiate_error
from tuning.identification.identify import MIN_REST_ROWS
from tuning.identification.noise import estimate_noise
from tuning.identification.records import CampaignTiming

# Derivatives of e - e* with respect to the parameters of "clean", as the slow test computes them.
SLOPES = np.array([[0.0076, -0.089, -3.9, 30.4, -2.8e-7, -5.7e-5]])


def test_optimal_design_for_a_slope_uses_both_ends_of_the_range():
    """Elfving 1952: for y = a + b x on -1 <= x <= 1, half of the readings at either end are optimal for b."""
    x = np.linspace(-1.0, 1.0, 21)
    rows = np.stack([np.ones_like(x), x])
    group = powers.RunLines(np.einsum("il,jl->lij", rows, rows), np.ones((1, 21)))
    (power,) = powers.optimise_powers([group], np.diag([0.0, 1.0]))
    np.testing.assert_allclose(power[[0, -1]], 0.5, atol=1e-2)
    assert power[1:-1].sum() < 1e-2


@pytest.mark.parametrize("seed", range(3))
def test_optimal_excitation_powers_match_general_solver(seed):
    random = np.random.default_rng(seed)
    rows = random.standard_normal((2, 7))
    use = random.uniform(0.1, 1.0, (2, 7))
    group, weight = powers.RunLines(np.einsum("il,jl->lij", rows, rows), use), np.diag([1.0, 0.3])

    def error(power):
        return np.trace(weight @ np.linalg.inv(powers.sum_information([group], [power])))

    limits = [{"type": "ineq", "fun": lambda p, row=row: 1.0 - row @ p} for row in use]
    start = powers.make_flat_powers(group)
    result = optimize.minimize(error, start, method="SLSQP", bounds=[(1e-9, None)] * 7, constraints=limits,
                              options={"ftol": 1e-10, "maxiter": 500})  # fmt: skip
    (power,) = powers.optimise_powers([group], weight)
    assert np.all(use @ power <= 1.0 + 1e-9)
    assert error(power) == pytest.approx(result.fun, rel=5e-3) and error(power) < error(start)


def test_multisine_has_low_crest_factor_and_specified_amplitudes():
    lines, rows = np.arange(1, 200, 2), 2000
    amplitude = np.random.default_rng(0).uniform(0.1, 1.0, len(lines))
    made = waveform.synthesise_multisine(
        amplitude, lines, rows, waveform.optimise_phases(amplitude, lines, rows)
    )
    np.testing.assert_allclose(2.0 / rows * np.abs(np.fft.rfft(made))[lines], amplitude, rtol=1e-12)
    assert waveform.crest_factor(made) < 1.6
    whole = waveform.repeat_with_fades(made, 3, 100)
    assert whole[0] == 0.0 and np.max(np.abs(np.diff(whole))) <= 1.1 * np.max(np.abs(np.diff(made)))
    np.testing.assert_array_equal(whole[100 : 100 + 2 * rows], np.tile(made, 2))


@pytest.fixture(scope="module")
def planned():
    mechanism = campaign_rigs.mechanism(
        "clean", simulator__acceleration_limit=20.0, simulator__velocity_limit=0.3
    )
    return design_excitation(mechanism, 0.002, lambda keys: SLOPES)


def test_excitation_design_reaches_but_does_not_exceed_limits(planned):
    free, press = planned.free.position, planned.press.position
    assert np.abs(free).max() == pytest.approx(0.002, rel=1e-6) or np.abs(free).max() < 0.002
    speed, acceleration = np.diff(free) / 1e-3, np.diff(free, 2) / 1e-6
    assert np.abs(speed).max() < 0.3 and np.abs(acceleration).max() < 20.0
    assert np.abs(free).max() > 0.0017 or np.abs(acceleration).max() > 0.85 * 18.0
    # No signal has a low crest factor in position, velocity and acceleration together.
    assert max(planned.free.crest, planned.press.crest) < 2.1
    # The press run never leaves the contact, and its force stays below the force of an approach.
    force = campaign_rigs.commanded("clean", "press", press, 0, noise=False).force_measured
    greatest = 0.006 * np.sqrt(1.2e5 * 350.0)
    pressed = slice(3000, 3000 + 12 * 5000)
    assert 0.03 * greatest < force[pressed].min() and force.max() < 0.9 * greatest
    assert press[0] == press[-1] == pytest.approx(-0.001, abs=1e-6)


def test_excitation_design_is_more_informative_than_flat_spectrum(planned):
    assert planned.flat > 1.5


def scatter_over_campaigns(planned, repeats):
    """Return standard deviations of motion parameters over campaigns, relative to the predicted values."""
    timing, rows = CampaignTiming(1e-3, "linear", 0, "tick"), []
    for seed in range(repeats):
        run = campaign_rigs.commanded("clean", "free", planned.free.position - 0.05, seed)
        fit = free_motion.fit_free_motion([run], timing, 2)
        assert fit is not None and fit.spectra[0].periods == MULTISINE_PERIODS - 1
        w, zeta, delay = fit.model.parameters
        rows.append([np.exp(w) / (2.0 * np.pi), np.exp(zeta), delay])
    return np.std(rows, axis=0, ddof=1) / planned.std[:3], np.mean(rows, axis=0)


def test_excitation_design_predicts_standard_deviations_of_fit(planned):
    run = campaign_rigs.commanded("clean", "free", planned.free.position - 0.05, 0)
    fit = free_motion.fit_free_motion([run], CampaignTiming(1e-3, "linear", 0, "tick"), 2)
    assert fit is not None and fit.spectra[0].periods == MULTISINE_PERIODS - 1
    values, std = fit.model.parameters, np.sqrt(np.diag(fit.covariance))
    scale = np.array([np.exp(values[0]) / (2.0 * np.pi), np.exp(values[1]), 1.0])
    np.testing.assert_allclose(scale * std, planned.std[:3], rtol=0.1)


@pytest.mark.slow
def test_excitation_design_predicts_scatter_over_many_campaigns():
    mechanism = campaign_rigs.mechanism("clean")
    gains = choose_gains(mechanism, "response_error", None)[1]
    planned = design_excitation(
        mechanism, 0.002, partial(differentiate_error, mechanism, "response_error", gains)
    )
    assert max(planned.free.crest, planned.press.crest) < 1.8
    print("slopes", np.round(planned.slopes.mean(axis=0), 9).tolist(), "flat over best", planned.flat)
    np.testing.assert_allclose(planned.slopes.mean(axis=0), SLOPES[0], rtol=0.2, atol=1e-6)
    ratio, _ = scatter_over_campaigns(planned, 100)
    print("free: std over predicted", ratio)
    assert np.all(np.abs(ratio - 1.0) < 0.25)
    timing, kind = CampaignTiming(1e-3, "linear", 0, "tick"), campaigns.KINDS["clean"]
    noise = estimate_noise(0.5 * np.random.default_rng(0).standard_normal(10 * MIN_REST_ROWS))
    free = campaign_rigs.commanded("clean", "free", planned.free.position - 0.05, 0, noise=False)
    model, rows = free_motion.fit_free_motion([free], timing, 2).model, []
    for seed in range(16):
        run = campaign_rigs.commanded("clean", "press", planned.press.position, seed)
        fit = contact_fit.fit_contact(
            contact_runs.split_long_run(run, 1e-3), model, timing, noise, "kelvin_voigt"
        )
        estimates = dict(zip(fit.posterior.names, fit.posterior.mean, strict=True))
        rows.append([estimates["delay"], estimates["stiffness.0"], estimates["damping"]])
    ratio = np.std(rows, axis=0, ddof=1) / planned.std[3:]
    print("press: std over predicted", ratio, "mean", np.mean(rows, axis=0), "of", kind.contact)
    # With 15 degrees of freedom, 99.9 % of the ratios are between 0.45 and 1.58.
    assert np.all(ratio < 1.6) and np.all(ratio > 0.45)


@pytest.mark.parametrize("law", ["kelvin_voigt", "hunt_crossley"])
def test_excitation_design_without_damping_predicts_lowest_detectable_damping(law):
    exponent = {"contact__exponent": 1.5} if law == "hunt_crossley" else {}
    mechanism = campaign_rigs.mechanism("clean", contact__law=law, contact__damping=[0.0], **exponent)
    planned = design_excitation(mechanism, 0.002, lambda keys: SLOPES)
    damping = planned.keys.index("contact.damping.0")
    assert planned.values[damping] == 0.0
    damped = campaign_rigs.mechanism(
        "clean", contact__law=law, contact__damping=[float(planned.std[damping])], **exponent
    )
    at_detectable = design_excitation(damped, 0.002, lambda keys: SLOPES)
    assert 0.5 < at_detectable.std[damping] / planned.std[damping] < 2.0


PLASTIC = "elastoplastic", 2.0, [0.0]


def test_excitation_design_rejects_unsupported_mechanism():
    for changed, reason in (
        (dict(zip(("contact__law", "contact__unloading_ratio", "contact__damping"), PLASTIC, strict=True)),
         r"contact\.law: found 'elastoplastic'"),
        ({"rig__simulator": campaign_kinds.RESONANT}, r"rig\.simulator\.model: found 'transfer_function'"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=reason):
            design_excitation(campaign_rigs.mechanism("clean", **changed), 0.002, lambda keys: SLOPES)


@pytest.mark.slow
def test_identify_design_command_writes_excitation_files(jaxhil, tmp_path):
    ran = jaxhil("identify", "--design", "rig-300kg", "--stroke", "0.003", "-o", tmp_path, "--json")
    assert ran.code == 0 and digest(ran.document) == ran.document["sha256"]
    for name in ("free", "press"):
        times, x = np.loadtxt(tmp_path / f"{name}.csv", delimiter=",", skiprows=1).T
        assert len(x) == ran.document["runs"][name]["rows"] and np.abs(x).max() <= 0.003
        np.testing.assert_allclose(np.diff(times), np.diff(times)[0], rtol=1e-6)
    assert all(item["std"] > 0.0 for item in ran.document["predicted"]) and ran.document["error"] < 0.01
    ran = jaxhil("identify", "--design", "--prior", "rig-300kg", "--stroke", "0.003", "-o", tmp_path)
    assert ran.code == 0 and "rig.force_sensor.delay" in ran.out and "crest factors" in ran.out
