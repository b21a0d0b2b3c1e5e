"""Simulation of a six-axis mechanism's ideal contact: two free bodies without a rig."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, jax_context, supported_options
from jaxhil.sixdof.building import build_scenarios
from jaxhil.sixdof.episode_tracking import required_pause
from jaxhil.sixdof.ideal_contact import summary_at
from jaxhil.sixdof.metrics import Metrics, compare_with_ideal
from jaxhil.sixdof.plausibility import check_scenario
from jaxhil.sixdof.rollout import REBOUNDED, EpisodeBatch, compute_ideal_contact
from jaxhil.sixdof.run import Final, check_integrated, compute_ideal_final
from jaxhil.sixdof.scenario import Scenario


class IdealEpisode(NamedTuple):
    """Metrics of the first episode (contact with all its touches) of the ideal contact; NaN if undefined.

    Attributes:
        reference_restitution: Restitution e* [1]; NaN unless there is a single touch.
        effective_mass: Effective mass m_n at the first touch [kg].
        approach_velocity: Approach velocity along the normal of the first touch [m/s].
        point: Point of the first touch, in target frame T [m].
        normal: Normal of the target's surface at this point, outward.
        reference_peak_force: Peak force [N].
        reference_peak_moment: Peak moment about the origin of target frame T [N m].
        reference_duration: Time during which shapes touch [s].
        reference_touches: Number of touches of all pairs of shapes.
    """

    reference_restitution: float
    effective_mass: float
    approach_velocity: float
    point: tuple[float, ...]
    normal: tuple[float, ...]
    reference_peak_force: float
    reference_peak_moment: float
    reference_duration: float
    reference_touches: int


class IdealRun(NamedTuple):
    """Result of a simulation of the ideal contact.

    Attributes:
        episode: Metrics of the first episode.
        status: "rebounded", "captured" (a latch holds the chaser), or "miss".
        final: Motion of the bodies at the end of the duration that the mechanism file specifies.
    """

    episode: IdealEpisode
    status: str
    final: Final


def simulate_ideal_contact(mechanism: SixAxisMechanism) -> IdealRun:
    """Simulate the ideal contact of a six-axis mechanism for the whole duration of its nominal run.

    Raise `InputError` if the start is invalid, or if a contact is too stiff to be integrated.
    """
    with jax_context():
        scenario = build_scenarios(mechanism)
        check_scenario(mechanism, scenario)
        metrics = jax.device_get(_compiled()(scenario))
    check_integrated(mechanism, metrics)

    def value(name: str) -> Any:
        entry = np.asarray(getattr(metrics, name))[..., 0, 0]
        return tuple(entry.tolist()) if entry.ndim else entry.item()

    episode = IdealEpisode(*map(value, IdealEpisode._fields))
    status = (
        "captured" if value("reference_captured") else "rebounded" if episode.reference_touches else "miss"
    )
    period = float(scenario.control_period[0])
    ticks = np.round(float(scenario.duration[0]) / period)
    return IdealRun(episode, status, compute_ideal_final(mechanism, float(ticks * period)))


def _ideal_metrics(scenario: Scenario) -> Metrics:
    """Return metrics in which only the fields of the ideal contact are valid; the rig's fields are not."""
    period = scenario.control_period
    until = jnp.round(scenario.duration / period) * period
    pause = required_pause(scenario.sensor, period, scenario.timing)
    reference = compute_ideal_contact(scenario)
    first = reference.gaps.begin.time[0]
    elapsed = jnp.minimum(first + pause, until)
    zero, none = jnp.zeros_like(until), jnp.zeros(until.shape, jnp.int32)
    episode = EpisodeBatch(
        start=scenario.start,
        end=scenario.start,
        elapsed=elapsed,
        first_touch=reference.first_touch,
        summary=summary_at(reference, elapsed, elapsed < until),
        touches=none,
        duration=zero,
        peak_force=zero,
        peak_command=zero,
        peak_moment=zero,
        penetration=zero,
        status=none + REBOUNDED,
    )
    return compare_with_ideal(scenario.bodies, jax.tree.map(lambda leaf: leaf[None], episode))


@cache
def _compiled() -> Callable[[Scenario], Metrics]:
    return jax.jit(_ideal_metrics, compiler_options=supported_options(SINGLE_RUN_OPTIONS))
