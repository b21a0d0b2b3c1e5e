"""User-defined objective, a function of the metrics of all contacts in all scenarios.

The function gets `ScenarioMetrics` and returns one number >= 0, which tuning minimises. It must be traceable
by JAX: it is compiled, and the solver differentiates it together with the simulation.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.simulation.outcome import Outcome

FUNCTION_REQUIREMENT = "a function of metrics that returns a finite number >= 0"


class ScenarioMetrics(NamedTuple):
    """Argument of a user's function: JAX arrays with one row per contact and one column per scenario.

    A contact that does not end has an error of 3, the matching restitution and a peak command of four times
    the ideal contact's peak force; its other metrics are those until the run stopped.
    """

    error: Float[Array, "contacts scenarios"]  # restitution error e - e* [1]
    restitution: Float[Array, "contacts scenarios"]  # rebound speed over approach speed, e [1]
    # restitution e* of the ideal contact with the same approach speed [1]
    reference_restitution: Float[Array, "contacts scenarios"]
    peak_command: Float[Array, "contacts scenarios"]  # largest magnitude of the commanded force F_c [N]
    peak_force: Float[Array, "contacts scenarios"]  # largest magnitude of the real contact force [N]
    duration: Float[Array, "contacts scenarios"]  # from a contact's beginning to its end [s]
    approach_velocity: Float[Array, "contacts scenarios"]  # speed at the onset of the contact [m/s]
    # 0 for a contact that ended, else the reason (index into `jaxhil.simulation.metrics.STATUS_NAMES`)
    status: Int[Array, "contacts scenarios"]


class MetricsFunction:
    """User's function as an objective; equal only to itself, so that no other function uses its program."""

    def __init__(self, function: Callable[[ScenarioMetrics], Any]):
        self.function = function
        self._vectorised = jax.jit(jax.vmap(self._value))

    def check(self, contacts: int, scenarios: int) -> None:
        """Raise `InputError` if the function does not return one number for (contacts, scenarios) metrics."""
        like: Any = jax.ShapeDtypeStruct((contacts, scenarios), jnp.result_type(float))
        count: Any = jax.ShapeDtypeStruct((contacts, scenarios), jnp.int32)
        metrics = ScenarioMetrics(*[like] * 7, status=count)
        try:
            result = jax.eval_shape(self.function, metrics)
        except Exception as error:
            reason = to_one_line(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}", 160)
            raise InputError(
                f"objective: found one that raises {reason}, expected {FUNCTION_REQUIREMENT}"
            ) from None
        if not isinstance(result, jax.ShapeDtypeStruct) or not jnp.issubdtype(result.dtype, jnp.floating):
            name = getattr(result, "dtype", type(result).__name__)
            raise InputError(
                f"objective: found one that returns {format_value(str(name))}, expected "
                f"{FUNCTION_REQUIREMENT}"
            )
        if result.shape != ():
            raise InputError(
                f"objective: found one that returns shape {result.shape}, expected {FUNCTION_REQUIREMENT}"
            )

    def values(self, metrics: ScenarioMetrics) -> Float[Array, "several"]:
        """Return the values of several sets of metrics, leaves (several, contacts, scenarios); traceable."""
        return jax.vmap(self._value)(metrics)

    def numbers(self, metrics: ScenarioMetrics) -> Float[np.ndarray, "several"]:
        """Return `values` in NumPy, NaN for non-finite ones; raise `InputError` if one is negative."""
        values = np.asarray(self._vectorised(metrics), float)
        if np.any(values < 0):
            raise InputError(
                f"objective: found {float(np.nanmin(values)):.6g}, expected {FUNCTION_REQUIREMENT}"
            )
        return np.where(np.isfinite(values), values, np.nan)

    def _value(self, metrics: ScenarioMetrics) -> Float[Array, ""]:
        return jnp.asarray(self.function(metrics), metrics.error.dtype)


def build_scenario_metrics(outcome: Outcome, failed: float) -> ScenarioMetrics:
    """Return the metrics of an outcome, leaves (contacts, *batch); failed contacts have error `failed`."""
    metrics = outcome.metrics
    # Without the inner `where`, non-finite numbers of failed contacts would make the derivative NaN.
    usable = outcome.good & jnp.isfinite(outcome.error) & jnp.isfinite(outcome.peak_ratio)
    error = jnp.where(usable, outcome.error, failed)
    reference = outcome.reference_restitution
    command = jnp.where(usable, metrics.peak_command, (1 + failed) * outcome.reference_peak_force)
    leaves = (
        error,
        jnp.where(usable, metrics.restitution, reference + failed),
        reference,
        command,
        metrics.peak_force,
        metrics.duration,
        metrics.approach_velocity,
    )
    finite = [jnp.where(jnp.isfinite(leaf), leaf, 0) for leaf in leaves]
    return ScenarioMetrics(*finite, status=jnp.asarray(metrics.status))
