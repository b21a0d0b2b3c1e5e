"""Search without derivatives in the unit box, batched: near a point or everywhere.

Gradients end at kinks and in the nearest basin; these searches do not. Both see an objective as a function
from NumPy to NumPy that takes the same number of points at every call, so that a compiled one is compiled
once. A point holds unit coordinates: each gain's place in its range, 0 at the lower bound and 1 at the upper.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

CANDIDATES = 16  # of a generation of `polish`
PER_BASIN = 32  # of a generation of `search_globally`, for each basin of its first round
BASINS = 8  # that `search_globally` goes down into at once
SCAN = 8  # the part of its budget that is the scan
APART = 0.1  # of the box's diagonal
REACHES = 0.1, 0.2, 0.01  # of its first round, of those between, of the last
# What a failed evaluation counts as: worse than all others, and still a number.
WORST = np.finfo(float).max

Losses = Callable[[Float[np.ndarray, "candidates gains"]], Float[np.ndarray, "candidates"]]


class SearchResult(NamedTuple):
    """What a search found; `polish` of several starts gives each its own."""

    point: Float[np.ndarray, "*starts gains"]  # the best point
    loss: Float[np.ndarray, "*starts"]  # there
    evaluations: int  # of the objective that it took


def polish(
    losses: Callable[
        [Float[np.ndarray, "*starts candidates gains"]], Float[np.ndarray, "*starts candidates"]
    ],
    start: Float[np.ndarray, "*starts gains"],
    evaluations: int,
    *,
    candidates: int = CANDIDATES,
    reach: float = 0.1,
    covariance: Float[np.ndarray, "*starts gains gains"] | None = None,
    seed: int = 0,
) -> SearchResult:
    """Local minimum near `start` by evolution of a normal distribution (CMA-ES), never worse than `start`.

    `losses` gets (*starts, candidates, gains) and gives (*starts, candidates); starts are searched side by
    side and do not depend on each other. `evaluations` are those of each start, rounded down to whole
    generations of `candidates`, at least one. The first generation holds the start itself.

    `reach` is the first standard deviation as a share of the box, of a gain on average; `covariance`, of
    any scale, is the first distribution's shape: an inverse Hessian of least squares, (J^T J / (2 L) + 16)^-1
    with the residuals' Jacobian J and the loss L, spares the search its learning; the 16 keeps what nothing
    depends on to a quarter of the box. Points outside the box are mirrored back into it.

    Source: Hansen, "The CMA Evolution Strategy: A Tutorial" (2016), with positive weights and the default
    constants for the number of candidates.
    """
    start = np.clip(np.asarray(start, float), 0, 1)
    state = _first_generation(start, reach, covariance)
    constants = _constants(start.shape[-1], candidates)
    generator = np.random.default_rng(seed)
    best, best_loss = start, np.full(start.shape[:-1], np.inf)
    generations = max(1, evaluations // candidates)
    for generation in range(generations):
        # All starts draw alike: what one finds does not hang on the others.
        normal = generator.standard_normal((candidates, start.shape[-1]))
        points = mirror(
            state.mean[..., None, :] + state.step[..., None, None] * (normal @ _transposed(state.root))
        )
        if generation == 0:
            points[..., 0, :] = start
        found = _finite(losses(points))
        order = np.argsort(found, axis=-1, kind="stable")
        found = np.take_along_axis(found, order, axis=-1)
        points = np.take_along_axis(points, order[..., None], axis=-2)
        better = found[..., 0] < best_loss
        best_loss = np.where(better, found[..., 0], best_loss)
        best = np.where(better[..., None], points[..., 0, :], best)
        state = _evolve(state, points, constants, generation)
    return SearchResult(best, best_loss, generations * candidates)


def search_globally(
    losses: Losses,
    gains: int,
    budget: int,
    *,
    candidates: int = PER_BASIN,
    basins: int = BASINS,
    seed: int = 0,
) -> SearchResult:
    """Best point of the whole box within `budget` evaluations: a scan, then the best basins.

    An eighth of the budget is a scrambled Sobol sequence. The best points of it that lie apart are then
    polished side by side, in rounds of equal cost: each goes on with the better half, from the bottoms found,
    with twice the candidates (which see over the ripples of a rough objective) and afresh, without the shape
    that the last had shrunk to. The last round goes into the best one closely. `losses` always gets
    basins * candidates points; `basins` is a power of two.

    Source: restarts with a growing population, Auger and Hansen, "A restart CMA evolution strategy with
    increasing population size" (2005); halving, Jamieson and Talwalkar (2016).
    """
    together = basins * candidates
    scan = max(1, budget // (SCAN * together))
    sequence = qmc.Sobol(gains, rng=np.random.default_rng(seed))
    # Drawn as a power of two, used in order: what is left of the balance is that of its prefix.
    points = sequence.random(1 << (scan * together - 1).bit_length())[: scan * together]
    points = points.reshape(scan, together, gains)
    scanned = np.concatenate([_finite(losses(part)) for part in points])
    points = points.reshape(-1, gains)
    starts = apart(points[np.argsort(scanned, kind="stable")], None, basins)

    used = scan * together
    rounds = [basins >> turn for turn in range(basins.bit_length())] + [1]
    bottoms, bottom_losses = np.empty((0, gains)), np.empty(0)
    for turn, number in enumerate(rounds):

        def side_by_side(points, number=number):
            return losses(points.reshape(together, gains)).reshape(number, -1)

        generations = max(1, (budget - used) // together // (len(rounds) - turn))
        found = polish(
            side_by_side,
            starts,
            generations * together // number,
            candidates=together // number,
            reach=REACHES[0 if turn == 0 else 2 if turn == len(rounds) - 1 else 1],
            seed=seed + turn,
        )
        used += generations * together
        bottoms = np.concatenate([found.point, bottoms[number:]])
        bottom_losses = np.concatenate([found.loss, bottom_losses[number:]])
        order = np.argsort(bottom_losses, kind="stable")
        bottoms, bottom_losses = bottoms[order], bottom_losses[order]
        starts = bottoms[: max(1, number // 2)]
    return SearchResult(bottoms[0], bottom_losses[0], used)


def mirror(points: Float[np.ndarray, "*points"]) -> Float[np.ndarray, "*points"]:
    """Points outside [0, 1] reflected at its ends."""
    folded = np.mod(points, 2)
    return np.where(folded > 1, 2 - folded, folded)


class _Generation(NamedTuple):
    """The normal distribution that candidates are drawn from, of every start."""

    mean: np.ndarray  # its mean
    step: np.ndarray  # sigma
    covariance: np.ndarray  # C: that of the distribution is sigma^2 C
    root: np.ndarray  # of C
    inverse_root: np.ndarray  # of C
    step_path: np.ndarray  # evolution path of the step
    shape_path: np.ndarray  # evolution path of C


class _Constants(NamedTuple):
    """Constants of the evolution; in brackets the tutorial's names."""

    weights: np.ndarray  # of the better half of the candidates
    step_rate: float  # of the step (c_sigma)
    damping: float  # of the step (d_sigma)
    path_rate: float  # of the covariance's path (c_c)
    rank_one: float  # of the covariance (c_1)
    rank_mu: float  # of the covariance (c_mu)
    effective: float  # number of candidates (mu_eff)
    length: float  # of a path of random steps, expected (E|N(0, I)|)


