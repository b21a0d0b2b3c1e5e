"""Search for the surface position with the smallest misfit at a given force delay."""

from tuning.identification.contact_problem import ContactProblem
from tuning.identification.contact_regression import CoefficientFit

MAX_NEWTON_STEPS = 6  # maximum number of Newton steps in the search for a surface position
MIN_LIKELIHOOD_GAIN = 2.0  # Newton's method stops when a step increases the log likelihood by less


def find_best_surface(
    problem: ContactProblem, delay: float, plane: float
) -> tuple[float, CoefficientFit, float]:
    """Find, by Newton's method, the surface position with the smallest misfit at a given force delay.

    Args:
        problem: Least-squares fit of a contact law.
        delay: Force delay [s].
        plane: Starting value of the surface position [m].

    Returns:
        The best surface position [m]; the fit at this position or one small Newton step before it; and the
        increase of the log likelihood expected from this step (0 without such a step).
    """
    inner = problem.at(delay, plane)
    for _ in range(MAX_NEWTON_STEPS):
        if problem.plane is not None or inner.curvature <= 0.0:
            return plane, inner, 0.0
        shift = inner.slope / inner.curvature
        gain = 0.5 * inner.slope * shift
        plane = plane - shift
        if gain < MIN_LIKELIHOOD_GAIN:
            return plane, inner, gain
        inner = problem.at(delay, plane)
    return plane, inner, 0.0
