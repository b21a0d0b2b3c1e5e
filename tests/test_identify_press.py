"""Data of a servo-hydraulic press (`data/press_0A.md`): order, lag, delay, and friction."""

from pathlib import Path

import numpy as np
import pytest

from tuning.identification import free_motion, validation
from tuning.identification.records import CampaignTiming, LoggedRun

PERIOD = 0.001
PUBLISHED = 183.8, 48.6  # poles of the model without delay that was published with the data [rad/s]


@pytest.fixture(scope="module")
def press():
    with np.load(Path(__file__).parent / "data" / "press_0A.npz") as data:
        command, position = (1e-6 * np.cumsum(data[name].astype(float)) for name in ("command", "position"))
    rows = len(command)
    run = LoggedRun("free", "press_0A", np.arange(rows), 0.0, command, position, None, None, None,
              np.ones(rows, bool), None, None)  # fmt: skip
    return free_motion.fit_free_motion([run], CampaignTiming(PERIOD, "linear", 0, "tick"))


def error(press, response):
    """Return the relative error of a response over 0.3 to 19.5 Hz, averaged over 0.4 Hz to reduce noise."""
    (spectrum,) = press.spectra
    band = (spectrum.frequency > 0.3) & (spectrum.frequency < 19.5)
    frequency = spectrum.frequency[band]
    model_response = response(2j * np.pi * frequency) * np.sinc(frequency * PERIOD) ** 2
    averaged = np.convolve(model_response / spectrum.response[band] - 1.0, np.ones(25) / 25.0, "valid")
    return np.sqrt(np.mean(np.abs(averaged) ** 2))


def test_measured_press_data_are_explained_by_first_order_lag_with_delay(press):
    assert press.model.structure.name == "first_order"
    lag, delay = np.exp(press.model.parameters[0]), press.model.delay
    assert lag == pytest.approx(0.0222, abs=4e-4) and delay == pytest.approx(0.00445, abs=1e-4)
    assert error(press, press.model.response) < 0.012


def test_omitting_delay_from_model_quadruples_fit_error_on_press_data(press):
    fast, slow = PUBLISHED
    assert error(press, lambda s: 1.0 / ((1.0 + s / fast) * (1.0 + s / slow))) > 0.044


def test_friction_in_measured_press_data_is_detected(press):
    misfit = validation.check_motion_model(press, 3.0)[0]
    assert misfit.name == "motion model" and misfit.is_significant and misfit.effect > 0.01
