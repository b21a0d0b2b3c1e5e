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
import numpy as np
import optimistix as optx
from jax.extend.core import jaxpr_as_fun
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array, Float, Int


class Bounds(NamedTuple):
    """Of each gain: lower and upper bound, and whether its scale is logarithmic."""

    lower: Float[Array | np.ndarray, "*problems gains"]
    upper: Float[Array | np.ndarray, "*problems gains"]
    logarithmic: Float[Array | np.ndarray, "*problems gains"]


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
    """Inverse of `to_gains`; a gain on a bound is moved inside by a thousandth of the range.

    A gain whose bounds are equal stays what it is, whatever its free number.
    """
    span = bounds.upper - bounds.lower
    share = (gains - bounds.lower) / jnp.where(span > 0, span, 1)
    logarithmic = (bounds.logarithmic > 0) & (span > 0)
    positive = jnp.where(logarithmic, jnp.maximum(gains, bounds.lower), 1)
    low = jnp.log(jnp.where(logarithmic, bounds.lower, 1))
    high = jnp.log(jnp.where(logarithmic, bounds.upper, 2))
    share = jnp.where(logarithmic, (jnp.log(positive) - low) / (high - low), share)
    share = jnp.clip(share, 1e-3, 1 - 1e-3)
    return jnp.log(share) - jnp.log1p(-share)


