"""The runs behind the figures: plain, pushed and damped ones of one mechanism under one law.

Of a law, all mechanisms that share a program go through one compiled program.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxhil.compensators import COMPENSATORS
from jaxhil.compensators.base import Constants
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.evaluation import Outcome, evaluate
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.batches import cut, join
from tuning.gains.common_program import CommonProgram
from tuning.statistics.intervals import Estimate
from tuning.transparency.damped_twins import damped_twins
from tuning.transparency.figures import Runs, judge
from tuning.transparency.pushes import EARLY, LATE, Space, in_space, probed


class Scene(NamedTuple):
    """What every law is judged on for one mechanism; NumPy arrays."""

    mechanism: Mechanism
    common: CommonProgram  # the program that it shares with others
    plain: Scenario  # its scenarios
    twins: Scenario  # their damped twins (`tuning.transparency.damped_twins`)
    space: Space  # the scenarios' first contacts in space


def build_scene(mechanism: Mechanism, common: CommonProgram, scenarios: int, seed: int) -> Scene:
    """So many fresh scenarios of a mechanism."""
    draws = draw(mechanism, scenarios, seed)
    twin, twin_draws = damped_twins(mechanism, draws)
    plain = common.scenarios(mechanism, build_scenarios(mechanism, draws, seed))
    twins = common.scenarios(twin, build_scenarios(twin, twin_draws, seed))
    return Scene(
        mechanism, common, plain, twins, in_space(common.law(beforehand=False), plain, _nominal(plain), 1)
    )


def judge_gains(
    scene: Scene, law: str, gains: Mapping[str, float], limit: float, seed: int
) -> dict[str, Estimate]:
    """All figures of a law under these gains; `limit` and `seed` of `tuning.transparency.figures.judge`."""
    number = len(scene.plain.velocity)
    contacts = scene.mechanism.approach.contacts
    space = scene.space

    def run(batches: list[Scenario]) -> list[Any]:
        return cut(_run(scene, law, gains, join(batches)), number)

    # As many batches as in the second call, so that one program serves.
    plain, twins, _ = run([probed(batch, space) for batch in (scene.plain, scene.twins, scene.plain)])
    if contacts > 1:
        # Later contacts are entered at the speed that the law left them.
        entered = np.where(plain.good, plain.metrics.approach_velocity, _nominal(scene.plain))
        space = in_space(scene.common.law(beforehand=False), scene.plain, entered, contacts)
    duration = np.where(plain.good[0], plain.metrics.duration[0], space.duration[0])
    pushed = [probed(scene.plain, space, share, duration) for share in (EARLY, LATE)]
    plain, early, late = run([probed(scene.plain, space), *pushed])
    return judge(
        Runs(plain, early, late, twins),
        (space.early, space.late),
        space.restitution[0],
        np.max(space.depth, axis=1),
        _amplification(scene, law, gains),
        limit,
        seed,
    )


def _run(scene: Scene, law: str, gains: Mapping[str, float], scenarios: Scenario) -> Outcome:
    loop = scene.common.loop(build_loop(scene.mechanism, law, scenarios))
    lanes = len(scenarios.velocity)
    return evaluate(loop, {name: np.full(lanes, value) for name, value in gains.items()}, scenarios)


def _nominal(scenarios: Scenario) -> Any:
    return np.broadcast_to(scenarios.velocity, scenarios.phase.shape)


def _amplification(scene: Scene, law: str, gains: Mapping[str, float]) -> float:
    """The mean over the scenarios, whose control periods may differ."""
    period, clearance = jnp.asarray(scene.plain.control_period), jnp.asarray(scene.plain.clearance)
    own = {name: jnp.full_like(period, value) for name, value in gains.items()}
    return float(jnp.mean(COMPENSATORS[law].noise_amplification(own, Constants(period, clearance))))
