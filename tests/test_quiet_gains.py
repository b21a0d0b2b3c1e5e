"""Quietest gains within an error limit: comparison with a grid of gains, in one program."""

import math
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import tuning
from jaxhil.mechanism.file import load, load_any
from jaxhil.mechanism.uncertainty import draw
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation import cached_programs
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import build_scenarios
from tuning.api import tune_verdict
from tuning.api.tune_options import TuneOptions
from tuning.caches.checkpoints import Checkpoints
from tuning.gains.noise import compute_noise_amplification
from tuning.gains.objective import Objective, evaluate_objective
from tuning.gains.quiet_gains import compute_training_tolerance, is_quiet_search_needed
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import build_task
from tuning.gains.tune import compute_error_metrics
from tuning.gains.tune_all import tune_all
from tuning.gains.validation import VALIDATION_SEED_OFFSET, build_validation

LAW = "phase_lead"
LIMIT = 0.06
SETTINGS = TuneSettings(
    scenarios=16,
    starts=2,
    steps=12,
    validation=64,
    scanned=32,
    polish=32,
    objective=Objective(limit=LIMIT),
    quiet=True,
)


def noisy(name, stiffness, delay, noise):
    changes = [f"name='{name}'", "approach.contacts=1", f"contact.stiffness=[{stiffness}]"]
    sensor = [f"rig.force_sensor.noise_std={noise}", f"rig.force_sensor.delay={delay}"]
    return load("varying", [*changes, *sensor]).mechanism


# For the last mechanism no gains meet the limit.
RIGS = [("soft", 5e4, 0.004, 0.3), ("late", 2e5, 0.03, 3.0)]
MECHANISMS = [noisy(*rig) for rig in RIGS]


def tuned(settings, **options):
    result = dict(tune_all(MECHANISMS, LAW, settings, **options))
    return [result[index] for index in range(len(MECHANISMS))]


@pytest.fixture(scope="module")
def quiet_gains():
    """Return the quietest gains, and the number of compiled programs."""
    cached_programs._programs.clear()
    result = tuned(SETTINGS)
    return result, sum(key[0].__name__ == "_solve_call" for key in cached_programs._programs)


def noise_of(result, gains):
    return compute_noise_amplification(result.mechanism, LAW, gains) - 1


def most_accurate(result):
    """Return the start with the smallest error."""
    return min(result.starts, key=lambda start: start.rms)


def test_quiet_gains_meet_error_limit_on_new_scenarios(quiet_gains):
    result = quiet_gains[0][0]
    accurate = most_accurate(result)
    assert result.quiet and accurate.rms < compute_training_tolerance(LIMIT, SETTINGS.scenarios or 0)
    assert result.figures["tuned"].failed == 0 and result.figures["tuned"].rms <= LIMIT
    assert noise_of(result, result.gains) < 0.8 * noise_of(result, accurate.gains)


def test_most_accurate_gains_are_kept_if_no_gains_meet_error_limit(quiet_gains, validation):
    result = quiet_gains[0][1]
    accurate = most_accurate(result)
    assert not result.quiet and accurate.rms > compute_training_tolerance(LIMIT, SETTINGS.scenarios or 0)
    losses = validation.losses(Objective(), [1], validation.coordinates(1, [result.gains])[None])
    assert losses[0, 0] <= accurate.rms * (1 + 1e-9)


@pytest.fixture(scope="module")
def validation():
    """Return the validation on the training scenarios of all mechanisms."""
    tasks = [build_task(one, LAW, SETTINGS.scenarios, SETTINGS.seed) for one in MECHANISMS]
    return build_validation(tasks, SETTINGS.validation, SETTINGS.seed)


def test_searches_for_quiet_gains_and_accurate_gains_share_one_program(quiet_gains):
    assert quiet_gains[1] == 1


