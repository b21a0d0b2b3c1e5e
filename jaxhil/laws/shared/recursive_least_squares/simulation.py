"""Weighted recursive least squares with forgetting, for contact stiffness and damping in real time.

The model is F = k d + b v; the weight of a reading is 0 (outside contact) to 1. The covariance is stored as P
= U D U^T, U = [[1, u], [0, 1]], D = diag(d_1, d_2) (Bierman 1977), which remains positive for any initial
covariance. d_1 and d_2 never exceed their initial values: a contact at rest has no information on the
damping, and forgetting would increase the variance of the damping without limit. With d_2 = 0 the damping
keeps its initial value, and only the stiffness is identified.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class ContactEstimate(NamedTuple):
    """Estimate of contact stiffness and damping, theta = (k, b), with its covariance P = U D U^T."""

    stiffness: Float[Array, "*batch"]  # k [N/m]
    damping: Float[Array, "*batch"]  # b [N s/m]
    coupling: Float[Array, "*batch"]  # u [1/s]
    stiffness_variance: Float[Array, "*batch"]  # d_1 [1/m^2], relative to the force's variance
    damping_variance: Float[Array, "*batch"]  # d_2 [s^2/m^2], relative to the force's variance


def update_estimate(
    old: ContactEstimate,
    forgetting: Array,
    initial_variances: tuple[Array, Array],
    deflection: Array,
    rate: Array,
    force: Array,
    weight: Array,
) -> ContactEstimate:
    """Update the estimate with one reading: deflection [m], rate [m/s], force F [N] and weight w [1].

    For theta = (k, b), its covariance P, phi = (deflection, rate) and lambda_w = 1 - w (1 - `forgetting`),
    the recursion is K = w P phi/(lambda_w + w phi^T P phi), theta += K (F - phi^T theta),
    P = (P - K phi^T P)/lambda_w. It minimises the sum of all w (F - phi^T theta)^2, in which each new reading
    multiplies the earlier terms by its lambda_w. With w = 0, nothing changes. `initial_variances` are the
    upper bounds of d_1 and d_2 in P = U diag(d_1, d_2) U^T.
    """
    factor = 1 - weight * (1 - forgetting)
    f_1 = deflection
    f_2 = old.coupling * deflection + rate
    g_1 = weight * old.stiffness_variance * f_1
    g_2 = weight * old.damping_variance * f_2
    alpha_1 = factor + f_1 * g_1
    alpha_2 = alpha_1 + f_2 * g_2
    inverse_1, inverse_2 = 1 / alpha_1, 1 / alpha_2
    step = (force - (old.stiffness * deflection + old.damping * rate)) * inverse_2
    variances = (old.stiffness_variance * inverse_1, old.damping_variance * alpha_1 * inverse_2 / factor)
    bounded = [jnp.where(d < most, d, most) for d, most in zip(variances, initial_variances, strict=True)]
    return ContactEstimate(
        stiffness=old.stiffness + (g_1 + g_2 * old.coupling) * step,
        damping=old.damping + g_2 * step,
        coupling=old.coupling - g_1 * f_2 * inverse_1,
        stiffness_variance=bounded[0],
        damping_variance=bounded[1],
    )
