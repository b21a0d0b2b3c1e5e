"""Accuracy of the identification on simulated campaigns: coverage, errors, contact laws, verdicts.

All tests are slow; `test_identify.py` has a daily sample. `pytest -m slow -s
tests/test_identify_campaigns.py` prints the results.
"""

import campaigns
import numpy as np
import pytest

from tuning.identification.contact_problem import ContactProblem
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.result import UNCERTAINTY_CHECK

pytestmark = pytest.mark.slow
REPEATS = 400
MASS = 350.0


def truth(name):
    """Return the true values by key, for a position sensor without delay."""
    kind = campaigns.KINDS[name]
    simulator, sensor = kind.rig["simulator"], kind.rig["force_sensor"]
    ahead = kind.rig["position_sensor"].get("delay", 0.0)
    delay, stiffness, damping = sensor["delay"] - ahead, kind.contact["stiffness"], kind.contact["damping"][0]
    numbers = {
        "rig.simulator.delay": simulator["delay"] + ahead,
        "rig.force_sensor.delay": delay,
        "rig.force_sensor.noise_std": sensor["noise_std"],
        "rig.force_sensor.bias": sensor.get("bias", 0.0),
        "rig.contact_plane": kind.rig.get("contact_plane", 0.0),
        "contact.damping.0": damping,
        "apparent damping": damping - stiffness[0] * (delay + sensor.get("time_constant", 0.0)),
        **{f"contact.stiffness.{i}": value for i, value in enumerate(stiffness)},
    }
    for key in ("natural_frequency", "damping_ratio"):
        if key in simulator:
            numbers[f"rig.simulator.{key}"] = simulator[key]
    return numbers


# Allowed rms errors at 0.5 N of noise, and at 2.67 N.
RMS_BARS = {
    "rig.simulator.delay": (2e-5, 2e-5),
    "rig.simulator.natural_frequency": (0.003 * 12.0, 0.003 * 12.0),
    "rig.force_sensor.delay": (1e-4, 5e-4),
    "apparent damping": (0.02 * np.sqrt(1.2e5 * MASS), 0.02 * np.sqrt(1.2e5 * MASS)),
    "contact.stiffness.0": (0.003 * 1.2e5, 0.005 * 1.2e5),
    "rig.contact_plane": (5e-6, 5e-6),
}


@pytest.mark.parametrize("name", ("clean", "noisy", "coloured", "jitter"))
def test_identify_intervals_have_stated_95_percent_coverage(name):
    numbers = truth(name)
    inside, scores, errors = ({key: [] for key in numbers} for _ in range(3))
    for seed in range(REPEATS):
        campaign = campaigns.campaign(name, 10_000 + seed)
        result = identify(
            campaign, options=IdentificationOptions(law="kelvin_voigt", order=2, hold_out=0.0, seed=seed)
        )
        for key, value in numbers.items():
            estimate = result[key]
            inside[key].append(estimate.low <= value <= estimate.high)
            errors[key].append(estimate.value - value)
            scores[key].append(errors[key][-1] / estimate.std)
        if name == "noisy":
            assert result["rig.force_sensor.quantum"].value == pytest.approx(0.5, rel=1e-9)
    print(name)
    for key in numbers:
        rms = np.sqrt(np.mean(np.square(scores[key])))
        rms_error = np.sqrt(np.mean(np.square(errors[key])))
        print(
            f"  {key:36s} covered {np.mean(inside[key]):.3f}, rms error {rms_error:.3g}, over std {rms:.3f}"
        )
        assert rms_error <= RMS_BARS.get(key, (np.inf, np.inf))[name == "noisy"]
    # The limits are 92 to 98 %: the stated 95 % and three standard errors of 400 repeats.
    shares = {key: np.mean(values) for key, values in inside.items()}
    assert all(0.917 <= share <= 0.985 for share in shares.values()), shares


BARS = {
    # largest errors of ten: delay of motion [s], delay and lag of force [s], stiffness (relative), plane [m]
    "clean": (2e-5, 1.5e-4, 0.003, 5e-6),
    "noisy": (2e-5, 6e-4, 0.007, 5e-6),
    "coloured": (2e-5, 3e-4, 0.005, 5e-6),
    "jitter": (2e-5, 2e-4, 0.003, 5e-6),
    "lagging": (2e-5, 4e-4, 0.003, 5e-6),
    "third_order": (2e-5, 2e-4, 0.003, 5e-6),
    "resonance": (1e-4, 2e-4, 0.003, 5e-6),
    "stiffnesses": (2e-5, 2e-4, 0.005, 5e-6),
    "dead_zone": (2e-5, None, 0.01, None),
}


