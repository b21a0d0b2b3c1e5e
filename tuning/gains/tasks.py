"""What there is to solve: one task a mechanism, with the scenarios that its gains are tuned on.

Tasks whose loops have the same shape (law, sensors, limits, lengths of delay lines) share one compiled
program, and are solved in one batch.
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
from jaxhil.laws.compensators import compensator_of, literature_gains
from jaxhil.laws.simulation_base import Gain
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import quasi_random
from jaxhil.rig_models import rig_model
from jaxhil.simulation.evaluation import RigModel, lanes_of
from jaxhil.simulation.outcome import parameters_by_slot
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.watch import LONGEST_FADING
from tuning.gains.common_program import CommonProgram
from tuning.optimisation.unit_box import Bounds, to_gains
from tuning.transparency.probes import LANES_PER_SCENARIO, probed_scenarios

# In training a contact that takes longer than this many times its undelayed duration, and so many
# seconds more, has failed.
PATIENCE = 2.0
SHORTEST_PATIENCE = 0.15  # s

SCENARIOS, NOISY_SCENARIOS = 32, 128  # to tune on, without and with sensor noise, probes included


@dataclass(frozen=True)
class TuneTask:
    """A mechanism to tune."""

    mechanism: AnyMechanism  # what is tuned for
    compensator: str  # what is tuned
    literature: dict[str, float]  # the compensator's gains by the literature's rule, or those of a setting
    scenarios: Any  # to tune on
    loop: Any  # that runs them
    common: CommonProgram | None = None  # the program it shares with unlike mechanisms, if it does
    probed: bool = False  # whether each scenario comes with its transparency probes

    @property
    def number(self) -> int:
        """Scenarios, probes not counted."""
        return self.lanes // (LANES_PER_SCENARIO if self.probed else 1)

    @property
    def lanes(self) -> int:
        """Scenarios, probes counted."""
        return lanes_of(self.scenarios)

    @property
    def contacts(self) -> int:
        """Rows of each scenario's outcome: its contacts, or both errors of its episodes."""
        return self.model.rows(self.mechanism)

    @property
    def model(self) -> RigModel:
        """The model of the mechanism's rig."""
        return rig_model(self.mechanism)

    @property
    def tuned(self) -> tuple[Gain, ...]:
        """The gains that tuning moves for this mechanism."""
        known: Any = self.mechanism
        return tuple(gain for gain in compensator_of(self.compensator).gains if gain.tuned(known))