def _constants(gains: int, candidates: int) -> _Constants:
    half = candidates // 2
    weights = np.log(candidates / 2 + 0.5) - np.log(np.arange(1, half + 1))
    weights /= weights.sum()
    effective = float(1 / np.sum(weights**2))
    step_rate = (effective + 2) / (gains + effective + 5)
    rank_one = 2 / ((gains + 1.3) ** 2 + effective)
    rank_mu = min(1 - rank_one, 2 * (effective - 2 + 1 / effective) / ((gains + 2) ** 2 + effective))
    return _Constants(
        weights=weights,
        step_rate=step_rate,
        damping=1 + 2 * max(0.0, np.sqrt((effective - 1) / (gains + 1)) - 1) + step_rate,
        path_rate=(4 + effective / gains) / (gains + 4 + 2 * effective / gains),
        rank_one=rank_one,
        rank_mu=rank_mu,
        effective=effective,
        length=np.sqrt(gains) * (1 - 1 / (4 * gains) + 1 / (21 * gains**2)),
    )


def _first_generation(start, reach, covariance) -> _Generation:
    gains = start.shape[-1]
    shape = np.broadcast_to(np.eye(gains), (*start.shape[:-1], gains, gains))
    if covariance is not None:
        # A mean variance of one: what is sloppy reaches further than what is stiff, and `reach` on average.
        average = np.trace(covariance, axis1=-2, axis2=-1) / gains
        shape = np.broadcast_to(covariance / average[..., None, None], shape.shape)
    root, inverse_root = _roots(shape)
    step = np.full(start.shape[:-1], reach)
    still = np.zeros_like(start)
    return _Generation(start, step, shape, root, inverse_root, still, still)


