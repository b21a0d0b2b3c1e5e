"""Result of the Levenberg-Marquardt solver, in a module without the slow import of the solver."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int

SOLVER_STATUSES = ("converged", "step limit", "not finite", "failed")


class SolverResult(NamedTuple):
    """Result of the Levenberg-Marquardt solver for each starting point."""

    coordinates: Float[Array, "starts gains"]  # unit coordinates of the gains
    # J^T J, where J is the Jacobian of the residuals with respect to the coordinates
    curvature: Float[Array, "starts gains gains"]
    loss: Float[Array, "starts"]  # half the sum of squared residuals
    history: Float[Array, "starts steps"]  # loss after every step; the final loss fills the unused entries
    steps: Int[Array, "starts"]  # number of steps taken
    status: Int[Array, "starts"]  # index into `SOLVER_STATUSES`
