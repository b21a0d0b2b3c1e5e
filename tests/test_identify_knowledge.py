"""Estimates from logs, prior and fixed values, compared with weighted least squares."""

from dataclasses import replace

import campaign_rigs
import campaigns
import numpy as np
import pytest

from jaxhil.errors import InputError
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from tuning.identification import conditioning
from tuning.identification.identify import IdentificationOptions, identify

KEYS = [
    "rig.simulator.natural_frequency",
    "rig.force_sensor.delay",
    "contact.stiffness.0",
    "contact.damping.0",
]
MEAN = np.array([12.0, 0.0037, 1.2e5, 650.0])
STD = np.array([0.02, 1e-4, 200.0, 12.0])
CORRELATION = np.array([[1, 0.3, 0, 0], [0.3, 1, 0.2, 0.9], [0, 0.2, 1, -0.1], [0, 0.9, -0.1, 1.0]])
COVARIANCE = CORRELATION * np.outer(STD, STD)
NUMBER = 4000


def logs_say(keys, seed=0):
    """Return parameter draws with exactly these means and covariances."""
    indices = [KEYS.index(key) for key in keys]
    white = np.random.default_rng(seed).standard_normal((len(keys), NUMBER))
    white -= white.mean(axis=1, keepdims=True)
    white = np.linalg.solve(np.linalg.cholesky(np.cov(white)), white)
    covariance = COVARIANCE[np.ix_(indices, indices)]
    return dict(zip(keys, MEAN[indices, None] + np.linalg.cholesky(covariance) @ white, strict=True))


def prior(shift=1.0, scale=1.5):
    """Return a mechanism whose marginal distributions are off by this number of standard deviations."""
    mean = MEAN + shift * STD * np.array([1, -1, 1, -1])
    document = to_plain_data(campaign_rigs.mechanism("clean", simulator__natural_frequency=mean[0],
                           force_sensor__delay=mean[1], contact__stiffness=[mean[2]],
                           contact__damping=[mean[3]]))  # fmt: skip
    names = [key.removesuffix(".0") for key in KEYS]
    document["uncertainty"] = {
        name: {"distribution": "normal", "std": float(scale * std)}
        for name, std in zip(names, STD, strict=True)
    }
    rows = [[float(value) for value in CORRELATION[i, : i + 1]] for i in range(4)]
    document["correlation"] = {"keys": names, "matrix": rows}
    return from_plain_data(document, "prior"), mean, scale**2 * COVARIANCE


def summary(draws, keys=KEYS):
    table = np.array([draws[key] for key in keys])
    return table.mean(axis=1), np.cov(table)


def close(actual, expected, share=0.06):
    """Check agreement within the sampling error of 4000 draws."""
    (mean, covariance), (wanted, spread) = actual, expected
    std = np.sqrt(np.diag(spread))
    np.testing.assert_allclose((mean - wanted) / std, 0.0, atol=share)
    np.testing.assert_allclose((covariance - spread) / np.outer(std, std), 0.0, atol=share)


def test_estimate_from_logs_and_prior_equals_weighted_least_squares():
    mechanism, mean, spread = prior()
    result = conditioning.condition_on_prior(logs_say(KEYS), mechanism, 3.0)
    both = np.linalg.inv(np.linalg.inv(COVARIANCE) + np.linalg.inv(spread))
    wanted = both @ (np.linalg.solve(COVARIANCE, MEAN) + np.linalg.solve(spread, mean))
    close(summary(result), (wanted, both))


