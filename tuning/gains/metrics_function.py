"""User-defined objective, a function of the metrics of all contacts in all scenarios.

The function gets `ScenarioMetrics` and returns one number >= 0, which tuning minimises. JAX must be able to
trace the function, because the solver compiles and differentiates it together with the simulation.
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
    """Contact metrics that a user's objective function gets, as JAX arrays (contacts, scenarios).

    For a contact that does not end, `error` is 3, `restitution` is e* + 3 and `peak_command` is four times
    the ideal contact's peak force. Its other metrics cover the time until the run stopped.

    Attributes:
        error: restitution error e - e* [1].
        restitution: restitution e, the rebound speed divided by the approach speed [1].
        reference_restitution: restitution e* of the ideal contact with the same approach speed [1].
        peak_command: largest magnitude of the force command F_c [N].
        peak_force: largest magnitude of the real contact force [N].
        duration: time from the contact's onset to its end [s].
        approach_velocity: speed at the contact's onset [m/s].
        status: 0 if the contact ended, else a key of `jaxhil.simulation.metrics.CONTACT_STATUS_NAMES`.
    """

    error: Float[Array, "contacts scenarios"]
    restitution: Float[Array, "contacts scenarios"]
    reference_restitution: Float[Array, "contacts scenarios"]
    peak_command: Float[Array, "contacts scenarios"]
    peak_force: Float[Array, "contacts scenarios"]
    duration: Float[Array, "contacts scenarios"]
    approach_velocity: Float[Array, "contacts scenarios"]
    status: Int[Array, "contacts scenarios"]


class MetricsFunction:
    """User's objective function; an instance equals only itself, so that it has its own compiled program."""

    def __init__(self, function: Callable[[ScenarioMetrics], Any]):
        self.function = function
        self._vectorised = jax.jit(jax.vmap(self._value))

    def check(self, contacts: int, scenarios: int) -> None:
        """Raise `InputError` unless the function turns metrics (contacts, scenarios) into one real number."""
        like: Any = jax.ShapeDtypeStruct((contacts, scenarios), jnp.result_type(float))
        count: Any = jax.ShapeDtypeStruct((contacts, scenarios), jnp.int32)
        metrics = ScenarioMetrics(*[like] * 7, status=count)
        try:
            result = jax.eval_shape(self.function, metrics)
        except Exception as error:
            reason = to_one_line(f"{type(error).__name__}: {str(error).partition(chr(10))[0]}", 160)
            raise InputError(
                f"objective: found a function that raises {reason}, expected {FUNCTION_REQUIREMENT}"
            ) from None
        if not isinstance(result, jax.ShapeDtypeStruct) or not jnp.issubdtype(result.dtype, jnp.floating):
            name = getattr(result, "dtype", type(result).__name__)
            raise InputError(
                f"objective: found a function that returns {format_value(str(name))}, expected "
                f"{FUNCTION_REQUIREMENT}"
            )
        if result.shape != ():
            raise InputError(
                f"objective: found a function that returns shape {result.shape}, expected "
                f"{FUNCTION_REQUIREMENT}"
            )

    def values(self, metrics: ScenarioMetrics) -> Float[Array, "several"]:
        """Return the function's value for each set of metrics, arrays (sets, contacts, scenarios)."""
        return jax.vmap(self._value)(metrics)

    def numbers(self, metrics: ScenarioMetrics) -> Float[np.ndarray, "several"]:
        """Evaluate the function like `values`; return a NumPy array in which NaN replaces infinity.

        Raise `InputError` if a value is negative.
        """
        values = np.asarray(self._vectorised(metrics), float)
        if np.any(values < 0):
            raise InputError(
                f"objective: found a function that returns {float(np.nanmin(values)):.6g}, expected "
                f"{FUNCTION_REQUIREMENT}"
            )
        return np.where(np.isfinite(values), values, np.nan)

    def _value(self, metrics: ScenarioMetrics) -> Float[Array, ""]:
        return jnp.asarray(self.function(metrics), metrics.error.dtype)


def build_scenario_metrics(outcome: Outcome, failed: float) -> ScenarioMetrics:
    """Select the metrics (contacts, *batch) from an outcome; a failed contact gets the error `failed`."""
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
