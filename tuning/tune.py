"""Tuning of one mechanism: scenarios, starts, solve, and judgement on scenarios that tuning never saw."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.stats import qmc

from jaxhil.building import build_loop
from jaxhil.compensators import COMPENSATORS, Gain
from jaxhil.evaluation import Outcome, evaluate, parameters_by_slot
from jaxhil.loop import Loop, build_rig
from jaxhil.mechanism import Mechanism
from jaxhil.scenario import Scenario, build_scenarios
from jaxhil.uncertainty import draw, quasi_random
from tuning import programs
from tuning.environment import program_folder
from tuning.objective import SCALE, Problem, restitution_errors
from tuning.optimiser import STATUSES, Bounds, Solution, solve

# Draws of the validation come from another seed than those of training.
VALIDATION_SEED = 0x5EED
# In training a contact that takes longer than this many times its undelayed duration, and so many
# seconds more, has failed.
PATIENCE = 2.0
SHORTEST_PATIENCE = 0.15  # s


@dataclass(frozen=True)
class Settings:
    """Numbers of scenarios to tune on, of starts, of solver steps, of scenarios to judge on; the seed."""

    scenarios: int = 32
    starts: int = 4
    steps: int = 25
    validation: int = 511
    seed: int = 0


class Figures(NamedTuple):
    """Over all contacts of a batch: rms, 99th percentile and maximum of |e - e*|, mean of e - e*; share of
    contacts that diverge (e > e*); largest |F_c| over the reference's peak; contacts that did not end."""

    rms: float
    p99: float
    max: float
    mean: float
    diverging: float
    peak_ratio: float
    failed: int


class Start(NamedTuple):
    """One start of the solve: status, steps, rms error it ended with, after every step, and its gains."""

    status: str
    steps: int
    rms: float
    history: list[float]
    gains: dict[str, float]


@dataclass(frozen=True)
class Result:
    """What tuning found: gains (all of the compensator's), the literature's; figures of "before" (no
    compensation), "literature" and "tuned" on the same fresh scenarios, and of their nominal run; every
    start; outcomes and scenarios for plots; seconds spent."""

    compensator: str
    mechanism: Mechanism
    gains: dict[str, float]
    literature: dict[str, float]
    figures: dict[str, Figures]
    nominal: dict[str, Figures]
    starts: list[Start]
    outcomes: dict[str, Outcome]
    scenarios: Scenario
    settings: Settings
    timings: dict[str, float] = field(default_factory=dict)


def tune(
    mechanism: Mechanism,
    compensator: str,
    settings: Settings,
    report: Callable[[str], None] = lambda text: None,
) -> Result:
    """Tune the gains of `compensator` for `mechanism`; `report` hears of each stage."""
    clock = _Clock()
    law = COMPENSATORS[compensator]
    literature = {gain.name: float(gain.nominal(mechanism)) for gain in law.gains}
    fresh = build_scenarios(
        mechanism,
        draw(mechanism, settings.validation, settings.seed + VALIDATION_SEED),
        settings.seed + VALIDATION_SEED,
    )
    # The nominal run is one more lane of the same batch.
    both = jax.tree.map(
        lambda fresh, nominal: np.concatenate([fresh, nominal], axis=-1),
        fresh,
        build_scenarios(mechanism),
    )
    loop = build_loop(mechanism, compensator, both)
    known = {"before": neutral_gains(compensator, literature), "literature": literature}
    starts, gains = [], literature
    # What does not wait for tuning is compiled and run while the solver's program compiles, on one core.
    with ThreadPoolExecutor(1) as meanwhile:
        judged = {name: meanwhile.submit(evaluate, loop, values, both) for name, values in known.items()}
        if any(gain.tuned(mechanism) for gain in law.gains):
            report(f"tuning {compensator} on {settings.scenarios} scenarios from {settings.starts} starts")
            starts = _solve(mechanism, compensator, literature, settings)
            usable = [start for start in starts if start.status != STATUSES[2]]
            if usable:
                gains = min(usable, key=lambda start: start.rms).gains
        clock.lap("tune")
        report(f"judging on {settings.validation} fresh scenarios")
        every = {name: outcome.result() for name, outcome in judged.items()}
    every["tuned"] = evaluate(loop, gains, both)
    outcomes = {name: jax.tree.map(lambda leaf: leaf[..., :-1], one) for name, one in every.items()}
    nominal_outcomes = {name: jax.tree.map(lambda leaf: leaf[..., -1:], one) for name, one in every.items()}
    clock.lap("judge")
    return Result(
        compensator=compensator,
        mechanism=mechanism,
        gains=gains,
        literature=literature,
        figures={name: figures(outcome) for name, outcome in outcomes.items()},
        nominal={name: figures(outcome) for name, outcome in nominal_outcomes.items()},
        starts=starts,
        outcomes=outcomes,
        scenarios=fresh,
        settings=settings,
        timings=clock.laps,
    )


