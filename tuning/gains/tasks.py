"""Tuning tasks: one mechanism each, with the scenarios on which its gains are tuned.

Tasks whose loops differ only in the length of their delay lines share one compiled program, and are solved in
one batch.
"""

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import qmc

from jaxhil.contact.laws import ContactLaw
from jaxhil.laws.compensators import get_compensator, literature_gains
from jaxhil.laws.simulation_base import Gain
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw_quasi_random
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.evaluation import RigModel, count_lanes
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.watch import MAX_DECAY_WAIT
from tuning.gains.common_program import CommonProgram
from tuning.optimisation.unit_box import GainBounds, to_gains
from tuning.transparency.probes import LANES_PER_SCENARIO, build_probed_scenarios

# In training a contact fails if it takes longer than PATIENCE undelayed durations plus SHORTEST_PATIENCE.
TIME_LIMIT_FACTOR = 2.0
TIME_LIMIT_OFFSET = 0.15  # s

DEFAULT_SCENARIOS, DEFAULT_NOISY_SCENARIOS = (
    32,
    128,
)  # default training scenarios without noise; with it, probes included


@dataclass(frozen=True)
class TuneTask:
    """Tuning task of one mechanism."""

    mechanism: AnyMechanism  # mechanism to tune for
    compensator: str  # compensator whose gains are tuned
    literature: dict[str, float]  # the compensator's gains by the literature's rule, or those of a setting
    scenarios: Any  # training scenarios
    loop: Any  # loop that runs the scenarios
    common: CommonProgram | None = None  # program shared with unlike mechanisms, if any
    probed: bool = False  # whether each scenario has its transparency probes

    @property
    def number(self) -> int:
        """Return the number of scenarios without probes."""
        return self.lanes // (LANES_PER_SCENARIO if self.probed else 1)

    @property
    def lanes(self) -> int:
        """Return the number of scenarios with their probes."""
        return count_lanes(self.scenarios)

    @property
    def contacts(self) -> int:
        """Return the rows of a scenario's outcome: its contacts, or both errors of each six-axis episode."""
        return self.model.rows(self.mechanism)

    @property
    def model(self) -> RigModel:
        """Return the model of the mechanism's rig."""
        return choose_rig_model(self.mechanism)

    @property
    def tuned(self) -> tuple[Gain, ...]:
        """Return the gains that are tuned for this mechanism."""
        mechanism: Any = self.mechanism
        return tuple(
            gain for gain in get_compensator(self.compensator, self.model.axes).gains if gain.tuned(mechanism)
        )


def build_task(
    mechanism: AnyMechanism,
    compensator: str,
    scenarios: int | None,
    seed: int,
    common: CommonProgram | None = None,
    setting: str | None = None,
    probed: bool = False,
) -> TuneTask:
    """Build a task with quasi-random training scenarios, whose contacts have a time limit.

    Each scenario has its own realisation of the sensors' noise. With noise the default number of `scenarios`
    is larger, since gains can be fitted to a few realisations; transparency probes (`probed`) count as
    scenarios. `setting` names a setting whose gains replace the literature's. Raise ValueError for probed
    tasks of a `common` program.
    """
    if probed and common is not None:
        raise ValueError("probed: found True, expected False for mechanisms that share a program")
    noisy = has_sensor_noise(mechanism)
    number = scenarios or (
        DEFAULT_NOISY_SCENARIOS // (LANES_PER_SCENARIO if probed else 1) if noisy else DEFAULT_SCENARIOS
    )
    draws, model = draw_quasi_random(mechanism, number, seed), choose_rig_model(mechanism)
    if isinstance(mechanism, Mechanism):
        batch: Any = (
            build_probed_scenarios(mechanism, draws, seed).scenarios
            if probed
            else model.scenarios(mechanism, draws, seed)
        )
        loop = model.loop(mechanism, compensator, batch)
        batch = batch._replace(time_limit=np.asarray(_compute_time_limit(loop.law, batch)))
        if common is not None:
            batch, loop = common.scenarios(mechanism, batch), common.loop(loop)
    else:
        batch = model.scenarios(mechanism, draws, seed)
        loop = model.loop(mechanism, compensator, batch)
    gains = literature_gains(mechanism, compensator, setting)
    return TuneTask(mechanism, compensator, gains, batch, loop, common, probed)


def has_sensor_noise(mechanism: AnyMechanism) -> bool:
    """Return whether the force or position sensor has noise in any scenario."""
    rig = mechanism.rig
    paths = "rig.force_sensor.noise_std", "rig.position_sensor.noise_std"
    deviations = rig.force_sensor.noise_std, rig.position_sensor.noise_std
    noisy = any(bool(np.max(deviation) > 0) for deviation in deviations)
    return noisy or any(path in mechanism.uncertainty for path in paths)


