"""What tuning runs: scenarios and loops of a mechanism of one axis or of six, under the same names.

`jaxhil.simulation.evaluation` runs both; the solver takes derivatives through what `prepared` and `outcome`
give it. In six axes errors are those of the energy and of the twist (`jaxhil.sixdof.evaluation`).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Constants, Gains
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.evaluation import Outcome, compare_with_reference, run_lanes
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.rollout import run_contacts
from jaxhil.simulation.scenario import build_scenarios


def scenarios_of(
    mechanism: AnyMechanism, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
) -> Any:
    """Scenarios of a mechanism, leaves NumPy's; see `jaxhil.simulation.scenario.build_scenarios`."""
    if isinstance(mechanism, SixAxisMechanism):
        # Knows of runs in six axes, too.
        from jaxhil.sixdof import building, evaluation  # noqa: F401

        return jax.tree.map(np.asarray, building.build_scenarios(mechanism, draws, seed, first))
    return build_scenarios(mechanism, draws, seed, first)


def loop_of(mechanism: AnyMechanism, compensator: str, scenarios: Any, **parts: bool) -> Any:
    """The loop that runs the scenarios; `parts` are those that one axis has."""
    if isinstance(mechanism, SixAxisMechanism):
        from jaxhil.sixdof import building

        return building.loop_of(mechanism, compensator, scenarios)
    return build_loop(mechanism, compensator, scenarios, **parts)


def without_noise(scenarios: Any) -> Any:
    """Return the scenarios with sensors that have no noise."""

    def silent(sensor: Any) -> Any:
        return sensor._replace(noise_std=np.zeros_like(sensor.noise_std))

    if hasattr(scenarios, "sensor"):  # six axes
        return scenarios._replace(sensor=silent(scenarios.sensor))
    force, position = silent(scenarios.force_sensor), silent(scenarios.position_sensor)
    return scenarios._replace(force_sensor=force, position_sensor=position)


def with_compensator(loop: Any, compensator: str) -> Any:
    """The loop with another compensator."""
    law = COMPENSATORS[compensator] if isinstance(loop, Loop) else compensator
    return dataclasses.replace(loop, compensator=law)


def compensator_name(loop: Any) -> str:
    """The name of a loop's compensator."""
    return loop.compensator.name if isinstance(loop, Loop) else loop.compensator


def contacts_of(mechanism: AnyMechanism) -> int:
    """Rows of an outcome that a run is asked for: its contacts; of episodes both errors."""
    if not isinstance(mechanism, SixAxisMechanism):
        return mechanism.approach.contacts
    return 2 * (mechanism.approach.episodes if mechanism.approach else 1)


def has_foreign_law(scenarios: Any) -> bool:
    """Whether scenarios of six axes have a contact law from elsewhere, which they carry themselves."""
    groups = getattr(scenarios, "groups", ())
    return any(not type(group.law).__module__.startswith("jaxhil.") for group in groups)


def prepared(loop: Any, scenarios: Any) -> Any:
    """What `outcome` needs of scenarios, worked out once for all gains."""
    if isinstance(loop, Loop):
        return build_rig_constants(loop, scenarios, measured=loop.compensator.reads_position)
    return scenarios


def outcome(loop: Any, gains: Gains, rig: Any) -> Outcome:
    """Outcome of what `prepared` gave, differentiable by the gains."""
    if not isinstance(loop, Loop):
        return run_lanes(loop, gains, rig)
    if loop.compensator.is_large:
        rig = _apart(rig)
    return compare_with_reference(loop, rig.scenario, run_contacts(loop, gains, rig))


def _apart(rig: RigConstants) -> RigConstants:
    """The same rig, such that loops around its runs are compiled apart from them.

    XLA makes the outermost loop that does not sort one function, all loops within it included, and LLVM's
    time for a function grows with the square of its length.
    """
    contacts = rig.scenario.contacts
    most = jnp.max(contacts)
    most = jnp.sort(jnp.stack([most, most + 1]))[1]
    return rig._replace(scenario=rig.scenario._replace(contacts=jnp.minimum(contacts, most)))


def amplification(loop: Any, gains: Gains, rig: Any) -> Float[Array, "*batch"]:
    """How much the compensator amplifies the sensor's noise [1]; in six axes it is not asked."""
    if isinstance(loop, Loop):
        return loop.compensator.noise_amplification(gains, rig.constants)
    return jnp.ones_like(rig.control_period)


def error_parts(outcome: Outcome) -> dict[str, Outcome]:
    """Outcome in six axes cut into that of each error, by its name."""
    from jaxhil.sixdof.evaluation import ERRORS

    episodes = len(outcome.error) // len(ERRORS)
    return {
        name: jax.tree.map(lambda leaf, begin=begin: leaf[begin : begin + episodes], outcome)
        for begin, name in zip(range(0, 2 * episodes, episodes), ERRORS, strict=True)
    }


def constants_of(scenarios: Any) -> Constants:
    """What the controller knows of the rig, of scenarios of one axis."""
    return Constants(jnp.asarray(scenarios.control_period), jnp.asarray(scenarios.clearance))