def figures(outcome: Outcome) -> Figures:
    """Summary of a batch; NaN where no contact ended."""
    errors = outcome.error[outcome.good]
    failed = int(np.sum(outcome.wanted & ~outcome.good))
    if not len(errors):
        nan = float("nan")
        return Figures(nan, nan, nan, nan, nan, nan, failed)
    size = np.abs(errors)
    return Figures(
        rms=float(np.sqrt(np.mean(errors**2))),
        p99=float(np.percentile(size, 99)),
        max=float(np.max(size)),
        mean=float(np.mean(errors)),
        diverging=float(np.mean(errors > 0)),
        peak_ratio=float(np.max(outcome.peak_ratio[outcome.good])),
        failed=failed,
    )


def neutral_gains(compensator: str, gains: dict[str, float]) -> dict[str, float]:
    """Gains at which the compensator passes the measured force on unchanged: what "before" is judged with.

    It is the same compiled program as for any other gains.
    """
    neutral = {
        gain.name: gain.neutral for gain in COMPENSATORS[compensator].gains if gain.neutral is not None
    }
    return {**gains, **neutral}


def _solve(mechanism, compensator, literature, settings) -> list[Start]:
    law = COMPENSATORS[compensator]
    tuned = [gain for gain in law.gains if gain.tuned(mechanism)]
    names = tuple(gain.name for gain in tuned)
    scenarios = build_scenarios(
        mechanism, quasi_random(mechanism, settings.scenarios, settings.seed), settings.seed
    )
    loop = build_loop(mechanism, compensator, scenarios)
    fixed = {name: value for name, value in literature.items() if name not in names}
    bounds = gain_bounds(tuned, mechanism)
    first = np.array([literature[name] for name in names])
    starts = spread_starts(first, bounds, settings.starts, settings.seed)
    problem = scenarios, fixed, bounds
    problems = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (len(starts), *np.shape(leaf))), problem)
    static = loop, names, settings.steps
    solution = jax.device_get(programs.run(_solve_problems, static, (*problems, starts), program_folder()))
    starts = []
    for i in range(settings.starts):
        gains = {**literature, **dict(zip(names, map(float, solution.gains[i]), strict=True))}
        history = [float(value) for value in SCALE * np.sqrt(2 * solution.history[i])]
        status = STATUSES[int(solution.status[i])]
        steps = int(solution.steps[i])
        starts.append(Start(status, steps, history[-1], history[: max(steps, 1)], gains))
    return starts


def gain_bounds(gains: list[Gain], mechanism: Mechanism) -> Bounds:
    """Bounds of `gains` for the optimiser."""
    return Bounds(
        np.array([float(gain.lower(mechanism)) for gain in gains]),
        np.array([float(gain.upper(mechanism)) for gain in gains]),
        np.array([float(gain.logarithmic) for gain in gains]),
    )


def spread_starts(first: np.ndarray, bounds: Bounds, number: int, seed: int) -> np.ndarray:
    """(number, gains): the literature's gains, then Sobol points around them and over the middle of the box.

    Half of the points lie within a quarter of each gain's range of the literature's value, half anywhere.
    """
    lower, upper = np.asarray(bounds.lower), np.asarray(bounds.upper)
    logarithmic = np.asarray(bounds.logarithmic) > 0
    low = np.where(logarithmic, np.log(np.where(logarithmic, lower, 1)), lower)
    high = np.where(logarithmic, np.log(np.where(logarithmic, upper, 1)), upper)
    place = np.where(logarithmic, np.log(np.maximum(first, np.where(logarithmic, lower, 1))), first)
    share = np.clip((place - low) / (high - low), 0, 1)
    points = qmc.Sobol(len(first), rng=np.random.default_rng(seed)).random(
        1 << max(number - 1, 1).bit_length()
    )
    reach = np.where(np.arange(len(points)) % 2 == 0, 0.25, 1.0)[:, None]
    shares = np.clip(share + reach * (points - 0.5), 0.02, 0.98)
    shares = np.concatenate([share[None], shares])[:number]
    values = low + (high - low) * shares
    return np.where(logarithmic, np.exp(np.where(logarithmic, values, 0)), values)


def _solve_problems(static, arguments) -> Solution:
    loop, names, steps = static
    scenarios, fixed, bounds, starts = arguments

    def rig(scenarios):
        return build_rig(loop, scenarios._replace(time_limit=_patience(loop, scenarios)))

    problems = Problem(jax.vmap(rig)(scenarios), fixed)
    return solve(restitution_errors, (loop, names), problems, bounds, starts, max_steps=steps)


def _patience(loop: Loop, scenarios: Scenario) -> Array:
    """How long [s] a contact may take in training before it has failed: some of its undelayed durations."""
    shape = scenarios.phase.shape
    mass = jnp.broadcast_to(scenarios.equivalent_mass, shape)
    velocity = jnp.broadcast_to(scenarios.velocity, shape)
    reference = loop.law.reference(parameters_by_slot(scenarios.contact), mass, velocity)
    longest = PATIENCE * jnp.max(reference.duration, axis=0) + SHORTEST_PATIENCE
    return jnp.minimum(longest, scenarios.time_limit)


class _Clock:
    def __init__(self):
        self.laps, self._last = {}, time.perf_counter()

    def lap(self, name):
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now
