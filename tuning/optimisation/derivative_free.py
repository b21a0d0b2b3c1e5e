"""Derivative-free optimisation in the unit box: local search by CMA-ES, and global search with restarts.

Unlike gradient methods, these searches do not get stuck at kinks and can leave the nearest basin. The loss
function maps NumPy arrays to NumPy arrays. All calls have the same number of points, so that a compiled
function is compiled once. A point has unit coordinates: 0 is a gain's lower bound, 1 is the upper bound.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

POLISH_CANDIDATES = 16  # candidates per generation of `polish`
# candidates per generation and basin in the first round of `search_globally`
CANDIDATES_PER_BASIN = 32
SIMULTANEOUS_BASINS = 8  # number of basins that `search_globally` searches at the same time
SCAN_BUDGET_DIVISOR = 8  # the scan of `search_globally` uses 1/8 of all evaluations
MIN_START_DISTANCE = 0.1  # minimum distance between starts, relative to the diagonal of the unit box
# initial standard deviation in the first, the middle and the last round of `search_globally`
INITIAL_STD_BY_ROUND = 0.1, 0.2, 0.01
FAILED_LOSS = np.finfo(float).max  # loss of a failed evaluation; finite, but larger than all others

LossFunction = Callable[[Float[np.ndarray, "candidates gains"]], Float[np.ndarray, "candidates"]]


class SearchResult(NamedTuple):
    """Best point of a derivative-free search, or of each of several independent searches by `polish`."""

    point: Float[np.ndarray, "*starts gains"]  # best point, in unit coordinates
    loss: Float[np.ndarray, "*starts"]  # loss at the best point
    evaluations: int  # number of evaluations of the loss, per start


def polish(
    losses: Callable[
        [Float[np.ndarray, "*starts candidates gains"]], Float[np.ndarray, "*starts candidates"]
    ],
    start: Float[np.ndarray, "*starts gains"],
    evaluations: int,
    *,
    candidates: int = POLISH_CANDIDATES,
    reach: float = 0.1,
    covariance: Float[np.ndarray, "*starts gains gains"] | None = None,
    seed: int = 0,
) -> SearchResult:
    """Find a local minimum near each start by CMA-ES; no result is worse than its start.

    Candidates outside the unit box are reflected into the box. The first generation contains the start.

    Source: Hansen, "The CMA Evolution Strategy: A Tutorial" (2016), with positive weights and the default
    constants.

    Args:
        losses: function that returns the losses (*starts, candidates) of points (*starts, candidates, gains).
        start: starting points of independent searches, in unit coordinates.
        evaluations: number of evaluations per start, rounded down to complete generations, at least one.
        candidates: number of candidates per generation.
        reach: initial standard deviation in unit coordinates, as the root mean square over the gains.
        covariance: covariance of the initial distribution, before scaling to `reach`; None: isotropic. The
            search needs fewer generations with (J^T J / (2 L) + 16 I)^-1, where J is the Jacobian of the
            residuals, L the loss and I the identity: nearly the inverse Hessian of least squares. The 16 I
            limits the standard deviation of a gain without effect to a quarter of its range.
        seed: seed of the random numbers.

    Returns:
        The best point of each search.
    """
    start = np.clip(np.asarray(start, float), 0, 1)
    state = _make_first_generation(start, reach, covariance)
    constants = _compute_constants(start.shape[-1], candidates)
    generator = np.random.default_rng(seed)
    best, best_loss = start, np.full(start.shape[:-1], np.inf)
    generations = max(1, evaluations // candidates)
    for generation in range(generations):
        # All starts use the same random numbers, so that a result does not depend on the other starts.
        normal = generator.standard_normal((candidates, start.shape[-1]))
        points = reflect_into_box(
            state.mean[..., None, :] + state.step[..., None, None] * (normal @ _transpose(state.root))
        )
        if generation == 0:
            points[..., 0, :] = start
        values = _replace_nonfinite(losses(points))
        order = np.argsort(values, axis=-1, kind="stable")
        values = np.take_along_axis(values, order, axis=-1)
        points = np.take_along_axis(points, order[..., None], axis=-2)
        is_better = values[..., 0] < best_loss
        best_loss = np.where(is_better, values[..., 0], best_loss)
        best = np.where(is_better[..., None], points[..., 0, :], best)
        state = _evolve(state, points, constants, generation)
    return SearchResult(best, best_loss, generations * candidates)


def search_globally(
    losses: LossFunction,
    gains: int,
    budget: int,
    *,
    candidates: int = CANDIDATES_PER_BASIN,
    basins: int = SIMULTANEOUS_BASINS,
    seed: int = 0,
) -> SearchResult:
    """Find the best point of the whole unit box within `budget` evaluations.

    A scan of a scrambled Sobol sequence uses an eighth of the evaluations. The best points with a minimum
    distance from each other start simultaneous runs of `polish`, each in its own basin (neighbourhood of a
    local minimum). The runs proceed in rounds of equal cost. Each round continues from the better half of the
    minima, with an isotropic distribution. It has twice as many candidates per run, which average out the
    roughness of the loss. The last round refines the best minimum.

    Source: restarts with a growing population, Auger and Hansen, "A restart CMA evolution strategy with
    increasing population size" (2005); successive halving, Jamieson and Talwalkar (2016).

    Args:
        losses: function that returns the losses of basins * candidates points.
        gains: number of gains.
        budget: number of evaluations of the loss.
        candidates: number of candidates per generation and basin in the first round.
        basins: number of basins in the first round, a power of two.
        seed: seed of the random numbers.

    Returns:
        The best point of the search.
    """
    together = basins * candidates
    scan = max(1, budget // (SCAN_BUDGET_DIVISOR * together))
    sequence = qmc.Sobol(gains, rng=np.random.default_rng(seed))
    # The number of drawn Sobol points must be a power of two; only the first points are used.
    points = sequence.random(1 << (scan * together - 1).bit_length())[: scan * together]
    points = points.reshape(scan, together, gains)
    scanned = np.concatenate([_replace_nonfinite(losses(batch)) for batch in points])
    points = points.reshape(-1, gains)
    starts = select_distant_points(points[np.argsort(scanned, kind="stable")], None, basins)

    used = scan * together
    rounds = [basins >> turn for turn in range(basins.bit_length())] + [1]
    minima, minimum_losses = np.empty((0, gains)), np.empty(0)
    for turn, number in enumerate(rounds):

        def batched_losses(points, number=number):
            return losses(points.reshape(together, gains)).reshape(number, -1)

        generations = max(1, (budget - used) // together // (len(rounds) - turn))
        result = polish(
            batched_losses,
            starts,
            generations * together // number,
            candidates=together // number,
            reach=INITIAL_STD_BY_ROUND[0 if turn == 0 else 2 if turn == len(rounds) - 1 else 1],
            seed=seed + turn,
        )
        used += generations * together
        minima = np.concatenate([result.point, minima[number:]])
        minimum_losses = np.concatenate([result.loss, minimum_losses[number:]])
        order = np.argsort(minimum_losses, kind="stable")
        minima, minimum_losses = minima[order], minimum_losses[order]
        starts = minima[: max(1, number // 2)]
    return SearchResult(minima[0], minimum_losses[0], used)


def reflect_into_box(points: Float[np.ndarray, "*points"]) -> Float[np.ndarray, "*points"]:
    """Reflect coordinates outside [0, 1] at the nearest bound, repeatedly if necessary."""
    folded = np.mod(points, 2)
    return np.where(folded > 1, 2 - folded, folded)


class _Generation(NamedTuple):
    """Normal distribution of the candidates in one generation of CMA-ES, for every start."""

    mean: np.ndarray  # mean of the distribution
    step: np.ndarray  # step size sigma; the covariance of the distribution is sigma^2 C
    covariance: np.ndarray  # matrix C
    root: np.ndarray  # symmetric square root of C
    inverse_root: np.ndarray  # inverse of the square root of C
    step_path: np.ndarray  # evolution path of the step size
    shape_path: np.ndarray  # evolution path of C


class _CmaConstants(NamedTuple):
    """Constants of CMA-ES, with their symbols in Hansen's tutorial in brackets."""

    weights: np.ndarray  # weights of the better half of the candidates
    step_rate: float  # learning rate of the step size's path (c_sigma)
    damping: float  # damping of the step size (d_sigma)
    path_rate: float  # learning rate of the covariance's path (c_c)
    rank_one: float  # learning rate of the rank-one update (c_1)
    rank_mu: float  # learning rate of the rank-mu update (c_mu)
    effective: float  # effective number of selected candidates (mu_eff)
    length: float  # expected length of an evolution path of random steps (E|N(0, I)|)


