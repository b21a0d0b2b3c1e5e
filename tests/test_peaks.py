"""Peaks of sampled curves, interpolated by parabolas between the samples."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.sixdof.peaks import update_peak, zero_peak

# Times with unequal steps [s]; every lane begins at a different index.
TIMES = np.cumsum(np.tile([0.02, 0.03, 0.05], 22))[:, None] + np.linspace(0, 0.02, 5)


@jax.jit
def largest(curve, times, anew):
    """Return the largest values of curves (samples, lanes) sampled at the given times."""

    def take(carry, given):
        peak, before = carry
        value, time, new = given
        return (update_peak(peak, value, time - before, new), time), None

    (peak, _), _ = jax.lax.scan(
        take, (zero_peak(jnp.zeros_like(times[0])), 0 * times[0]), (curve, times, anew)
    )
    return peak.largest


def test_peak_between_unequally_spaced_samples_is_interpolated_by_parabola():
    """The error for a sine is 2e-5, compared with 6e-4 for the largest sample."""
    never = np.zeros_like(TIMES, bool)
    parabola, sine = np.maximum(2.0 - (TIMES - 1.01) ** 2, 0.0), np.maximum(np.sin(2 * TIMES), 0.0)
    np.testing.assert_allclose(largest(parabola, TIMES, never), 2.0, rtol=1e-12)
    np.testing.assert_allclose(largest(sine, TIMES, never), 1.0, rtol=2e-5)
    assert sine.max(axis=0).min() < 1 - 6e-4


def test_peak_is_not_interpolated_across_a_jump():
    curve = np.array([[1.0, 1.0, 0.0], [1.1, 1.1, 3.0], [3.0, 3.0, 2.5], [2.5, 2.5, 0.0]])
    times = np.arange(1.0, 5.0)[:, None] + np.zeros(3)
    jumps = np.zeros_like(curve, bool)
    jumps[2, 0] = True
    result = largest(curve, times, jumps)
    assert result[0] == 3.0 and result[1] > 3.1 and result[2] == 3.0
