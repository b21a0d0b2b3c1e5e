"""Levenberg-Marquardt solver in the unit box, based on optimistix, for many problems in one program.

A step minimises the damped linear model within the box. A gain that the model would move beyond a bound stops
at the bound, and the other gains then move as if this gain were constant (`_BoxedDescent`). Each step
computes residuals and Jacobian together, in forward mode.
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
from jax.scipy.linalg import cho_solve
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array, Float, Int

from tuning.optimisation.solution import SolverResult
from tuning.optimisation.unit_box import GainBounds, to_gains

INITIAL_DAMPING = 0.1  # damping of the first step, relative to the mean diagonal element of J^T J [1]
MIN_STEP_LENGTH = 1e-6  # minimum step, in unit coordinates; a problem whose step is shorter has converged
# Number of steps and minimum relative decrease of the loss in these steps; below it, a problem has converged.
PROGRESS_STEPS, MIN_LOSS_DECREASE = 5, 1e-3
RTOL, ATOL = 1e-4, 1e-6  # relative and absolute tolerance of convergence


@partial(jax.jit, static_argnames=("residuals", "static", "longest", "tile"))
def solve_least_squares(
    residuals: Callable[..., Float[Array, "problems residuals"]],
    static: Any,
    arguments: Any,
    bounds: GainBounds,
    starts: Float[Array, "problems gains"],
    steps: Int[Array, ""],
    longest: int = 32,
    tile: int | None = None,
) -> SolverResult:
    """Minimise half the sum of squared residuals for each of many problems, distributed over all devices.

    A problem has converged if a step changes its residuals and coordinates by less than the tolerances `RTOL`
    and `ATOL`, or is shorter than `MIN_STEP_LENGTH`. It has also converged if the relative decrease of the
    loss in `PROGRESS_STEPS` steps is below `MIN_LOSS_DECREASE`.

    Args:
        residuals: function that returns the residuals (problems, residuals). The residuals of a problem must
            depend only on the gains and arguments of this problem.
        static: first argument of `residuals`; a new value causes a new compilation.
        arguments: third argument of `residuals`, arrays with a leading axis of problems.
        bounds: bounds of the gains of each problem.
        starts: starting points in unit coordinates.
        steps: largest number of steps, at most `longest`.
        longest: upper limit on `steps`; a new value causes a new compilation.
        tile: number of problems that a device evaluates together; None for all problems of the device.

    Returns:
        The best point of each problem, and the history of the loss.
    """

    def of_coordinates(coordinates, arguments):
        bounds, arguments = arguments
        return residuals(static, to_gains(coordinates, bounds), arguments)

    solver = _LossRecordingSolver(_BoxedLevenbergMarquardt(RTOL, ATOL), steps, longest)

    def one_device(starts, bounds, arguments):
        function = _with_jacobian(of_coordinates, starts, (bounds, arguments), tile)
        return jax.vmap(partial(one_problem, function))(starts, bounds, arguments)

    def one_problem(function, start, bounds, arguments):
        solution = optx.least_squares(
            function,
            solver,
            start,
            args=(bounds, arguments),
            has_aux=True,
            max_steps=longest,
            throw=False,
        )
        stats = solution.stats
        loss = jnp.min(stats["history"])
        status = _find_status(solution.result, stats["converged"], loss)
        steps = stats["num_steps"].astype(jnp.int32)
        return SolverResult(solution.value, stats["curvature"], loss, stats["history"], steps, status)

    return SolverResult(*_shard_over_devices(one_device, starts, bounds, arguments))


def _shard_over_devices(one_device: Callable[..., SolverResult], *arguments: Any) -> tuple[Array, ...]:
    """Split the arguments along their leading axis, and call `one_device` on each device with its part."""
    leaves, structure = jax.tree.flatten(arguments)
    devices = math.gcd(jax.device_count(), len(leaves[0]))
    # Tracing is done outside `jax.shard_map`, because the solver's linear algebra cannot be traced inside.
    local = [jax.ShapeDtypeStruct((len(leaf) // devices, *leaf.shape[1:]), leaf.dtype) for leaf in leaves]
    traced = jax.make_jaxpr(lambda *leaves: one_device(*jax.tree.unflatten(structure, leaves)))(*local)
    mesh = jax.make_mesh(
        (devices,), ("device",), axis_types=(AxisType.Auto,), devices=jax.devices()[:devices]
    )
    spec = PartitionSpec("device")
    # The devices exchange no data, so that no device waits for another.
    run = jax.shard_map(jaxpr_as_fun(traced), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return tuple(run(*leaves))


def _with_jacobian(residuals, free, arguments, tile=None):
    """Return a function that computes (residuals, loss) of one problem, for use inside `jax.vmap`.

    The map must be over all problems. The function's derivative is the product of the Jacobian and a tangent.
    The Jacobian is computed once, in forward mode, for `tile` problems at a time. `free` and `arguments` are
    example inputs of the mapped function, with a leading axis of problems.
    """

    def value_and_jacobian(free, arguments):
        def along(direction):
            directions = jnp.broadcast_to(direction, free.shape)
            return jax.jvp(lambda free: residuals(free, arguments), (free,), (directions,))

        # One tangent serves all problems, because the residuals of a problem depend only on its own gains.
        basis = jnp.eye(free.shape[-1], dtype=free.dtype)
        return jax.vmap(along, out_axes=(None, -1))(basis)

    def in_tiles(free, arguments):
        # Problems run in groups (tiles): a slow problem delays only its tile, whose data fit into the cache.
        size = math.gcd(len(free), tile or len(free))
        shape = len(free) // size, size
        tiles = jax.tree.map(lambda leaf: leaf.reshape(*shape, *leaf.shape[1:]), (free, arguments))
        results = jax.lax.map(lambda tile: value_and_jacobian(*tile), tiles)
        return jax.tree.map(lambda leaf: leaf.reshape(len(free), *leaf.shape[2:]), results)

    # The function is traced once for all calls by the solver, because tracing costs more than many steps.
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), (free, arguments))
    number = len(free)
    traced = jaxpr_as_fun(jax.make_jaxpr(in_tiles)(*shapes))

    @jax.custom_batching.custom_vmap
    def several(free, arguments):
        # A single problem is repeated, because the traced function needs `number` problems.
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (number, *leaf.shape)), (free, arguments))
        return tuple(leaf[0] for leaf in traced(*jax.tree.leaves(copies)))

    @several.def_vmap
    def rule(axis_size, in_batched, free, arguments):
        if not all(jax.tree.leaves(in_batched)):
            raise NotImplementedError(
                "vmap: found an argument without a batch axis, expected a batch axis on each"
            )
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


class _LinearModel(NamedTuple):
    """Linear model of the residuals at the start of a step."""

    coordinates: Float[Array, "gains"]  # start of the step
    curvature: Float[Array, "gains gains"]  # J^T J
    gradient: Float[Array, "gains"]  # gradient of the loss, J^T r


class _BoxedDescent(optx.AbstractDescent):
    """Optimistix descent whose step d minimises the damped linear model of the residuals in the unit box.

    For the gains that are not at a bound, d solves (J^T J + D I) d = -J^T r. Here, r are the residuals, J is
    their Jacobian, I the identity, and D = `INITIAL_DAMPING` mean(diag(J^T J)) / step_size the damping.
    """

    def init(self, y, f_info_struct):
        return _LinearModel(y, jnp.zeros((len(y), len(y)), y.dtype), jnp.zeros_like(y))

    def query(self, y, f_info, state):
        basis = jnp.eye(len(y), dtype=y.dtype)
        jacobian = jax.vmap(f_info.jac.mv, out_axes=-1)(basis)
        return _LinearModel(y, jacobian.T @ jacobian, jacobian.T @ f_info.residual)

    def step(self, step_size, state):
        coordinates, curvature, gradient = state
        number, dtype = len(coordinates), coordinates.dtype
        damping = INITIAL_DAMPING * jnp.trace(curvature) / number / step_size.astype(dtype)
        identity = jnp.eye(number, dtype=dtype)
        # The small number makes the matrix regular even if a gain has no effect and its curvature is 0.
        damped = curvature + (damping + jnp.finfo(dtype).tiny ** 0.5) * identity
        room = -coordinates, 1 - coordinates
        free = ~((coordinates <= 0) & (gradient > 0) | (coordinates >= 1) & (gradient < 0))

        def bind(_, state):
            free, step = state
            step = jnp.where(free, 0, step)
            both = free[:, None] & free[None, :]
            matrix = jnp.where(both, damped, identity)
            force = jnp.where(free, -gradient - curvature @ step, 0)
            unbounded = cho_solve((jnp.linalg.cholesky(matrix), True), force)
            inside = jnp.clip(unbounded, *room)
            return free & (unbounded == inside), jnp.where(free, inside, step)

        # Each iteration fixes at least one more gain at a bound, unless the step is already final.
        _, step = jax.lax.fori_loop(0, number + 1, bind, (free, jnp.zeros_like(coordinates)))
        return step, optx.RESULTS.successful


class _BoxedLevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt solver whose iterates stay in the unit box."""

    rtol: float
    atol: float
    norm: Callable[[Any], Array]
    descent: _BoxedDescent
    search: optx.ClassicalTrustRegion
    verbose: Callable[..., None]

    def __init__(self, rtol: float, atol: float):
        self.rtol, self.atol, self.norm = rtol, atol, optx.max_norm
        self.descent = _BoxedDescent()
        # The trust region grows if the decrease is at least 0.75 of the predicted one; the default condition
        # is never met.
        self.search = optx.ClassicalTrustRegion(0.75, 1e-3, 3.0, 0.25)
        self.verbose = lambda **_: None