@pytest.mark.slow
def test_quiet_gains_have_least_noise_of_all_grid_points_within_tolerance(quiet_gains, validation):
    result = quiet_gains[0][0]
    accurate = most_accurate(result).gains
    side = np.linspace(0, 1, 24)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    points = np.concatenate([grid, validation.coordinates(0, [result.gains, accurate])])[None]
    errors = validation.losses(Objective(), [0], points)[0]
    beside = validation.losses(Objective(command_weight=1.0, limit=1.0), [0], points)[0]
    peaks = np.sqrt(np.maximum(0, beside**2 - errors**2))
    noise = np.array(
        [max(0.0, noise_of(result, validation.gains(0, coordinates))) for coordinates in points[0]]
    )
    loudness = np.hypot(noise / max(noise[-1], 1), peaks / max(peaks[-1], 0.5))
    tolerance = compute_training_tolerance(LIMIT, SETTINGS.scenarios or 0)
    assert errors[-2] <= 1.05 * tolerance
    assert (errors[:-2] <= tolerance).any()
    assert loudness[-2] <= 1.03 * loudness[:-2][errors[:-2] <= tolerance].min()


def test_noise_free_metrics_equal_those_of_mechanism_without_noise(quiet_gains):
    for rig, result in zip(RIGS, quiet_gains[0], strict=True):
        silent = noisy(*rig[:-1], 0.0)
        seed = SETTINGS.seed + VALIDATION_SEED_OFFSET
        scenarios = build_scenarios(silent, draw(silent, SETTINGS.validation, seed), seed)
        outcome = evaluate(build_loop(silent, LAW, scenarios), result.gains, scenarios)
        expected = compute_error_metrics(outcome)
        assert result.without_noise.rms == pytest.approx(expected.rms, rel=1e-9)
        assert result.without_noise.failed == expected.failed
        assert result.without_noise.rms != result.figures["tuned"].rms


def test_quiet_option_has_no_effect_for_mechanisms_without_noise():
    silent = load("varying").mechanism
    assert not is_quiet_search_needed(build_task(silent, LAW, 4, 0), SETTINGS)
    assert not is_quiet_search_needed(build_task(MECHANISMS[0], "position_lead", 4, 0), SETTINGS)
    assert is_quiet_search_needed(build_task(MECHANISMS[0], LAW, 4, 0), SETTINGS)


@pytest.mark.slow
def test_quiet_gains_from_cached_program_are_identical(quiet_gains, tmp_path):
    made = tuned(SETTINGS, pieces=Checkpoints(tmp_path))
    again = tuned(SETTINGS, pieces=Checkpoints(tmp_path, resume=True))
    for one, other, reference in zip(made, again, quiet_gains[0], strict=True):
        assert one.gains == other.gains == reference.gains
        assert one.quiet == other.quiet and one.without_noise == other.without_noise


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({}, True),
        ({"limit": 0.5}, True),
        ({"limit": 0.0}, False),
        ({"limit": math.inf}, False),
        ({"noise_weight": 0.0}, False),
        ({"command_weight": 0.1}, False),
        ({"chatter_weight": 0.1}, False),
        ({"objective": "worst"}, False),
        ({"objective": lambda metrics: metrics.error.max()}, False),
        ({"divergence_weight": 2.0}, False),
    ],
)
def test_search_for_quiet_gains_runs_unless_another_objective_is_requested(options, wanted):
    settings = TuneOptions(**options).settings()
    assert settings.quiet is wanted and settings.objective.tolerance is None


def result_of(rms=0.005, silent=0.004, failed=0, unlike=0.0, peaks=(1.0, 1.2), gains=(0.0, 0.001)):
    """Return a tuning result with the fields that the verdict uses."""

    def figures_of(rms, failed=0):
        shares = {"peak_force_ratio": 1.1, "duration_ratio": (0.9, 1.2), "unlike": unlike}
        return SimpleNamespace(rms=rms, failed=failed, **shares)

    outcome = SimpleNamespace(peak_ratio=np.array([*peaks, 99.0]), good=np.array([True, True, False]))
    return SimpleNamespace(
        figures={"tuned": figures_of(rms)},
        without_noise=None if silent is None else figures_of(silent, failed),
        outcomes={"tuned": outcome},
        mechanism=MECHANISMS[0],
        compensator=LAW,
        gains=dict(zip(("phase_lead", "lead_filter"), gains, strict=True)),
        intervals=None,
    )


