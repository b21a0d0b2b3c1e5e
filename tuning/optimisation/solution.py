"""Result of the solver with derivatives, without an import of the solver, which a cached program spares."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int

SOLVER_STATUSES = ("converged", "step limit", "not finite", "failed")


class SolverResult(NamedTuple):
    """Result of the solver for each start."""

    coordinates: Float[Array, "starts gains"]  # unit coordinates of the gains
    curvature: Float[Array, "starts gains gains"]  # J^T J, J = Jacobian of the residuals by the coordinates
    loss: Float[Array, "starts"]  # half the sum of squared residuals
    history: Float[Array, "starts steps"]  # loss after every step; the last one repeats
    steps: Int[Array, "starts"]  # number of steps
    status: Int[Array, "starts"]  # index into `SOLVER_STATUSES`
