"""Model of a motion simulator that averages its command over a window, as the drives of industrial robots do.

    H(s) = (1 - e^{-s W}) / (s W) e^{-s tau}

The window W and the delay tau are fitted if the prior states this kind of motion simulator. At low
frequencies, the spectra determine only the sum W / 2 + tau; the attenuation at higher frequencies determines
the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tuning.identification.rational import (
    MotionModel,
    SimulatorStructure,
    SpectralLines,
    estimate_low_frequency_delay,
)

MIN_WINDOW_PERIODS, WINDOW_GRID_SIZE = 2.0, 60  # shortest window in a first search, and number of windows
MAX_WINDOW_RATIO = 1.1  # longest window in a first search, divided by the window for which the delay is 0
MIN_SPECTRUM = 1e-12  # smallest magnitude of 1 - e^{-s W}, so that derivatives at its zeros are finite


@dataclass(frozen=True)
class MovingAverageStructure(SimulatorStructure):
    """Structure of moving-average models, with the parameters log(window [s]) and delay [s]."""

    def make_model(self, parameters: np.ndarray) -> MotionModel:
        """Return the moving-average model with the given parameters."""
        return MovingAverageModel(self, parameters)

    def make_starts(self, lines: SpectralLines) -> list[tuple[float, np.ndarray]]:
        """Return starting points of a fit: chi-squared and parameters of models with different windows.

        In each model, the delay plus half the window equals the measured delay at low frequencies.
        """
        total = estimate_low_frequency_delay(lines)
        longest = MAX_WINDOW_RATIO * max(2.0 * total, 2.0 * MIN_WINDOW_PERIODS * lines.period)
        starts = []
        for window in np.geomspace(MIN_WINDOW_PERIODS * lines.period, longest, WINDOW_GRID_SIZE):
            parameters = np.array([np.log(window), total - 0.5 * window])
            misfit = np.abs(self.make_model(parameters).predict(lines) - lines.output) / lines.std
            starts.append((float(np.sum(misfit**2)), parameters))
        return starts


class MovingAverageModel(MotionModel):
    """Model that averages the command over a window W [s] and delays it; parameters: log W, delay [s]."""

    @property
    def window(self) -> float:
        """Return the time span over which the command is averaged [s]."""
        return float(np.exp(self.parameters[0]))

    @property
    def memory(self) -> float:
        return self.window

    @property
    def names(self) -> list[str]:
        return ["window", "delay"]

    @cached_property
    def fraction(self) -> tuple[np.ndarray, np.ndarray]:
        """Return numerator 1 and denominator 1, because a moving average has no rational factor."""
        return np.ones(1), np.ones(1)

    def response(self, s: np.ndarray) -> np.ndarray:
        return self._spectrum(s) / (s * self.window) * np.exp(-s * self.delay)

    def slopes(self, s: np.ndarray) -> np.ndarray:
        product = s * self.window
        return np.array([product * np.exp(-product) / self._spectrum(s) - 1.0, -s])

    def bandwidth(self) -> float:
        """Return the -3 dB bandwidth f [Hz]: sin(pi f W) / (pi f W) = 1 / sqrt(2) for the window W [s]."""
        return 0.442946 / self.window

    def _spectrum(self, s: np.ndarray) -> np.ndarray:
        values = -np.expm1(-s * self.window)
        return np.where(np.abs(values) < MIN_SPECTRUM, MIN_SPECTRUM, values)


MOVING_AVERAGE = MovingAverageStructure("moving_average", 1, 0, 0)
