"""Contact model in JAX: batched version of `rig.py` in this folder.

`rig.py` states model, equations, arguments and sources. The first axis of an array contains the parameters.
"""

import math
from functools import reduce
from operator import add
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxhil.laws.impulse_ledger.contact_model import rig
from jaxhil.laws.impulse_ledger.contact_model.rig import DAMPING, DELAY, DISSIPATIVE, PARAMETERS, PRELOAD


class ContactModelEstimate(NamedTuple):
    """Recursive least-squares estimate of theta, the parameters of the contact model in `rig.py`."""

    mean: Float[Array, "parameters *batch"]  # posterior mean without constraints
    covariance: Float[Array, "parameters parameters *batch"]  # posterior covariance without constraints
    theta: Float[Array, "parameters *batch"]  # posterior mean with dissipative parameters >= 0
    squares: Float[Array, "*batch"]  # sum of squared innovations, each divided by its variance
    count: Float[Array, "*batch"]  # number of readings in the estimate


class DelayEstimate(NamedTuple):
    """Estimate of the true minus an assumed force delay."""

    mean: Float[Array, "*batch"]  # s
    variance: Float[Array, "*batch"]  # s^2


def prior(stiffness: Array, spreads: list[Array], delay_variance: Array) -> tuple[Array, Array]:
    """Return prior means and variances of the parameters; arguments as in `rig.ContactModel.restart`."""
    variances = [spreads[k] ** 2 * factor for k, factor in zip(rig.SPREAD_INDICES, rig.FACTORS, strict=True)]
    mean = jnp.stack([stiffness, *[jnp.zeros_like(stiffness)] * (PARAMETERS - 1)])
    return mean, jnp.stack([*variances, delay_variance])


def begin(mean: Array, variances: Array) -> ContactModelEstimate:
    """Return the estimate before a contact from the prior means and variances."""
    zeros = jnp.zeros_like(mean[0])
    identity = np.eye(PARAMETERS, dtype=bool).reshape(PARAMETERS, PARAMETERS, *[1] * zeros.ndim)
    return ContactModelEstimate(mean, jnp.where(identity, variances[None], 0), mean, zeros, zeros)


def features(depth: Array, speed: Array, deepest: Array, delay_effect: Array) -> Array:
    """Return the regressor phi: phi.theta is the force for the parameters theta. Out of contact, phi is 0."""
    hinges = [jnp.where(depth > knot, depth - knot, 0) for knot in rig.KNOTS]
    turning = speed / jnp.sqrt(speed * speed + rig.MIN_SLIDING_SPEED * rig.MIN_SLIDING_SPEED)
    losses = [speed, depth * speed / rig.REACH, jnp.where(depth < deepest, depth - deepest, 0), turning]
    return jnp.where((depth > 0)[None], jnp.stack([*hinges, *losses, jnp.ones_like(depth), delay_effect]), 0)


def slope(theta: Array, depth: Array) -> Float[Array, "*batch"]:
    """Return the contact model's stiffness per unit mass [1/s^2], at least 0."""
    slopes = [jnp.where(depth > knot, hinge, 0) for hinge, knot in zip(theta, rig.KNOTS, strict=False)]
    total = reduce(add, slopes)
    return jnp.where(total > 0, total, 0)


def damping(theta: Array, depth: Array) -> Float[Array, "*batch"]:
    """Return the contact model's damping per unit mass [1/s]."""
    return jnp.where(depth > 0, theta[DAMPING] + theta[rig.DEPTH_DAMPING] * depth / rig.REACH, 0)


def learn(
    old: ContactModelEstimate, phi: Array, force: Array, variance: Array, used: Bool[Array, "*batch"]
) -> ContactModelEstimate:
    """Update the estimate in the lanes `used` with one force reading [1/s] and its noise variance [1/s^2].

    The reading is divided by mass and approach speed.
    """
    column = reduce(add, (old.covariance[j] * phi[j][None] for j in range(PARAMETERS)))
    total = variance + dot(phi, column)
    used = used & (total > 0)  # false if the covariance is not positive because of rounding
    share = jnp.where(used, 1 / jnp.where(used, total, 1), 0)
    error = force - dot(phi, old.mean)
    return ContactModelEstimate(
        old.mean + column * (share * error)[None],
        old.covariance - (share[None] * column)[:, None] * column[None],
        old.theta,
        old.squares + share * (error * error),
        old.count + jnp.where(used, 1, 0),
    )


def conclude(
    estimate: ContactModelEstimate, prior_variances: Array, delay: Array
) -> Float[Array, "parameters *batch"]:
    """Return theta, the estimated parameters for a known `delay` [s] and non-negative dissipation."""
    rows = [estimate.covariance[j] for j in rig.CONCLUDED]
    mean, rows = _observe(estimate.mean, rows, len(DISSIPATIVE), DELAY, rig.EXACT * delay, rig.EXACT)
    for row, index in enumerate(DISSIPATIVE):
        is_zero = (mean[index] < 0) & (mean[index] ** 2 < rig.ZERO_SIGMAS**2 * rows[row][index])
        mean, rows = _observe(mean, rows, row, index, 0.0, jnp.where(is_zero, rig.EXACT, 0))
    theta, _ = _dissipate(mean, rows, DAMPING, prior_variances, True)
    signed = theta[DAMPING:PRELOAD]
    return jnp.concatenate([theta[:DAMPING], jnp.where(signed > 0, signed, 0), theta[PRELOAD:]])


