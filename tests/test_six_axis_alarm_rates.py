"""Six-axis alarm rates in fresh scenarios, without a fault and with an injected fault.

`calibrate_six_axes` computes the limits and states the rates. Fresh scenarios are simulated with the fault in
the loop, and replayed through the C controller with these limits. A wrong mass and a stuck channel are
injected into the replays of good runs. Run with `pytest -m slow -s tests/test_six_axis_alarm_rates.py`.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from c99_cases import COMPILER, NEXT_CONTACT, compiled
from gain_documents import sign
from six_axis_c99 import DRIVER, RESULT, SixAxisBatch, rows_of, write_sources
from six_axis_documents import six_axis_document
from test_six_axis_robustness import delayed

from jaxhil.mechanism.file import load_any
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.controller_record import record_controller
from jaxhil.sixdof.rollout import STATUS_NAMES
from tuning.bundle.bundle import build_limits_section
from tuning.statistics.intervals import binomial_interval
from tuning.verification.six_axis_replay import draw_scenarios, six_axis_loop
from tuning.watchdog.six_axes import ERROR_LIMIT, WRONG_MASS, calibrate_six_axes

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc) on this machine"),
]
CALIBRATED, FRESH, SEED = 256, 128, 7000  # number of calibrated and of fresh scenarios, seed of the latter
LONG_DELAY = 0.01  # unmodelled force delay [s]
CHANNELS = "fx fy fz mx my mz x y z rx ry rz".split()


def with_gain(scenarios, gain):
    """Return scenarios whose force sensor reads the wrench times `gain`."""
    sensor = scenarios.sensor
    matrix = np.broadcast_to(gain * np.eye(6)[..., None], (6, 6, len(scenarios.control_period)))
    return scenarios._replace(sensor=sensor._replace(errors=sensor.errors._replace(crosstalk=matrix)))


def late(scenarios):
    return delayed(scenarios.sensor.delay + LONG_DELAY)(scenarios)


class Alarms:
    """C controller of a gain document, which decides whether it stops a recorded run."""

    def __init__(self, document, folder):
        sources = write_sources(folder, document)
        self.batch = SixAxisBatch(compiled(sources, DRIVER.name, "driver.so", "-O2", "-shared", "-fPIC"))
        self.period = document["control_period"]

    def stops(self, record):
        """Return whether the controller trips in the run, or at the audit after the run."""
        rows = rows_of([np.concatenate([column, column[-1:]]) for column in record[:4]], self.period)
        audit = rows[-1:].copy()
        audit[0, [0, 25]] = NEXT_CONTACT, audit[0, 25] + self.period
        results = self.batch.run(np.ascontiguousarray(np.concatenate([rows, audit])))
        return bool(results[-1, RESULT.index("tripped")])


def wrong_mass(document):
    constants = document["constants"]
    mass = (WRONG_MASS * np.array(constants["mass_matrix"])).tolist()
    inverse = (np.array(constants["inverse_mass"]) / WRONG_MASS).tolist()
    return sign({**document, "constants": {**constants, "mass_matrix": mass, "inverse_mass": inverse}})


def stuck(record, channel, rng, limits):
    """Hold a channel constant, starting at a random tick in the first half of the contact.

    Return the record, and whether the motion after this tick suffices to notice the fault.
    """
    columns = [column.copy() for column in record]
    acts = np.flatnonzero(np.any(record.command != 0, axis=1))
    tick = int(rng.integers(acts[0], acts[0] + max(1, (acts[-1] - acts[0]) // 2)))
    readings = columns[0 if channel < 6 else 3][:, channel % 6]
    readings[tick:] = readings[tick]
    if channel < 6:
        steps = np.linalg.norm(np.diff(record.pose_measured[tick:, :3], axis=0), axis=1)
        name = "force_stuck_travel"
    else:
        steps = np.abs(np.diff(record.pose_desired[tick:, channel % 6]))
        name = "position_stuck_travel" if channel < 9 else "rotation_stuck_travel"
    return type(record)(*columns), np.sum(steps) > limits[name] and readings[tick] != 0


def show(text, missed, runs):
    low, high = binomial_interval(missed, runs)[1:] if runs else (0, 1)
    print(f"{text}: {missed} of {runs} ({low:.2g} to {high:.2g})", flush=True)
    return low, high


@pytest.mark.parametrize("name", ["ring-capture", "petals", "probe-drogue"])
def test_six_axis_alarm_rates_in_fresh_scenarios(name, tmp_path):
    with jax_context():
        document = six_axis_document("impulse_ledger", name)
        loaded = check_document(document, any_axes=True)
        calibration = calibrate_six_axes(loaded, scenarios=CALIBRATED)
        document = sign({**document, "limits": build_limits_section(calibration.limits, 6)})
        plain, wrong = Alarms(document, tmp_path / "plain"), Alarms(wrong_mass(document), tmp_path / "mass")
        fresh = with_gain(draw_scenarios(loaded.mechanism, FRESH, SEED), 1.0)
        loop = six_axis_loop(loaded.mechanism, loaded.compensator, late(fresh))
        gains = {gain: jnp.asarray(value) for gain, value in loaded.gains.items()}

        def recorded(scenarios):
            metrics, records = record_controller(loop, gains, scenarios)
            ended = np.array([STATUS_NAMES[s] in ("rebounded", "captured") for s in metrics.status[0]])
            return np.where(ended, metrics.twist_error[0], np.inf), records

        errors, records = recorded(fresh)
        good = np.flatnonzero(errors <= 0.5 * ERROR_LIMIT)
        faulty = {
            "wrong sign of the wrench": with_gain(fresh, -1.0),
            "wrench twice as large": with_gain(fresh, 2.0),
            "unmodelled force delay of 10 ms": late(fresh),
        }
        missed = {}
        for text, scenarios in faulty.items():
            runs = recorded(scenarios)[1]
            missed[text] = sum(not plain.stops(runs[lane]) for lane in good)
    stated = calibration.rates
    false = sum(plain.stops(records[lane]) for lane in good)
    bad = np.flatnonzero(errors > ERROR_LIMIT)
    unseen = sum(not plain.stops(records[lane]) for lane in bad)
    heavy = sum(not wrong.stops(records[lane]) for lane in good)
    print(f"\n{name}: stated false alarms {stated['false_alarms']}, missed {stated['missed_alarms']}")
    for text, count, runs, rate in (
        ("false alarms", false, len(good), stated["false_alarms"]),
        ("missed, twist error above the limit", unseen, len(bad), stated["missed_alarms"]),
        ("missed, mass 20 % wrong", heavy, len(good), stated["fault_runs"][0]),
    ):
        low, high = show(text, count, runs)
        assert low <= rate["high"] and high >= rate["low"], rate
    for text, count in missed.items():
        show(f"missed, {text}", count, len(good))
    assert missed["wrong sign of the wrench"] == 0
    rng = np.random.default_rng(5)
    for channel, label in enumerate(CHANNELS):
        runs = [stuck(records[lane], channel, rng, calibration.limits) for lane in good]
        missed_runs = [noticeable for run, noticeable in runs if not plain.stops(run)]
        show(f"missed, {label} stuck", len(missed_runs), len(runs))
        assert not any(missed_runs), "the motion suffices to notice the stuck channel"


def test_limits_from_few_draws_stop_more_good_runs():
    with jax_context():
        loaded = check_document(six_axis_document(), any_axes=True)
        few, many = (
            calibrate_six_axes(loaded, scenarios=draws).rates["false_alarms"] for draws in (128, 512)
        )
    for draws, rate in ((128, few), (512, many)):
        show(f"false alarms, probe-drogue, {draws} draws", rate["alarms"], rate["runs"])
    assert many["high"] <= many["allowed"] < few["high"]
    assert few["alarms"] / few["runs"] > many["alarms"] / many["runs"]


def test_doubled_wrench_scale_equals_a_contact_twice_as_stiff():
    """A fixed sensor that reads twice the wrench has the readings of a contact twice as stiff."""
    stiffer = {
        "contact.ring.stiffness": 2e6,
        "latch.hooks.stiffness": {"translation": 16e3, "rotation": 0.0},
        "latch.hooks.damping": {"translation": 600.0, "rotation": 0.0},
    }
    with jax_context():
        records = []
        for changes, gain in (({}, 2.0), (stiffer, 1.0)):
            mechanism = load_any("ring-capture", changes).mechanism
            loaded = check_document(six_axis_document("impulse_ledger", "ring-capture"), any_axes=True)
            scenario = with_gain(draw_scenarios(mechanism, 0, SEED), gain)
            loop = six_axis_loop(mechanism, "impulse_ledger", scenario)
            gains = {name: jnp.asarray(value) for name, value in loaded.gains.items()}
            records.append(record_controller(loop, gains, scenario)[1][0])
    scaled, stiff = records
    for column in ("wrench", "pose_measured", "command"):
        first, second = (getattr(record, column) for record in (scaled, stiff))
        np.testing.assert_allclose(first, second, rtol=0, atol=1e-8 * np.ptp(second))
