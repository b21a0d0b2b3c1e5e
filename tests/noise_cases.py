"""Noise amplification of a compensator: closed form compared with the rig's controller."""

from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from lanes import QUICK
from scipy.signal import bilinear, lfilter

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import KnownConstants
from jaxhil.rig import COMPENSATORS as ON_THE_RIG

LONG = 4000  # so many that every filter has settled [ticks]


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def _amplified(name, gains, period):
    def value(gains):
        return COMPENSATORS[name].noise_amplification(gains, KnownConstants(period, jnp.asarray(jnp.inf)))

    return value(gains), jax.jacfwd(value)(gains)


def runtime_commands(name: str, gains: Mapping[str, float], forces: np.ndarray, period: float) -> np.ndarray:
    """Return F_c [N] of the runtime for these force readings [N], out of contact."""
    law = ON_THE_RIG[name](gains, period, np.inf)
    return np.array([law.step(force, -1.0, 0.0, -1.0) for force in forces.tolist()])


def check_amplification(name: str, cases: Sequence[Mapping[str, float]], period: float = 1e-3) -> None:
    """Check `noise_amplification` of a compensator that filters only the force.

    The amplification equals the root of the sum of squares of the runtime's impulse response and the standard
    deviation of filtered white noise. Its derivatives equal finite differences.
    """
    noise = np.random.default_rng(2).normal(size=60_000)
    impulse = np.zeros(LONG)
    impulse[0] = 1.0
    for number, case in enumerate(cases):
        arrays = {gain: jnp.asarray(value, float) for gain, value in case.items()}
        ours, slopes = _amplified(name, arrays, jnp.asarray(period))
        response = runtime_commands(name, case, impulse, period)
        assert abs(response[-1]) < 1e-12
        np.testing.assert_allclose(ours, np.sqrt(np.sum(response**2)), rtol=1e-10)
        if number == 0:
            made = runtime_commands(name, case, noise, period)
            np.testing.assert_allclose(np.std(made), ours, rtol=0.02)
        for gain, value in case.items():
            step = 1e-5 * abs(value) or 1e-8
            low, high = (
                _amplified(name, {**arrays, gain: jnp.asarray(value + h)}, jnp.asarray(period))[0]
                for h in (-step, step)
            )
            np.testing.assert_allclose(slopes[gain], (high - low) / (2 * step), rtol=1e-6, atol=1e-6)


def amplification(gains, period=1e-3):
    """Return the root of the sum of squares of the lead filter's impulse response, filtered by SciPy."""
    lead, smoothing = gains
    numerator, denominator = bilinear([lead + smoothing, 1], [smoothing, 1], 1 / period)
    impulse = np.zeros(3000)
    impulse[0] = 1
    return np.sqrt(np.sum(lfilter(numerator, denominator, impulse) ** 2))
