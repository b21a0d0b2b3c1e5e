"""Two bodies in space alone, without a rig: their first episode, and where it leads."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.environment import ONCE, computing, known_options
from jaxhil.sixdof.building import build_scenarios
from jaxhil.sixdof.metrics import Metrics, judge
from jaxhil.sixdof.plausibility import check_scenario
from jaxhil.sixdof.rollout import REBOUNDED, Episode
from jaxhil.sixdof.run import Final, check_followed, final_in_space
from jaxhil.sixdof.scenario import Scenario


class EpisodeInSpace(NamedTuple):
    """As an episode of a run has it; NaN for what there is not."""

    reference_restitution: float  # e*, of a single touch [1]
    effective_mass: float  # m_n at the first touch [kg]
    approach_velocity: float  # along its normal [m/s]
    point: tuple[float, ...]  # of the first touch, in T axes [m]
    normal: tuple[float, ...]  # there, outward from the target
    reference_peak_force: float  # [N]
    reference_peak_moment: float  # about T [N m]
    reference_duration: float  # in touch [s]
    reference_touches: int  # candidates that began to touch


class SpaceRun(NamedTuple):
    """What becomes of a mechanism's two bodies in space."""

    episode: EpisodeInSpace
    status: str  # "rebounded", "captured", held by a latch, or "miss"
    final: Final  # the motion at the end of the file's duration


def simulate_in_space(mechanism: SixAxisMechanism) -> SpaceRun:
    """Follow the bodies of a mechanism of six axes in space, from its start to the end of its duration.

    Raises `InputError` for a start that cannot be run, and for a contact that is too stiff to be followed.
    """
    with computing():
        scenario = build_scenarios(mechanism)
        check_scenario(mechanism, scenario)
        found = jax.device_get(_compiled()(scenario))
    check_followed(mechanism, found)

    def value(name: str) -> Any:
        one = np.asarray(getattr(found, name))[..., 0, 0]
        return tuple(one.tolist()) if one.ndim else one.item()

    episode = EpisodeInSpace(*map(value, EpisodeInSpace._fields))
    status = (
        "captured" if value("reference_captured") else "rebounded" if episode.reference_touches else "miss"
    )
    period = float(scenario.control_period[0])
    ticks = np.round(float(scenario.duration[0]) / period)
    return SpaceRun(episode, status, final_in_space(mechanism, float(ticks * period)))


def _judged(scenario: Scenario) -> Metrics:
    """The figures of an episode that begins with the run; only those in space have a meaning."""
    start = jax.tree.map(lambda leaf: leaf[None], scenario.start)
    zero = jnp.zeros_like(scenario.duration)[None]
    none = zero.astype(jnp.int32)
    return judge(
        scenario,
        Episode(
            entry=start,
            end=start,
            entry_time=zero,
            end_time=zero,
            touches=none,
            duration=zero,
            peak_force=zero,
            peak_moment=zero,
            penetration=zero,
            status=none + REBOUNDED,
        ),
    )


@cache
def _compiled() -> Callable[[Scenario], Metrics]:
    return jax.jit(_judged, compiler_options=known_options(ONCE))
