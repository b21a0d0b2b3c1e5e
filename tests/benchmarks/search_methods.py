"""Optimisers that users would choose, run until a time limit, and a record of their best loss.

Each optimiser is called with the loss of many points, a starting point in the unit box, and a seed. It
restarts if it converges before the time limit. Settings are the defaults of its authors or package, unless a
comment says otherwise.
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

PARTICLES, ITERATIONS = 15, 13  # values published for real-time hybrid simulation
INERTIA, PULL = 0.729844, 1.496180  # constriction: Clerc and Kennedy (2002)
SPREAD = 0.3  # first standard deviation of CMA-ES relative to the box
EDGE = 0.25  # edge of the first simplex of Nelder-Mead; SciPy's default is 0 for a gain of 0
POPULATION = 2  # per gain; SciPy's default of 15 allows only a few generations within the time limit
NEVER = 1 << 40  # evaluation limit that is never reached


class Trace(NamedTuple):
    """Number of rollouts, seconds and best loss after each call of the loss function.

    A rollout is the simulation of one point in all scenarios; residuals with their Jacobian with respect to P
    gains count as 1 + P rollouts.
    """

    rollouts: Float[np.ndarray, "calls"]
    seconds: Float[np.ndarray, "calls"]
    loss: Float[np.ndarray, "calls"]


class TimeIsUp(Exception):
    """Exception that stops an optimiser at its time limit."""


class Recorder:
    """Loss function that counts rollouts and raises `TimeIsUp` when called after the time limit."""

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
    """Run an optimiser from a starting point for the given seconds; return its trace."""
    recorder = Recorder(losses, seconds)
    try:
        method(recorder, start, seed)
    except TimeIsUp:
        return recorder.trace
    raise RuntimeError("a method ended before its time")


def particle_swarm(losses: Losses, start: Float[np.ndarray, "gains"], seed: int) -> None:
    """Global-best particle swarm with the starting point in the first swarm; restarts are random.

    A particle that leaves the box stops at the bound. Source: Clerc, "Standard particle swarm optimisation"
    (2012); constants from Clerc and Kennedy (2002).
    """
    generator = np.random.default_rng(seed)
    while True:
        place = generator.random((PARTICLES, len(start)))
        place[0] = start
        velocity = (generator.random(place.shape) - place) / 2
        best_places, own_loss = place, np.full(PARTICLES, np.inf)
        for _ in range(ITERATIONS):
            swarm_losses = losses(place)
            better = swarm_losses < own_loss
            best_places, own_loss = (
                np.where(better[:, None], place, best_places),
                np.where(better, swarm_losses, own_loss),
            )
            best = best_places[np.argmin(own_loss)]
            to_own, to_best = PULL * generator.random((2, *place.shape))
            velocity = INERTIA * velocity + to_own * (best_places - place) + to_best * (best - place)
            moved = place + velocity
            place = np.clip(moved, 0, 1)
            velocity = np.where(moved == place, velocity, 0)
        start = generator.random(len(start))


def cma_es(losses: Losses, start: Float[np.ndarray, "gains"], seed: int) -> None:
    """CMA-ES of the package `cma`, one generation per call; restarts are random with twice the population.

    Source: Auger and Hansen, "A restart CMA evolution strategy with increasing population size" (2005).
    """
    generator = np.random.default_rng(seed)
    options = {"bounds": [0, 1], "verbose": -9, "maxfevals": NEVER}
    population = None
    while True:
        options |= {"seed": int(generator.integers(1, 1 << 31))}
        options |= {"popsize": population} if population else {}
        strategy = cma.CMAEvolutionStrategy(start, SPREAD, options)
        # The first distribution is drawn around the starting point and need not contain this point.
        strategy.inject([start])
        while not strategy.stop():
            points = strategy.ask()
            strategy.tell(points, losses(np.array(points)).tolist())
        population = 2 * strategy.popsize
        start = generator.random(len(start))


def nelder_mead(losses: Losses, start: Float[np.ndarray, "gains"], seed: int) -> None:
    """SciPy's Nelder-Mead method, one point at a time; restarts use a new simplex at the last result."""
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
    """SciPy's differential evolution, one generation per call; the first population contains the start."""
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
