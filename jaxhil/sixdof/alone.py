"""Ideal contact of two free bodies without a rig: their first episode and their final motion."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, jax_context, supported_options
from jaxhil.sixdof.building import build_scenarios
from jaxhil.sixdof.metrics import Metrics, judge
from jaxhil.sixdof.plausibility import check_scenario
from jaxhil.sixdof.reference import follow_contact, past_at
from jaxhil.sixdof.rollout import REBOUNDED, Episode
from jaxhil.sixdof.run import Final, check_followed, final_in_space
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.space import Space
from jaxhil.sixdof.watch import quiet_time


class EpisodeInSpace(NamedTuple):
    """First episode of the ideal contact, as in a run; NaN for values that it does not have."""

    reference_restitution: float  # e*; NaN unless there is a single touch [1]
    effective_mass: float  # m_n at the first touch [kg]
    approach_velocity: float  # along the normal of the first touch [m/s]
    point: tuple[float, ...]  # point of the first touch, in T axes [m]
    normal: tuple[float, ...]  # normal there, outward from the target
    reference_peak_force: float  # [N]
    reference_peak_moment: float  # about T's origin [N m]
    reference_duration: float  # time in touch [s]
    reference_touches: int  # number of onsets of touch, over all candidates


class SpaceRun(NamedTuple):
    """Ideal contact of a mechanism's two bodies."""

    episode: EpisodeInSpace
    status: str  # "rebounded", "captured" (held by a latch), or "miss"
    final: Final  # motion at the end of the file's duration


def simulate_in_space(mechanism: SixAxisMechanism) -> SpaceRun:
    """Simulate the ideal contact of a six-axis mechanism, from its start to the end of its duration.

    Raise `InputError` if the start is invalid or a contact is too stiff to be integrated.
    """
    with jax_context():
        scenario = build_scenarios(mechanism)
        check_scenario(mechanism, scenario)
        metrics = jax.device_get(_compiled()(scenario))
    check_followed(mechanism, metrics)

    def value(name: str) -> Any:
        entry = np.asarray(getattr(metrics, name))[..., 0, 0]
        return tuple(entry.tolist()) if entry.ndim else entry.item()

    episode = EpisodeInSpace(*map(value, EpisodeInSpace._fields))
    status = (
        "captured" if value("reference_captured") else "rebounded" if episode.reference_touches else "miss"
    )
    period = float(scenario.control_period[0])
    ticks = np.round(float(scenario.duration[0]) / period)
    return SpaceRun(episode, status, final_in_space(mechanism, float(ticks * period)))


def _ideal_metrics(scenario: Scenario) -> Metrics:
    """Return the metrics of the ideal contact; those of a rig's episode in them are meaningless."""
    period = scenario.control_period
    space = Space(scenario.bodies, scenario.groups, scenario.latches)
    until = jnp.round(scenario.duration / period) * period
    quiet = quiet_time(scenario.sensor, period)
    reference = follow_contact(space, scenario.start, quiet, until, period)
    first = reference.gaps.begin.time[0]
    lasted = jnp.minimum(first + quiet, until)
    zero, none = jnp.zeros_like(until), jnp.zeros(until.shape, jnp.int32)
    episode = Episode(
        start=scenario.start,
        end=scenario.start,
        lasted=lasted,
        meeting=reference.meeting,
        past=past_at(reference, lasted, lasted < until),
        touches=none,
        duration=zero,
        peak_force=zero,
        peak_moment=zero,
        penetration=zero,
        status=none + REBOUNDED,
    )
    return judge(scenario.bodies, jax.tree.map(lambda leaf: leaf[None], episode))


@cache
def _compiled() -> Callable[[Scenario], Metrics]:
    """Return the compiled function for the metrics."""
    return jax.jit(_ideal_metrics, compiler_options=supported_options(SINGLE_RUN_OPTIONS))
