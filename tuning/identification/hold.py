"""What the drives make of the commands between ticks, in the frequency domain.

A command is a number a tick; the drives hold it (`zoh`) or draw a line to it (`linear`). Its spectrum
repeats at every multiple of the tick rate, and the hold weighs the copies. What a sensor reads at the ticks
is the sum over the copies, each through the rig's response at its own frequency:

    Y(f) = X_d(f) sum_m H(2 pi j f_m) h(f_m),    f_m = f + m / T,

with h = sinc^2(f T) e^{-s L T} for the line and sinc(f T) e^{-s (L - 1/2) T} for the step, L periods of
latency. The copies that matter are few: a motion simulator passes little at the tick rate.
"""

import numpy as np

COPIES = 3  # on each side


def frequencies(frequency: np.ndarray, period: float) -> np.ndarray:
    """f + m / T [Hz] of every copy m, shape (copies, lines)."""
    return frequency + np.arange(-COPIES, COPIES + 1)[:, None] / period


def response(frequency: np.ndarray, period: float, hold: str, latency: int, shift: int = 0) -> np.ndarray:
    """h at each frequency [Hz], complex: from the logged command to what the drives follow; the readings of a
    row lag its command by `shift` periods."""
    line = np.sinc(frequency * period)
    periods = latency + shift - (0.5 if hold == "zoh" else 0.0)
    return (line if hold == "zoh" else line**2) * np.exp(-2j * np.pi * frequency * periods * period)
