"""What tuning minimises: a figure of the restitution errors of a batch of scenarios, and penalties beside it.

With e - e* of every contact, divergence weighted against convergence (`Objective`), the figures are

    rms     root of the mean square
    cvar    mean magnitude of the worst 5 % of the contacts (the conditional value at risk)
    worst   the largest magnitude

and the penalties a command that peaks above the reference's force and a compensator that amplifies the noise
of the force sensor. Levenberg-Marquardt wants sums of squares: `residuals` has the square of the figure and
of the penalties as its sum of squares, so that all are in one unit, that of a restitution error.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.errors import InputError, shown
from jaxhil.evaluation import Outcome, compare_with_reference
from jaxhil.loop import Loop, Rig
from jaxhil.rollout import run_contacts

SCALE = 0.01  # an error of one: the solver's first steps are damped as for residuals of order one
FAILED = 3.0  # error of a contact that does not end, or is not reached: as bad as a wild divergence
OBJECTIVES = ("rms", "cvar", "worst")
TAIL = 20  # cvar: the worst one in so many contacts, at least one
POWER = 16  # worst: the exponent of the norm that stands for the maximum; even


@dataclass(frozen=True)
class Objective:
    """What to minimise, J with

        J^2 = figure(E)^2 + (command_weight rms(C))^2 + (noise_weight N)^2

    E: per contact the restitution error e - e* [1], times sqrt(divergence_weight) where it is positive:
    divergence_weight [1] is how much more a squared divergence (e > e*) counts than a squared convergence.
    C: per contact max(0, peak |F_c| / the reference's peak force - 1) [1].
    N: max(0, A - 1) [1], A the amplification of the force sensor's white noise, from the gains alone
    (`Compensator.noise_amplification`); a quieter command than the measured force earns nothing.

    name: `figure`, one of `OBJECTIVES`. The weights of command and noise [1] are restitution errors: that
    which weighs as much as a command one reference peak too high, as an amplification one too large.

    Raises `InputError` for another name or a weight that is negative or not finite, or 0 for divergence.
    """

    name: str = "rms"
    divergence_weight: float = 1.0
    command_weight: float = 0.0
    noise_weight: float = 0.0

    def __post_init__(self):
        if self.name not in OBJECTIVES:
            raise InputError(f"objective: found {shown(self.name)}, allowed {', '.join(OBJECTIVES)}")
        for name in ("divergence_weight", "command_weight", "noise_weight"):
            weight, may_be_0 = getattr(self, name), name != "divergence_weight"
            if not (0 < weight < math.inf or (may_be_0 and weight == 0)):
                allowed = f"allowed finite numbers {'>=' if may_be_0 else '>'} 0"
                raise InputError(f"objective: {name}: found {shown(weight)}, {allowed}")


class Problem(NamedTuple):
    """A rig built for a batch of scenarios, and the gains that stay as they are; where there are several
    problems, each leaf has a leading axis of them."""

    rig: Rig
    fixed: dict[str, Array]


def residuals(
    static: tuple[Loop, tuple[str, ...], Objective],
    gains: Float[Array, "problems gains"],
    problems: Problem,
) -> Float[Array, "problems residuals"]:
    """(J / `SCALE`)^2 of every problem as a sum of squares, J as of `Objective`; the loss is half of it.

    One residual per contact slot of every scenario for the figure, as many for the command and one for the
    noise, where their weights are not 0. Contacts that fail count with the constant error and excess
    `FAILED`. `rms` and `cvar` are exact; which contacts are the worst is not differentiated. For `worst`
    stands the norm (sum of |E|^`POWER`)^(1/`POWER`): never below the maximum, nor above contacts^(1/`POWER`)
    times that.

    `static` is the loop, the names of the gains that are tuned and the objective. The scenarios of all
    problems run side by side, as the lanes of one batch.
    """
    loop, names, objective = static
    number, lanes = problems.rig.inverse_mass.shape
    rig = jax.tree.map(_side_by_side, problems.rig)
    values: dict[str, Any] = {name: gains[:, i] for i, name in enumerate(names)}
    values = {name: jnp.repeat(value, lanes) for name, value in {**problems.fixed, **values}.items()}
    outcome = compare_with_reference(loop, rig.scenario, run_contacts(loop, values, rig))

    def by_problem(leaf):
        return jnp.moveaxis(leaf.reshape(-1, number, lanes), 1, 0).reshape(number, -1)

    error, excess = map(by_problem, contact_terms(outcome))
    amplification = jnp.mean(by_problem(loop.compensator.noise_amplification(values, rig.constants)), axis=1)
    return weigh(objective, error, excess, by_problem(outcome.wanted), amplification)


def restitution_errors(
    static: tuple[Loop, tuple[str, ...]],
    gains: Float[Array, "problems gains"],
    problems: Problem,
) -> Float[Array, "problems residuals"]:
    """`residuals` of the plain rms."""
    return residuals((*static, Objective()), gains, problems)


def weigh(
    objective: Objective,
    error: Float[Array, "problems contacts"],
    excess: Float[Array, "problems contacts"],
    wanted: Bool[Array, "problems contacts"],
    amplification: Float[Array, "problems"],
) -> Float[Array, "problems residuals"]:
    """The residuals of `contact_terms` and of the noise's amplification."""
    count = jnp.sum(wanted, axis=1, dtype=jnp.int32)[:, None]
    diverging = math.sqrt(objective.divergence_weight) * error
    parts = [_FIGURES[objective.name](jnp.where(error > 0, diverging, error), count)]
    if objective.command_weight > 0:
        parts.append(objective.command_weight * _mean_square(excess, count))
    if objective.noise_weight > 0:
        beyond = amplification[:, None] - 1
        parts.append(objective.noise_weight * jnp.where(beyond > 0, beyond, 0))
    return jnp.concatenate(parts, axis=1) / SCALE


def contact_terms(
    outcome: Outcome,
) -> tuple[Float[Array, "slots *batch"], Float[Array, "slots *batch"]]:
    """Per contact the restitution error and the command's excess over the reference's peak force, relative
    to it: `FAILED` for contacts that failed, 0 for those not asked for."""
    # The inner `where` keeps what a failed contact leaves behind out of the derivative.
    usable = outcome.good & jnp.isfinite(outcome.error) & jnp.isfinite(outcome.peak_ratio)
    error = jnp.where(usable, outcome.error, FAILED)
    beyond = jnp.where(usable, outcome.peak_ratio, 1 + FAILED) - 1
    excess = jnp.where(beyond > 0, beyond, 0)
    return jnp.where(outcome.wanted, error, 0), jnp.where(outcome.wanted, excess, 0)


def objective_value(
    objective: Objective,
    errors: Float[np.ndarray, "contacts"],
    excesses: Float[np.ndarray, "contacts"] | None = None,
    amplification: float = 1.0,
) -> float:
    """J [1] of `Objective`, exactly, for all three names: what a table of results is made of.

    `errors` and `excesses` (none: no part in it) are those of `contact_terms`, of the contacts asked for;
    what is not finite counts as `FAILED`.
    """
    error, excess = (
        np.where(np.isfinite(term), term, FAILED)
        for term in (np.ravel(errors), np.zeros(1) if excesses is None else np.ravel(excesses))
    )
    size = np.sort(np.abs(np.where(error > 0, math.sqrt(objective.divergence_weight) * error, error)))
    figure = {
        "rms": np.sqrt(np.mean(size**2)),
        "cvar": np.mean(size[-_tail(len(size)) :]),
        "worst": size[-1],
    }[objective.name]
    command = objective.command_weight * np.sqrt(np.mean(excess**2))
    return math.hypot(figure, command, objective.noise_weight * max(0.0, float(amplification) - 1))


def _tail(count):
    return -(-count // TAIL)


def _mean_square(error: Float[Array, "problems contacts"], count: Int[Array, "problems 1"]) -> Array:
    """Sum of squares: the mean square of the first `count`, the others being 0."""
    return error / jnp.sqrt(count.astype(error.dtype))


def _tail_mean(error: Float[Array, "problems contacts"], count: Int[Array, "problems 1"]) -> Array:
    """Sum of squares: the square of the mean magnitude C of the worst; residuals sqrt(|E| C / their number).

    Of first degree in the errors, unlike sqrt(|E|), whose Gauss-Newton step overshoots twofold.
    """
    size, tail = jnp.abs(error), _tail(count)
    order = jnp.argsort(lax.stop_gradient(-size), axis=1)
    chosen = jnp.argsort(order, axis=1).astype(tail.dtype) < tail
    number = tail.astype(size.dtype)
    mean = jnp.sum(jnp.where(chosen, size, 0), axis=1, keepdims=True) / number
    square = jnp.where(chosen, size * mean / number, 0)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _high_norm(error: Float[Array, "problems contacts"], count: Int[Array, "problems 1"]) -> Array:
    """Sum of squares: the square of the norm |E|_p, p = `POWER`; residuals E (|E| / |E|_p)^(p/2 - 1)."""
    size = jnp.abs(error)
    largest = lax.stop_gradient(jnp.max(size, axis=1, keepdims=True))
    unit = jnp.where(largest > 0, largest, 1)
    total = jnp.sum((size / unit) ** POWER, axis=1, keepdims=True)
    norm = unit * jnp.where(largest > 0, total, 1) ** (1 / POWER)
    return error * (size / norm) ** (POWER // 2 - 1)


_FIGURES = {"rms": _mean_square, "cvar": _tail_mean, "worst": _high_norm}


def _side_by_side(leaf: Array) -> Array:
    """(problems, ..., scenarios) -> (..., lanes)"""
    return jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], leaf.shape[0] * leaf.shape[-1])
