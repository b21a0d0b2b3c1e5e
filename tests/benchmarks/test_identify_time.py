"""Time of `jaxhil identify` for logs in memory, compared with a general optimiser.

The logs have 60 s of free motion at 1 kHz and 15 contacts. The general optimiser is SciPy's least squares
with finite differences on the same exact motion, without intervals and checks. Times are CPU times. Run with
`pytest -m benchmark -s tests/benchmarks/test_identify_time.py`.
"""

import time
from dataclasses import replace

import campaigns
import numpy as np
import pytest
from scipy import optimize

from tuning.identification.force_readings import ForceReadings
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.motion import MotionResponse

pytestmark = pytest.mark.benchmark
BAR = 10.0  # warm [s]
PRESS_BAR = 15.0  # s
TRUE = np.array([0.0037, 0.0, 1.2e5, 650.0])  # force delay, plane, stiffness, damping
UNITS = np.array([1e-3, 1e-6, 1e5, 100.0])


def fit_by_general_optimiser(campaign, model):
    """Fit the four parameters and the bias by a general optimiser."""
    runs = [run for run in campaign.runs if run.kind == "contact"]
    motion, readings = MotionResponse(model, runs, campaign.timing, 0.022), ForceReadings.of(runs, 0.5)

    def residuals(scaled):
        delay, plane, stiffness, damping = scaled[:4] * UNITS
        position, velocity = motion.at(delay)
        force = stiffness * (position - plane) + damping * velocity
        force = np.where((position > plane) & (force > 0.0), force, 0.0) + scaled[4]
        return ((force - readings.force) / readings.std)[readings.counts]

    start = np.append(TRUE * 1.05 / UNITS, 0.0)
    least, most = [0.0, *[-np.inf] * 4], [20.0, *[np.inf] * 4]
    return optimize.least_squares(residuals, start, x_scale="jac", bounds=(least, most)).x[:4] * UNITS


def test_identify_processes_logs_of_one_day_within_time_limit(capsys):
    campaign = campaigns.campaign("clean", 0)
    options = IdentificationOptions(law="kelvin_voigt")
    identify(campaign, options=options)
    begin = time.process_time()
    result = identify(campaign, options=options)
    took = time.process_time() - begin
    begin = time.process_time()
    identify(campaign)
    every = time.process_time() - begin
    begin = time.process_time()
    numbers = fit_by_general_optimiser(campaign, result.motion.model)
    alone = time.process_time() - begin
    keys = "rig.force_sensor.delay", "contact.damping.0"
    ours = [abs(result[key].value - true) for key, true in zip(keys, TRUE[[0, 3]], strict=True)]
    theirs = np.abs(numbers - TRUE)[[0, 3]]
    with capsys.disabled():
        print(
            f"\nidentify: {took:.2f} s with the law told, {every:.2f} s with all laws tried; "
            f"general optimizer on the touches: {alone:.2f} s\n"
            f"errors of force delay and damping: {1e3 * ours[0]:.3f} ms and {ours[1]:.1f} N s/m; "
            f"general optimizer: {1e3 * theirs[0]:.3f} ms and {theirs[1]:.1f} N s/m"
        )
    assert max(took, every) < BAR


def test_identify_processes_a_long_press_run_within_time_limit(capsys):
    """Include a lagging force sensor and a press run of 40 s with 43,000 readings in contact."""
    kind, campaign = campaigns.KINDS["lagging"], campaigns.campaign("lagging", 0)
    press = campaigns._press_run(kind, np.random.default_rng(0), seconds=40.0)
    begin = time.process_time()
    result = identify(replace(campaign, runs=(*campaign.runs, press)))
    took = time.process_time() - begin
    with capsys.disabled():
        print(f"\nidentify with a press of 40 s behind a lag: {took:.1f} s; {result.verdict}")
    assert took < PRESS_BAR