def _evolve(state, points, constants, generation) -> _Generation:
    """The next distribution, from points sorted by their loss."""
    gains = state.mean.shape[-1]
    weights = constants.weights
    steps = (points[..., : len(weights), :] - state.mean[..., None, :]) / state.step[..., None, None]
    move = np.einsum("c,...cg->...g", weights, steps)
    rate = constants.step_rate
    whitened = np.einsum("...ij,...j->...i", state.inverse_root, move)
    step_path = (1 - rate) * state.step_path + np.sqrt(rate * (2 - rate) * constants.effective) * whitened
    size = np.linalg.norm(step_path, axis=-1)
    # A path grown long by a large step does not widen the distribution as well.
    usual = np.sqrt(1 - (1 - rate) ** (2 * (generation + 1)))
    going = (size / usual < (1.4 + 2 / (gains + 1)) * constants.length)[..., None]
    rate = constants.path_rate
    shape_path = (1 - rate) * state.shape_path
    shape_path = shape_path + going * np.sqrt(rate * (2 - rate) * constants.effective) * move
    kept = 1 - constants.rank_one - constants.rank_mu
    lost = (1 - going) * constants.rank_one * rate * (2 - rate)
    covariance = (
        (kept + lost)[..., None] * state.covariance
        + constants.rank_one * shape_path[..., :, None] * shape_path[..., None, :]
        + constants.rank_mu * np.einsum("c,...ci,...cj->...ij", weights, steps, steps)
    )
    growth = constants.step_rate / constants.damping * (size / constants.length - 1)
    # Wider than the box, mirrored points are uniform and teach nothing.
    step = np.clip(state.step * np.exp(np.minimum(growth, 1)), 1e-12, 0.5)
    root, inverse_root = _roots(covariance)
    return _Generation(
        state.mean + state.step[..., None] * move, step, covariance, root, inverse_root, step_path, shape_path
    )


def _roots(covariance):
    """Symmetric root of a covariance and its inverse."""
    values, vectors = np.linalg.eigh(covariance)
    roots = np.sqrt(np.maximum(values, 1e-20 * np.max(values, axis=-1, keepdims=True)))
    root = (vectors * roots[..., None, :]) @ _transposed(vectors)
    return root, (vectors / roots[..., None, :]) @ _transposed(vectors)


def _transposed(matrix):
    return np.swapaxes(matrix, -1, -2)


def _finite(losses):
    losses = np.asarray(losses, float)
    return np.where(np.isfinite(losses), losses, WORST)


def apart(ranked, known, number):
    """The known points and the best of the `ranked` ones that lie apart, so many in all.

    Apart is a tenth of the box's diagonal, less where there are not enough of them.
    """
    known = np.zeros((0, ranked.shape[-1])) if known is None else known
    distance = APART * np.sqrt(ranked.shape[-1])
    while True:
        chosen = far_apart(ranked, known, number, distance)
        if len(chosen) == number:
            return chosen
        distance = distance / 2 if len(ranked) > number and distance > 1e-9 else 0.0


def far_apart(ranked, known, number, distance=None):
    """The same, but fewer where no more lie so far apart, by default a tenth of the diagonal."""
    distance = APART * np.sqrt(ranked.shape[-1]) if distance is None else distance
    chosen = list(np.clip(known[:number], 0, 1))
    for point in ranked:
        if len(chosen) == number:
            break
        if all(np.linalg.norm(point - other) >= distance for other in chosen):
            chosen.append(point)
    return np.array(chosen)
