"""The methods that users would pick, each until its time is up, and the record of what they find when.

Each is called with the loss of many points, a start (in the unit box, as all points) and a seed, and goes on
for ever: the record ends it. Where a method is done before, it begins again. Settings are those of its
authors or its package, but where a comment says otherwise; the start is one of the first points of all.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import cma
import numpy as np
from jaxtyping import Float
from scipy import optimize

Losses = Callable[[Float[np.ndarray, "points gains"]], Float[np.ndarray, "points"]]
Method = Callable[[Losses, Float[np.ndarray, "gains"], int], None]

PARTICLES, ITERATIONS = 15, 13  # as published for real-time hybrid simulation
INERTIA, PULL = 0.729844, 1.496180  # constriction: Clerc and Kennedy (2002)
SPREAD = 0.3  # first standard deviation of CMA-ES, as a share of the box
EDGE = 0.25  # of the first simplex of Nelder-Mead; SciPy's 0.05 of the coordinate is 0 for a gain that is 0
POPULATION = 2  # of differential evolution, for each gain; of SciPy's 15 a start sees few generations
NEVER = 1 << 40  # evaluations


class Trace(NamedTuple):
    """After each call of the loss: rollouts so far, seconds so far, best loss so far.

    A rollout is one point on all scenarios; residuals with their Jacobian over P gains are 1 + P of them.
    """

    rollouts: Float[np.ndarray, "calls"]
    seconds: Float[np.ndarray, "calls"]
    loss: Float[np.ndarray, "calls"]


class TimeIsUp(Exception):
    """Ends a method."""


class Recorder:
    """The loss with a clock: counts what it is called for, and raises `TimeIsUp` at a call after its time.

    A call begun in time counts, however long it takes.
    """

    def __init__(self, losses: Losses, seconds: float):
        self.losses, self.seconds = losses, seconds
        self.rollouts, self.times, self.found = [], [], []
        self.begin = time.perf_counter()

    def __call__(self, points: Float[np.ndarray, "points gains"]) -> Float[np.ndarray, "points"]:
        if time.perf_counter() - self.begin >= self.seconds:
            raise TimeIsUp
        values = self.losses(points)
        self.times.append(time.perf_counter() - self.begin)
        self.rollouts.append(len(points))
        self.found.append(np.min(values))
        return values

    @property
    def trace(self) -> Trace:
        return Trace(
            np.cumsum(self.rollouts, dtype=float), np.array(self.times), np.minimum.accumulate(self.found)
        )


def record(
    method: Method, losses: Losses, start: Float[np.ndarray, "gains"], seed: int, seconds: float
) -> Trace:
    """What a method finds from a start in so many seconds."""
    recorder = Recorder(losses, seconds)
    try:
        method(recorder, start, seed)
    except TimeIsUp:
        return recorder.trace
    raise RuntimeError("a method ended before its time")


def particle_swarm(losses: Losses, start: Float[np.ndarray, "gains"], seed: int) -> None:
    """Global-best particle swarm, the start one of the first swarm; further swarms at random.

    A particle that leaves the box stops at its wall.
    Source: Clerc, "Standard particle swarm optimisation" (2012); Clerc and Kennedy (2002) for the constants.
    """
    generator = np.random.default_rng(seed)
    while True:
        place = generator.random((PARTICLES, len(start)))
        place[0] = start
        velocity = (generator.random(place.shape) - place) / 2
        own, own_loss = place, np.full(PARTICLES, np.inf)
        for _ in range(ITERATIONS):
            found = losses(place)
            better = found < own_loss
            own, own_loss = np.where(better[:, None], place, own), np.where(better, found, own_loss)
            best = own[np.argmin(own_loss)]
            to_own, to_best = PULL * generator.random((2, *place.shape))
            velocity = INERTIA * velocity + to_own * (own - place) + to_best * (best - place)
            moved = place + velocity
            place = np.clip(moved, 0, 1)
            velocity = np.where(moved == place, velocity, 0)
        start = generator.random(len(start))


def cma_es(losses: Losses, start: Float[np.ndarray, "gains"], seed: int) -> None:
    """CMA-ES of the package `cma`, a generation in one call; begun again at random with twice the population
    (Auger and Hansen, "A restart CMA evolution strategy with increasing population size", 2005)."""
    generator = np.random.default_rng(seed)
    options = {"bounds": [0, 1], "verbose": -9, "maxfevals": NEVER}
    population = None
    while True:
        options |= {"seed": int(generator.integers(1, 1 << 31))}
        options |= {"popsize": population} if population else {}
        strategy = cma.CMAEvolutionStrategy(start, SPREAD, options)
        # The first distribution is drawn around the start and need not hold it.
        strategy.inject([start])
        while not strategy.stop():
            points = strategy.ask()
            strategy.tell(points, losses(np.array(points)).tolist())
        population = 2 * strategy.popsize
        start = generator.random(len(start))


def nelder_mead(losses: Losses, start: Float[np.ndarray, "gains"], seed: int) -> None:
    """SciPy's Nelder-Mead, one point at a time; begun again with a fresh simplex where it ended."""
    best = start
    bounds = [(0.0, 1.0)] * len(start)
    while True:
        edges = np.where(best < 0.5, EDGE, -EDGE)
        simplex = np.concatenate([best[None], best + np.diag(edges)])
        best = optimize.minimize(
            lambda point: float(losses(point[None])[0]),
            best,
            method="Nelder-Mead",
            bounds=bounds,
            options={"initial_simplex": simplex, "maxfev": NEVER, "maxiter": NEVER},
        ).x


def differential_evolution(losses: Losses, start: Float[np.ndarray, "gains"], seed: int) -> None:
    """SciPy's differential evolution, a generation in one call, the start one of the first population."""
    generator = np.random.default_rng(seed)
    while True:
        optimize.differential_evolution(
            lambda points: losses(points.T),
            [(0.0, 1.0)] * len(start),
            x0=start,
            maxiter=NEVER,
            popsize=POPULATION,
            rng=generator,
            vectorized=True,
            updating="deferred",
            polish=False,
        )
        start = generator.random(len(start))


OTHERS: dict[str, Method] = {
    "particle swarm": particle_swarm,
    "CMA-ES": cma_es,
    "Nelder-Mead": nelder_mead,
    "differential evolution": differential_evolution,
}
