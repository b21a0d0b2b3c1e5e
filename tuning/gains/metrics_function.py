"""An objective of the user's own: a function of the metrics of all contacts in all scenarios.

It gets `ScenarioMetrics` and has to return one number that is to be made small, at least 0. It must be
traceable: it is compiled, and the solver differentiates it together with the simulation.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxhil.errors import InputError, one_line, shown
from jaxhil.simulation.outcome import Outcome

ALLOWED = "a function of metrics that returns a finite number >= 0"


class ScenarioMetrics(NamedTuple):
    """What the function gets: jax arrays, a contact a row, a scenario a column.

    Of a contact that does not end, error and restitution are those of a wild divergence (an error of 3), and
    the command peaks at four times the force in space; the rest is as far as it got."""

    error: Float[Array, "contacts scenarios"]  # restitution error e - e* [1]
    restitution: Float[Array, "contacts scenarios"]  # rebound speed over approach speed, e [1]
    # the same in space, entered at the same speed, e* [1]
    reference_restitution: Float[Array, "contacts scenarios"]
    peak_command: Float[Array, "contacts scenarios"]  # largest magnitude of the commanded force F_c [N]
    peak_force: Float[Array, "contacts scenarios"]  # largest magnitude of the real contact force [N]
    duration: Float[Array, "contacts scenarios"]  # from a contact's beginning to its end [s]
    approach_velocity: Float[Array, "contacts scenarios"]  # with which the contact is entered [m/s]
    # 0 for a contact that ended, else why not (`jaxhil.simulation.metrics.STATUS_NAMES`)
    status: Int[Array, "contacts scenarios"]


class MetricsFunction:
    """A user's function as an objective. It is equal to itself alone: no other's program stands in for it."""

    def __init__(self, function: Callable[[ScenarioMetrics], Any]):
        self.function = function
        self._several = jax.jit(jax.vmap(self._value))

    def check(self, contacts: int, scenarios: int) -> None:
        """It returns one number for so many contacts and scenarios. Raises `InputError`."""
        like: Any = jax.ShapeDtypeStruct((contacts, scenarios), jnp.result_type(float))
        count: Any = jax.ShapeDtypeStruct((contacts, scenarios), jnp.int32)
        metrics = ScenarioMetrics(*[like] * 7, status=count)
        try:
            found = jax.eval_shape(self.function, metrics)
        except Exception as error:
            reason = one_line(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}", 160)
            raise InputError(f"objective: found one that raises {reason}, allowed {ALLOWED}") from None
        if not isinstance(found, jax.ShapeDtypeStruct) or not jnp.issubdtype(found.dtype, jnp.floating):
            name = getattr(found, "dtype", type(found).__name__)
            raise InputError(f"objective: found one that returns {shown(str(name))}, allowed {ALLOWED}")
        if found.shape != ():
            raise InputError(f"objective: found one that returns shape {found.shape}, allowed {ALLOWED}")

    def values(self, metrics: ScenarioMetrics) -> Float[Array, "several"]:
        """Of several sets of metrics, each leaf (several, contacts, scenarios); traceable."""
        return jax.vmap(self._value)(metrics)

    def numbers(self, metrics: ScenarioMetrics) -> Float[np.ndarray, "several"]:
        """The same as NumPy numbers, NaN where one is not finite. Raises `InputError` for a negative one."""
        found = np.asarray(self._several(metrics), float)
        if np.any(found < 0):
            raise InputError(f"objective: found {float(np.nanmin(found)):.6g}, allowed {ALLOWED}")
        return np.where(np.isfinite(found), found, np.nan)

    def _value(self, metrics: ScenarioMetrics) -> Float[Array, ""]:
        return jnp.asarray(self.function(metrics), metrics.error.dtype)


def scenario_metrics(outcome: Outcome, failed: float) -> ScenarioMetrics:
    """Metrics of an outcome, each leaf (contacts, *batch); contacts that failed have so large an error."""
    metrics = outcome.metrics
    # The inner `where` keeps what a failed contact leaves behind out of the derivative.
    usable = outcome.good & jnp.isfinite(outcome.error) & jnp.isfinite(outcome.peak_ratio)
    error = jnp.where(usable, outcome.error, failed)
    reference = outcome.reference_restitution
    command = jnp.where(usable, metrics.peak_command, (1 + failed) * outcome.reference_peak_force)
    found = (
        error,
        jnp.where(usable, metrics.restitution, reference + failed),
        reference,
        command,
        metrics.peak_force,
        metrics.duration,
        metrics.approach_velocity,
    )
    finite = [jnp.where(jnp.isfinite(leaf), leaf, 0) for leaf in found]
    return ScenarioMetrics(*finite, status=jnp.asarray(metrics.status))
