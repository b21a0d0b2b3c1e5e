"""Tuning tasks: a mechanism, a compensator and the training scenarios for which its gains are tuned.

Tasks whose loops differ only in the length of their delay lines share a compiled program and are tuned
together.
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
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import draw_quasi_random
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.contact_tracking import MAX_DECAY_WAIT
from jaxhil.simulation.evaluation import RigModel, count_lanes
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.scenario import Scenario
from tuning.gains.common_program import CommonProgram
from tuning.optimisation.unit_box import GainBounds, to_gains
from tuning.transparency.probes import LANES_PER_SCENARIO, build_probed_scenarios

# Time limit of a contact in training: this factor times the ideal contact's duration, plus the offset.
TIME_LIMIT_FACTOR = 2.0
TIME_LIMIT_OFFSET = 0.15  # s

# default number of training scenarios without sensor noise, and with noise (including probes)
DEFAULT_SCENARIOS, DEFAULT_NOISY_SCENARIOS = 32, 128


@dataclass(frozen=True)
class TuneTask:
    """Tuning task: one mechanism, the compensator to tune, and the training scenarios."""

    mechanism: AnyMechanism
    compensator: str  # name of the compensator
    # initial gains of the compensator: by the literature's rule, or one of the compensator's fixed sets
    literature: dict[str, float]
    scenarios: Any  # training scenarios
    loop: Any  # static properties of the simulated loop
    common: CommonProgram | None = None  # program shared with mechanisms of a different kind, or None
    probed: bool = False  # whether each scenario includes transparency probes

    @property
    def number(self) -> int:
        """Return the number of training scenarios, not counting their transparency probes."""
        return self.lanes // (LANES_PER_SCENARIO if self.probed else 1)

    @property
    def lanes(self) -> int:
        """Return the number of scenarios and of probes (perturbed copies of the scenarios) together."""
        return count_lanes(self.scenarios)

    @property
    def contacts(self) -> int:
        """Return the number of contacts in a scenario; for six axes, the number of episodes."""
        return self.model.runs(self.mechanism)

    @property
    def model(self) -> RigModel:
        return choose_rig_model(self.mechanism)

    @property
    def tuned(self) -> tuple[Gain, ...]:
        """Return the specifications (`Gain`) of the gains that are tuned for this mechanism."""
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
    """Build a tuning task with quasi-random training scenarios, whose contacts have a time limit.

    Each scenario has its own realisation of the sensor noise. With noise, the default number of `scenarios`
    is larger, because the gains would fit a few realisations too closely. If `probed` is true, the number
    includes transparency probes. `setting` names one of the compensator's fixed sets of gains. The task then
    has these gains in place of the gains by the literature's rule. Raise ValueError if `probed` is true and a
    `common` program is given.
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
    """Return whether a sensor has noise, or a random walk of its bias, in at least one scenario."""
    paths = (
        "rig.force_sensor.noise_std",
        "rig.force_sensor.bias_random_walk",
        "rig.position_sensor.noise_std",
    )
    noisy = any(bool(np.max(value_at(mechanism, path)) > 0) for path in paths)
    return noisy or any(path in mechanism.uncertainty for path in paths)


def group_by_program(loops: list[Any], scenarios: list[Any]) -> list[list[int]]:
    """Group loops that can share a compiled program; return the indices of each group.

    The loops of a group differ only in the length of delay lines; their scenario arrays have equal shapes.
    """
    groups: dict[Any, list[int]] = {}
    for index, (loop, batch) in enumerate(zip(loops, scenarios, strict=True)):
        shapes = tuple(leaf.shape for leaf in jax.tree.leaves(batch))
        same = dataclasses.replace(loop, **dict.fromkeys(_list_delay_line_fields(loop), 0))
        groups.setdefault((same, jax.tree.structure(batch), shapes), []).append(index)
    return list(groups.values())


def join_loops(loops: list[Any]) -> Any:
    """Return one simulated loop that can replace all `loops` of a group; it has the longest delay lines."""
    longest = {name: max(getattr(loop, name) for loop in loops) for name in _list_delay_line_fields(loops[0])}
    return dataclasses.replace(loops[0], **longest)


def _list_delay_line_fields(loop: Any) -> list[str]:
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
    """Return the bounds (gains,) of the gains `names`; for an untuned gain, both are its literature value."""
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
    """Convert unit coordinates of the gains `names` to values of all gains of the compensator.

    Gains that are not tuned for the task get their literature value.
    """
    moved = {gain.name for gain in task.tuned}
    values = dict(zip(names, np.moveaxis(to_gains(coordinates, bounds), -1, 0), strict=True))
    return {
        name: values[name] if name in moved else np.full(coordinates.shape[:-1], literature)
        for name, literature in task.literature.items()
    }


def spread_points(first: np.ndarray, number: int, seed: int | tuple[int, ...]) -> np.ndarray:
    """Return points (number, gains) in unit coordinates: `first`, then points of a Sobol sequence.

    Every second Sobol point differs from `first` by at most 1/8 in each coordinate. The others cover the
    whole range.
    """
    points = qmc.Sobol(len(first), rng=np.random.default_rng(seed)).random(
        1 << max(number - 1, 1).bit_length()
    )
    reach = np.where(np.arange(len(points)) % 2 == 0, 0.25, 1.0)[:, None]
    near = np.clip(first + reach * (points - 0.5), 0, 1)
    return np.concatenate([first[None], np.where(reach < 1, near, points)])[:number]


@partial(jax.jit, static_argnums=0)
def _compute_time_limit(law: ContactLaw, scenarios: Scenario) -> Float[Array, "*batch"]:
    """Return the time limit [s] of a contact in each training scenario, from the longest ideal contact.

    If the force sensor has noise or bias, the limit includes `MAX_DECAY_WAIT`, because the force command then
    does not decay and the contact ends only after this wait.
    """
    shape = scenarios.phase.shape
    mass = jnp.broadcast_to(scenarios.equivalent_mass, shape)
    velocity = jnp.broadcast_to(scenarios.velocity, shape)
    reference = law.ideal_contact(parameters_by_slot(scenarios.contact), mass, velocity)
    longest = TIME_LIMIT_FACTOR * jnp.max(reference.duration, axis=0) + TIME_LIMIT_OFFSET
    # With noise, the command does not decay: a contact ends only after the longest wait for its decay.
    sensor = scenarios.force_sensor
    is_unsteady = (sensor.noise_std != 0) | (sensor.bias != 0)
    if sensor.bias_walk is not None:
        is_unsteady = is_unsteady | (sensor.bias_walk != 0)
    longest = longest + jnp.where(is_unsteady, MAX_DECAY_WAIT, 0.0)
    return jnp.minimum(longest, scenarios.time_limit)
