"""What tuning minimises: a figure of the restitution errors of a batch of scenarios, and penalties beside it.

With e - e* of every contact, divergence weighted against convergence (`Objective`), the figures are

    rms     root of the mean square
    cvar    mean magnitude of the worst 5 % of the contacts (the conditional value at risk)
    worst   the largest magnitude

and the penalties a command that peaks above the reference's force, one that chatters, and a compensator that
amplifies the noise of the force sensor. Each penalty is a dimensionless number; its weight says how many
limits of the error that number is worth. `objective_value` has them exactly.

Levenberg-Marquardt wants smooth sums of squares. That of `residuals` is the square of the norm

    (sum of |E|^p / m)^(1/p)    rms: p = 2, m contacts;  cvar: p = 6, m the worst 5 %;  worst: p = 8, m = 1

which is the rms, and never below the other two: the mean of the worst is at most the p-th root of the mean
of their p-th powers. The exact tail is no use to a solver that linearises: contacts outside it weigh nothing,
and a step that spoils one of them is not foreseen. By this norm the tail ends lower.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.errors import InputError, shown
from jaxhil.simulation.evaluation import RigModel
from jaxhil.simulation.outcome import Outcome
from tuning.gains.metrics_function import MetricsFunction, ScenarioMetrics, scenario_metrics
from tuning.transparency.probes import are_probes

SCALE = 0.01  # an error of one: the solver's first steps are damped as for residuals of order one
FAILED = 3.0  # error of a contact that does not end, or is not reached: as bad as a wild divergence
CHUNK = 32  # lanes with probes that are computed side by side
TAIL = 20  # cvar: the worst one in so many contacts, at least one
POWERS = {"rms": 2, "cvar": 6, "worst": 8}  # of the norms in the residuals; even
OBJECTIVES = tuple(POWERS)
WEIGHTS = tuple(f"{name}_weight" for name in ("divergence", "command", "noise", "chatter", "transparency"))
IN_LIMITS = ("command_weight", "noise_weight", "chatter_weight")  # weights in multiples of the limit
# By what share of itself an error within the tolerance still counts: of equally quiet gains the most
# accurate are wanted.
TOLERATED = 0.02


@dataclass(frozen=True)
class Objective:
    """What to minimise: J with

        J^2 = figure(E)^2 + (transparency_weight rms(H))^2
          + limit^2 ((command_weight rms(C))^2 + (chatter_weight rms(S))^2 + (noise_weight N)^2)

        E  per contact the restitution error e - e* [1], times sqrt(divergence_weight) where it is positive
        H  the same of the transparency probes, e* their own (`tuning.transparency.probes`)
        C  per contact, of probes too, max(0, peak |F_c| / the reference's peak force - 1) [1]
        S  per contact, of probes too, the chatter [1]: how far F_c goes up and down beyond a single swing
           (`jaxhil.simulation.metrics`), over the reference's peak force; with the sensors' noise in it
        N  max(0, A - 1) [1], A the amplification of the force sensor's white noise, from the gains alone
           (`Compensator.noise_amplification`); a command quieter than the measured force earns nothing

    With w the weight of X, one of C, S and N, minimising J raises the figure to at most
    sqrt(figure^2 + (w limit X)^2), both taken at the gains of the least figure: what a weight costs is known
    in multiples of the limit, whatever the rig.

    With a `tolerance`, max(figure - tolerance, `TOLERATED` figure) takes the figure's place: gains whose
    error is within it are compared by the penalties.

    Raises `InputError` for another name or a weight that is negative or not finite, or 0 for divergence.
    """

    name: str = "rms"  # of the figure, one of `OBJECTIVES`
    # how much more a squared divergence (e > e*) counts than a squared convergence [1]
    divergence_weight: float = 1.0
    # how many limits of the error a command is worth that peaks one reference peak too high [1]
    command_weight: float = 0.0
    noise_weight: float = 0.0  # the same of an amplification one too large [1]
    chatter_weight: float = 0.0  # the same of one swing over the reference's peak too many [1]
    transparency_weight: float = 0.0  # with 1, probes' errors count as much as those of the scenarios [1]
    # a function of the user's own in the figure's place, of the metrics of all scenarios but the probes;
    # divergence_weight has no part in it
    function: MetricsFunction | None = None
    limit: float = 0.01  # of the error [1]: the unit of the weights of command, noise and chatter
    # up to which the figure is good enough [1]; None: no error is, and the program has no such part
    tolerance: float | None = None

    def __post_init__(self):
        if self.name not in OBJECTIVES:
            raise InputError(f"objective: found {shown(self.name)}, allowed {', '.join(OBJECTIVES)}")
        for name in WEIGHTS:
            weight, may_be_0 = getattr(self, name), name != "divergence_weight"
            if not (0 < weight < math.inf or (may_be_0 and weight == 0)):
                allowed = f"allowed finite numbers {'>=' if may_be_0 else '>'} 0"
                raise InputError(f"objective: {name}: found {shown(weight)}, {allowed}")
        if not 0 < self.limit < math.inf:
            raise InputError(f"objective: limit: found {shown(self.limit)}, allowed finite numbers > 0")

    def unit(self, weight: str) -> float:
        """Return the error [1] that a weight of 1 stands for; `weight` is a field's name."""
        return self.limit if weight in IN_LIMITS else 1.0

    @property
    def weights(self) -> "Weights":
        """The numbers in it, each a scalar array, those of penalties in the unit of an error."""
        numbers = [float(getattr(self, name)) * self.unit(name) for name in WEIGHTS]
        return Weights(*map(jnp.asarray, numbers), tolerance=jnp.asarray(float(self.tolerance or 0.0)))


RMS = Objective()


class Terms(NamedTuple):
    """What of an objective shapes the compiled program."""

    name: str  # of its figure
    command: bool  # whether the command has a part
    noise: bool  # whether the noise has one
    chatter: bool  # whether the chatter has one
    transparency: bool = False  # whether the scenarios come with probes
    function: MetricsFunction | None = None  # the user's, in the place of the figure, if any
    contacts: int = 0  # how many the user's function gets
    tolerance: bool = False  # whether errors within a tolerance, which may be 0, are good enough


class Weights(NamedTuple):
    """The weights of an objective (`Objective`): numbers that one program takes, each problem its own."""

    divergence: Float[Array, "*problems"]  # of a squared divergence over a squared convergence [1]
    command: Float[Array, "*problems"]  # of the command's excess [1]
    noise: Float[Array, "*problems"]  # of the amplification beyond 1 [1]
    chatter: Float[Array, "*problems"]  # of the chatter [1]
    transparency: Float[Array, "*problems"]  # of the probes' errors [1]
    tolerance: Float[Array, "*problems"]  # of the figure [1]


class Problem(NamedTuple):
    """What one start is solved for; where there are several, each leaf has a leading axis of them."""

    rig: Any  # a batch of scenarios, as `RigModel.prepared` returns it
    fixed: dict[str, Array]  # gains that stay as they are
    weights: Weights  # the objective's


def one_each(objective: Objective | Sequence[Objective], number: int) -> list[Objective]:
    """The objective of each of so many tasks, from that of all of them or a list of them."""
    return [objective] * number if isinstance(objective, Objective) else list(objective)


def common_terms(objectives: Sequence[Objective], probed: bool = False, contacts: int = 0) -> Terms:
    """The terms of objectives of one name and function: a part that one of them has, all have, some with a
    weight of 0. `probed` scenarios come with probes; all have so many `contacts`, if there is a function.

    Raises ValueError for objectives of several names or functions.
    """
    [(name, function)] = {(objective.name, objective.function) for objective in objectives}
    tolerance = any(objective.tolerance is not None for objective in objectives)
    return Terms(
        name=name,
        # What is tolerated makes room for a quieter command.
        command=tolerance or any(objective.command_weight > 0 for objective in objectives),
        noise=tolerance or any(objective.noise_weight > 0 for objective in objectives),
        chatter=any(objective.chatter_weight > 0 for objective in objectives),
        transparency=probed,
        function=function,
        contacts=contacts if function else 0,
        tolerance=tolerance,
    )


def residuals(
    static: tuple[RigModel, Any, tuple[str, ...], Terms],
    gains: Float[Array, "problems gains"],
    problems: Problem,
) -> Float[Array, "problems residuals"]:
    """(J / `SCALE`)^2 of every problem as a sum of squares, J as of `Objective`; the loss is half of it.

    One residual per contact slot of every scenario for the figure, or the norm that stands for it, as many
    for the command, as many for its chatter, one for the noise, and one for every contact slot of the probes,
    where they are among the terms. Contacts that fail count with the constant error, excess and chatter
    `FAILED`.

    `static` are the rig model, the loop, the names of the gains that are tuned and the objective's terms. The
    scenarios of all problems run side by side, as the lanes of one batch.
    """
    model, loop, names, terms = static
    if terms.chatter:
        loop = dataclasses.replace(loop, chatter=True)
    number, lanes = len(gains), jax.tree.leaves(problems.rig)[0].shape[-1]
    rig = jax.tree.map(_side_by_side, problems.rig)
    values: dict[str, Any] = {name: gains[:, i] for i, name in enumerate(names)}
    values = {name: jnp.repeat(value, lanes) for name, value in {**problems.fixed, **values}.items()}

    def run(arguments):
        values, rig = arguments
        return model.outcome(loop, values, rig)

    outcome = _in_chunks(run, (values, rig)) if terms.transparency else run((values, rig))

    def by_problem(leaf):
        return jnp.moveaxis(leaf.reshape(-1, number, lanes), 1, 0).reshape(number, -1)

    error, excess, chatter = map(by_problem, contact_terms(outcome))
    amplification = jnp.mean(by_problem(model.noise_amplification(loop, values, rig)), axis=1)
    probes = by_problem(jnp.broadcast_to(are_probes(number * lanes), outcome.wanted.shape))
    wanted = by_problem(outcome.wanted)
    figure = None
    if terms.function is not None:
        figure = terms.function.values(metrics_of(outcome, number, terms.contacts, terms.transparency))
    return weigh(terms, problems.weights, error, excess, chatter, wanted, amplification, probes, figure)


def weigh(
    terms: Terms,
    weights: Weights,
    error: Float[Array, "problems contacts"],
    excess: Float[Array, "problems contacts"],
    chatter: Float[Array, "problems contacts"],
    wanted: Bool[Array, "problems contacts"],
    amplification: Float[Array, "problems"],
    probes: Bool[Array, "problems contacts"] | None = None,
    figure: Float[Array, "problems"] | None = None,
) -> Float[Array, "problems residuals"]:
    """The residuals of `contact_terms` and of the noise's amplification; `probes`: which contacts are of
    probes, where the terms have transparency; `figure`: the value of the user's function, which is one
    residual, where they have one."""

    # A problem that asks for no contact, which fills up a call, has errors of 0.
    def counted(asked):
        return jnp.maximum(jnp.sum(asked, axis=1, dtype=jnp.int32), 1)[:, None]

    count = plain = counted(wanted)
    blindness = []
    if terms.transparency and probes is not None:
        blind = _norm(jnp.where(probes, error, 0), counted(wanted & probes), 2)
        blindness = [weights.transparency[:, None] * blind]
        error, plain = jnp.where(probes, 0, error), counted(wanted & ~probes)
    diverging = jnp.sqrt(weights.divergence)[:, None] * error
    number = {"rms": plain, "cvar": _tail(plain), "worst": jnp.ones_like(plain)}[terms.name]
    if figure is None:
        own = _norm(jnp.where(error > 0, diverging, error), number, POWERS[terms.name])
    else:
        own = figure[:, None]
    if terms.tolerance:
        own = own * _untolerated(own, weights.tolerance[:, None])
    parts = [own, *blindness]
    if terms.command:
        parts.append(weights.command[:, None] * _norm(excess, count, 2))
    if terms.chatter:
        parts.append(weights.chatter[:, None] * _norm(chatter, count, 2))
    if terms.noise:
        beyond = amplification - 1
        parts.append((weights.noise * jnp.where(beyond > 0, beyond, 0))[:, None])
    return jnp.concatenate(parts, axis=1) / SCALE


def _untolerated(
    terms: Float[Array, "problems terms"], tolerance: Float[Array, "problems 1"]
) -> Float[Array, "problems 1"]:
    """Return the share of the norm of `terms` that counts: max(1 - tolerance / norm, `TOLERATED`)."""
    square = jnp.sum(terms**2, axis=1, keepdims=True)
    norm = jnp.sqrt(jnp.where(square > 0, square, 1))
    return jnp.where(tolerance > 0, jnp.maximum(1 - tolerance / norm, TOLERATED), 1)


def contact_terms(
    outcome: Outcome,
) -> tuple[Float[Any, "slots *batch"], Float[Any, "slots *batch"], Float[Any, "slots *batch"]]:
    """Per contact the restitution error, the command's excess over the reference's peak force, relative to
    it, and the chatter: `FAILED` for contacts that failed, 0 for those not asked for. NumPy in, NumPy out."""
    xp = jnp if isinstance(outcome.error, jax.Array) else np
    # The inner `where` keeps what a failed contact leaves behind out of the derivative.
    usable = outcome.good & xp.isfinite(outcome.error) & xp.isfinite(outcome.peak_ratio)
    usable = usable & xp.isfinite(outcome.chatter)
    error = xp.where(usable, outcome.error, FAILED)
    beyond = xp.where(usable, outcome.peak_ratio, 1 + FAILED) - 1
    excess = xp.where(beyond > 0, beyond, 0)
    chatter = xp.where(usable, outcome.chatter, FAILED)
    wanted = outcome.wanted
    return xp.where(wanted, error, 0), xp.where(wanted, excess, 0), xp.where(wanted, chatter, 0)


def metrics_of(outcome: Outcome, number: int, contacts: int, probed: bool) -> ScenarioMetrics:
    """What a user's function gets, for each of so many problems whose scenarios are side by side: leaves
    (problems, contacts, scenarios), without the copies of `probed` ones."""

    def by_problem(leaf):
        several = leaf[:contacts].reshape(contacts, number, -1)
        return jnp.moveaxis(several[..., ~(are_probes(several.shape[-1]) & probed)], 1, 0)

    return jax.tree.map(by_problem, scenario_metrics(outcome, FAILED))


def objective_value(
    objective: Objective,
    errors: Float[np.ndarray, "*points contacts"],
    excesses: Float[np.ndarray, "*points contacts"] | None = None,
    amplification: float | Float[np.ndarray, "*points"] = 1.0,
    chatter: Float[np.ndarray, "*points contacts"] | None = None,
    probe_errors: Float[np.ndarray, "*points contacts"] | None = None,
    value: Float[np.ndarray, "*points"] | None = None,
) -> Float[np.ndarray, "*points"]:
    """J [1] of `Objective`, exactly, for all three names: what a table of results is made of.

    `errors`, `excesses` and `chatter` (none: no part in it) are those of `contact_terms`, of the contacts
    asked for; `probe_errors` are the errors of the transparency probes, which are not among `errors` then.
    What is not finite counts as `FAILED`. `value` is that of the user's function, which is the figure then.
    """
    given = errors, excesses, chatter, probe_errors
    error, excess, swings, blindness = (
        np.where(np.isfinite(term), term, FAILED)
        for term in (np.zeros(1) if term is None else term for term in given)
    )
    figure = _figure(objective, error) if value is None else value
    if objective.tolerance:
        figure = np.maximum(figure - objective.tolerance, TOLERATED * figure)
    parts = (
        figure,
        objective.limit * objective.command_weight * _rms(excess),
        objective.limit * objective.chatter_weight * _rms(swings),
        objective.limit * objective.noise_weight * np.maximum(0.0, np.asarray(amplification) - 1),
        objective.transparency_weight * _rms(blindness),
    )
    return np.sqrt(sum(part**2 for part in parts))


def _figure(
    objective: Objective, error: Float[np.ndarray, "*points contacts"]
) -> Float[np.ndarray, "*points"]:
    """Of errors alone."""
    size = np.abs(np.where(error > 0, math.sqrt(objective.divergence_weight) * error, error))
    if objective.name == "rms":
        return _rms(size)
    if objective.name == "worst":
        return np.max(size, axis=-1)
    return np.mean(np.sort(size, axis=-1)[..., -_tail(size.shape[-1]) :], axis=-1)


def _rms(term: Float[np.ndarray, "*points contacts"]) -> Float[np.ndarray, "*points"]:
    return np.sqrt(np.mean(term**2, axis=-1))


def _tail(count):
    return -(-count // TAIL)


def _norm(error: Float[Array, "problems contacts"], number: Int[Array, "problems 1"], power: int) -> Array:
    """Sum of squares: (sum of |E|^p / m)^(2/p); residuals E (|E| / |E|_p)^(p/2 - 1) / m^(1/p).

    They are of first degree in the errors, so that Gauss-Newton steps neither overshoot nor fall short.
    """
    size = jnp.abs(error)
    largest = lax.stop_gradient(jnp.max(size, axis=1, keepdims=True))
    unit = jnp.where(largest > 0, largest, 1)
    total = jnp.sum((size / unit) ** power, axis=1, keepdims=True)
    norm = unit * jnp.where(largest > 0, total, 1) ** (1 / power)
    return error * (size / norm) ** (power // 2 - 1) / number.astype(error.dtype) ** (1 / power)


def _in_chunks(function: Callable[[Any], Outcome], arguments: Any) -> Outcome:
    """Lanes, the last axis of every leaf, `CHUNK` at a time: each chunk ends with its own slowest lane."""
    lanes = jax.tree.leaves(arguments)[0].shape[-1]
    size = math.gcd(lanes, CHUNK)
    chunks = jax.tree.map(
        lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], lanes // size, size), -2, 0), arguments
    )
    done = lax.map(function, chunks)
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], lanes), done)


def _side_by_side(leaf: Array) -> Array:
    """(problems, ..., scenarios) -> (..., lanes)"""
    return jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], leaf.shape[0] * leaf.shape[-1])