class _LossRecordingSolver(optx.AbstractLeastSquaresSolver):
    """Solver that records the loss of every accepted iterate."""

    rtol: float
    atol: float
    norm: Callable[[Any], Array]
    inner: optx.AbstractLeastSquaresSolver
    steps: Int[Array, ""]  # limit on the number of steps, an argument of the compiled program
    longest: int = eqx.field(static=True)  # limit on `steps`, a constant of the compiled program

    def __init__(self, inner: optx.AbstractLeastSquaresSolver, steps: Int[Array, ""], longest: int):
        self.rtol, self.atol, self.norm = inner.rtol, inner.atol, inner.norm
        self.inner, self.steps, self.longest = inner, steps, longest

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        inner = self.inner.init(fn, y, args, options, f_struct, aux_struct, tags)
        history = jnp.full(self.longest, jnp.inf, y.dtype)
        return inner, history, jnp.zeros_like(self.steps)

    def step(self, fn, y, args, options, state, tags):
        inner, history, count = state
        y, inner, aux = self.inner.step(fn, y, args, options, inner, tags)
        # The returned `aux` belongs to the previous step; `inner.aux` is the current loss.
        best = jnp.minimum(inner.aux, jnp.where(count > 0, history[count - 1], jnp.inf))
        history = jnp.where(jnp.arange(self.longest) >= count, best, history)
        return y, (inner, history, count + 1), aux

    def terminate(self, fn, y, args, options, state, tags):
        converged, result = self._converged(fn, y, args, options, state, tags)
        return converged | (state[2] >= self.steps), result

    def _converged(self, fn, y, args, options, state, tags):
        inner, history, count = state
        converged, result = self.inner.terminate(fn, y, args, options, inner, tags)
        still = jnp.max(jnp.abs(inner.y_eval - y)) < MIN_STEP_LENGTH
        before = history[jnp.maximum(count - 1 - PROGRESS_STEPS, 0)]
        slow = (count > PROGRESS_STEPS) & (history[count - 1] > (1 - MIN_LOSS_DECREASE) * before)
        return converged | ((count > 0) & (still | slow)), result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        converged, _ = self._converged(fn, y, args, options, state, tags)
        y, aux, stats = self.inner.postprocess(fn, y, aux, args, options, state[0], tags, result)
        curvature = state[0].descent_state.curvature
        return y, aux, {**stats, "history": state[1], "converged": converged, "curvature": curvature}


def _find_status(result, converged, loss):
    ended = (result == optx.RESULTS.successful) | (result == optx.RESULTS.nonlinear_max_steps_reached)
    status = jnp.where(ended, jnp.where(converged, 0, 1), 3)
    return jnp.where(jnp.isfinite(loss), status, 2).astype(jnp.int32)
