"""Ours in the comparison: the one place to change where tuning finds its gains in another way.

`ours` takes all starts at once, as tuning does, and says of each what it had found after how many rollouts
and seconds; `warm_up` compiles what it will run. Nothing else of this file is used elsewhere.
"""

import time
from functools import partial

import jax
import numpy as np
from jaxtyping import Float
from search_case import Case, over_scenarios, several, to_gains
from search_methods import Trace

from tuning.objective import RMS, common_terms, residuals
from tuning.optimiser import solve
from tuning.search import polish

STEPS = 25  # of Levenberg-Marquardt
POLISH = 320  # evaluations
LONGEST = 32  # steps that the program is made for


def ours(
    case: Case, starts: Float[np.ndarray, "starts gains"], steps: int = STEPS, evaluations: int = POLISH
) -> list[Trace]:
    """Levenberg-Marquardt, then the derivative-free polish, from every start (in the unit box) in one batch.

    A trace has an entry for every step, 1 + P rollouts, and every generation. Its seconds are those of the
    batch over the number of starts; the steps of a solve, which is one program, count as equally long.
    """
    number, gains = starts.shape
    static = case.loop, case.names, common_terms([RMS])
    problems, bounds = several((case.problem, case.bounds), number)
    begin = time.perf_counter()

    def elapsed():
        return (time.perf_counter() - begin) / number

    solution = jax.device_get(
        solve(residuals, static, problems, bounds, case.gains_of(starts), np.array(steps), LONGEST, tile=1)
    )
    last = max(1, int(np.max(solution.steps)))
    seconds = list(elapsed() * np.arange(1, last + 1) / last)
    rollouts = [(1 + gains) * np.clip(solution.steps, 1, step) for step in range(1, last + 1)]
    best = list(solution.history[:, :last].T)

    shares = case.shares_of(solution.gains)
    shape = _curvature(static, case.problem, shares, case.placed_bounds)
    shape = np.mean(np.asarray(shape), axis=0) / (2 * solution.loss[:, None, None]) + 16 * np.eye(gains)
    of_shape = 1 + gains

    def losses(points):
        nonlocal of_shape
        found = case.losses(points.reshape(-1, gains)).reshape(points.shape[:-1])
        seconds.append(elapsed())
        rollouts.append(rollouts[-1] + of_shape + points.shape[-2])
        best.append(np.min(found, axis=-1))
        of_shape = 0
        return found

    polish(losses, shares, evaluations, covariance=np.linalg.inv(shape))
    lowest = np.minimum.accumulate(best)
    return [Trace(np.array(rollouts, float)[:, i], np.array(seconds), lowest[:, i]) for i in range(number)]


def warm_up(case: Case, starts: Float[np.ndarray, "starts gains"]) -> None:
    """Compile what `ours` runs for as many starts."""
    ours(case, starts, steps=1, evaluations=1)


@partial(jax.jit, static_argnums=0)
def _curvature(static, problem, points, bounds):
    """J^T J at each point, J the residuals' Jacobian by the shares; (devices, points, gains, gains)."""

    def one_device(problem, points, bounds):
        def one(shares):
            alone = jax.tree.map(lambda leaf: leaf[None], problem)
            jacobian = jax.jacfwd(lambda shares: residuals(static, to_gains(shares, bounds)[None], alone)[0])(
                shares
            )
            return jacobian.T @ jacobian

        return jax.lax.map(one, points)

    return over_scenarios(one_device, problem, points, bounds)