def test_estimate_from_logs_updates_correlated_values_known_only_from_prior():
    """Without free motion, the estimated force delay includes the error of the prior's motion simulator."""
    mechanism, mean, spread = prior()
    draws = conditioning.condition_on_prior(logs_say(KEYS[1:]), mechanism, 3.0)
    slope = conditioning._differentiate_lag(mechanism, KEYS[:1], 3.0)[KEYS[0]]
    # Second order: the lag is 2 zeta/w at low frequencies, so its relative slope is -1/12 per Hz.
    assert slope == pytest.approx(-2 * 0.8 / (2 * np.pi * 12.0) / 12.0, rel=0.1)
    reading = np.array([[slope, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    logs_information = np.linalg.inv(COVARIANCE[1:, 1:])
    both = np.linalg.inv(np.linalg.inv(spread) + reading.T @ logs_information @ reading)
    logs_mean = MEAN[1:] + np.array([slope * mean[0], 0, 0])
    wanted = both @ (np.linalg.solve(spread, mean) + reading.T @ logs_information @ logs_mean)
    close(summary(draws), (wanted, both))


def test_parameter_draws_respect_fixed_values_and_note_contradictions():
    result, notes = conditioning.condition_on_fixed(logs_say(KEYS), {"contact.damping.0": 660.0})
    assert KEYS[3] not in result and notes == []
    regression = COVARIANCE[:3, 3] / COVARIANCE[3, 3]
    rest = COVARIANCE[:3, :3] - np.outer(regression, COVARIANCE[3, :3])
    close(summary(result, KEYS[:3]), (MEAN[:3] + 10.0 * regression, rest), 1e-6)
    _, notes = conditioning.condition_on_fixed(logs_say(KEYS), {"contact.damping.0": 0.0})
    assert notes == ["contact.damping.0: fixed at 0, but the logs give 650 +- 12"]


def test_fixed_list_values_are_assigned_entry_by_entry():
    result = ["contact.stiffness.0", "contact.stiffness.1", "contact.damping.0"]
    assert conditioning.split_lists({"contact.stiffness": [1.0, 2.0]}, result) == {
        result[0]: 1.0,
        result[1]: 2.0,
    }
    assert conditioning.split_lists({"contact.stiffness": 3.0}, result) == {result[0]: 3.0, result[1]: 3.0}
    assert conditioning.split_lists({"contact.stiffness.1": 3.0}, result) == {result[1]: 3.0}
    for key, value in (
        ("rig.range", 1.0),
        ("contact.stiffness", [1.0, 2.0, 3.0]),
        ("contact.damping", [[1.0]]),
    ):
        with pytest.raises(InputError, match=f"fix: found {key}.*, expected contact.stiffness.0, "):
            conditioning.split_lists({key: value}, result)


def test_prior_without_uncertainty_is_rejected():
    with pytest.raises(
        InputError, match=r"prior: \[uncertainty\]: found no normal distribution of a parameter that"
    ):
        conditioning.condition_on_prior(logs_say(KEYS), campaign_rigs.mechanism("clean"), 3.0)
    with pytest.raises(InputError, match="bayes: found no prior"):
        identify(campaigns.campaign("clean", 0, (), 5.0), options=IdentificationOptions(bayes=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", ("clean", "noisy"))
@pytest.mark.parametrize("seed", (0, 1))
def test_sequential_campaigns_equal_joint_identification(name, seed):
    speeds = (0.003, 0.003, 0.006, 0.006, 0.012, 0.012) * 2
    whole = campaigns.campaign(name, seed, speeds=speeds, seconds=30.0)
    rest, free, *touches = whole.runs
    *_, other = campaigns.campaign(name, seed + 50, speeds=(), seconds=30.0).runs
    options = IdentificationOptions(law="kelvin_voigt", order=2, hold_out=0.0, calibration=0.0, clock=0.0)

    def identify_runs(*runs, **changes):
        return identify(replace(whole, runs=runs), changes.pop("prior", None), replace(options, **changes))

    first = identify_runs(rest, free, *touches[::2])
    second = identify_runs(
        rest, other, *touches[1::2], prior=from_plain_data(first.mechanism, "first"), bayes=True
    )
    once = identify_runs(rest, free, other, *touches)
    keys = [key for key in second.mechanism["correlation"]["keys"]]
    assert len(keys) == 7
    for joint in (*once.estimates, *once.combinations):
        again = second[joint.key]
        if joint.key.startswith("rig.position_sensor") or joint.key.endswith(
            ("noise_std", "bias", "quantum")
        ):
            continue
        off, ratio = (again.value - joint.value) / joint.std, again.std / joint.std
        print(f"{name} {seed} {joint.key:36s} off {off:+.2f} of its std, std {ratio:.2f} times")
        # With large noise the posterior of the force delay is only roughly normal.
        assert abs(off) < 0.7 and 0.6 < ratio < 1.5