def build_task(
    mechanism: AnyMechanism,
    compensator: str,
    scenarios: int | None,
    seed: int,
    common: CommonProgram | None = None,
    setting: str | None = None,
    probed: bool = False,
) -> TuneTask:
    """Training scenarios are quasi-random: they fill the range evenly. Their contacts must end in time.

    Each comes with a realisation of the sensors' noise of its own. Gains can be fitted to a few of them, so
    that there are more, unless a number is given, where there is noise. The transparency probes of `probed`
    ones are as good for that: there are fewer scenarios then.

    Raises ValueError for probed tasks of a common program.
    """
    if probed and common is not None:
        raise ValueError("probed: found True, allowed False for mechanisms that share a program")
    noisy = has_sensor_noise(mechanism)
    number = scenarios or (NOISY_SCENARIOS // (LANES_PER_SCENARIO if probed else 1) if noisy else SCENARIOS)
    draws, model = quasi_random(mechanism, number, seed), rig_model(mechanism)
    if isinstance(mechanism, Mechanism):
        batch: Any = (
            probed_scenarios(mechanism, draws, seed).scenarios
            if probed
            else model.scenarios(mechanism, draws, seed)
        )
        loop = model.loop(mechanism, compensator, batch)
        batch = batch._replace(time_limit=np.asarray(_patience(loop.law, batch)))
        if common is not None:
            batch, loop = common.scenarios(mechanism, batch), common.loop(loop)
    else:
        batch = model.scenarios(mechanism, draws, seed)
        loop = model.loop(mechanism, compensator, batch)
    gains = literature_gains(mechanism, compensator, setting)
    return TuneTask(mechanism, compensator, gains, batch, loop, common, probed)


def has_sensor_noise(mechanism: AnyMechanism) -> bool:
    """Whether either sensor is noisy, in some scenarios at least."""
    rig = mechanism.rig
    paths = "rig.force_sensor.noise_std", "rig.position_sensor.noise_std"
    # In six axes the position sensor has none.
    position = getattr(rig.position_sensor, "noise_std", 0.0)
    noisy = bool(max(np.max(rig.force_sensor.noise_std), position) > 0)
    return noisy or any(path in mechanism.uncertainty for path in paths)


def alike(loops: list[Any], scenarios: list[Any]) -> list[list[int]]:
    """Indices of what one program serves: loops that differ by the length of their delay lines alone, with
    scenario arrays of the same shapes. In the order in which they come."""
    groups: dict[Any, list[int]] = {}
    for index, (loop, batch) in enumerate(zip(loops, scenarios, strict=True)):
        shapes = tuple(leaf.shape for leaf in jax.tree.leaves(batch))
        same = dataclasses.replace(loop, **dict.fromkeys(_rings(loop), 0))
        groups.setdefault((same, jax.tree.structure(batch), shapes), []).append(index)
    return list(groups.values())


def common_loop(loops: list[Any]) -> Any:
    """The loop of like ones, with the longest of their delay lines."""
    longest = {name: max(getattr(loop, name) for loop in loops) for name in _rings(loops[0])}
    return dataclasses.replace(loops[0], **longest)


def _rings(loop: Any) -> list[str]:
    """Fields of a loop that are lengths of delay lines."""
    return [name for name in ("ring", "controller_ring") if hasattr(loop, name)]


def tuned_names(tasks: list[TuneTask]) -> tuple[str, ...]:
    """Names of all gains that are tuned for at least one of the tasks."""
    tuned = {gain.name for task in tasks for gain in task.tuned}
    return tuple(gain.name for gain in compensator_of(tasks[0].compensator).gains if gain.name in tuned)


def gain_bounds(task: TuneTask, names: tuple[str, ...]) -> Bounds:
    """Bounds (gains,) of a task; of a gain that is not tuned for it both are the literature's value."""
    gains = {gain.name: gain for gain in compensator_of(task.compensator).gains}
    moved = {gain.name for gain in task.tuned}

    def bounds(name: str) -> tuple[float, float, float]:
        gain = gains[name]
        mechanism: Any = task.mechanism
        if name not in moved:
            return task.literature[name], task.literature[name], 0.0
        return float(gain.lower(mechanism)), float(gain.upper(mechanism)), float(gain.logarithmic)

    return Bounds(*np.array([bounds(name) for name in names]).reshape(-1, 3).T)


def gains_at(
    task: TuneTask, names: tuple[str, ...], bounds: Bounds, coordinates: Float[np.ndarray, "*points gains"]
) -> dict[str, Float[np.ndarray, "*points"]]:
    """All of the compensator's gains: `names` at `coordinates` of their ranges, as far as tuned for the
    task."""
    moved = {gain.name for gain in task.tuned}
    found = dict(zip(names, np.moveaxis(to_gains(coordinates, bounds), -1, 0), strict=True))
    return {
        name: found[name] if name in moved else np.full(coordinates.shape[:-1], literature)
        for name, literature in task.literature.items()
    }


def spread_points(first: np.ndarray, number: int, seed: int | tuple[int, ...]) -> np.ndarray:
    """(number, gains) coordinates of the unit box: `first`, then Sobol points, every other one of them within
    a quarter of each gain's range of `first`, the rest anywhere."""
    points = qmc.Sobol(len(first), rng=np.random.default_rng(seed)).random(
        1 << max(number - 1, 1).bit_length()
    )
    reach = np.where(np.arange(len(points)) % 2 == 0, 0.25, 1.0)[:, None]
    near = np.clip(first + reach * (points - 0.5), 0, 1)
    return np.concatenate([first[None], np.where(reach < 1, near, points)])[:number]


@partial(jax.jit, static_argnums=0)
def _patience(law: ContactLaw, scenarios: Scenario) -> Float[Array, "*batch"]:
    """How long [s] a contact may take in training before it has failed: some of its undelayed durations."""
    shape = scenarios.phase.shape
    mass = jnp.broadcast_to(scenarios.equivalent_mass, shape)
    velocity = jnp.broadcast_to(scenarios.velocity, shape)
    reference = law.reference(parameters_by_slot(scenarios.contact), mass, velocity)
    longest = PATIENCE * jnp.max(reference.duration, axis=0) + SHORTEST_PATIENCE
    # A noisy command never dies out, so that a contact's end is waited for longer: gains do not pay for that.
    sensor = scenarios.force_sensor
    longest = longest + jnp.where((sensor.noise_std != 0) | (sensor.bias != 0), LONGEST_FADING, 0.0)
    return jnp.minimum(longest, scenarios.time_limit)
