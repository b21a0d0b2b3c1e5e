"""Contact model in JAX: batched estimate, force and features of `rig.py` in this folder.

`rig.py` states model, equations and sources. The first axis of the arrays is that of the parameters.
"""

import math
from functools import reduce
from operator import add
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.contact_model.rig import (
    BROAD,
    DAMPING,
    DELAY,
    DELAY_PARAMETERS,
    DEPTH_DAMPING,
    DISSIPATIVE,
    ELASTIC_ODDS,
    EXACT,
    FRICTION,
    KNOTS,
    LEAST_VARIANCE,
    ODDS,
    PARAMETERS,
    PRELOAD,
    REACH,
    SLOW,
    SURPLUS,
    UNLOADING,
    WANDER,
    WIDE_STIFFNESS,
)


class Estimate(NamedTuple):
    """Estimate of the parameters theta."""

    mean: Float[Array, "parameters *batch"]  # posterior mean, dissipative parameters of either sign
    covariance: Float[Array, "parameters parameters *batch"]
    theta: Float[Array, "parameters *batch"]  # posterior mean, dissipative parameters zero or positive
    squares: Float[Array, "*batch"]  # sum of squared innovations over their variances
    count: Float[Array, "*batch"]  # number of readings


def prior(stiffness: Array, spreads: tuple[Array, ...], delay_variance: Array) -> tuple[Array, Array]:
    """Return prior mean and variances; the arguments are those of `ContactModel.restart` in `rig.py`."""
    common, wander, *rest = spreads
    changes = (np.diff(np.minimum(KNOTS, BROAD)) / WANDER).tolist()
    variances = [common**2, *(wander**2 * change for change in changes), *(spread**2 for spread in rest)]
    variances.append(delay_variance)
    mean = jnp.stack([stiffness, *[jnp.zeros_like(stiffness)] * (PARAMETERS - 1)])
    return mean, jnp.stack(variances)


def begin(mean: Array, variances: Array) -> Estimate:
    """Return the estimate before contact, from the prior's mean and variances."""
    zeros = jnp.zeros_like(mean[0])
    identity = np.eye(PARAMETERS, dtype=bool).reshape(PARAMETERS, PARAMETERS, *[1] * zeros.ndim)
    return Estimate(mean, jnp.where(identity, variances[None], 0), mean, zeros, zeros)


def features(depth: Array, speed: Array, deepest: Array, delay_effect: Array) -> Array:
    """Return the features phi, so that the force is phi.theta; zeros out of contact."""
    back = depth - deepest
    hinges = [jnp.where(depth > knot, depth - knot, 0) for knot in KNOTS]
    turning = speed / jnp.sqrt(speed * speed + SLOW * SLOW)
    back = jnp.where(back < 0, back, 0)
    losses = [speed, depth * speed / REACH, back, turning]
    return jnp.where((depth > 0)[None], jnp.stack([*hinges, *losses, jnp.ones_like(depth), delay_effect]), 0)


def force(theta: Array, depth: Array, speed: Array, deepest: Array) -> Float[Array, "*batch"]:
    """Return the force [1/s] of the parameters `theta`."""
    back = depth - deepest
    total = theta[PRELOAD]
    for hinge, knot in zip(theta, KNOTS, strict=False):
        total = total + hinge * jnp.where(depth > knot, depth - knot, 0)
    total = total + (theta[DAMPING] + theta[DEPTH_DAMPING] * depth / REACH) * speed
    total = total + theta[UNLOADING] * jnp.where(back < 0, back, 0)
    total = total + theta[FRICTION] * (speed / jnp.sqrt(speed * speed + SLOW * SLOW))
    return jnp.where(depth > 0, total, 0)


def slope(theta: Array, depth: Array) -> Float[Array, "*batch"]:
    """Return the slope [1/s^2] at a depth [s], at least 0."""
    hinges = (jnp.where(depth > knot, hinge, 0) for hinge, knot in zip(theta, KNOTS, strict=False))
    total = reduce(add, hinges)
    return jnp.where(total > 0, total, 0)


def learn(old: Estimate, phi: Array, force: Array, variance: Array, used: Bool[Array, "*batch"]) -> Estimate:
    """Update the estimate, where `used`, with one reading of the force [1/s] of this variance [1/s^2]."""
    column = reduce(add, (old.covariance[j] * phi[j][None] for j in range(PARAMETERS)))
    total = variance + dot(phi, column)
    used = used & (total > 0)  # unless rounding has spoilt the covariance
    share = jnp.where(used, 1 / jnp.where(used, total, 1), 0)
    error = force - dot(phi, old.mean)
    covariance = old.covariance - (share[None] * column)[:, None] * column[None]
    squares = old.squares + share * (error * error)
    count = old.count + jnp.where(used, 1, 0)
    return Estimate(old.mean + column * (share * error)[None], covariance, old.theta, squares, count)


def conclude(estimate: Estimate, prior_variances: Array, delay: Array) -> Float[Array, "parameters *batch"]:
    """Return theta for a known delay [s], with dissipative parameters zero or positive."""
    indices = (DELAY, *DISSIPATIVE)
    rows = [estimate.covariance[j] for j in indices]
    mean, rows = _observe(estimate.mean, rows, 0, DELAY, EXACT * delay, EXACT)
    theta, _ = _dissipate(mean, rows, {j: (k, j) for k, j in enumerate(indices)}, prior_variances, True)
    signed = theta[DAMPING : FRICTION + 1]
    return jnp.concatenate([theta[:DAMPING], jnp.where(signed > 0, signed, 0), theta[PRELOAD:]])


