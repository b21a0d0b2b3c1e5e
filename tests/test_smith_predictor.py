"""Smith predictor and hybrid compensator compared with their characteristic roots."""

import numpy as np
import pytest
from endless import OMEGA, STIFFNESS, characteristic_root, decay, without_period
from lanes import IDEAL, first_contact, grid, mechanism, spread, validated
from noise_cases import check_amplification

from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.mechanism.file import builtin_names, load
from tuning.gains.pareto_search import compute_noise_amplification as pareto_amplification

# Lag of the motion simulator and delay of the force [s]; the first pair is used in model.md.
LAGS = np.array([[0.010, 0.008], [0.010, 0.002], [0.004, 0.008], [0.015, 0.0]])
SMITH = {"smith_predictor": 1.0, "smith_hybrid": 0.5}


def expected_decay(share, lag, delay):
    """Return the decay of the root of s^2 + omega^2 C(s) e^(-s (lag + delay)) = 0.

    C is the controller with the given share of the predictor.
    """

    def equation(s):
        force = (1 + share * lag * s / (1 + lag * s / 2)) * (1 + delay * s)
        return s**2 + OMEGA**2 * force * np.exp(-s * (lag + delay))

    return decay(characteristic_root(equation))


def test_smith_predictor_restitution_equals_value_in_the_guide():
    lag, delay = LAGS[0]
    assert np.exp(expected_decay(1.0, lag, delay)) == pytest.approx(1.014, abs=5e-4)

    def other_reading(s):
        force = 1 + lag * s / (1 + lag * s / 2) * (1 + delay * s)
        return s**2 + OMEGA**2 * force * np.exp(-s * (lag + delay))

    assert np.exp(decay(characteristic_root(other_reading))) == pytest.approx(1.267, abs=5e-4)


@pytest.mark.parametrize("name", SMITH)
def test_smith_predictor_loop_growth_matches_characteristic_root(name):
    lag, delay = LAGS.T
    gains = {"phase_lead": delay, "simulator_lag": lag}
    result = without_period(name, 2.5, gains, simulator__delay=lag, force_sensor__delay=delay)
    expected = [expected_decay(SMITH[name], *one) for one in LAGS]
    # Errors of second order in T and of a discrete predictor remain: 1e-4 at these periods.
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-4)
    assert np.ptp(expected) > 0.005


@pytest.mark.parametrize("name", SMITH)
def test_smith_predictor_restitution_is_near_prediction_of_characteristic_root(name):
    period, phase = grid([5e-4, 2.5e-4], (np.arange(8) + 0.5) / 8)
    parsed = validated(mechanism({"stiffness": [STIFFNESS]}, IDEAL, 0.0, period=2.5e-4))
    lag, delay = LAGS[0]
    leaves = {"simulator__delay": lag, "force_sensor__delay": delay, "control_period": period}
    scenario = spread(parsed, len(phase), phase=phase, **leaves)
    gains = {"phase_lead": delay, "simulator_lag": lag, "lead_filter": period / 2}
    result = first_contact(parsed, scenario, name, gains)["restitution"].reshape(2, -1).mean(axis=1)
    print(name, 2 * result[1] - result[0], np.exp(expected_decay(SMITH[name], lag, delay)))
    # Onset and end of the contact are not part of the oscillation.
    expected = np.exp(expected_decay(SMITH[name], lag, delay))
    assert 2 * result[1] - result[0] == pytest.approx(expected, abs=0.2 * (OMEGA * (lag + delay)) ** 3)


@pytest.mark.parametrize("name", SMITH)
def test_noise_amplification_of_smith_predictor_matches_runtime(name):
    check_amplification(
        name,
        [
            {"phase_lead": 0.008, "lead_filter": 0.001, "simulator_lag": 0.01},
            {"phase_lead": 0.003, "lead_filter": 0.0005, "simulator_lag": 0.04},
            {"phase_lead": 0.0, "lead_filter": 0.004, "simulator_lag": 0.0002},
        ],
    )


@pytest.mark.parametrize("name", SMITH)
def test_smith_predictor_without_lag_equals_phase_lead(name):
    made = load("rig-300kg").mechanism
    gains = {"phase_lead": 0.008, "lead_filter": 0.001}
    amplified = pareto_amplification(made, name, gains | {"simulator_lag": 0.0})
    assert amplified == pytest.approx(pareto_amplification(made, "phase_lead", gains), rel=1e-13)


def test_smith_predictor_nominal_gains_are_within_bounds():
    for name in builtin_names():
        for override in [[], ["rig.control_period=0.004", "rig.force_sensor.delay=0.3"]]:
            made = load(name, override).mechanism
            for law in SMITH:
                nominal = literature_gains(made, law)
                for gain in COMPENSATORS[law].gains:
                    assert gain.lower(made) <= nominal[gain.name] <= gain.upper(made)