def _compute_constants(gains: int, candidates: int) -> _CmaConstants:
    half = candidates // 2
    weights = np.log(candidates / 2 + 0.5) - np.log(np.arange(1, half + 1))
    weights /= weights.sum()
    effective = float(1 / np.sum(weights**2))
    step_rate = (effective + 2) / (gains + effective + 5)
    rank_one = 2 / ((gains + 1.3) ** 2 + effective)
    rank_mu = min(1 - rank_one, 2 * (effective - 2 + 1 / effective) / ((gains + 2) ** 2 + effective))
    return _CmaConstants(
        weights=weights,
        step_rate=step_rate,
        damping=1 + 2 * max(0.0, np.sqrt((effective - 1) / (gains + 1)) - 1) + step_rate,
        path_rate=(4 + effective / gains) / (gains + 4 + 2 * effective / gains),
        rank_one=rank_one,
        rank_mu=rank_mu,
        effective=effective,
        length=np.sqrt(gains) * (1 - 1 / (4 * gains) + 1 / (21 * gains**2)),
    )


def _make_first_generation(start, reach, covariance) -> _Generation:
    gains = start.shape[-1]
    shape = np.broadcast_to(np.eye(gains), (*start.shape[:-1], gains, gains))
    if covariance is not None:
        # The mean variance of all gains is scaled to 1, so that `reach` is their root mean square spread.
        average = np.trace(covariance, axis1=-2, axis2=-1) / gains
        shape = np.broadcast_to(covariance / average[..., None, None], shape.shape)
    root, inverse_root = _compute_square_roots(shape)
    step = np.full(start.shape[:-1], reach)
    still = np.zeros_like(start)
    return _Generation(start, step, shape, root, inverse_root, still, still)