def estimate_delay(
    estimate: Estimate, prior_mean: Array, variances: Array, preload: Array, preload_spread: Array
) -> tuple[Array, Array]:
    """Return mean [s] and variance [s^2] of the delay after a contact; arguments as in `rig.py`."""
    mean = jnp.stack([estimate.mean[j] for j in DELAY_PARAMETERS])
    rows = [jnp.stack([estimate.covariance[i, j] for j in DELAY_PARAMETERS]) for i in DELAY_PARAMETERS]
    for index, j, value, spread in ((0, 0, *WIDE_STIFFNESS), (1, PRELOAD, preload, preload_spread)):
        old, new = 1 / _above(variances[j], LEAST_VARIANCE), 1 / spread**2
        mean, rows = _observe(mean, rows, index, index, new * value - old * prior_mean[j], new - old)
    excess = estimate.squares / jnp.where(estimate.count > 0, estimate.count, 1)
    excess = SURPLUS * jnp.where(excess > 1, excess, 1)
    indices = {j: (index, index) for index, j in enumerate(DELAY_PARAMETERS)}
    lossy, lossy_rows = _dissipate(mean, rows, indices, variances, False)
    evidence = 0.0
    for j in DISSIPATIVE:
        index, _ = indices[j]
        variance = _above(rows[index][index], LEAST_VARIANCE)
        evidence += 0.5 * (
            jnp.log(_above(variances[j], LEAST_VARIANCE) / variance) - mean[index] ** 2 / (variance * excess)
        )
        mean, rows = _observe(mean, rows, index, index, 0.0, EXACT)
    odds = jnp.exp(jnp.clip(evidence, -50, 50))  # of elastic contact by the readings alone
    share = ELASTIC_ODDS * odds / (1 + ELASTIC_ODDS * odds)
    elastic, dissipative = mean[-1], lossy[-1]
    delay = dissipative + share * (elastic - dissipative)
    share = odds / (1 + odds)
    variance = lossy_rows[-1][-1] + share * (rows[-1][-1] - lossy_rows[-1][-1])
    variance = variance + share * (1 - share) * (elastic - dissipative) ** 2
    before = variances[DELAY]
    usable = (variance > 0) & (variance < before)
    variance, before = jnp.where(usable, variance, 1), jnp.where(usable, before, 1)
    weakened = 1 / (1 / before + (1 / variance - 1 / before) / excess**2)
    delay = jnp.where(usable, weakened * delay / variance / excess**2, 0)
    return delay, jnp.where(usable, weakened, variances[DELAY])


def _observe(
    mean: Array,
    rows: list[Array],
    row_index: int,
    index: int,
    information: Array | float,
    precision: Array | float,
) -> tuple[Array, list[Array]]:
    """Return mean and rows of the covariance after an observation of the parameter of that row."""
    row = rows[row_index]
    total = 1 + precision * row[index]
    usable = total > 0
    share = jnp.where(usable, 1 / jnp.where(usable, total, 1), 0)
    later = mean + row * (share * (information - precision * mean[index]))[None]
    weight = share * precision
    return later, [old - (weight * old[index])[None] * row for old in rows]


def _dissipate(
    mean: Array, rows: list[Array], indices: dict[int, tuple[int, int]], prior_variances: Array, certain: bool
) -> tuple[Array, list[Array]]:
    """Return mean and rows of the covariance with dissipative parameters zero or positive.

    `indices` has row and index of each parameter. If `certain`, the parameters count as known afterwards.
    """
    for j in DISSIPATIVE:
        row_index, index = indices[j]
        variance = _above(rows[row_index][index], LEAST_VARIANCE)
        expected, left = zero_or_positive(mean[index], variance, prior_variances[j])
        old, new = 1 / variance, EXACT if certain else 1 / _above(left, 1 / EXACT)
        information = new * expected - old * mean[index]
        mean, rows = _observe(mean, rows, row_index, index, information, new - old)
    return mean, rows


def zero_or_positive(mean: Array, variance: Array, prior_variance: Array) -> tuple[Array, Array]:
    """Return posterior mean and variance of a parameter that is zero with `ZERO_PROBABILITY` or positive.

    Arguments and source are those of the function in `rig.py`.
    """
    spread = jnp.sqrt(variance)
    ratio = mean / spread
    size = jnp.abs(ratio)
    mills = math.pi / ((math.pi - 1) * size + jnp.sqrt(size * size + 2 * math.pi))
    density = jnp.exp(-0.5 * (size * size)) / math.sqrt(2 * math.pi)
    hazard = jnp.where(ratio > 0, density / (1 - density * mills), 1 / mills)
    share = 1 / (1 + ODDS * jnp.sqrt(prior_variance / variance) * hazard)
    positive = ratio + hazard
    expected = share * spread * positive
    return expected, share * variance * (1 + ratio * positive) - expected * expected


def dot(left: Array, right: Array) -> Array:
    """Return the sum of products over the first axis, added term by term.

    The compiler computes this sum within the loop over lanes, but a reduction in a loop of its own.
    """
    return reduce(add, (left[j] * right[j] for j in range(len(left))))


def _above(value: Array, least: float) -> Array:
    """Return the larger of value and `least`."""
    return jnp.where(value > least, value, least)