@pytest.mark.parametrize("name", BARS)
def test_identify_errors_lie_within_allowed_limits(name):
    numbers, bars = truth(name), BARS[name]
    kind = campaigns.KINDS[name]
    critical = 2.0 * np.sqrt(min(kind.contact["stiffness"]) * MASS)
    rows, good, left = [], 0, []
    for seed in range(10):
        result = identify(
            campaigns.campaign(name, 20_000 + seed),
            options=IdentificationOptions(law="kelvin_voigt", seed=seed),
        )
        delays = result["rig.force_sensor.delay"].value
        lag = next(
            (item.value for item in result.estimates if item.key.endswith("sensor.time_constant")), 0.0
        )
        true_lag = kind.rig["force_sensor"].get("time_constant", 0.0)
        plane = next((item.value for item in result.estimates if item.key == "rig.contact_plane"), np.nan)
        rows.append([
            result["rig.simulator.delay"].value - numbers["rig.simulator.delay"],
            delays + lag - numbers["rig.force_sensor.delay"] - true_lag,
            max(abs(result[key].value / value - 1.0) for key, value in numbers.items() if "stiffness" in key),
            plane - numbers["rig.contact_plane"],
            (result["apparent damping"].value - (numbers["apparent damping"] + 0.0)) / critical,
        ])  # fmt: skip
        # Noise and dead zones leave damping and delay uncertain; that is not a defect.
        good += result.good or result.worst.name == UNCERTAINTY_CHECK
        held_out_line = next(
            line for line in result.lines if line.name == "restitution of touches not fitted"
        )
        left.append(float(held_out_line.finding.rsplit(" ", 1)[1]))
    print(name, "rms z of the restitution of touches not fitted", np.sqrt(np.mean(np.square(left))))
    assert 0.7 < np.sqrt(np.mean(np.square(left))) < 1.5
    rms, worst = np.sqrt(np.mean(np.square(rows), axis=0)), np.max(np.abs(rows), axis=0)
    print(name, "rms", rms, "worst", worst, "good", good)
    for value, bar in zip(worst, bars, strict=False):
        assert bar is None or value <= bar
    if true_lag == 0.0:
        assert worst[-1] <= 0.01
    assert good >= 9


@pytest.mark.parametrize("name, law", (
    ("clean", "kelvin_voigt"), ("hertz", "hunt_crossley"), ("stiffnesses", "kelvin_voigt"),
    ("layered", "piecewise_linear"),
))  # fmt: skip
def test_identify_selects_the_true_contact_law_in_20_of_20_campaigns(name, law):
    for seed in range(20):
        result = identify(
            campaigns.campaign(name, 30_000 + seed), options=IdentificationOptions(hold_out=0.0)
        )
        assert result.contact.law.name == law, (seed, result.contact.law)


def test_identify_detects_every_drift():
    for seed in range(20):
        result = identify(
            campaigns.campaign("drifting", 40_000 + seed), options=IdentificationOptions(law="kelvin_voigt")
        )
        assert not result.good


def test_errors_of_identified_delay_and_lag_reach_cramer_rao_bound():
    true = np.array([0.0025, 0.0016, 0.0, 1.2e5, 650.0, 0.0])
    steps = np.array([2e-6, 2e-6, 2e-8, 10.0, 0.1, 0.01])
    off, bounds = [], []
    for seed in range(10):
        campaign = campaigns.campaign("lagging", 20_000 + seed)
        result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt", hold_out=0.0))
        off.append(result["delay and lag of force"].value - 0.0041)
        problem = result.contact.problem

        def force(numbers, problem=problem):
            lag = ContactProblem(problem.motion, problem.readings, problem.law, None, numbers[1])
            return lag.force(numbers[0], numbers[2], numbers[3:]).ravel()[problem.used_rows] / 0.5

        slopes = np.array(
            [(force(true + step) - force(true - step)) / (2.0 * step.sum()) for step in np.diag(steps)]
        )
        size = np.linalg.norm(slopes, axis=1)
        covariance = np.linalg.inv(slopes @ slopes.T / np.outer(size, size)) / np.outer(size, size)
        bounds.append(np.sqrt(covariance[:2, :2].sum()))
    rms = np.sqrt(np.mean(np.square(off)))
    print(f"rms error {1e3 * rms:.3f} ms, bound {1e3 * np.mean(bounds):.3f} ms")
    # The rms of 10 normal values is below 1.6 standard deviations in 997 of 1000 cases.
    assert rms < 1.6 * np.mean(bounds)


def test_identify_separates_force_delay_from_damping_with_press_run():
    """The Cramer-Rao bound is 0.05 ms with a press run of 30 s at 0.05 mm, and 0.2 ms from contacts alone.

    The interval also allows for a sensor lag that the readings do not exclude, so it is wider than the bound.
    The rms of five errors at the bound exceeds 1.6 times the bound with a probability of 2.5 %.
    """
    off, good = [], 0
    for seed in range(5):
        result = identify(
            campaigns.campaign("noisy", 50_000 + seed, press=True),
            options=IdentificationOptions(law="kelvin_voigt"),
        )
        off.append((result["rig.force_sensor.delay"].value - 0.0037, result["rig.force_sensor.delay"].std))
        assert result.good or result.worst.name == UNCERTAINTY_CHECK
        good += result.good
    off = np.array(off)
    assert good >= 3
    print("rms error", np.sqrt(np.mean(off[:, 0] ** 2)), "std", off[:, 1].mean())
    assert np.sqrt(np.mean(off[:, 0] ** 2)) < 1.6 * 5.1e-5 and off[:, 1].max() < 1.3e-4
