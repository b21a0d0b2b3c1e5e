"""A lag of the force sensor beside its delay: only where the touches tell the two apart.

To first order a lag is a delay, so their sum alone is known from slow contacts, and it is what the loop
feels. A lag is added where it explains so much more that the Bayesian information criterion gains 6.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from tuning.identification.contact_problem import Problem
from tuning.identification.contact_profile import Posterior
from tuning.identification.law_choice import Fitted, quick

LARGEST = 0.005  # s
TRIED = 0.0005, 0.0015, 0.004  # s, of which one gains if any does
GAIN = 6.0  # of the criterion
STEPS = 3.0  # standard deviations of the lag on each side at which the other numbers are fitted again


@dataclass(frozen=True)
class Lag:
    """The sensor's time constant, and how the other numbers move with it."""

    value: float  # s
    std: float  # s
    near: tuple[float, float]  # s and m, best delay and plane with it
    slopes: np.ndarray  # of delay, plane and coefficients by the time constant

    def spread(self, posterior: Posterior, seed: int) -> Posterior:
        """Draws with the time constant's uncertainty in them, and itself as the last number."""
        off = self.std * np.random.default_rng([seed, 2]).standard_normal(len(posterior.draws))
        draws = posterior.draws + off[:, None] * self.slopes
        draws = np.column_stack([draws, self.value + off])
        return replace(posterior, names=[*posterior.names, "time_constant"], draws=draws)


def sensor_lag(problem: Problem, posterior: Posterior) -> Lag | None:
    """The time constant where the readings ask for one, else None."""
    delay, plane, inner = posterior.best
    fits: dict[float, Fitted] = {}

    def fit(value: float) -> Fitted:
        if value not in fits:
            start = (max(delay - value, 0.0), plane, inner.misfit)
            fits[value] = quick(_lagging(problem, value), start, 2)
        return fits[value]

    needed = GAIN + np.log(len(problem.kept))
    if inner.misfit - min(fit(value)[2] for value in TRIED) < 0.5 * needed:
        return None
    found: Any = optimize.minimize_scalar(
        lambda value: fit(value)[2], bounds=(0.1 * problem.motion.period, LARGEST), method="bounded",
        options={"xatol": 0.02 * problem.motion.period},
    )  # fmt: skip
    value, gain = float(found.x), inner.misfit - float(found.fun)
    if gain < needed:
        return None
    step = 0.1 * value
    for _ in range(2):
        rise = np.mean([fit(value + side * step)[2] for side in (-1.0, 1.0)]) - found.fun
        std = step / np.sqrt(max(rise, 0.1))
        step = min(STEPS * std, 0.5 * value)
    numbers = []
    for side in (-1.0, 1.0):
        at, where, _ = fit(value + side * step)
        numbers.append(
            np.array([at, where, *_lagging(problem, value + side * step).at(at, where).coefficients])
        )
    return Lag(value, float(std), fit(value)[:2], (numbers[1] - numbers[0]) / (2.0 * step))


def _lagging(problem: Problem, value: float) -> Problem:
    return Problem(problem.motion, problem.readings, problem.law, problem.plane, value)
