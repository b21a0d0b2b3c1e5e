"""Identification of the motion simulator by `jaxhil identify` and by other methods on the same free motion.

The other methods need other package versions: install `sippy-unipi`, `nfoursid` and `scikit-rf` in an
environment and name its interpreter in JAXHIL_OTHERS; otherwise they are skipped. Run with `pytest -m
benchmark -s tests/benchmarks/test_identify_others.py`.
"""

import json
import os
import subprocess
import time
from pathlib import Path

import campaigns
import numpy as np
import pytest
from scipy import optimize

from tuning.identification import free_motion
from tuning.identification.hold import compute_hold_response as hold_response
from tuning.identification.rational import STRUCTURES, MotionModel

pytestmark = pytest.mark.benchmark
SCRIPT = Path(__file__).with_name("identify_others.py")
TRUE = MotionModel(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
CONTACT = 3.0  # frequency at which the lag is compared [Hz]
AT = np.concatenate([[CONTACT], np.linspace(5.0, 20.0, 301)])


def fit_response(spectrum):
    """Fit the response by unweighted least squares without a model of the command hold."""

    def residuals(parameters):
        model = MotionModel(STRUCTURES[2], np.array([*parameters[:2], 1e-3 * parameters[2]]))
        off = model.response(2j * np.pi * spectrum.frequency) - spectrum.output / spectrum.command
        return np.concatenate([off.real, off.imag])

    solution = optimize.least_squares(residuals, [np.log(60.0), 0.0, 1.0]).x
    return MotionModel(STRUCTURES[2], np.array([*solution[:2], 1e-3 * solution[2]]))


def lag_and_bandwidth_errors(response):
    """Return the errors of the lag at the contact frequency [ms] and of the bandwidth [%]."""

    def lag(values):
        return -np.angle(values[0]) / (2.0 * np.pi * CONTACT)

    exact = TRUE.response(2j * np.pi * AT)
    gain = np.abs(response[1:] / response[0]) * np.abs(exact[0])
    width = np.interp(-np.sqrt(0.5), -gain, AT[1:])
    return 1e3 * (lag(response) - lag(exact)), 100.0 * (width / TRUE.bandwidth() - 1.0)


def test_identify_is_more_accurate_than_other_identification_methods(tmp_path, capsys):
    run = campaigns.campaign("clean", 0, speeds=(), rest=0).runs[0]
    timing = campaigns.campaign("clean", 0, speeds=(), seconds=0, rest=0).timing
    period, rows = timing.control_period, []
    begin = time.process_time()
    ours = free_motion.fit_free_motion([run], timing)
    rows.append(
        ("jaxhil", ours.model.response(2j * np.pi * AT), ours.model.delay, time.process_time() - begin)
    )
    begin = time.process_time()
    hand = fit_response(ours.spectra[0])
    rows.append(
        ("least squares by hand", hand.response(2j * np.pi * AT), hand.delay, time.process_time() - begin)
    )
    interpreter = os.environ.get("JAXHIL_OTHERS")
    if interpreter:
        spectrum, steady = ours.spectra[0], slice(5000, None)
        level = run.position_desired[steady].mean()
        np.savez(tmp_path / "data.npz", command=run.position_desired[steady] - level,
                 reading=run.position_measured[steady] - level, period=period, at=AT,
                 frequency=spectrum.frequency, response=spectrum.output / spectrum.command)  # fmt: skip
        ran = subprocess.run(
            [interpreter, SCRIPT, tmp_path / "data.npz"], capture_output=True, text=True, check=True
        )
        for name, one in json.loads(ran.stdout.splitlines()[-1]).items():
            values = np.array(one["response"]) @ [1.0, 1j]
            # The response from commands to readings includes the command hold.
            hold = hold_response(AT, period, "linear", 0)
            rows.append((name, values / hold, one["delay"], one["seconds"]))
    headings = "lag at 3 Hz [ms]", "bandwidth [%]", "delay [ms]", "time [s]"
    with capsys.disabled():
        print("\nErrors of" + "".join(f"{one:>18s}" for one in headings))
        for name, values, delay, seconds in rows:
            lag, width = lag_and_bandwidth_errors(values)
            off = "none" if delay is None else f"{1e3 * (delay - 0.0043):+.4f}"
            print(f"{name:26s} {lag:+.4f} {width:+17.3f} {off:>17s} {seconds:17.2f}")
    lag, width = lag_and_bandwidth_errors(rows[0][1])
    assert abs(lag) < 0.02 and abs(width) < 0.3 and abs(rows[0][2] - 0.0043) < 2e-5
    delays = [abs(delay - 0.0043) for _, _, delay, _ in rows if delay is not None]
    assert min(delays[1:]) > 5.0 * delays[0]