def estimate_delay(
    estimate: ContactModelEstimate, prior_mean: Array, variances: Array, preload: Array, preload_spread: Array
) -> DelayEstimate:
    """Estimate the delay d after a contact."""
    used = np.array(rig.DELAY_PARAMETERS)
    mean, rows = estimate.mean[used], list(estimate.covariance[used][:, used])
    last = len(DISSIPATIVE)  # index of the delay
    for index, j, value, spread in (
        (last + 1, 0, *rig.WIDE_STIFFNESS),
        (last + 2, PRELOAD, preload, preload_spread),
    ):
        old, new = 1 / jnp.maximum(variances[j], rig.MIN_VARIANCE), 1 / spread**2
        mean, rows = _observe(mean, rows, index, index, new * value - old * prior_mean[j], new - old)
    excess = rig.SURPLUS * jnp.maximum(estimate.squares / jnp.maximum(estimate.count, 1.0), 1.0)
    lossy, lossy_rows = _dissipate(mean, rows, 0, variances, False)
    evidence = 0.0
    for index in range(last):
        variance = jnp.maximum(rows[index][index], rig.MIN_VARIANCE)
        ratio = jnp.maximum(variances[DAMPING + index], rig.MIN_VARIANCE) / variance
        evidence += 0.5 * (jnp.log(ratio) - mean[index] ** 2 / (variance * excess))
        mean, rows = _observe(mean, rows, index, index, 0.0, rig.EXACT)
    odds = jnp.exp(jnp.clip(evidence, -50, 50))  # odds of an elastic contact, from the readings alone
    share = rig.ELASTIC_ODDS * odds / (1 + rig.ELASTIC_ODDS * odds)
    difference = mean[last] - lossy[last]
    delay = lossy[last] + share * difference
    share = odds / (1 + odds)  # without the prior odds, which must not affect the variance
    variance = lossy_rows[last][last] + share * (rows[last][last] - lossy_rows[last][last])
    variance = variance + share * (1 - share) * difference**2
    usable = (variance > 0) & (variance < variances[DELAY])
    variance, before = jnp.where(usable, variance, 1), jnp.where(usable, variances[DELAY], 1)
    weakened = 1 / (1 / before + (1 / variance - 1 / before) / excess**2)
    delay = jnp.where(usable, weakened * delay / variance / excess**2, 0)
    return DelayEstimate(delay, jnp.where(usable, weakened, variances[DELAY]))


def _dissipate(
    mean: Array, rows: list[Array], first: int, prior_variances: Array, certain: bool
) -> tuple[Array, list[Array]]:
    """Constrain the dissipative parameters to be >= 0; return the new mean and the new covariance rows."""
    for row in range(len(DISSIPATIVE)):
        index = first + row
        variance = jnp.maximum(rows[row][index], rig.MIN_VARIANCE)
        expected, left = zero_or_positive(mean[index], variance, prior_variances[DAMPING + row])
        old, new = 1 / variance, rig.EXACT if certain else 1 / jnp.maximum(left, 1 / rig.EXACT)
        mean, rows = _observe(mean, rows, row, index, new * expected - old * mean[index], new - old)
    return mean, rows


def _observe(
    mean: Array, rows: list[Array], row: int, index: int, information: Array | float, precision: Array | float
) -> tuple[Array, list[Array]]:
    """Condition a normal distribution on an observation of one parameter; return mean and covariance rows."""
    observed = rows[row]
    total = 1 + precision * observed[index]
    share = jnp.where(total > 0, 1 / jnp.where(total > 0, total, 1), 0)
    mean = mean + observed * (share * (information - precision * mean[index]))[None]
    return mean, [target - (share * precision * target[index])[None] * observed for target in rows]


def zero_or_positive(mean: Array, variance: Array, prior_variance: Array) -> tuple[Array, Array]:
    """Return mean and variance of a parameter >= 0 that is 0 with prior probability `ZERO_PROBABILITY`."""
    spread = jnp.sqrt(variance)
    ratio = mean / spread
    size = jnp.abs(ratio)
    mills = math.pi / ((math.pi - 1) * size + jnp.sqrt(size * size + 2 * math.pi))
    density = jnp.exp(-0.5 * (size * size)) / math.sqrt(2 * math.pi)
    hazard = jnp.where(ratio > 0, density / (1 - density * mills), 1 / mills)
    share = 1 / (1 + rig.ODDS * jnp.sqrt(prior_variance / variance) * hazard)
    positive = ratio + hazard
    expected = share * spread * positive
    return expected, share * variance * (1 + ratio * positive) - expected * expected


def dot(left: Array, right: Array) -> Array:
    """Return the sum of products along the first axis, added term by term.

    XLA fuses these additions with the loop over the lanes; a reduction would be a separate loop.
    """
    return reduce(add, (left[j] * right[j] for j in range(len(left))))
