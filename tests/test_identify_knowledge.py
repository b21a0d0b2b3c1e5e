"""What is known beside the logs: told numbers and a prior's marginals, against weighted least squares."""

from dataclasses import replace

import campaign_rigs
import campaigns
import numpy as np
import pytest

from jaxhil.errors import InputError
from jaxhil.mechanism.file import from_builtins, to_builtins
from tuning.identification import knowledge
from tuning.identification.estimate import Options, identify

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
    """Draws with exactly these means and covariances."""
    places = [KEYS.index(key) for key in keys]
    white = np.random.default_rng(seed).standard_normal((len(keys), NUMBER))
    white -= white.mean(axis=1, keepdims=True)
    white = np.linalg.solve(np.linalg.cholesky(np.cov(white)), white)
    own = COVARIANCE[np.ix_(places, places)]
    return dict(zip(keys, MEAN[places, None] + np.linalg.cholesky(own) @ white, strict=True))


def prior(shift=1.0, scale=1.5):
    """A mechanism whose marginals are off by so many standard deviations."""
    mean = MEAN + shift * STD * np.array([1, -1, 1, -1])
    document = to_builtins(campaign_rigs.mechanism("clean", simulator__natural_frequency=mean[0],
                           force_sensor__delay=mean[1], contact__stiffness=[mean[2]],
                           contact__damping=[mean[3]]))  # fmt: skip
    names = [key.removesuffix(".0") for key in KEYS]
    document["uncertainty"] = {
        name: {"distribution": "normal", "std": float(scale * std)}
        for name, std in zip(names, STD, strict=True)
    }
    rows = [[float(one) for one in CORRELATION[i, : i + 1]] for i in range(4)]
    document["correlation"] = {"keys": names, "matrix": rows}
    return from_builtins(document, "prior"), mean, scale**2 * COVARIANCE


def summary(draws, keys=KEYS):
    table = np.array([draws[key] for key in keys])
    return table.mean(axis=1), np.cov(table)


def close(found, expected, share=0.06):
    """Within the scatter of 4000 draws."""
    (mean, covariance), (wanted, spread) = found, expected
    std = np.sqrt(np.diag(spread))
    np.testing.assert_allclose((mean - wanted) / std, 0.0, atol=share)
    np.testing.assert_allclose((covariance - spread) / np.outer(std, std), 0.0, atol=share)


def test_logs_and_prior_together_are_weighted_least_squares():
    mechanism, mean, spread = prior()
    found = knowledge.with_prior(logs_say(KEYS), mechanism, 3.0)
    both = np.linalg.inv(np.linalg.inv(COVARIANCE) + np.linalg.inv(spread))
    wanted = both @ (np.linalg.solve(COVARIANCE, MEAN) + np.linalg.solve(spread, mean))
    close(summary(found), (wanted, both))


def test_numbers_of_the_prior_alone_go_along_with_those_that_the_logs_tell():
    """Logs without free motion: the force delay found is that for the simulator as told, and so holds the
    sum of both lags."""
    mechanism, mean, spread = prior()
    found = knowledge.with_prior(logs_say(KEYS[1:]), mechanism, 3.0)
    slope = knowledge._lag_slopes(mechanism, KEYS[:1], 3.0)[KEYS[0]]
    # Second order: the lag is 2 zeta/w at low frequencies, so it falls by a share of 1/12 per Hz.
    assert slope == pytest.approx(-2 * 0.8 / (2 * np.pi * 12.0) / 12.0, rel=0.1)
    reading = np.array([[slope, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    told = np.linalg.inv(COVARIANCE[1:, 1:])
    both = np.linalg.inv(np.linalg.inv(spread) + reading.T @ told @ reading)
    said = MEAN[1:] + np.array([slope * mean[0], 0, 0])
    wanted = both @ (np.linalg.solve(spread, mean) + reading.T @ told @ said)
    close(summary(found), (wanted, both))


def test_told_numbers_move_the_others_by_regression_and_are_denied_where_they_are_far_off():
    found, notes = knowledge.with_told(logs_say(KEYS), {"contact.damping.0": 660.0})
    assert KEYS[3] not in found and notes == []
    regression = COVARIANCE[:3, 3] / COVARIANCE[3, 3]
    rest = COVARIANCE[:3, :3] - np.outer(regression, COVARIANCE[3, :3])
    close(summary(found, KEYS[:3]), (MEAN[:3] + 10.0 * regression, rest), 1e-6)
    _, notes = knowledge.with_told(logs_say(KEYS), {"contact.damping.0": 0.0})
    assert notes == ["contact.damping.0: 0 was told, the logs say 650 +- 12"]


def test_told_lists_are_told_entry_by_entry():
    found = ["contact.stiffness.0", "contact.stiffness.1", "contact.damping.0"]
    assert knowledge.spread_out({"contact.stiffness": [1.0, 2.0]}, found) == {found[0]: 1.0, found[1]: 2.0}
    assert knowledge.spread_out({"contact.stiffness": 3.0}, found) == {found[0]: 3.0, found[1]: 3.0}
    assert knowledge.spread_out({"contact.stiffness.1": 3.0}, found) == {found[1]: 3.0}
    for key, value in (
        ("rig.range", 1.0),
        ("contact.stiffness", [1.0, 2.0, 3.0]),
        ("contact.damping", [[1.0]]),
    ):
        with pytest.raises(InputError, match=f"fix: found {key}.*, allowed contact.stiffness.0, "):
            knowledge.spread_out({key: value}, found)


def test_a_prior_that_knows_nothing_of_it_is_refused():
    with pytest.raises(InputError, match=r"prior: \[uncertainty\]: found no entry of what the logs tell"):
        knowledge.with_prior(logs_say(KEYS), campaign_rigs.mechanism("clean"), 3.0)
    with pytest.raises(InputError, match="bayes: found no prior"):
        identify(campaigns.campaign("clean", 0, (), 5.0), options=Options(bayes=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", ("clean", "noisy"))
@pytest.mark.parametrize("seed", (0, 1))
def test_a_second_campaign_after_the_first_says_what_both_say_at_once(name, seed):
    speeds = (0.003, 0.003, 0.006, 0.006, 0.012, 0.012) * 2
    whole = campaigns.campaign(name, seed, speeds=speeds, seconds=30.0)
    rest, free, *touches = whole.runs
    *_, other = campaigns.campaign(name, seed + 50, speeds=(), seconds=30.0).runs
    options = Options(law="kelvin_voigt", order=2, hold_out=0.0, calibration=0.0, clock=0.0)

    def said(*runs, **kept):
        return identify(replace(whole, runs=runs), kept.pop("prior", None), replace(options, **kept))

    first = said(rest, free, *touches[::2])
    second = said(rest, other, *touches[1::2], prior=from_builtins(first.mechanism, "first"), bayes=True)
    once = said(rest, free, other, *touches)
    keys = [key for key in second.mechanism["correlation"]["keys"]]
    assert len(keys) == 7
    for one in (*once.estimates, *once.combinations):
        again = second[one.key]
        if one.key.startswith("rig.position_sensor") or one.key.endswith(("noise_std", "bias", "quantum")):
            continue
        off, ratio = (again.value - one.value) / one.std, again.std / one.std
        print(f"{name} {seed} {one.key:36s} off {off:+.2f} of its std, std {ratio:.2f} times")
        # The posterior of the force delay is normal but roughly where noise is large.
        assert abs(off) < 0.7 and 0.6 < ratio < 1.5
