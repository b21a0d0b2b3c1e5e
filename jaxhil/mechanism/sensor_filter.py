"""Low-pass filter of the force sensor: poles, and parallel form of the transfer function.

A Butterworth filter has a maximally flat gain, a Bessel filter a maximally flat group delay. The gain of both
is -3 dB at the cutoff frequency w_c. The poles -r_m w_c are distinct, so that the filter is a sum of
first-order lags with complex rates r_m w_c and weights v_m:

    H(s) = prod r_m w_c/(s + r_m w_c) = sum v_m r_m w_c/(s + r_m w_c)
"""

import cmath
import functools
import math
from typing import NamedTuple

import numpy as np

from jaxhil.mechanism.six_axes_rig import ForceSensor as SixAxisForceSensor
from jaxhil.mechanism.structs import ForceSensor, SensorFilter


class FilterModes(NamedTuple):
    """Sum of modes of a filter with the cutoff 1 rad/s: one for each real pole or pair of conjugate poles.

    For the input F, the output is the sum of Re(weights[m] y_m), where dy_m/dt = rates[m] (F - y_m).
    """

    rates: tuple[complex, ...]  # rates of decay [rad/s]; a pole is -rate
    weights: tuple[complex, ...]  # doubled for a pair of poles [1]

    @property
    def slowest(self) -> float:
        """Return the decay rate [1/s] of the slowest mode of the filter with the cutoff 1 rad/s."""
        return min(rate.real for rate in self.rates)

    @property
    def delay(self) -> float:
        """Return the group delay [s] at low frequencies of the filter with the cutoff 1 rad/s."""
        return sum((weight / rate).real for weight, rate in zip(self.weights, self.rates, strict=True))


@functools.cache
def find_modes(kind: str, order: int) -> FilterModes:
    """Compute the modes (parallel form) of a Butterworth or Bessel filter with the cutoff 1 rad/s.

    Args:
        kind: "butterworth" or "bessel".
        order: order of the filter, at least 1.

    Example:
        >>> from jaxhil.mechanism.sensor_filter import find_modes
        >>> round(find_modes("butterworth", 2).delay, 6)
        1.414214
    """
    poles = _bessel_rates(order) if kind == "bessel" else _butterworth_rates(order)
    gain = math.prod(poles, start=1 + 0j)
    rates, weights = [], []
    for index, rate in enumerate(poles):
        if rate.imag < -1e-9:
            continue
        others = [other - rate for i, other in enumerate(poles) if i != index]
        is_real = rate.imag < 1e-9
        rates.append(complex(rate.real) if is_real else rate)
        weights.append(gain / math.prod(others, start=1 + 0j) / rate * (1 if is_real else 2))
    return FilterModes(tuple(rates), tuple(weights))


def low_frequency_delay(sensor_filter: SensorFilter | None) -> float:
    """Return the group delay [s] of a filter at frequencies well below its cutoff; 0 without a filter."""
    if sensor_filter is None:
        return 0.0
    modes = find_modes(sensor_filter.kind, sensor_filter.order)
    return modes.delay / (2 * math.pi * sensor_filter.cutoff)


def settling_constant(sensor: ForceSensor | SixAxisForceSensor) -> float:
    """Return the time constant [s] of a force sensor's lag, or of the slowest mode of its filter."""
    low_pass = sensor.filter
    if low_pass is None:
        return sensor.time_constant
    return 1 / (2 * math.pi * low_pass.cutoff * find_modes(low_pass.kind, low_pass.order).slowest)


def _butterworth_rates(order: int) -> list[complex]:
    """Return the negated poles of a Butterworth filter with the cutoff 1 rad/s, all on the unit circle."""
    return [cmath.exp(1j * math.pi * (2 * k - order + 1) / (2 * order)) for k in range(order)]


def _bessel_rates(order: int) -> list[complex]:
    """Return the negated poles of a Bessel filter (roots of a Bessel polynomial) with the cutoff 1 rad/s."""
    coefficients = np.array(
        [
            math.factorial(2 * order - k)
            // (math.factorial(order - k) * math.factorial(k) * 2 ** (order - k))
            for k in range(order, -1, -1)
        ],
        float,
    )
    poles = np.roots(coefficients)
    # The squared gain is a_0^2/|a(j w)|^2, and |a(j w)|^2 is a polynomial in w^2.
    signs = np.where(np.arange(order, -1, -1) % 2, -1.0, 1.0)
    square = np.polymul(coefficients, coefficients * signs)[::2]
    square = square * np.where(np.arange(order, -1, -1) % 2, -1.0, 1.0)
    square[-1] -= 2 * coefficients[-1] ** 2
    candidates = np.roots(square)
    cutoff = math.sqrt(min(root.real for root in candidates if abs(root.imag) < 1e-9 and root.real > 0))
    return [complex(-pole / cutoff) for pole in poles]
