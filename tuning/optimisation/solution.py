"""Where a solve with derivatives ended: known without its solver, which a kept program needs no more."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int

STATUSES = ("converged", "step limit", "not finite", "failed")


class Solution(NamedTuple):
    """Where the starts ended."""

    coordinates: Float[Array, "starts gains"]  # unit coordinates of the gains
    curvature: Float[Array, "starts gains gains"]  # J^T J there, J the residuals' Jacobian by the coordinates
    loss: Float[Array, "starts"]  # half the sum of squared residuals
    history: Float[Array, "starts steps"]  # loss after every step, the last repeated
    steps: Int[Array, "starts"]  # steps taken
    status: Int[Array, "starts"]  # an index into `STATUSES`
