"""Terms of the tuning objective for every contact of an outcome: error, excess of the command, chatter."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxhil.simulation.outcome import Outcome
from tuning.gains.metrics_function import ScenarioMetrics, build_scenario_metrics
from tuning.transparency.probes import mask_probes

# error e - e* [1] that is assigned to a contact that does not end or does not occur: a strong divergence
FAILED_CONTACT_ERROR = 3.0


def compute_contact_terms(
    outcome: Outcome,
) -> tuple[Float[Any, "slots *batch"], Float[Any, "slots *batch"], Float[Any, "slots *batch"]]:
    """Return the restitution error, the excess of the peak command and the chatter of every contact, all [1].

    The excess is max(0, peak command / peak force of the ideal contact - 1). All three are
    `FAILED_CONTACT_ERROR` for failed contacts, and 0 for rows that are no contact of the scenario
    (`is_scheduled` is false). The results are NumPy arrays if the outcome holds NumPy arrays, otherwise JAX
    arrays.
    """
    xp = jnp if isinstance(outcome.error, jax.Array) else np
    # Without the inner `where`, non-finite numbers of failed contacts would make the derivative NaN.
    usable = outcome.good & xp.isfinite(outcome.error) & xp.isfinite(outcome.peak_ratio)
    usable = usable & xp.isfinite(outcome.chatter)
    error = xp.where(usable, outcome.error, FAILED_CONTACT_ERROR)
    beyond = xp.where(usable, outcome.peak_ratio, 1 + FAILED_CONTACT_ERROR) - 1
    excess = xp.where(beyond > 0, beyond, 0)
    chatter = xp.where(usable, outcome.chatter, FAILED_CONTACT_ERROR)
    is_scheduled = outcome.is_scheduled
    return (
        xp.where(is_scheduled, error, 0),
        xp.where(is_scheduled, excess, 0),
        xp.where(is_scheduled, chatter, 0),
    )


def extract_scenario_metrics(outcome: Outcome, number: int, contacts: int, probed: bool) -> ScenarioMetrics:
    """Return the metrics that a user's function receives, arrays (problems, contacts, scenarios).

    The last axis of `outcome` lists the scenarios of all problems one after the other. If `probed` is true,
    this axis also contains the transparency probes of each scenario, which the metrics omit.
    """

    def by_problem(leaf):
        several = leaf[:contacts].reshape(contacts, number, -1)
        return jnp.moveaxis(several[..., ~(mask_probes(several.shape[-1]) & probed)], 1, 0)

    return jax.tree.map(by_problem, build_scenario_metrics(outcome, FAILED_CONTACT_ERROR))
