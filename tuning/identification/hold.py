"""Frequency response of the command hold, which converts sampled commands to a continuous drive input.

A command is one number per tick. The drives either hold it (`zoh`) or interpolate linearly between two
commands (`linear`). The spectrum X_d of the sampled command repeats at every multiple of the tick rate 1 / T.
The hold (response h) attenuates these spectral images. The spectrum Y of the sampled readings is the sum of
all images, each multiplied by the response H of the rig at the frequency of the image:

    Y(f) = X_d(f) sum_m H(2 pi j f_m) h(f_m),    f_m = f + m / T,

with h = sinc^2(f T) e^{-s L T} for linear interpolation and h = sinc(f T) e^{-s (L - 1/2) T} for the
zero-order hold, and a latency of L periods. Few images matter, because a motion simulator attenuates
frequencies near the tick rate.
"""

import numpy as np

SPECTRAL_IMAGES = 3  # number of spectral images on either side of the base band


def compute_image_frequencies(frequency: np.ndarray, period: float) -> np.ndarray:
    """Return the frequencies f + m / T [Hz] of the spectral images m of all lines, shape (images, lines)."""
    return frequency + np.arange(-SPECTRAL_IMAGES, SPECTRAL_IMAGES + 1)[:, None] / period


def compute_hold_response(
    frequency: np.ndarray, period: float, hold: str, latency: int, shift: int = 0
) -> np.ndarray:
    """Return the complex response from the logged command to the drives' input at each frequency [Hz].

    The response includes the command latency [periods], and the `shift` [periods] by which the readings of a
    row are older than its command.
    """
    attenuation = np.sinc(frequency * period)
    periods = latency + shift - (0.5 if hold == "zoh" else 0.0)
    return (attenuation if hold == "zoh" else attenuation**2) * np.exp(
        -2j * np.pi * frequency * periods * period
    )
