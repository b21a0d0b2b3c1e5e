"""Which gains matter: how far each may move before the objective rises by a given share of itself.

`sensitivity` reads off the residuals' Jacobian at the optimum which combinations of gains the objective holds
firmly (stiff) and which it leaves open (sloppy); `freedom` tries it out, gain by gain, kinks and all.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RISE = 0.01  # of the loss, that a gain's freedom is measured by
STIFF = 0.1  # of the box: directions that may move no further are stiff
SMALLEST = 1e-4  # of the range: the first step of `freedom`


class Sensitivity(NamedTuple):
    """What the Jacobian says of each gain and of each direction in the space of gains; see `sensitivity`.

    values: singular values of J, falling; directions: unit vectors, one per row, of the same order; radius
    of the region along each; stiff_share: of each gain, 0 (sloppy) to 1; alone, together: how far each gain
    may move, as a share of its range; correlation between gains.
    """

    values: Float[np.ndarray, "gains"]
    directions: Float[np.ndarray, "gains gains"]
    radius: Float[np.ndarray, "gains"]
    stiff_share: Float[np.ndarray, "gains"]
    alone: Float[np.ndarray, "gains"]
    together: Float[np.ndarray, "gains"]
    correlation: Float[np.ndarray, "gains gains"]


def sensitivity(
    jacobian: Float[np.ndarray, "residuals gains"],
    loss: float,
    rise: float = RISE,
) -> Sensitivity:
    """Which gains the objective L = |r|^2 / 2 holds at its optimum, and which it leaves open.

    `jacobian` is J = dr/du, u each gain as a share of its range. Around the optimum

        L(u + d) = L (1 + d^T A d rise),    A = J^T J / (2 rise L)

    so that d^T A d <= 1 is where L rises by no more than `rise` of itself. No gain moves by more than its
    range, whatever the objective says: B = A + 1 in place of A. With the singular values s_i of J and its
    right singular vectors v_i:

        radius_i = (s_i^2 / (2 rise L) + 1)^(-1/2)         the region's half axis along v_i
        stiff_share_p = sum of v_ip^2 over directions with radius < `STIFF`
        alone_p = B_pp^(-1/2)                              the others held
        together_p = ((B^-1)_pp)^(1/2)                     the others moved along, at their best
        correlation_pq = (B^-1)_pq / (together_p together_q)

    A gain with `together` near one is of no account or made up for by others; `alone` tells which. Kinks of
    the objective are not seen here: `freedom` sees them.

    Source: Transtrum, Machta, Sethna, "Geometry of nonlinear least squares with applications to sloppy
    models and optimization", Phys. Rev. E 83, 036701 (2011).
    """
    gains = jacobian.shape[1]
    # Fewer residuals than gains leave directions that nothing depends on.
    padded = np.concatenate([jacobian, np.zeros((max(0, gains - len(jacobian)), gains))])
    _, values, directions = np.linalg.svd(padded, full_matrices=False)
    scale = 2 * rise * max(loss, np.finfo(float).tiny)
    radius = 1 / np.hypot(values / np.sqrt(scale), 1)
    covariance = (directions.T * radius**2) @ directions
    together = np.sqrt(np.diag(covariance))
    return Sensitivity(
        values=values,
        directions=directions,
        radius=radius,
        stiff_share=np.sum(directions[radius < STIFF] ** 2, axis=0),
        alone=1 / np.sqrt(np.sum(jacobian**2, axis=0) / scale + 1),
        together=together,
        correlation=covariance / np.outer(together, together),
    )


def freedom(
    losses: Callable[[Float[np.ndarray, "candidates gains"]], Float[np.ndarray, "candidates"]],
    optimum: Float[np.ndarray, "gains"],
    *,
    rise: float = RISE,
    steps: int = 16,
) -> Float[np.ndarray, "2 gains"]:
    """How far down (row 0) and up (row 1) each gain alone can move from `optimum`, as a share of its range,
    before the loss rises by more than `rise` of itself.

    Found by trying: distances on a logarithmic ladder from a ten-thousandth of the range to the bound, in one
    call with 2 * gains * steps + 1 points in the unit box. What is returned is the last step before the first
    that is too high: 0 where the first already is, the distance to the bound where none is.
    """
    gains = len(optimum)
    room = np.stack([optimum, 1 - optimum])
    ladder = np.geomspace(SMALLEST, 1, steps)
    distances = np.maximum(room, 0)[..., None] * ladder
    signs = np.array([-1.0, 1.0])[:, None, None]
    points = optimum + (signs * distances)[..., None] * np.eye(gains)[:, None, :]
    points = np.clip(np.concatenate([optimum[None], points.reshape(-1, gains)]), 0, 1)
    found = np.asarray(losses(points), float)
    # A loss that is not a number is too high.
    low = found[1:].reshape(2, gains, steps) <= (1 + rise) * found[0]
    reached = np.sum(np.cumprod(low, axis=-1), axis=-1)
    last = np.take_along_axis(distances, np.maximum(reached - 1, 0)[..., None], axis=-1)[..., 0]
    return np.where(reached > 0, last, 0)
