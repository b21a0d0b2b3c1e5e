"""Levenberg-Marquardt over bounded gains, many starts in one program: the one file that imports optimistix.

Least squares knows no bounds: every gain is a sigmoid (on a linear or logarithmic scale) of a free number.
The residuals' Jacobian is computed in forward mode, once per step and next to the residuals themselves.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.extend.core import jaxpr_as_fun
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array, Float, Int

LANES = "starts"


class Bounds(NamedTuple):
    """Of each gain: lower and upper bound, and whether its scale is logarithmic."""

    lower: Float[Array, "gains"]
    upper: Float[Array, "gains"]
    logarithmic: Float[Array, "gains"]


class Solution(NamedTuple):
    """Per start: gains; loss, half the sum of squared residuals; loss after every step, the last repeated;
    steps taken; status, an index into `STATUSES`."""

    gains: Float[Array, "starts gains"]
    loss: Float[Array, "starts"]
    history: Float[Array, "starts steps"]
    steps: Int[Array, "starts"]
    status: Int[Array, "starts"]


STATUSES = ("converged", "step limit", "not finite", "failed")


def to_gains(free: Float[Array, "gains"], bounds: Bounds) -> Float[Array, "gains"]:
    """Gains strictly inside their bounds for any free numbers."""
    share = jax.nn.sigmoid(free)
    straight = bounds.lower + (bounds.upper - bounds.lower) * share
    low = jnp.log(jnp.where(bounds.logarithmic > 0, bounds.lower, 1))
    high = jnp.log(jnp.where(bounds.logarithmic > 0, bounds.upper, 1))
    return jnp.where(bounds.logarithmic > 0, jnp.exp(low + (high - low) * share), straight)


def to_free(gains: Float[Array, "gains"], bounds: Bounds) -> Float[Array, "gains"]:
    """Inverse of `to_gains`; a gain on a bound is moved inside by a thousandth of the range."""
    span = bounds.upper - bounds.lower
    share = (gains - bounds.lower) / jnp.where(span > 0, span, 1)
    positive = jnp.where(bounds.logarithmic > 0, jnp.maximum(gains, bounds.lower), 1)
    low = jnp.log(jnp.where(bounds.logarithmic > 0, bounds.lower, 1))
    high = jnp.log(jnp.where(bounds.logarithmic > 0, bounds.upper, 2))
    share = jnp.where(bounds.logarithmic > 0, (jnp.log(positive) - low) / (high - low), share)
    share = jnp.clip(share, 1e-3, 1 - 1e-3)
    return jnp.log(share) - jnp.log1p(-share)


@partial(jax.jit, static_argnames=("residuals", "static", "max_steps"))
def solve(
    residuals: Callable[..., Float[Array, "residuals"]],
    static: Any,
    arguments: Any,
    bounds: Bounds,
    starts: Float[Array, "starts gains"],
    max_steps: int = 30,
    rtol: float = 1e-4,
    atol: float = 1e-6,
) -> Solution:
    """Minimise sum(residuals(static, gains, arguments, LANES)^2) / 2 from every start at once.

    `residuals` runs under `jax.vmap` with the axis name `LANES`; starts are dealt out to the devices.
    """

    function = _with_jacobian(
        lambda free, arguments: residuals(static, to_gains(free, arguments[0]), arguments[1], LANES),
        len(starts),
        starts[0],
        (bounds, arguments),
    )
    solver = _Recording(optx.LevenbergMarquardt(rtol=rtol, atol=atol), max_steps)

    def one(start):
        solution = optx.least_squares(
            function,
            solver,
            to_free(start, bounds),
            args=(bounds, arguments),
            has_aux=True,
            max_steps=max_steps,
            throw=False,
        )
        history, steps = solution.stats["history"], solution.stats["num_steps"]
        status = _status(solution.result, jnp.min(history))
        gains = to_gains(solution.value, bounds)
        return Solution(gains, jnp.min(history), history, steps.astype(jnp.int32), status)

    return jax.vmap(one)(starts)


def _with_jacobian(residuals, copies, free, arguments):
    """(residuals, loss) whose derivative is one product with a Jacobian computed once, in forward mode.

    `free` and `arguments` are like those to come; `copies` of the function run under one `jax.vmap`. The
    copies are dealt out to the devices; the solver around them is not: its linear algebra does not run
    inside `jax.shard_map`.
    """

    def value_and_jacobian(free, arguments):
        def twice(free):
            value = residuals(free, arguments)
            return value, value

        jacobian, value = jax.jacfwd(twice, has_aux=True)(free)
        return value, jacobian

    def mapped(free, arguments):
        return jax.vmap(value_and_jacobian, (0, None), axis_name=LANES)(free, arguments)

    def dealt(free, arguments):
        devices = math.gcd(jax.device_count(), copies)
        mesh = jax.make_mesh(
            (devices,), ("device",), axis_types=(AxisType.Auto,), devices=jax.devices()[:devices]
        )
        own, common = PartitionSpec("device"), PartitionSpec()
        return jax.shard_map(mapped, mesh=mesh, in_specs=(own, common), out_specs=own, check_vma=False)(
            free, arguments
        )

    # Traced once, however often the solver asks for it: tracing costs more than many a step.
    leaves, structure = jax.tree.flatten(arguments)
    traced = jax.make_jaxpr(lambda free, *leaves: dealt(free, jax.tree.unflatten(structure, leaves)))(
        jax.ShapeDtypeStruct((copies, *free.shape), free.dtype),
        *(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves),
    )

    def shared(free, arguments):
        return tuple(jaxpr_as_fun(traced)(free, *jax.tree.leaves(arguments)))

    @jax.custom_batching.custom_vmap
    def several(free, arguments):
        # Of the same shape as when it is mapped, hence no second program.
        same = jnp.broadcast_to(free, (copies, *free.shape))
        return jax.tree.map(lambda leaf: leaf[0], shared(same, arguments))

    @several.def_vmap
    def rule(axis_size, in_batched, free, arguments):
        if any(jax.tree.leaves(in_batched[1])) or not in_batched[0]:
            raise NotImplementedError("only the free numbers may be mapped")
        return shared(free, arguments), (True, True)

    @jax.custom_jvp
    def function(free, arguments):
        return several(free, arguments)[0]

    @function.defjvp
    def derivative(primals, tangents):
        value, jacobian = several(*primals)
        return value, jacobian @ tangents[0]

    def with_loss(free, arguments):
        value = function(free, arguments)
        return value, jnp.sum(value**2) / 2

    return with_loss


class _Recording(optx.AbstractLeastSquaresSolver):
    """A solver that keeps the loss of every accepted iterate."""

    rtol: float
    atol: float
    norm: Callable[[Any], Array]
    inner: optx.AbstractLeastSquaresSolver
    max_steps: int = eqx.field(static=True)

    def __init__(self, inner: optx.AbstractLeastSquaresSolver, max_steps: int):
        self.rtol, self.atol, self.norm = inner.rtol, inner.atol, inner.norm
        self.inner, self.max_steps = inner, max_steps

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        inner = self.inner.init(fn, y, args, options, f_struct, aux_struct, tags)
        history = jnp.full(self.max_steps, jnp.inf, y.dtype)
        return inner, history, jnp.array(0)

    def step(self, fn, y, args, options, state, tags):
        inner, history, count = state
        y, inner, loss = self.inner.step(fn, y, args, options, inner, tags)
        best = jnp.minimum(loss, jnp.where(count > 0, history[count - 1], jnp.inf))
        history = jnp.where(jnp.arange(self.max_steps) >= count, best, history)
        return y, (inner, history, count + 1), loss

    def terminate(self, fn, y, args, options, state, tags):
        return self.inner.terminate(fn, y, args, options, state[0], tags)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        y, aux, stats = self.inner.postprocess(fn, y, aux, args, options, state[0], tags, result)
        return y, aux, {**stats, "history": state[1]}


def _status(result, loss):
    converged = result == optx.RESULTS.successful
    limit = result == optx.RESULTS.nonlinear_max_steps_reached
    status = jnp.where(converged, 0, jnp.where(limit, 1, 3))
    return jnp.where(jnp.isfinite(loss), status, 2).astype(jnp.int32)
