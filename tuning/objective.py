"""What tuning minimises: the restitution errors of a batch of scenarios, contact by contact."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.evaluation import compare_with_reference
from jaxhil.loop import Loop, Rig
from jaxhil.rollout import run_contacts

SCALE = 0.01  # an error of one: the solver's first steps are damped as for residuals of order one
FAILED = 3.0  # error of a contact that does not end, or is not reached: as bad as a wild divergence


class Problem(NamedTuple):
    """A rig built for a batch of scenarios, and the gains that stay as they are."""

    rig: Rig
    fixed: dict[str, Array]


def restitution_errors(
    static: tuple[Loop, tuple[str, ...]],
    gains: Float[Array, "gains"],
    problem: Problem,
    lane_axis: str | None = None,
) -> Float[Array, "residuals"]:
    """e - e* in units of `SCALE` of every contact of every scenario, over the root of their number: the loss
    is half the mean square. Contacts that fail count with the constant error `FAILED`.

    `static` is the loop and the names of the gains that are tuned.
    """
    loop, names = static
    values: dict[str, Any] = dict(problem.fixed)
    values.update({name: gains[i] for i, name in enumerate(names)})
    metrics = run_contacts(loop, values, problem.rig, lane_axis)
    outcome = compare_with_reference(loop, problem.rig.scenario, metrics)
    # The inner `where` keeps what a failed contact leaves behind out of the derivative.
    usable = outcome.good & jnp.isfinite(outcome.error)
    error = jnp.where(usable, outcome.error, FAILED)
    error = jnp.where(outcome.wanted, error, 0)
    count = jnp.sum(outcome.wanted).astype(error.dtype)
    return (error / (SCALE * jnp.sqrt(count))).reshape(-1)