def _evolve(state, points, constants, generation) -> _Generation:
    """Return the distribution of the next generation, from candidates in ascending order of loss."""
    gains = state.mean.shape[-1]
    weights = constants.weights
    steps = (points[..., : len(weights), :] - state.mean[..., None, :]) / state.step[..., None, None]
    move = np.einsum("c,...cg->...g", weights, steps)
    rate = constants.step_rate
    whitened = np.einsum("...ij,...j->...i", state.inverse_root, move)
    step_path = (1 - rate) * state.step_path + np.sqrt(rate * (2 - rate) * constants.effective) * whitened
    size = np.linalg.norm(step_path, axis=-1)
    # A long step-size path makes the step size grow; the path of the covariance must not grow at the same
    # time.
    scale = np.sqrt(1 - (1 - rate) ** (2 * (generation + 1)))
    grows = (size / scale < (1.4 + 2 / (gains + 1)) * constants.length)[..., None]
    rate = constants.path_rate
    shape_path = (1 - rate) * state.shape_path
    shape_path = shape_path + grows * np.sqrt(rate * (2 - rate) * constants.effective) * move
    decay = 1 - constants.rank_one - constants.rank_mu
    correction = (1 - grows) * constants.rank_one * rate * (2 - rate)
    covariance = (
        (decay + correction)[..., None] * state.covariance
        + constants.rank_one * shape_path[..., :, None] * shape_path[..., None, :]
        + constants.rank_mu * np.einsum("c,...ci,...cj->...ij", weights, steps, steps)
    )
    growth = constants.step_rate / constants.damping * (size / constants.length - 1)
    # If the distribution is wider than the box, the reflected candidates are uniform and carry no
    # information.
    step = np.clip(state.step * np.exp(np.minimum(growth, 1)), 1e-12, 0.5)
    root, inverse_root = _compute_square_roots(covariance)
    return _Generation(
        state.mean + state.step[..., None] * move, step, covariance, root, inverse_root, step_path, shape_path
    )


def _compute_square_roots(covariance):
    """Return the symmetric square root of a covariance matrix, and the inverse of the square root."""
    values, vectors = np.linalg.eigh(covariance)
    roots = np.sqrt(np.maximum(values, 1e-20 * np.max(values, axis=-1, keepdims=True)))
    root = (vectors * roots[..., None, :]) @ _transpose(vectors)
    return root, (vectors / roots[..., None, :]) @ _transpose(vectors)


def _transpose(matrix):
    return np.swapaxes(matrix, -1, -2)


def _replace_nonfinite(losses):
    losses = np.asarray(losses, float)
    return np.where(np.isfinite(losses), losses, FAILED_LOSS)


def select_distant_points(ranked, fixed_points, number):
    """Select `number` points: all `fixed_points`, then the best `ranked` points at a minimum distance.

    `ranked` is in ascending order of loss. The minimum distance between selected points is a tenth of the
    unit box's diagonal. It is reduced if too few points have this distance.
    """
    fixed_points = np.zeros((0, ranked.shape[-1])) if fixed_points is None else fixed_points
    distance = MIN_START_DISTANCE * np.sqrt(ranked.shape[-1])
    while True:
        chosen = select_points_at_distance(ranked, fixed_points, number, distance)
        if len(chosen) == number:
            return chosen
        distance = distance / 2 if len(ranked) > number and distance > 1e-9 else 0.0


def select_points_at_distance(ranked, fixed_points, number, distance=None):
    """Select points like `select_distant_points`, but fewer if too few points keep the given `distance`."""
    distance = MIN_START_DISTANCE * np.sqrt(ranked.shape[-1]) if distance is None else distance
    chosen = list(np.clip(fixed_points[:number], 0, 1))
    for point in ranked:
        if len(chosen) == number:
            break
        if all(np.linalg.norm(point - neighbour) >= distance for neighbour in chosen):
            chosen.append(point)
    return np.array(chosen)