def group_by_program(loops: list[Any], scenarios: list[Any]) -> list[list[int]]:
    """Group loops that share a compiled program; return lists of indices in order of the first index.

    The loops of a group differ only in the length of their delay lines; their scenarios have equal shapes.
    """
    groups: dict[Any, list[int]] = {}
    for index, (loop, batch) in enumerate(zip(loops, scenarios, strict=True)):
        shapes = tuple(leaf.shape for leaf in jax.tree.leaves(batch))
        same = dataclasses.replace(loop, **dict.fromkeys(_list_delay_line_fields(loop), 0))
        groups.setdefault((same, jax.tree.structure(batch), shapes), []).append(index)
    return list(groups.values())


def join_loops(loops: list[Any]) -> Any:
    """Return the loop that serves all `loops` of a group, with the longest of their delay lines."""
    longest = {name: max(getattr(loop, name) for loop in loops) for name in _list_delay_line_fields(loops[0])}
    return dataclasses.replace(loops[0], **longest)


def _list_delay_line_fields(loop: Any) -> list[str]:
    """Return the fields of a loop that are lengths of delay lines."""
    return [name for name in ("ring", "controller_ring") if hasattr(loop, name)]


def list_tuned_gains(tasks: list[TuneTask]) -> tuple[str, ...]:
    """Return the names of all gains that are tuned for at least one of the tasks."""
    tuned = {gain.name for task in tasks for gain in task.tuned}
    return tuple(
        gain.name
        for gain in get_compensator(tasks[0].compensator, tasks[0].model.axes).gains
        if gain.name in tuned
    )


def build_gain_bounds(task: TuneTask, names: tuple[str, ...]) -> GainBounds:
    """Return the bounds (gains,) of a task; both are the literature's value for a gain that is not tuned."""
    gains = {gain.name: gain for gain in get_compensator(task.compensator, task.model.axes).gains}
    moved = {gain.name for gain in task.tuned}

    def bounds(name: str) -> tuple[float, float, float]:
        gain = gains[name]
        mechanism: Any = task.mechanism
        if name not in moved:
            return task.literature[name], task.literature[name], 0.0
        return float(gain.lower(mechanism)), float(gain.upper(mechanism)), float(gain.logarithmic)

    return GainBounds(*np.array([bounds(name) for name in names]).reshape(-1, 3).T)


def convert_to_gains(
    task: TuneTask,
    names: tuple[str, ...],
    bounds: GainBounds,
    coordinates: Float[np.ndarray, "*points gains"],
) -> dict[str, Float[np.ndarray, "*points"]]:
    """Return all gains of the compensator at unit coordinates of the gains `names`.

    Gains that are not tuned for the task have the literature's value.
    """
    moved = {gain.name for gain in task.tuned}
    values = dict(zip(names, np.moveaxis(to_gains(coordinates, bounds), -1, 0), strict=True))
    return {
        name: values[name] if name in moved else np.full(coordinates.shape[:-1], literature)
        for name, literature in task.literature.items()
    }


def spread_points(first: np.ndarray, number: int, seed: int | tuple[int, ...]) -> np.ndarray:
    """Return points (number, gains) of the unit box: `first`, then Sobol points.

    Every other Sobol point lies within 1/8 of each gain's range from `first`, the rest anywhere.
    """
    points = qmc.Sobol(len(first), rng=np.random.default_rng(seed)).random(
        1 << max(number - 1, 1).bit_length()
    )
    reach = np.where(np.arange(len(points)) % 2 == 0, 0.25, 1.0)[:, None]
    near = np.clip(first + reach * (points - 0.5), 0, 1)
    return np.concatenate([first[None], np.where(reach < 1, near, points)])[:number]


@partial(jax.jit, static_argnums=0)
def _compute_time_limit(law: ContactLaw, scenarios: Scenario) -> Float[Array, "*batch"]:
    """Return the time limit [s] of a contact in training (`TIME_LIMIT_FACTOR`)."""
    shape = scenarios.phase.shape
    mass = jnp.broadcast_to(scenarios.equivalent_mass, shape)
    velocity = jnp.broadcast_to(scenarios.velocity, shape)
    reference = law.reference(parameters_by_slot(scenarios.contact), mass, velocity)
    longest = TIME_LIMIT_FACTOR * jnp.max(reference.duration, axis=0) + TIME_LIMIT_OFFSET
    # A noisy command never dies out, so that every contact ends later; the limit allows for that.
    sensor = scenarios.force_sensor
    longest = longest + jnp.where((sensor.noise_std != 0) | (sensor.bias != 0), MAX_DECAY_WAIT, 0.0)
    return jnp.minimum(longest, scenarios.time_limit)
