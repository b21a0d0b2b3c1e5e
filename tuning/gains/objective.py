"""Objective of tuning: a metric of the restitution errors of a batch of scenarios, plus penalties.

The metrics of the restitution errors e - e* (positive errors have their own weight, see `Objective`) are

    rms     root of the mean square
    cvar    mean magnitude of the worst 5 % of the contacts (the conditional value at risk)
    worst   the largest magnitude

Penalties are added for a force command that exceeds the ideal contact's peak force, for chatter, and for
amplified noise of the force sensor. Each penalty is a dimensionless number. Its weight is the error, in
multiples of the limit, that counts as much as a penalty of 1. `evaluate_objective` computes the exact
objective.

Levenberg-Marquardt needs a smooth sum of squares. The residuals of `compute_residuals` therefore replace the
metric by a norm of the errors E of all n contacts,

    (sum of |E|^p / m)^(1/p)    rms: p = 2, m = n;  cvar: p = 6, m = 0.05 n;  worst: p = 8, m = 1

The norm equals the rms and is an upper bound of `cvar` and `worst`, since a mean of magnitudes is at most the
p-th root of the mean of their p-th powers. A solver that linearises the exact `cvar` would ignore contacts
outside the worst 5 %, and take steps that move these contacts into the worst 5 %.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.errors import InputError, format_value
from jaxhil.simulation.evaluation import RigModel
from tuning.gains.contact_terms import FAILED_CONTACT_ERROR, compute_contact_terms, extract_scenario_metrics
from tuning.gains.lane_tiles import flatten_lanes, map_over_tiles
from tuning.gains.metrics_function import MetricsFunction
from tuning.transparency.probes import mask_probes

# error [1] that gives a residual of 1; the solver's initial damping suits residuals of about 1
RESIDUAL_SCALE = 0.01
CVAR_TAIL_DIVISOR = 20  # cvar is the mean of the worst 1/20 of the contacts, at least of one contact
NORM_POWERS = {"rms": 2, "cvar": 6, "worst": 8}  # even exponents p of the norm in the residuals
OBJECTIVE_NAMES = tuple(NORM_POWERS)
WEIGHT_FIELDS = tuple(
    f"{name}_weight" for name in ("divergence", "command", "noise", "chatter", "transparency")
)
LIMIT_SCALED_WEIGHTS = "command_weight", "noise_weight", "chatter_weight"  # in multiples of the limit
# Factor on an error within the tolerance [1]; above 0, so that the search prefers the most accurate of
# equally quiet gains.
TOLERATED_ERROR_FACTOR = 0.02
# Penalty of a metric above its bound, divided by the excess [1]; large, so that no other term outweighs it.
BOUND_PENALTY = 100.0


@dataclass(frozen=True)
class Objective:
    """Objective J that tuning minimises.

        J^2 = metric(E)^2 + (transparency_weight rms(H))^2
          + limit^2 ((command_weight rms(C))^2 + (chatter_weight rms(S))^2 + (noise_weight N)^2)

        metric  norm of the errors, chosen by `name`
        limit   limit of the error [1]; three of the weights are multiples of it
        E  restitution error e - e* of each contact [1]; positive errors times sqrt(divergence_weight)
        H  restitution error e - e* of each contact of the transparency probes [1]
           (`tuning.transparency.probes`)
        C  excess of each contact's peak command, max(0, peak |F_c| / peak force of the ideal contact - 1) [1]
        S  chatter of each contact [1]: variation of F_c beyond a single rise and fall, divided by the ideal
           contact's peak force (`jaxhil.simulation.metrics`); it includes the effect of sensor noise
        N  max(0, A - 1) [1], where A is the amplification of the force sensor's white noise, which depends
           only on the gains (`Compensator.noise_amplification`)

    C and S include the contacts of the probes. Let m be the least metric that any gains reach, X the value of
    one penalty (C, S or N) at these gains, and w the penalty's weight. At the minimum of J, the metric is at
    most sqrt(m^2 + (w limit X)^2). Because of the factor `limit`, a weight permits the same additional error,
    in multiples of the limit, on every rig.

    With a `tolerance`, max(metric - tolerance, `TOLERATED_ERROR_FACTOR` metric) replaces the metric, so that
    the penalties decide between gains whose error is within the tolerance. With an `error_bound`, a search
    without derivatives minimises J + `BOUND_PENALTY` max(0, metric - error_bound), an exact penalty function
    (Nocedal and Wright 2006, section 17.2).

    Raises:
        InputError: If `name` is unknown, a weight is negative or not finite, or `divergence_weight` is 0.
    """

    name: str = "rms"  # name of the metric, one of `OBJECTIVE_NAMES`
    # weight of a squared positive error (e > e*) divided by the weight of a squared negative error [1]
    divergence_weight: float = 1.0
    command_weight: float = 0.0  # error, in multiples of the limit, that counts as much as C = 1
    noise_weight: float = 0.0  # error, in multiples of the limit, that counts as much as N = 1
    chatter_weight: float = 0.0  # error, in multiples of the limit, that counts as much as S = 1
    transparency_weight: float = 0.0  # weight of the probes' rms error relative to the metric [1]
    # User's function, which replaces the metric. Its arguments are the metrics of all scenarios without their
    # probes. divergence_weight has no effect on the function.
    function: MetricsFunction | None = None
    limit: float = 0.01  # limit of the error [1], the unit of the weights of command, noise and chatter
    tolerance: float | None = None  # metric [1] below which mainly the penalties count; None: no tolerance
    error_bound: float | None = None  # largest acceptable metric [1], ignored by the solver; None: no bound

    def __post_init__(self):
        if self.name not in OBJECTIVE_NAMES:
            raise InputError(
                f"objective: found {format_value(self.name)}, expected {', '.join(OBJECTIVE_NAMES)}"
            )
        for name in WEIGHT_FIELDS:
            weight, may_be_0 = getattr(self, name), name != "divergence_weight"
            if not (0 < weight < math.inf or (may_be_0 and weight == 0)):
                allowed = f"expected a finite number {'>=' if may_be_0 else '>'} 0"
                raise InputError(f"objective: {name}: found {format_value(weight)}, {allowed}")
        if not 0 < self.limit < math.inf:
            raise InputError(
                f"objective: limit: found {format_value(self.limit)}, expected a finite number > 0"
            )

    def unit(self, weight: str) -> float:
        """Return the unit [1] of the field `weight`: the error limit for three weights, 1 for the others."""
        return self.limit if weight in LIMIT_SCALED_WEIGHTS else 1.0

    @property
    def weights(self) -> "ObjectiveWeights":
        """Return all weights as scalar arrays; weighted penalties then have the unit of the error [1]."""
        numbers = [float(getattr(self, name)) * self.unit(name) for name in WEIGHT_FIELDS]
        return ObjectiveWeights(
            *map(jnp.asarray, numbers), tolerance=jnp.asarray(float(self.tolerance or 0.0))
        )


RMS_OBJECTIVE = Objective()


class ObjectiveTerms(NamedTuple):
    """Static properties of an objective; each combination of them needs its own compiled program."""

    name: str  # name of the metric
    command: bool  # whether excess peaks of the force command are penalised
    noise: bool  # whether noise amplification is penalised
    chatter: bool  # whether chatter is penalised
    transparency: bool = False  # whether the scenarios include transparency probes
    function: MetricsFunction | None = None  # user's function that replaces the metric, or None
    contacts: int = 0  # number of contacts per scenario in the arguments of the user's function
    tolerance: bool = False  # whether the metric has a tolerance, which may be 0


class ObjectiveWeights(NamedTuple):
    """Weights of the terms C, N, S and H of `Objective` for each problem.

    The compiled program takes the weights as arguments, so that one program serves for all weights.
    """

    divergence: Float[Array, "*problems"]  # weight of squared positive errors relative to negative ones [1]
    command: Float[Array, "*problems"]  # weight of the excess peak command C [1]
    noise: Float[Array, "*problems"]  # weight of the excess noise amplification N [1]
    chatter: Float[Array, "*problems"]  # weight of the chatter S [1]
    transparency: Float[Array, "*problems"]  # weight of the probes' errors H [1]
    tolerance: Float[Array, "*problems"]  # tolerance of the metric [1]


class SolverProblem(NamedTuple):
    """Solver inputs for one start; for several starts, every array has a leading axis of problems."""

    rig: Any  # batch of scenarios, as returned by `RigModel.prepared`
    fixed: dict[str, Array]  # gains that are not tuned
    weights: ObjectiveWeights  # weights of the objective


def list_objectives(objective: Objective | Sequence[Objective], number: int) -> list[Objective]:
    """Return one objective for each of `number` tasks; repeat `objective` if it is a single one."""
    return [objective] * number if isinstance(objective, Objective) else list(objective)


def join_terms(objectives: Sequence[Objective], probed: bool = False, contacts: int = 0) -> ObjectiveTerms:
    """Return the union of the terms of several objectives, so that they can share a compiled program.

    A term that an objective does not contain has a weight of 0 in this objective. `probed`: whether the
    scenarios include transparency probes; `contacts`: number of contacts that a user's function gets. Raise
    ValueError if the objectives do not have the same metric and the same user's function.
    """
    [(name, function)] = {(objective.name, objective.function) for objective in objectives}
    tolerance = any(objective.tolerance is not None for objective in objectives)
    return ObjectiveTerms(
        name=name,
        # An objective with a tolerance shares the program of the search for quieter commands.
        command=tolerance or any(objective.command_weight > 0 for objective in objectives),
        noise=tolerance or any(objective.noise_weight > 0 for objective in objectives),
        chatter=any(objective.chatter_weight > 0 for objective in objectives),
        transparency=probed,
        function=function,
        contacts=contacts if function else 0,
        tolerance=tolerance,
    )


def compute_residuals(
    static: tuple[RigModel, Any, tuple[str, ...], ObjectiveTerms],
    gains: Float[Array, "problems gains"],
    problems: SolverProblem,
) -> Float[Array, "problems residuals"]:
    """Compute the least-squares residuals of every problem.

    Their sum of squares is (J / `RESIDUAL_SCALE`)^2, where J is the objective with the smooth norm as its
    metric. Each contact of each scenario has one residual for its error, and one for each of these
    terms, if the objective contains it: probes, command, chatter. The noise has a single residual. A failed
    contact has an error, an excess peak command and a chatter of `FAILED_CONTACT_ERROR`.

    `static` holds the rig model, the loop, the names of the tuned gains and the objective's terms. All
    problems are simulated in one batch, whose lanes are their scenarios.
    """
    model, loop, names, terms = static
    if terms.chatter:
        loop = dataclasses.replace(loop, chatter=True)
    number, lanes = len(gains), jax.tree.leaves(problems.rig)[0].shape[-1]
    rig = jax.tree.map(flatten_lanes, problems.rig)
    values: dict[str, Any] = {name: gains[:, i] for i, name in enumerate(names)}
    values = {name: jnp.repeat(value, lanes) for name, value in {**problems.fixed, **values}.items()}

    def run(arguments):
        values, rig = arguments
        return model.outcome(loop, values, rig)

    outcome = map_over_tiles(run, (values, rig)) if terms.transparency else run((values, rig))
    outcome = model.select_verdict_error(outcome)

    def by_problem(leaf):
        return jnp.moveaxis(leaf.reshape(-1, number, lanes), 1, 0).reshape(number, -1)

    error, excess, chatter = map(by_problem, compute_contact_terms(outcome))
    amplification = jnp.mean(by_problem(model.noise_amplification(loop, values, rig)), axis=1)
    probes = by_problem(jnp.broadcast_to(mask_probes(number * lanes), outcome.is_scheduled.shape))
    is_scheduled = by_problem(outcome.is_scheduled)
    metric = None
    if terms.function is not None:
        metric = terms.function.values(
            extract_scenario_metrics(outcome, number, terms.contacts, terms.transparency)
        )
    return weight_residuals(
        terms, problems.weights, error, excess, chatter, is_scheduled, amplification, probes, metric
    )


def weight_residuals(
    terms: ObjectiveTerms,
    weights: ObjectiveWeights,
    error: Float[Array, "problems contacts"],
    excess: Float[Array, "problems contacts"],
    chatter: Float[Array, "problems contacts"],
    is_scheduled: Bool[Array, "problems contacts"],
    amplification: Float[Array, "problems"],
    probes: Bool[Array, "problems contacts"] | None = None,
    metric: Float[Array, "problems"] | None = None,
) -> Float[Array, "problems residuals"]:
    """Compute the least-squares residuals from the terms of all contacts and the noise amplification.

    `error`, `excess` and `chatter` are the results of `compute_contact_terms`. `probes` is True for contacts
    of transparency probes. `metric` is the value of the user's function; if it is given, one residual with
    this value replaces the residuals of the errors.
    """

    # A copy of a problem that only fills a call has no contact; a count of 1 avoids a division by 0.
    def counted(mask):
        return jnp.maximum(jnp.sum(mask, axis=1, dtype=jnp.int32), 1)[:, None]

    count = plain = counted(is_scheduled)
    transparency = []
    if terms.transparency and probes is not None:
        probe_errors = _compute_norm_residuals(jnp.where(probes, error, 0), counted(is_scheduled & probes), 2)
        transparency = [weights.transparency[:, None] * probe_errors]
        error, plain = jnp.where(probes, 0, error), counted(is_scheduled & ~probes)
    if metric is None:
        weighted = jnp.where(error > 0, jnp.sqrt(weights.divergence)[:, None] * error, error)
        numbers = {"rms": plain, "cvar": _count_tail_contacts(plain), "worst": jnp.ones_like(plain)}
        errors = _compute_norm_residuals(weighted, numbers[terms.name], NORM_POWERS[terms.name])
    else:
        errors = metric[:, None]
    if terms.tolerance:
        errors = errors * _compute_untolerated_share(errors, weights.tolerance[:, None])
    parts = [errors, *transparency]
    if terms.command:
        parts.append(weights.command[:, None] * _compute_norm_residuals(excess, count, 2))
    if terms.chatter:
        parts.append(weights.chatter[:, None] * _compute_norm_residuals(chatter, count, 2))
    if terms.noise:
        beyond = amplification - 1
        parts.append((weights.noise * jnp.where(beyond > 0, beyond, 0))[:, None])
    return jnp.concatenate(parts, axis=1) / RESIDUAL_SCALE


def _compute_untolerated_share(
    terms: Float[Array, "problems terms"], tolerance: Float[Array, "problems 1"]
) -> Float[Array, "problems 1"]:
    """Return max(1 - tolerance / norm, `TOLERATED_ERROR_FACTOR`), where norm is the norm of `terms`."""
    square = jnp.sum(terms**2, axis=1, keepdims=True)
    norm = jnp.sqrt(jnp.where(square > 0, square, 1))
    return jnp.where(tolerance > 0, jnp.maximum(1 - tolerance / norm, TOLERATED_ERROR_FACTOR), 1)


def evaluate_objective(
    objective: Objective,
    errors: Float[np.ndarray, "*points contacts"],
    excesses: Float[np.ndarray, "*points contacts"] | None = None,
    amplification: float | Float[np.ndarray, "*points"] = 1.0,
    chatter: Float[np.ndarray, "*points contacts"] | None = None,
    probe_errors: Float[np.ndarray, "*points contacts"] | None = None,
    value: Float[np.ndarray, "*points"] | None = None,
) -> Float[np.ndarray, "*points"]:
    """Compute the exact objective J [1] of each point.

    A point is a set of gains. `errors`, `excesses` and `chatter` are results of `compute_contact_terms`,
    without the rows that are no contact; None counts as 0. `errors` exclude the contacts of transparency
    probes, whose errors are `probe_errors`. A non-finite number counts as `FAILED_CONTACT_ERROR`. `value` is
    the value of the user's function, which replaces the metric.
    """
    terms = errors, excesses, chatter, probe_errors
    error, excess, swings, transparency = (
        np.where(np.isfinite(term), term, FAILED_CONTACT_ERROR)
        for term in (np.zeros(1) if term is None else term for term in terms)
    )
    metric = _compute_metric(objective, error) if value is None else value
    beyond = 0.0 if objective.error_bound is None else np.maximum(0.0, metric - objective.error_bound)
    if objective.tolerance:
        metric = np.maximum(metric - objective.tolerance, TOLERATED_ERROR_FACTOR * metric)
    parts = (
        metric,
        objective.limit * objective.command_weight * _compute_rms(excess),
        objective.limit * objective.chatter_weight * _compute_rms(swings),
        objective.limit * objective.noise_weight * np.maximum(0.0, np.asarray(amplification) - 1),
        objective.transparency_weight * _compute_rms(transparency),
    )
    return np.sqrt(sum(part**2 for part in parts)) + BOUND_PENALTY * beyond


def _compute_metric(
    objective: Objective, error: Float[np.ndarray, "*points contacts"]
) -> Float[np.ndarray, "*points"]:
    size = np.abs(np.where(error > 0, math.sqrt(objective.divergence_weight) * error, error))
    if objective.name == "rms":
        return _compute_rms(size)
    if objective.name == "worst":
        return np.max(size, axis=-1)
    return np.mean(np.sort(size, axis=-1)[..., -_count_tail_contacts(size.shape[-1]) :], axis=-1)


def _compute_rms(term: Float[np.ndarray, "*points contacts"]) -> Float[np.ndarray, "*points"]:
    return np.sqrt(np.mean(term**2, axis=-1))


def _count_tail_contacts(count):
    return -(-count // CVAR_TAIL_DIVISOR)


def _compute_norm_residuals(
    error: Float[Array, "problems contacts"], number: Int[Array, "problems 1"], power: int
) -> Array:
    """Return residuals E (|E| / |E|_p)^(p/2 - 1) / m^(1/p), whose sum of squares is (sum of |E|^p / m)^(2/p).

    E is `error`, |E|_p its p-norm over the contacts, m is `number` and p is `power`. The residuals are
    homogeneous of degree one in the errors, so that Gauss-Newton steps have the right length.
    """
    size = jnp.abs(error)
    largest = lax.stop_gradient(jnp.max(size, axis=1, keepdims=True))
    unit = jnp.where(largest > 0, largest, 1)
    total = jnp.sum((size / unit) ** power, axis=1, keepdims=True)
    norm = unit * jnp.where(largest > 0, total, 1) ** (1 / power)
    return error * (size / norm) ** (power // 2 - 1) / number.astype(error.dtype) ** (1 / power)
