"""The runs behind the figures: plain, pushed and damped ones of one mechanism under one law."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.building import build_loop
from jaxhil.compensators import COMPENSATORS
from jaxhil.compensators.base import Constants
from jaxhil.evaluation import Outcome, evaluate
from jaxhil.mechanism import Mechanism
from jaxhil.scenario import Scenario, build_scenarios
from jaxhil.uncertainty import draw
from tuning.comparison.damped import damped_twins
from tuning.comparison.figures import Figure, Judged, judge
from tuning.comparison.probing import EARLY, LATE, in_space, probed
from tuning.forms import Form


class Judge:
    """Scenarios of a mechanism and what they do in space; `figures` runs a law on them.

    All runs of all mechanisms of a form go through one compiled program: twice three batches as large.
    """

    def __init__(self, mechanism: Mechanism, law: str, form: Form, scenarios: int, seed: int):
        draws = draw(mechanism, scenarios, seed)
        twin, twin_draws = damped_twins(mechanism, draws)
        self._contacts = mechanism.approach.contacts
        self._plain = form.scenarios(mechanism, build_scenarios(mechanism, draws, seed))
        self._twins = form.scenarios(twin, build_scenarios(twin, twin_draws, seed))
        both = _join([self._plain, self._twins])
        self._loop = form.loop(build_loop(mechanism, law, both))
        entered: Any = np.broadcast_to(both.velocity, both.phase.shape)
        space = in_space(self._loop.law, both, entered, 1)
        self._loop = form.loop(build_loop(mechanism, law, probed(both, space)))
        self._space = jax.tree.map(lambda leaf: leaf[..., :scenarios], space)
        self._both = probed(both, space)
        self._number = scenarios
        self._law = COMPENSATORS[law]

    def figures(self, gains: Mapping[str, float], limit: float, seed: int) -> dict[str, Figure]:
        """All figures under these gains."""
        number = self._number
        # Three batches, as in the second call: the same program.
        first = self._run(gains, _join([self._both, _part(self._both, slice(number))]))
        plain, twins = (_part(first, slice(i * number, (i + 1) * number)) for i in range(2))
        space, entered = self._space, plain.metrics.approach_velocity
        if self._contacts > 1:
            # Later contacts are entered at the speed that the law left them.
            entered = np.where(plain.good, entered, self._plain.velocity)
            space = in_space(self._loop.law, self._plain, entered, self._contacts)
        duration = np.where(plain.good[0], plain.metrics.duration[0], space.duration[0])
        runs = [probed(self._plain, space)]
        runs += [probed(self._plain, space, share, duration) for share in (EARLY, LATE)]
        second = self._run(gains, _join(runs))
        plain, early, late = (_part(second, slice(i * number, (i + 1) * number)) for i in range(3))
        return judge(
            Judged(plain, early, late, twins),
            (space.early, space.late),
            space.restitution[0],
            np.max(space.depth, axis=1),
            self._amplification(gains),
            limit,
            seed,
        )

    def _run(self, gains: Mapping[str, float], scenarios: Scenario) -> Outcome:
        lanes = len(scenarios.velocity)
        return evaluate(self._loop, {name: np.full(lanes, value) for name, value in gains.items()}, scenarios)

    def _amplification(self, gains: Mapping[str, float]) -> float:
        """The mean over the scenarios, whose control periods may differ."""
        constants = Constants(jnp.asarray(self._plain.control_period), jnp.asarray(self._plain.clearance))
        own = {name: jnp.full_like(constants.control_period, value) for name, value in gains.items()}
        return float(jnp.mean(self._law.noise_amplification(own, constants)))


def _join(batches: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *batches)


def _part(batch: Any, which: slice) -> Any:
    return jax.tree.map(lambda leaf: leaf[..., which], batch)
