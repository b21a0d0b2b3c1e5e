"""Search for the surface position with the smallest misfit at a given force delay.

The force of a damped contact jumps at the onset. The misfit therefore jumps where one more row comes into
contact: it is a staircase that descends to the best position. Newton's method works within a step of the
staircase; a scan over adjacent steps finds the best one.
"""

import numpy as np

from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import ContactProblem
from tuning.identification.contact_regression import CoefficientFit

MAX_NEWTON_STEPS = 6  # maximum number of Newton steps in the search for a surface position
MIN_LIKELIHOOD_GAIN = 2.0  # Newton's method stops when a step increases the log likelihood by less
MAX_STEP = 0.01  # maximum Newton step [m]; without readings in contact, the steps are arbitrary
MIN_EDGE_RESIDUAL = 4.0  # residual next to an onset [standard deviations] that suggests another step
# Number of rows per onset that a wrong surface may misplace, to bound the decrease of the misfit by a scan.
MAX_MISPLACED_ROWS = 5
MAX_SCANS = 12  # maximum number of scans, each of which moves the surface by up to the travel in a period
MAX_SCANNED_SIDE = 10  # maximum number of steps on either side that a scan evaluates
MIN_SCAN_GAIN = 4.0  # minimum decrease of chi-squared for which a scan moves the surface


def find_best_surface(
    problem: ContactProblem, delay: float, plane: float, enough: float = np.inf
) -> tuple[float, CoefficientFit, float]:
    """Find the surface position with the smallest misfit at a given force delay.

    Args:
        problem: Least-squares fit of a contact law.
        delay: Force delay [s].
        plane: Starting value of the surface position [m].
        enough: Chi-squared that matters to the caller. Steps are not scanned if they cannot lead below it.

    Returns:
        The best surface position [m]; the fit at this position or one small Newton step before it; and the
        increase of the log likelihood expected from this step (0 without such a step).
    """
    optimum = _take_newton_steps(problem, delay, plane)
    for _ in range(MAX_SCANS if has_steps(problem) else 0):
        surface, fit, gain = optimum
        residuals = np.abs(problem.compute_edge_residuals(delay, surface, fit.coefficients))
        misfit = fit.misfit - 2.0 * gain
        is_settled = np.max(residuals, initial=0.0) < MIN_EDGE_RESIDUAL
        if is_settled or misfit - MAX_MISPLACED_ROWS * np.sum(residuals**2) > enough:
            break
        planes = _list_adjacent_steps(problem, delay, surface)
        if not len(planes):
            break
        misfits = [scanned.misfit for scanned in problem.fit_surfaces(delay, planes)]
        best = int(np.argmin(misfits))
        if misfits[best] > misfit - MIN_SCAN_GAIN:
            break
        optimum = _take_newton_steps(problem, delay, float(planes[best]))
    return optimum


def has_steps(problem: ContactProblem) -> bool:
    """Return whether the misfit jumps with the surface position: for damped onsets without a sensor's lag."""
    return problem.plane is None and not problem.time_constant and has_onset_damping(problem.law)


def has_onset_damping(law: Law) -> bool:
    """Return whether the law has damping at zero depth, so that the force jumps at the onset of contact."""
    surface, rate = np.zeros(1), np.ones(1)
    return any(
        np.any(value != 0.0) for value in (*law.entry_functions(surface, rate), *law.shared(surface, rate))
    )


def _take_newton_steps(
    problem: ContactProblem, delay: float, plane: float
) -> tuple[float, CoefficientFit, float]:
    """Take Newton steps as long as they decrease the misfit; return the same as `find_best_surface`."""
    inner = problem.at(delay, plane)
    for _ in range(MAX_NEWTON_STEPS):
        if problem.plane is not None or inner.curvature <= 0.0:
            break
        shift = inner.slope / inner.curvature
        if abs(shift) > MAX_STEP:
            break
        gain = 0.5 * inner.slope * shift
        if gain < MIN_LIKELIHOOD_GAIN:
            return plane - shift, inner, gain
        moved = problem.at(delay, plane - shift)
        if not moved.misfit < inner.misfit:
            break
        plane, inner = plane - shift, moved
    return plane, inner, 0.0


def _list_adjacent_steps(problem: ContactProblem, delay: float, plane: float) -> np.ndarray:
    """List the centres [m] of the steps of the staircase next to a surface, up to a period's travel away."""
    position, rate = problem.motion.at(delay)
    onsets = (position[:-1] <= plane) & (position[1:] > plane)
    reach = float(np.max(rate[1:][onsets], initial=0.0)) * problem.motion.period
    low, high = plane - reach, plane + reach
    edges = np.array([low, *problem.onsets_between(delay, low, high), high])
    here = int(np.searchsorted(edges, plane))
    nearest = slice(max(here - 1 - MAX_SCANNED_SIDE, 0), here + 1 + MAX_SCANNED_SIDE)
    centres = (edges[1:] + edges[:-1])[nearest] / 2.0
    return centres if reach > 0.0 else centres[:0]
