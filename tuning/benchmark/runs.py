"""The runs behind the figures: plain, pushed and damped ones of one mechanism under one law.

Of a law, all mechanisms that share a program go through one compiled program.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Constants
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.batches import cut, join
from tuning.gains.common_program import CommonProgram
from tuning.statistics.intervals import Estimate
from tuning.transparency.damping_perturbations import perturb_damping
from tuning.transparency.figures import Runs, judge
from tuning.transparency.pushes import EARLY, LATE, Space, in_space, probed


class Scene(NamedTuple):
    """What every law is judged on for one mechanism; NumPy arrays."""

    mechanism: Mechanism
    common: CommonProgram  # the program that it shares with others
    plain: Scenario  # its scenarios
    twins: Scenario  # with damping added (`tuning.transparency.damping_perturbations`)
    space: Space  # the scenarios' first contacts in space


def build_scene(mechanism: Mechanism, common: CommonProgram, scenarios: int, seed: int) -> Scene:
    """So many fresh scenarios of a mechanism."""
    draws = draw(mechanism, scenarios, seed)
    twin, twin_draws = perturb_damping(mechanism, draws)
    plain = common.scenarios(mechanism, build_scenarios(mechanism, draws, seed))
    twins = common.scenarios(twin, build_scenarios(twin, twin_draws, seed))
    return Scene(
        mechanism, common, plain, twins, in_space(common.law(beforehand=False), plain, _nominal(plain), 1)
    )


def judge_gains(
    scene: Scene, law: str, gains: Mapping[str, float], limit: float, seed: int
) -> dict[str, Estimate]:
    """All figures of a law under these gains; `limit` and `seed` of `tuning.transparency.figures.judge`."""
    contacts, space = scene.mechanism.approach.contacts, scene.space
    runs = _runs(scene, law, gains, space)
    if contacts > 1:
        # Later contacts are entered at the speed that the law left them.
        plain: Any = runs.plain
        entered = np.where(plain.good, plain.metrics.approach_velocity, _nominal(scene.plain))
        space = in_space(scene.common.law(beforehand=False), scene.plain, entered, contacts)
        runs = _runs(scene, law, gains, space)
    return judge(
        runs,
        (space.early, space.late),
        space.restitution[0],
        np.max(space.depth, axis=1),
        _amplification(scene, law, gains),
        limit,
        seed,
    )


def lanes_judged(scene: Scene) -> int:
    """How many lanes are run for the figures of one set of gains."""
    return len(Runs._fields) * len(scene.plain.velocity) * (1 + (scene.mechanism.approach.contacts > 1))


def _runs(scene: Scene, law: str, gains: Mapping[str, float], space: Space) -> Runs:
    """All runs that figures take, as one batch, beside these contacts in space."""
    pushed = [probed(scene.plain, space, share) for share in (EARLY, LATE)]
    scenarios = join([probed(scene.plain, space), *pushed, probed(scene.twins, space)])
    loop = scene.common.loop(build_loop(scene.mechanism, law, scenarios))
    every = {name: np.full(len(scenarios.velocity), value) for name, value in gains.items()}
    return Runs(*cut(evaluate(loop, every, scenarios), len(scene.plain.velocity)))


def _nominal(scenarios: Scenario) -> Any:
    return np.broadcast_to(scenarios.velocity, scenarios.phase.shape)


def _amplification(scene: Scene, law: str, gains: Mapping[str, float]) -> float:
    """The mean over the scenarios, whose control periods may differ."""
    period, clearance = jnp.asarray(scene.plain.control_period), jnp.asarray(scene.plain.clearance)
    own = {name: jnp.full_like(period, value) for name, value in gains.items()}
    return float(jnp.mean(COMPENSATORS[law].noise_amplification(own, Constants(period, clearance))))
