"""Effect of the drives' hold on the commands between ticks, in the frequency domain.

A command is one number per tick. The drives hold it (`zoh`) or interpolate linearly to it (`linear`). Its
spectrum repeats at every multiple of the tick rate, and the hold weights these copies. The spectrum of the
sensor readings at the ticks is the sum over the copies, each multiplied by the rig's response at the
frequency of the copy:

    Y(f) = X_d(f) sum_m H(2 pi j f_m) h(f_m),    f_m = f + m / T,

with h = sinc^2(f T) e^{-s L T} for linear interpolation and h = sinc(f T) e^{-s (L - 1/2) T} for the
zero-order hold, and a latency of L periods. Few copies matter, because a motion simulator passes little at
the tick rate.
"""

import numpy as np

SPECTRAL_COPIES = 3  # on either side of the base band


def compute_copy_frequencies(frequency: np.ndarray, period: float) -> np.ndarray:
    """Return the frequency f + m / T [Hz] of every copy m, shape (copies, lines)."""
    return frequency + np.arange(-SPECTRAL_COPIES, SPECTRAL_COPIES + 1)[:, None] / period


def compute_hold_response(
    frequency: np.ndarray, period: float, hold: str, latency: int, shift: int = 0
) -> np.ndarray:
    """Return the complex response h from the logged command to the drives' input at each frequency [Hz].

    It includes the `shift` [periods] by which the readings of a row lag its command.
    """
    line = np.sinc(frequency * period)
    periods = latency + shift - (0.5 if hold == "zoh" else 0.0)
    return (line if hold == "zoh" else line**2) * np.exp(-2j * np.pi * frequency * periods * period)
