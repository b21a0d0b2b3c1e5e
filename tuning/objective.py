"""What tuning minimises: the restitution errors of a batch of scenarios, contact by contact."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.evaluation import compare_with_reference
from jaxhil.loop import Loop, Rig
from jaxhil.rollout import run_contacts

SCALE = 0.01  # an error of one: the solver's first steps are damped as for residuals of order one
FAILED = 3.0  # error of a contact that does not end, or is not reached: as bad as a wild divergence


class Problem(NamedTuple):
    """A rig built for a batch of scenarios, and the gains that stay as they are; where there are several
    problems, each leaf has a leading axis of them."""

    rig: Rig
    fixed: dict[str, Array]


def restitution_errors(
    static: tuple[Loop, tuple[str, ...]],
    gains: Float[Array, "problems gains"],
    problems: Problem,
) -> Float[Array, "problems residuals"]:
    """e - e* in units of `SCALE` of every contact of every scenario, over the root of their number: the loss
    is half the mean square. Contacts that fail count with the constant error `FAILED`.

    `static` is the loop and the names of the gains that are tuned. The scenarios of all problems run side by
    side, as the lanes of one batch.
    """
    loop, names = static
    number, lanes = problems.rig.inverse_mass.shape
    rig = jax.tree.map(_side_by_side, problems.rig)
    values: dict[str, Any] = {name: gains[:, i] for i, name in enumerate(names)}
    values = {name: jnp.repeat(value, lanes) for name, value in {**problems.fixed, **values}.items()}
    outcome = compare_with_reference(loop, rig.scenario, run_contacts(loop, values, rig))
    # The inner `where` keeps what a failed contact leaves behind out of the derivative.
    usable = outcome.good & jnp.isfinite(outcome.error)
    error = jnp.where(usable, outcome.error, FAILED)
    error = jnp.where(outcome.wanted, error, 0)
    slots = error.shape[0]
    error, wanted = (leaf.reshape(slots, number, lanes) for leaf in (error, outcome.wanted))
    count = jnp.maximum(jnp.sum(wanted, axis=(0, 2)), 1).astype(error.dtype)
    errors = error / (SCALE * jnp.sqrt(count))[None, :, None]
    return jnp.moveaxis(errors, 0, 1).reshape(number, -1)


def _side_by_side(leaf: Array) -> Array:
    """(problems, ..., scenarios) -> (..., lanes)"""
    return jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], leaf.shape[0] * leaf.shape[-1])
