"""Transfer of gains between mechanisms: unchanged for equal mechanisms, within bounds for others."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.mechanism.file import builtin_names, load
from jaxhil.simulation.one_axis import evaluate
from tuning.gains import tune_all
from tuning.gains.multistart import choose_starts
from tuning.gains.multistart_solver import solve_tasks
from tuning.gains.objective import RMS_OBJECTIVE, evaluate_objective
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import build_task
from tuning.gains.transfer import (
    EarlierGains,
    compute_mechanism_distance,
    compute_traits,
    find_nearest,
    transfer_gains,
)
from tuning.gains.validation import build_validation

MASS, STIFFNESS = 350.0, 124355.0
OMEGA = math.sqrt(STIFFNESS / MASS)


def claw(*overrides):
    return load("claw-350kg", overrides).mechanism


def claw_behind(simulator):
    """Return the claw with another motion simulator."""
    return claw(f"rig.simulator={{delay=0.004, model={simulator}}}", "uncertainty={}")


def random_gains(mechanism, compensator, seed=0):
    """Draw gains within their bounds."""
    generator, gains = np.random.default_rng(seed), {}
    for gain in COMPENSATORS[compensator].gains:
        lower, upper = gain.lower(mechanism), gain.upper(mechanism)
        if gain.logarithmic:
            gains[gain.name] = math.exp(generator.uniform(math.log(lower), math.log(upper)))
        else:
            gains[gain.name] = generator.uniform(lower, upper)
    return gains


# Distance


def test_mechanism_distance_is_symmetric_and_zero_for_identical_mechanisms():
    mechanisms = [load(name).mechanism for name in builtin_names()]
    for a in mechanisms:
        assert compute_mechanism_distance(a, a) == 0
        for b in mechanisms:
            assert compute_mechanism_distance(a, b) == compute_mechanism_distance(b, a) >= 0
            assert (compute_mechanism_distance(a, b) == 0) == (a is b)


@pytest.mark.parametrize(
    "override, expected",
    [
        # Four times the stiffness doubles the frequency; the same damper then has half the damping ratio.
        ("contact.stiffness=[497420.0]", math.hypot(math.log(2), math.pi * 0.015)),
        ("contact.damping=[0.0]", math.pi * 0.03),
        ("rig.force_sensor.delay=0.009", math.pi / 2 * OMEGA * 0.005),
        ("rig.force_sensor.time_constant=0.005", math.pi / 2 * OMEGA * 0.005),
        ("rig.simulator.delay=0.0", math.pi / 2 * OMEGA * 0.004),
        # Lag 2 zeta / omega_n = zeta / (pi f_n).
        ("rig.simulator.natural_frequency=6.0", math.pi / 2 * OMEGA * 0.8 / math.pi * (1 / 6 - 1 / 12)),
        ("rig.command_latency=1", math.pi / 2 * OMEGA * 0.001),
        ("rig.command_hold='zoh'", math.pi / 2 * OMEGA * 0.0005),
        ("rig.control_period=0.003", math.pi / 2 * OMEGA * 0.002),
        ("contact.law='linear'", math.hypot(1, math.pi * 0.03)),
        ("contact.clearance=0.1", 1.0),
        # Values that do not change the restitution.
        ("approach.velocity=0.01", 0.0),
        ("name='other'", 0.0),
    ],
)
def test_properties_are_weighted_by_effect_on_restitution_in_mechanism_distance(override, expected):
    assert compute_mechanism_distance(claw(), claw(override)) == pytest.approx(expected, rel=2e-4, abs=1e-12)


def test_mechanism_properties_do_not_depend_on_form_of_simulator_model():
    second = compute_traits(claw("rig.simulator.natural_frequency=10.0", "rig.simulator.damping_ratio=0.7"))
    omega = 2 * math.pi * 10
    written = claw_behind(
        f"'transfer_function', numerator=[{omega**2}], denominator=[1.0, {1.4 * omega}, {omega**2}]"
    )
    assert compute_traits(written).simulator_delay == pytest.approx(second.simulator_delay, rel=1e-12)
    leading = claw_behind("'transfer_function', numerator=[0.01, 1.0], denominator=[0.0001, 0.03, 1.0]")
    assert compute_traits(leading).simulator_delay == pytest.approx(0.004 + 0.02, rel=1e-12)
    assert compute_traits(claw_behind("'ideal'")).simulator_delay == 0.004


def test_equivalent_damping_of_every_contact_law_matches_its_restitution():
    """For Hunt and Crossley, expect e = 1 - chi v."""
    hertz = compute_traits(claw("contact.law='hunt_crossley'", "contact.damping=[4.0]"))
    assert math.exp(-math.pi * hertz.damping_ratio) == pytest.approx(1 - 4.0 * 0.005, rel=1e-3)
    assert compute_traits(claw()).damping_ratio == pytest.approx(0.03, rel=1e-3)


def test_nearest_mechanism_has_least_distance_and_is_first_among_equals():
    stiff, soft = claw("contact.stiffness=[3e5]"), claw("contact.stiffness=[6e4]")
    sources = [
        EarlierGains(stiff, {}, "stiff"),
        EarlierGains(soft, {}, "soft"),
        EarlierGains(soft, {}, "again"),
    ]
    assert find_nearest(claw("contact.stiffness=[2e5]"), sources).source == "stiff"
    assert find_nearest(claw("contact.stiffness=[8e4]"), sources).source == "soft"


# Transfer


@pytest.mark.parametrize("compensator", ["phase_lead", "response_error"])
@pytest.mark.parametrize("name", builtin_names())
def test_gains_transferred_to_an_identical_mechanism_are_unchanged(compensator, name):
    mechanism = load(name).mechanism
    gains = random_gains(mechanism, compensator)
    assert transfer_gains(compensator, gains, mechanism, load(name).mechanism) == gains


@pytest.mark.parametrize("compensator", ["phase_lead", "response_error"])
def test_transferred_literature_gains_equal_literature_gains_of_target(compensator):
    source, target = claw(), load("varying", ["rig.control_period=0.002"]).mechanism
    transferred = transfer_gains(compensator, literature_gains(source, compensator), source, target)
    for name, value in literature_gains(target, compensator).items():
        assert transferred[name] == pytest.approx(value, rel=1e-12)


def test_transferred_gains_keep_their_position_between_published_value_and_range_limits():
    source = claw()
    target = claw("contact.stiffness=[497420.0]", "rig.force_sensor.delay=0.01", "rig.control_period=0.002")
    gains = {**literature_gains(source, "response_error"), "initial_stiffness": 1e5, "lead_filter": 1.5e-3}
    transferred = transfer_gains("response_error", {**gains, "phase_lead": 0.0054}, source, target)
    # The range is 2 tau + 0.02 s; a lead of 1.4 ms beyond the delay is a twentieth of the range.
    assert transferred["phase_lead"] == pytest.approx(0.01 + 0.05 * 0.04, rel=1e-12)
    assert transferred["initial_stiffness"] == pytest.approx(4e5, rel=1e-12)
    # The literature's filter time is one period; 1.5 times this value, on a logarithmic scale.
    assert transferred["lead_filter"] == pytest.approx(3e-3, rel=1e-12)


def test_transferred_gains_are_within_the_bounds():
    names = builtin_names()
    for seed, name in enumerate(names):
        source, target = load(name).mechanism, load(names[seed - 1], ["rig.control_period=0.003"]).mechanism
        transferred = transfer_gains(
            "response_error", random_gains(source, "response_error", seed), source, target
        )
        for gain in COMPENSATORS["response_error"].gains:
            assert gain.lower(target) <= transferred[gain.name] <= gain.upper(target)


@pytest.fixture(scope="module")
def task():
    return build_task(load("rig-300kg").mechanism, "phase_lead", 8, 0)


@pytest.fixture(scope="module")
def validation(task):
    return build_validation([task], 15, 0)


@pytest.fixture(scope="module")
def solved(task, validation):
    (starts,) = solve_tasks([task], choose_starts(validation, 3, 0), 6)
    return starts


def test_starting_gains_from_user_replace_the_last_random_starts(task, validation):
    gains = {"phase_lead": 0.011, "lead_filter": 0.0007}
    (usual,) = choose_starts(validation, 3, 0)
    (points,) = choose_starts(validation, 3, 0, first=[[gains]])
    np.testing.assert_array_equal(points[:2], usual[:2])
    assert validation.gains(0, points[2]) == pytest.approx(gains, rel=1e-12)
    # The first loss belongs to exactly these gains.
    (starts,) = solve_tasks([task], [points], 6)
    errors = np.where(task.scenarios.contacts > 0, evaluate(task.loop, gains, task.scenarios).error[0], 0)
    assert starts[2].history[0] == pytest.approx(evaluate_objective(RMS_OBJECTIVE, errors), rel=1e-9)


@pytest.mark.parametrize("starts", [1, 2])
def test_literature_gains_are_kept_beside_starting_gains_from_user(task, validation, starts):
    given = [{"phase_lead": 0.011, "lead_filter": 0.0007}, {"phase_lead": 0.002, "lead_filter": 0.0005}]
    (points,) = choose_starts(validation, starts, 0, first=[given])
    for gains, point in zip([task.literature, *given], points, strict=True):
        assert validation.gains(0, point) == pytest.approx(gains, rel=1e-12)


def test_tuning_from_user_gains_never_ends_worse_than_those_gains(task, validation, solved):
    best = min(solved, key=lambda start: start.rms)
    upper = COMPENSATORS["phase_lead"].gains[0].upper(task.mechanism)
    assert best.gains["phase_lead"] == pytest.approx(upper, rel=1e-12)
    (again,) = solve_tasks([task], choose_starts(validation, 2, 0, first=[[best.gains]]), 1)
    assert again[-1].rms <= best.rms * (1 + 1e-12)


@pytest.fixture
def in_blocks(monkeypatch):
    """Return the origins of the starts when mechanisms of 1e5, 3e5 and 2.9e5 N/m are tuned two at a time."""
    monkeypatch.setattr(tune_all, "MAX_GROUP_SIZE", 2)

    def block(tasks, settings, work, near):
        return [
            SimpleNamespace(mechanism=t.mechanism, gains={}, near=own)
            for t, own in zip(tasks, near, strict=True)
        ]

    monkeypatch.setattr(tune_all, "tune_group", block)

    def call(starts, tuned=()):
        mechanisms = [claw(f"contact.stiffness=[{k}]", f"name='{k}'") for k in ("1e5", "3e5", "2.9e5")]
        settings = TuneSettings(scenarios=4, starts=starts)
        every = dict(tune_all.tune_all(mechanisms, "phase_lead", settings, tuned=tuned))
        return [[one.source for one in every[i].near] for i in range(3)]

    return call


def test_later_tuning_groups_start_at_results_of_similar_earlier_mechanisms(in_blocks):
    assert in_blocks(starts=3) == [[], [], ["3e5"]]
    assert in_blocks(starts=2) == [[], [], ["3e5"]]


def test_starting_gains_are_first_literature_then_user_then_transferred_gains(in_blocks):
    file = EarlierGains(claw("contact.stiffness=[1.1e5]"), {}, "file")
    assert in_blocks(3, [file]) == [["file"], ["file"], ["file", "3e5"]]
    assert in_blocks(2, [file]) == in_blocks(1, [file]) == [["file"]] * 3
    assert in_blocks(1) == [[]] * 3