@partial(jax.jit, static_argnames=("residuals", "static", "longest", "tile"))
def solve(
    residuals: Callable[..., Float[Array, "problems residuals"]],
    static: Any,
    arguments: Any,
    bounds: Bounds,
    starts: Float[Array, "problems gains"],
    steps: Int[Array, ""],
    longest: int = 32,
    tile: int | None = None,
    rtol: float = 1e-4,
    atol: float = 1e-6,
) -> Solution:
    """Minimise sum(residuals(static, gains, arguments)^2) / 2 of many problems at once, in at most `steps`
    steps, themselves at most `longest`. Problems are dealt out to the devices.

    A problem is a start: its gains, their bounds and its arguments. `residuals` gets several, a leading axis
    of problems, which must not mix: `tile` of them at a time, by default all that a device has to do.
    """

    def of_free(free, arguments):
        bounds, arguments = arguments
        return residuals(static, jax.vmap(to_gains)(free, bounds), arguments)

    solver = _Recording(optx.LevenbergMarquardt(rtol=rtol, atol=atol), steps, longest)

    def one_device(starts, bounds, arguments):
        function = _with_jacobian(of_free, starts, (bounds, arguments), tile)
        return jax.vmap(partial(one, function))(starts, bounds, arguments)

    def one(function, start, bounds, arguments):
        solution = optx.least_squares(
            function,
            solver,
            to_free(start, bounds),
            args=(bounds, arguments),
            has_aux=True,
            max_steps=longest,
            throw=False,
        )
        stats = solution.stats
        loss = jnp.min(stats["history"])
        status = _status(solution.result, stats["converged"], loss)
        gains = to_gains(solution.value, bounds)
        return Solution(gains, loss, stats["history"], stats["num_steps"].astype(jnp.int32), status)

    devices = math.gcd(jax.device_count(), len(starts))
    # Traced outside of `jax.shard_map`, inside of which the solver's linear algebra does not trace.
    leaves, structure = jax.tree.flatten((starts, bounds, arguments))
    local = [jax.ShapeDtypeStruct((len(leaf) // devices, *leaf.shape[1:]), leaf.dtype) for leaf in leaves]
    traced = jax.make_jaxpr(lambda *leaves: one_device(*jax.tree.unflatten(structure, leaves)))(*local)
    mesh = jax.make_mesh(
        (devices,), ("device",), axis_types=(AxisType.Auto,), devices=jax.devices()[:devices]
    )
    own = PartitionSpec("device")
    # Each device goes its own way to the end: nothing is exchanged, nothing waits for another.
    found = jax.shard_map(jaxpr_as_fun(traced), mesh=mesh, in_specs=own, out_specs=own, check_vma=False)(
        *leaves
    )
    return Solution(*found)


def _with_jacobian(residuals, free, arguments, tile=None):
    """(residuals, loss) of one problem, to be called under a `jax.vmap` over all of them.

    Its derivative is one product with a Jacobian computed once, in forward mode, for all problems side by
    side, `tile` at a time. `free` and `arguments` are like those to come, problems first.
    """

    def value_and_jacobian(free, arguments):
        def along(direction):
            every = jnp.broadcast_to(direction, free.shape)
            return jax.jvp(lambda free: residuals(free, arguments), (free,), (every,))

        # Problems do not mix: one direction serves all of them.
        basis = jnp.eye(free.shape[-1], dtype=free.dtype)
        return jax.vmap(along, out_axes=(None, -1))(basis)

    def in_tiles(free, arguments):
        # A tile ends with its own slowest lane, and its numbers stay in the cache.
        size = math.gcd(len(free), tile or len(free))
        shape = len(free) // size, size
        tiles = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), (free, arguments))
        done = jax.lax.map(lambda one: value_and_jacobian(*one), tiles)
        return jax.tree.map(lambda leaf: leaf.reshape(len(free), *leaf.shape[2:]), done)

    # Traced once, however often the solver asks for it: tracing costs more than many a step.
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), (free, arguments))
    number = len(free)
    traced = jaxpr_as_fun(jax.make_jaxpr(in_tiles)(*shapes))

    @jax.custom_batching.custom_vmap
    def several(free, arguments):
        # One problem alone, run as often as there are problems: the program traced serves.
        same = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (number, *leaf.shape)), (free, arguments))
        return tuple(leaf[0] for leaf in traced(*jax.tree.leaves(same)))

    @several.def_vmap
    def rule(axis_size, in_batched, free, arguments):
        if not all(jax.tree.leaves(in_batched)):
            raise NotImplementedError("every argument must be mapped")
        return tuple(traced(*jax.tree.leaves((free, arguments)))), (True, True)

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
    """A solver that keeps the loss of every accepted iterate, and ends after `steps` of them, a number that
    is no part of the program."""

    rtol: float
    atol: float
    norm: Callable[[Any], Array]
    inner: optx.AbstractLeastSquaresSolver
    steps: Int[Array, ""]
    longest: int = eqx.field(static=True)

    def __init__(self, inner: optx.AbstractLeastSquaresSolver, steps: Int[Array, ""], longest: int):
        self.rtol, self.atol, self.norm = inner.rtol, inner.atol, inner.norm
        self.inner, self.steps, self.longest = inner, steps, longest

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        inner = self.inner.init(fn, y, args, options, f_struct, aux_struct, tags)
        history = jnp.full(self.longest, jnp.inf, y.dtype)
        return inner, history, jnp.array(0)

    def step(self, fn, y, args, options, state, tags):
        inner, history, count = state
        y, inner, loss = self.inner.step(fn, y, args, options, inner, tags)
        best = jnp.minimum(loss, jnp.where(count > 0, history[count - 1], jnp.inf))
        history = jnp.where(jnp.arange(self.longest) >= count, best, history)
        return y, (inner, history, count + 1), loss

    def terminate(self, fn, y, args, options, state, tags):
        converged, result = self.inner.terminate(fn, y, args, options, state[0], tags)
        return converged | (state[2] >= self.steps), result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        converged, _ = self.inner.terminate(fn, y, args, options, state[0], tags)
        y, aux, stats = self.inner.postprocess(fn, y, aux, args, options, state[0], tags, result)
        return y, aux, {**stats, "history": state[1], "converged": converged}


def _status(result, converged, loss):
    ended = (result == optx.RESULTS.successful) | (result == optx.RESULTS.nonlinear_max_steps_reached)
    status = jnp.where(ended, jnp.where(converged, 0, 1), 3)
    return jnp.where(jnp.isfinite(loss), status, 2).astype(jnp.int32)