@pytest.mark.parametrize(
    ("changes", "good", "words"),
    [
        ({}, True, "Good: the tuned rms error 0.005, 0.004 without noise, is within 0.01; peak ratio 1.2"),
        ({"silent": None}, True, "Good: the tuned rms error 0.005 is within 0.01; peak ratio 1.2"),
        ({"rms": 0.02}, False, "Bad: the tuned rms error 0.02, 0.004 without noise, exceeds 0.01; peak"),
        ({"silent": 0.03}, False, "Bad: the tuned rms error 0.005, 0.03 without noise, exceeds 0.01; peak"),
        ({"failed": 2}, False, "Bad: 2 contacts did not end well"),
        ({"unlike": 0.02}, False, "Bad: too many real contacts are unlike the ideal one; the tuned rms"),
    ],
)
def test_tuning_verdict_names_the_metrics_used(changes, good, words):
    result = result_of(**changes)
    line = tune_verdict.describe_verdict(result, 0.01)
    assert tune_verdict.is_good(result, 0.01) is good
    assert line.startswith(words)
    assert "sensor noise x 1" in line or "Real contacts" in line


def test_tuning_warnings_report_peak_force_and_noise_beyond_bounds():
    def warned(**changes):
        result = result_of(**changes)
        return tune_verdict.command_warnings(result, tune_verdict.command_metrics(result))

    loud = {"gains": (0.004, 0.001)}
    assert compute_noise_amplification(MECHANISMS[0], LAW, {"phase_lead": 0.004, "lead_filter": 0.001}) > 2
    assert warned() == ()
    (peaks,) = warned(peaks=(1.6, 1.6))
    assert "1.6 times the ideal contact's peak force" in peaks and "at most 1.5" in peaks
    (noise,) = warned(**loud)
    assert "amplifies the sensor's noise" in noise and "at most 2" in noise
    # Without noise there is nothing to amplify.
    assert warned(**loud, silent=None) == ()


def test_objective_of_error_within_tolerance_is_small_but_nonzero():
    within = Objective(tolerance=0.01)
    assert evaluate_objective(within, np.array([0.005])) == pytest.approx(1e-4)


@pytest.mark.slow
def test_tune_of_a_noisy_mechanism_records_its_noise_free_error_and_warnings():
    small = {"scenarios": 8, "starts": 1, "steps": 2, "validation": 16}
    one = tuning.tune("suite-noisy", LAW, **small)
    written = one.document["figures"]
    assert written["without_noise"]["rms"] == one.without_noise.rms
    assert written["command"]["peak_p99"] == one.command.peak_p99
    assert written["warnings"] == list(one.warnings)


@pytest.mark.parametrize("name", ["suite-noisy", "petals"])
def test_noise_free_scenarios_differ_from_noisy_scenarios_only_in_noise(name):
    sensor = {} if name != "petals" else {"rig.force_sensor.noise_std": {"force": 0.5, "torque": 0.05}}
    mechanism = load_any(name, {**sensor, "rig.force_sensor.delay": 0.003}).mechanism
    scenarios = choose_rig_model(mechanism).scenarios(mechanism)
    silent = choose_rig_model(mechanism).without_noise(scenarios)
    noisy = jax.tree.leaves(scenarios)
    changed = [
        (before, after)
        for before, after in zip(noisy, jax.tree.leaves(silent), strict=True)
        if not np.array_equal(before, after)
    ]
    ((before, after),) = changed
    assert np.any(before > 0) and not np.any(after) and before.shape == after.shape
