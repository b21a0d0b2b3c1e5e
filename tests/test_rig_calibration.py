"""Calibrated limits for the rig: audit of the watchdog, expected restitution, missed and false alarms."""

import functools
import math

import numpy as np
import pytest
from cases import SECOND_ORDER, mechanism, nominal_gains, validated
from limited_replay import limited_controller, replay_lane
from sweep_cases import NOISY, UNCERTAIN, case
from sweep_cases import manifest as sweep_manifest

from jaxhil.errors import InputError
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.rig.faults import CONTACT_TOO_LONG
from jaxhil.rig.law_status import UNSTATED
from jaxhil.rig.limits import LIMITS, complete_limits
from jaxhil.rig.watchdog import Watchdog
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.metrics import OK
from tuning.bundle.bundle import build_limits_section
from tuning.gain_file import build_document
from tuning.sweeps.run_sweep import run_sweep
from tuning.sweeps.store import open_store, read_chunk
from tuning.watchdog.alarms import evaluate_runs, find_good_runs
from tuning.watchdog.audit import audit_contacts, find_first_true
from tuning.watchdog.calibration import build_audit_rules, calibrate, compute_guard_limits
from tuning.watchdog.expectation import (
    POLYNOMIAL_TERMS,
    ContactFeatures,
    ExpectationFit,
    expected_restitution,
    fit_expectation,
)
from tuning.watchdog.recording import RecordedSignals, ScenarioSelection, record_selection
from tuning.watchdog.signal_extremes import find_signal_extremes

DAMPING = {"contact.damping": {"distribution": "loguniform", "factor": [0.5, 2.0]}}
LIMIT = 0.02


def gains(contact=None, uncertainty=UNCERTAIN, compensator="response_error", contacts=2, **parts):
    """Return gains for two damped contacts at a coarse control period, with both good and bad runs."""
    contact = {"damping": [400.0], **(contact or {})}
    raw = mechanism(contact, {**SECOND_ORDER, "natural_frequency": 20.0}, contacts=contacts, **parts)
    parsed = validated({**raw, "uncertainty": uncertainty})
    law = nominal_gains(parsed, compensator)
    return check_document(build_document(compensator, law, parsed, "0" * 64, {}, {}, 0, {}))


LANES = 128  # equal in all tests, so that a single program is compiled
ONE_SIDED = gains()
NOISY_GAP = gains({"clearance": 0.001}, force_sensor=NOISY, contacts=3)


@functools.cache
def recorded(sided):
    """Return recorded runs of either mechanism."""
    (chunk,) = record_selection({1: ONE_SIDED, 2: NOISY_GAP}[sided], ScenarioSelection("random", 1, LANES))
    return chunk


@pytest.fixture(scope="module")
def calibrated():
    """Return the calibrated limits, and other runs."""
    return calibrate(ONE_SIDED, scenarios=2 * LANES, limit=LIMIT, lanes=LANES), recorded(1)


def watch(limits, signals, rules, lane):
    """Return (restitution, expected, imbalance, fault) of a lane's contacts from the runtime's watchdog."""
    watchdog = Watchdog(complete_limits(limits), rules.period, rules.clearance)
    result, output = [], 0.0

    def note(fault):
        if watchdog.contacts > len(result):
            result.append((watchdog.restitution, watchdog.expected, watchdog.balance, fault))

    for tick in range(int(np.sum(signals.live[:, lane]))):
        force, position, velocity, measured, command = (float(leaf[tick, lane]) for leaf in signals[:5])
        if tick and signals.begins[tick, lane]:
            note(watchdog.conclude(output, UNSTATED))
            watchdog.restart()
        note(watchdog.tick(output, UNSTATED, force, position, velocity, measured))
        output = command
    note(watchdog.conclude(output, UNSTATED))
    return result


@pytest.mark.slow
@pytest.mark.parametrize("sided", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_calibration_audit_equals_watchdog_audit_bit_for_bit(sided):
    rules, _ = build_audit_rules({1: ONE_SIDED, 2: NOISY_GAP}[sided])
    chunk, slots = recorded(sided), 8
    audited = audit_contacts(chunk.signals, rules, slots)
    limits = {
        "equivalent_mass": rules.mass,
        "settling": rules.settling,
        "alignment": rules.alignment,
        "fading": rules.fading,
        "restitution_margin": 0.05,
        "reference_stiffness": 1e5,
        "reference_velocity": 0.004,
        **{f"{name}_lowest": -0.5 for name in ("softness", "speed", "loss")},
        **{f"{name}_highest": 0.5 for name in ("softness", "speed", "loss")},
        **{f"expected_{term}": 0.9 / 3**index for index, term in enumerate(POLYNOMIAL_TERMS)},
    }
    expectation = ExpectationFit(
        {term: limits[f"expected_{term}"] for term in POLYNOMIAL_TERMS}, 1e5, 0.004, *[(-0.5, 0.5)] * 3
    )
    features = ContactFeatures(audited.stiffness, audited.damping, audited.approach)
    expected = expected_restitution(expectation, features, rules.mass)
    contacts = 0
    for lane in range(LANES):
        for contact, one in enumerate(watch(limits, chunk.signals, rules, lane)[:slots]):
            energy = 0.5 * rules.mass * audited.approach[contact, lane] * audited.approach[contact, lane]
            assert one[0] == audited.restitution[contact, lane]
            assert one[1] == expected[contact, lane]
            assert abs(one[2]) / energy == audited.imbalance[contact, lane]
            assert (one[3] != 0) == (not abs(one[0] - one[1]) <= 0.05)
            contacts += 1
    assert contacts == np.sum(np.isfinite(audited.restitution)) >= 2 * LANES


def test_calibration_audit_restitution_equals_simulated_restitution():
    rules, distance = build_audit_rules(ONE_SIDED)
    chunk = recorded(1)
    evaluated = evaluate_runs(chunk, rules, distance)
    ended = (evaluated.status == OK) & (np.abs(evaluated.error) < 0.1)
    ended = np.logical_and.accumulate(ended, axis=0)
    apart = np.abs(evaluated.audited.restitution - chunk.contacts.restitution)[ended]
    assert len(apart) >= LANES and np.max(apart) < 1e-6
    assert np.max(evaluated.audited.imbalance[ended]) < 1e-11


def test_audit_of_impulse_ledger_begins_when_the_compensator_acts():
    """The real surface is 1 mm nearer than specified, so that no position reaches the specified surface."""
    nearer = gains(uncertainty={}, compensator="impulse_ledger", contact_plane=-1e-3)
    assert build_audit_rules(nearer)[0].has_status and not build_audit_rules(ONE_SIDED)[0].has_status
    (chunk,) = record_selection(nearer, ScenarioSelection("random", 1, 8))
    audited = audit_contacts(chunk.signals, build_audit_rules(nearer)[0], 2)
    assert np.all(chunk.signals.position <= 0) and np.all(chunk.signals.measured <= 0)
    np.testing.assert_allclose(audited.restitution, chunk.contacts.restitution[:2], atol=1e-6)


def test_calibration_sets_every_limit_and_the_gain_file_loads(calibrated):
    limits = calibrated[0].limits
    assert list(limits) == list(LIMITS)
    # The distance from which a rig approaches a surface is not limited.
    assert [name for name, value in limits.items() if value is None] == ["measured_lowest", "command_lowest"]
    controller = limited_controller(ONE_SIDED, build_limits_section(limits))
    assert not controller.tripped
    for name in (
        "force_range",
        "force_limit",
        "force_slew",
        "velocity_limit",
        "longest_contact",
        "free_force",
    ):
        assert limits[name] is not None and limits[name] > 0, name
    assert 0 < limits["measured_highest"] < 0.01


def test_long_approach_under_calibrated_limits_raises_no_fault(calibrated):
    controller = limited_controller(ONE_SIDED, build_limits_section(calibrated[0].limits))
    velocity, period = ONE_SIDED.mechanism.approach.velocity, ONE_SIDED.mechanism.rig.control_period
    for tick in range(5000):
        position = -0.5 + tick * period * velocity
        assert controller.step(0.0, position, velocity, position - 1e-5, tick * period) == 0.0
        controller.position_command(position + period * velocity, velocity, 0.0)
        assert controller.faults == 0


def test_contacts_end_without_force_even_if_compensator_output_decays_slowly(calibrated):
    limits = {name: value for name, value in calibrated[0].limits.items() if value is not None}

    def faults(output):
        watchdog = Watchdog(complete_limits(limits), 1e-3, math.inf)
        result, rate = set(), 2 * math.pi / 0.15
        for tick in range(2000):
            phase, given = rate * 1e-3 * tick, output * 0.99999**tick
            position, velocity = 1e-4 * (math.sin(phase) - 0.5), 1e-4 * rate * math.cos(phase)
            result.add(watchdog.tick(given, UNSTATED, 0.0, position, velocity, position))
        return result

    assert CONTACT_TOO_LONG in faults(1e-3) and CONTACT_TOO_LONG not in faults(1e-9)


def test_runs_stopped_by_rig_specific_limits_count_as_false_alarms():
    small = {"force_limit": 1e-3, "command_lowest": -0.05}
    result = calibrate(ONE_SIDED, scenarios=64, limit=LIMIT, replaced=small)
    assert {name: result.limits[name] for name in small} == small
    # A limit that no run satisfies also stops good runs.
    rate = result.rates["false_alarms"]
    assert rate["alarms"] == rate["runs"] > 0


def test_calibrated_controller_stops_every_bad_run_and_no_good_run(calibrated):
    (limits, rates), chunk = calibrated
    rules, distance = build_audit_rules(ONE_SIDED)
    evaluated = evaluate_runs(chunk, rules, distance)
    bad = (evaluated.status != OK) | ~(np.abs(evaluated.error) <= LIMIT)
    first, good = find_first_true(bad), find_good_runs(evaluated, LIMIT / 2)
    controller = limited_controller(ONE_SIDED, build_limits_section(limits))
    stopped = 0
    for lane in range(len(good)):
        tripped = replay_lane(controller, chunk.signals, lane, rules.mass)
        if good[lane]:
            assert tripped is None
        if np.any(bad[:, lane]):
            assert tripped is not None
            following = evaluated.audited.tick[first[lane] + 1 :, lane]
            assert not np.any(tripped.tick >= following[:1])
            stopped += 1
    assert stopped > 10 and np.sum(good) > 5
    assert rates["false_alarms"]["alarms"] == rates["missed_alarms"]["alarms"] == 0
    assert rates["missed_alarms"]["runs"] > 10 and 0 < rates["missed_alarms"]["high"] < 0.3


def test_watchdog_with_specified_damping_does_not_use_identified_damping(calibrated):
    rates = calibrated[0].rates
    assert rates["terms"] == ["1", "p", "pp", "ppp"]
    assert rates["expectation_largest"] < 2e-3 and rates["restitution_margin"] == 0.75 * LIMIT
    assert rates["widened_from"] is None and rates["noticed_from"]["error"] < LIMIT


@pytest.mark.slow
def test_watchdog_without_specified_damping_cannot_distinguish_damping_from_delay():
    """The margin is widened until good runs pass, and the verdict states the missed alarms."""
    loaded = gains(uncertainty={**UNCERTAIN, **DAMPING})
    rates = calibrate(loaded, scenarios=8 * LANES, limit=LIMIT, lanes=LANES).rates
    assert "z" in rates["terms"]
    # The expected rms is pi omega sd(delay) / 2, here for 0.5 ms at 3 Hz.
    assert rates["expectation_rms"] == pytest.approx(math.pi * 2 * math.pi * 3 * 0.0005 / 2, rel=0.3)
    narrow = rates["widened_from"]
    assert narrow < 0.75 * LIMIT < LIMIT < rates["restitution_margin"]
    assert rates["false_alarms"]["alarms"] == 0 < rates["false_alarms"]["runs"]
    assert rates["verdict"] == "bad" and rates["reasons"][0].startswith("missed alarms: 95 % interval ")
    noticed = rates["noticed_from"]["error"]
    assert noticed is None or noticed > rates["restitution_margin"]
    # Without the wider margin most good runs would be stopped.
    replaced = {"restitution_margin": narrow}
    rates = calibrate(loaded, scenarios=4 * LANES, limit=LIMIT, lanes=LANES, replaced=replaced).rates
    assert rates["false_alarms"]["low"] > 0.1 and rates["missed_alarms"]["rate"] < 0.05
    assert rates["widened_from"] is None and rates["reasons"][0].startswith("false alarms: ")


def test_expected_restitution_of_undamped_contact_is_1():
    rng = np.random.default_rng(0)
    features = ContactFeatures(*rng.uniform(1.0, 2.0, (3, 100)))
    fitted = fit_expectation(features, np.ones(100), np.arange(100), 350.0, 1e-4)
    assert fitted.coefficients == {**dict.fromkeys(POLYNOMIAL_TERMS, 0.0), "1": pytest.approx(1.0)}


def test_calibration_recovers_a_known_restitution_polynomial():
    rng = np.random.default_rng(1)
    features = ContactFeatures(
        1e5 * rng.uniform(0.5, 2, 400), 300 * rng.uniform(0.5, 2, 400), rng.uniform(4e-3, 6e-3, 400)
    )
    truth = fit_expectation(features, np.ones(400), np.arange(400), 350.0, 1.0)
    truth = truth._replace(coefficients=dict(zip(POLYNOMIAL_TERMS, 0.8 / 2.0 ** np.arange(11), strict=True)))
    truth = truth._replace(coefficients={**truth.coefficients, "1": 0.5, "p": -0.05, "z": -1.0})
    expected = expected_restitution(truth, features, 350.0)
    inside = (expected > 0) & (expected < 1)
    chosen = ContactFeatures(*(leaf[inside] for leaf in features))
    fitted = fit_expectation(chosen, expected[inside], np.arange(np.sum(inside)), 350.0, 1e-6)
    again = expected_restitution(fitted, chosen, 350.0)
    assert np.sum(inside) > 300 and np.max(np.abs(again - expected[inside])) < 1e-9


@pytest.mark.slow
def test_calibration_repeats_the_runs_of_a_stored_sweep(tmp_path):
    document = case(2, "response_error")
    manifest = sweep_manifest(document, scenarios=LANES, limit=LIMIT)
    store = open_store(tmp_path / "store", manifest, resume=False)
    run_sweep(store, lambda *_: None, lambda *_: None)
    loaded = check_document(document)
    rows = read_chunk(store, 0)
    assert rows is not None
    (chunk,) = record_selection(loaded, ScenarioSelection(manifest.sampling, manifest.seed, LANES))
    for contact in (1, 2):
        assert chunk.contacts.restitution[contact - 1, :32] == pytest.approx(
            rows[f"restitution_{contact}"], abs=1e-12
        )
    done = []
    limits, rates = calibrate(loaded, store, progress=done.append)
    assert sum(done) == LANES and rates["limit"] == LIMIT and rates["calibrated_on"]["scenarios"] == LANES
    assert limits["equivalent_mass"] == loaded.mechanism.bodies.mass
    with pytest.raises(InputError, match="--scenarios: found 129, expected at most 128"):
        calibrate(loaded, store, scenarios=129)
    with pytest.raises(InputError, match="gains_sha256"):
        calibrate(ONE_SIDED, store)


@pytest.mark.slow
def test_calibrated_watchdog_misses_no_bad_run_in_a_hundred_thousand_scenarios():
    parsed = load("claw-350kg").mechanism
    law = literature_gains(parsed, "response_error")
    law |= {"response_error": 0.93 * law["response_error"], "phase_lead": 1.1 * law["phase_lead"]}
    loaded = check_document(build_document("response_error", law, parsed, "0" * 64, {}, {}, 0, {}))
    limit = 0.05
    limits, rates = calibrate(loaded, scenarios=100_000, limit=limit)
    print(rates)
    false, missed = rates["false_alarms"], rates["missed_alarms"]
    assert false["runs"] + missed["runs"] > 60_000 and missed["runs"] > 10_000
    assert missed["alarms"] == 0 and missed["high"] < 5e-4
    assert false["high"] < 1e-4
    # Compare with verdicts of the controller itself on other draws.
    rules, distance = build_audit_rules(loaded)
    controller = limited_controller(loaded, build_limits_section(limits))
    (chunk,) = record_selection(loaded, ScenarioSelection("random", 1, 1024))
    evaluated = evaluate_runs(chunk, rules, distance)
    error = np.abs(evaluated.error[0])
    for lane in range(1024):
        tripped = replay_lane(controller, chunk.signals, lane, rules.mass)
        assert (tripped is not None) >= (not error[lane] <= limit)
        assert (tripped is None) >= (error[lane] <= limit / 2)


def signals(**columns):
    """Return the signals of one lane."""
    columns = {name: np.array(values, float)[:, None] for name, values in columns.items()}
    shape = next(iter(columns.values())).shape
    live, begins = np.ones(shape, bool), np.zeros(shape, bool)
    begins[0] = True
    every: dict = {name: columns.get(name, np.zeros(shape)) for name in RecordedSignals._fields[:6]}
    return RecordedSignals(**every, live=live, begins=begins)


def test_run_extremes_are_largest_and_smallest_signal_values():
    made = signals(
        force=[0.0, 0.5, 0.5, 0.5, 7.0, -9.0],
        measured=[-4.0, -3.0, 1.0, 3.0, 3.0, 4.0],
        position=[-4.0, -3.0, 1.0, 3.0, 5.0, 6.0],
        velocity=[1.0, 1.0, 1.0, 1.0, 1.0, -3.0],
        command=[0.0, 1.0, -1.0, 2.0, 0.0, 0.0],
        sent=[-3.0, -2.5, 2.0, 7.0, 6.0, 5.5],
    )
    result = find_signal_extremes(made, period=0.5, clearance=math.inf, free_distance=2.0, settling=0.5)
    expected = {
        "reading": 9.0,
        "measured_lowest": -4.0,
        "measured_highest": 4.0,
        "sent_lowest": -3.0,
        "sent_highest": 7.0,
        "command": 2.0,
        "slew": 6.0,
        "start": 1.0,
        "sent_speed": 10.0,
        "speed": 8.0,
        "acceleration": 8.0,
        "force_stuck": 6.0,
        "position_stuck": 2.0,
        "flight_force": 0.5,
        "flight_spread": 0.0,
    }
    assert {name: float(values[0]) for name, values in result._asdict().items()} == expected


@pytest.mark.parametrize(("force", "travel"), [(0.0, 1.5 + 0.5), (5.0, 1.5 + 0.5 + 0.5 + 0.3 + 0.5)])
def test_travel_without_force_is_counted_only_while_penetration_increases(force, travel):
    """A damped mechanism leaves the contact without force."""
    flat = dict.fromkeys(("position", "velocity", "command", "sent"), [0.0] * 6)
    made = signals(force=[force] * 6, measured=[-1.0, 0.5, 1.0, 0.5, 0.2, 0.7], **flat)
    result = find_signal_extremes(made, period=0.5, clearance=math.inf, free_distance=2.0, settling=0.5)
    assert float(result.force_stuck[0]) == pytest.approx(travel)


def test_calibrated_limits_depend_only_on_good_runs(calibrated):
    _, chunk = calibrated
    rules, distance = build_audit_rules(ONE_SIDED)
    evaluated = evaluate_runs(chunk, rules, distance)
    one = np.arange(len(evaluated.index)) == 5
    limits = compute_guard_limits(ONE_SIDED, evaluated, one, rules, distance)
    assert limits["force_limit"] == 1.5 * np.max(np.abs(chunk.signals.command[chunk.signals.live[:, 5], 5]))


@pytest.mark.parametrize("keywords", [{"scenarios": 1}, {"limit": 0.0}, {"limit": math.nan}])
def test_calibration_rejects_impossible_arguments(keywords):
    with pytest.raises(InputError, match=r"found .*, expected"):
        calibrate(ONE_SIDED, **keywords)
