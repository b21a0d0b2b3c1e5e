"""Run of a six-axis mechanism: results of each episode, and all ticks."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.errors import InputError, format_value
from jaxhil.files import write_csv
from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.gain_choice import choose_gains
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, jax_context, supported_options
from jaxhil.simulation.run import check_seed
from jaxhil.sixdof.building import build_scenarios, loop_of
from jaxhil.sixdof.loop import Loop
from jaxhil.sixdof.meaning import Meaning, meaning
from jaxhil.sixdof.metrics import Metrics, evaluate, reference_final
from jaxhil.sixdof.plausibility import check_scenario
from jaxhil.sixdof.recording import Recorded, motion, record, table
from jaxhil.sixdof.relative import Pair, States, effective_mass
from jaxhil.sixdof.rollout import STATUS_NAMES
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.vectors import Vector, cross, direction, vector

GOOD = ("rebounded", "captured")  # statuses of good episodes
DEEP = 0.5  # penetration over shapes' size above which there is a warning


class Episode(NamedTuple):
    """Results of a contact with all its touches; NaN for values that it does not have."""

    energy_error: float  # kinetic energy minus that of the ideal contact, over that of the approach [1]
    twist_error: float  # deviation of the twist from that of the ideal contact, over the latter's change [1]
    normal_part: float  # part of the twist error along the ideal impulse [1]
    lateral_part: float  # translational part of the rest [1]
    rotational_part: float  # rotational part of the rest [1]
    restitution: float  # e; NaN unless there is a single touch [1]
    reference_restitution: float  # e* of the ideal contact [1]
    effective_mass: float  # m_n at the first touch [kg]
    approach_velocity: float  # along the normal of the first touch [m/s]
    point: tuple[float, ...]  # point of the first touch, in T axes [m]
    normal: tuple[float, ...]  # normal there, outward from the target
    peak_force: float  # of the real contact [N]
    reference_peak_force: float  # of the ideal contact [N]
    peak_moment: float  # of the real contact, about T's origin [N m]
    reference_peak_moment: float  # of the ideal contact [N m]
    duration: float  # time in touch [s]
    reference_duration: float  # time in touch of the ideal contact [s]
    touches: int  # number of onsets of touch, over all candidates
    reference_touches: int  # likewise in the ideal contact
    penetration: float  # largest penetration of the real contact, over the size of its shapes [1]
    status: str  # one of `rollout.STATUS_NAMES`


class Final(NamedTuple):
    """Motion at the end of a run."""

    time: float  # [s]
    pose: tuple[float, ...]  # position and rotation vector of C against T, in T axes [m, rad]
    twist: tuple[float, ...]  # velocity and angular velocity, likewise [m/s, rad/s]
    v1: tuple[float, ...]  # velocity of the target's centre of mass, in world axes [m/s]
    w1: tuple[float, ...]  # angular velocity of the target, in body axes [rad/s]
    v2: tuple[float, ...]  # velocity of the chaser's centre of mass, in world axes [m/s]
    w2: tuple[float, ...]  # angular velocity of the chaser, in body axes [rad/s]


@dataclass(frozen=True, eq=False)
class SixAxisRun:
    """One run of a six-axis mechanism's episodes under a compensator."""

    mechanism: SixAxisMechanism = field(repr=False)
    compensator: str  # name of the compensator
    gains: dict[str, float]  # gains by name, in SI units
    seed: int  # seed of the sensor's noise
    episodes: tuple[Episode, ...]
    status: str  # status of the first episode not in `GOOD`, else of the last episode
    final: Final  # final motion of the numerical model
    meaning: Meaning  # summary of the mechanism

    @cached_property
    def reference_final(self) -> Final:
        """Motion in the ideal contact with the same start, at the time of `final`."""
        return final_in_space(self.mechanism, self.final.time)

    @cached_property
    def ticks(self) -> Recorded:
        """All ticks of the run."""
        with jax_context():
            return record(self.mechanism, self.compensator, self.gains, self.seed, self.final.time)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the ticks as CSV, one line each after a line of names, in SI units with all digits.

        Raise `InputError` if the file cannot be written.
        """
        write_csv(path, {name: column.tolist() for name, column in table(self.ticks).items()})


def simulate_six_axes(
    mechanism: SixAxisMechanism, compensator: str = "none", gains: Any = None, *, seed: int = 0
) -> SixAxisRun:
    """Run a nominal six-axis mechanism once; the arguments are those of `jaxhil.simulate`.

    `compensator` is one of `SIX_AXIS_COMPENSATORS`; it acts on each channel of the wrench separately. Raise
    `InputError` if an argument is invalid.
    """
    if compensator not in SIX_AXIS_COMPENSATORS:
        allowed = f"one of {', '.join(SIX_AXIS_COMPENSATORS)} for six axes"
        raise InputError(f"compensator: found {format_value(compensator)}, expected {allowed}")
    number = check_seed(seed)
    name, values = choose_gains(mechanism, compensator, gains)
    with jax_context():
        scenario = build_scenarios(mechanism, seed=number)
        check_scenario(mechanism, scenario)
        loop = loop_of(mechanism, name, scenario)
        arrays = {key: jnp.asarray(value) for key, value in values.items()}
        outcome = jax.device_get(_compiled()(loop, arrays, scenario))
    return _result(mechanism, name, values, number, outcome)


def _result(
    mechanism: SixAxisMechanism, compensator: str, gains: dict[str, float], seed: int, outcome: Any
) -> SixAxisRun:
    """Return the run from the metrics, final time, final motion and tangential mass."""
    metrics, time, final, tangential = outcome
    check_followed(mechanism, metrics)
    episodes = tuple(
        _episode(metrics, slot)
        for slot in range(metrics.status.shape[0])
        if slot == 0 or STATUS_NAMES[int(metrics.status[slot, 0])] != "miss"
    )
    bad = [episode.status for episode in episodes if episode.status not in GOOD]
    first = episodes[0]
    duration = math.nan if metrics.reference_captured[0, 0] else first.reference_duration
    summary = meaning(
        mechanism, first.effective_mass, float(tangential[0]), duration,
        first.reference_peak_force, first.reference_restitution,
    )  # fmt: skip
    deep = max(episode.penetration for episode in episodes)
    if deep > DEEP:
        expected = f"at most {DEEP:g}: shapes that are too soft or too fast pass through each other"
        warning = f"contact: found a depth of {deep:.2g} times the size of the shapes, expected {expected}"
        summary = summary._replace(warnings=(*summary.warnings, warning))
    status = [*bad, episodes[-1].status][0]
    return SixAxisRun(
        mechanism=mechanism,
        compensator=compensator,
        gains=gains,
        seed=seed,
        episodes=episodes,
        status=status,
        final=_final(float(time[0]), final),
        meaning=summary,
    )


def final_in_space(mechanism: SixAxisMechanism, time: float) -> Final:
    """Return the motion in the ideal contact at a time [s] after a mechanism's start."""
    with jax_context():
        scenario = build_scenarios(mechanism)
        return _final(time, jax.device_get(_ideal_motion(scenario, np.array([time]))))


def check_followed(mechanism: SixAxisMechanism, metrics: Metrics) -> None:
    """Raise `InputError` if the ideal contact was not integrated to its end."""
    if not np.all(np.isfinite(metrics.reference_duration)):
        raise InputError(f"{mechanism.name}: {_stiffest(mechanism)}")


def _stiffest(mechanism: SixAxisMechanism) -> str:
    """Return advice for an ideal contact that takes too many steps."""
    frictions = {name: contact.friction for name, contact in mechanism.contact.items() if contact.friction}
    slips = {name: law.slip / max(law.coefficient, 1e-9) for name, law in frictions.items() if law.slip}
    if slips:
        name = min(slips, key=slips.__getitem__)
        found = f"contact.{name}.friction.slip: found {frictions[name].slip:g} m/s"
        allowed = "a larger one, or friction = { law = 'bristle', ... }"
    else:
        name = next(iter(mechanism.contact))
        found, allowed = f"contact.{name}: found forces", "a softer contact"
    return f"{found} for which the integration of the ideal contact takes too many steps, expected {allowed}"


def _episode(metrics: Metrics, slot: int) -> Episode:
    """Return the results of one episode."""

    def value(name: str) -> Any:
        entry = np.asarray(getattr(metrics, name))[..., slot, 0]
        if name == "status":
            return STATUS_NAMES[int(entry)]
        return tuple(entry.tolist()) if entry.ndim else entry.item()

    return Episode(*map(value, Episode._fields))


def _final(time: float, motion: Any) -> Final:
    """Return the motion at the end of a run."""
    pose, twist, *velocities = (tuple(np.asarray(part, float)[:, 0].tolist()) for part in motion)
    return Final(time, pose, twist, *velocities)


@cache
def _compiled() -> Callable[..., Any]:
    """Return the compiled function for runs."""
    return jax.jit(_run, static_argnums=0, compiler_options=supported_options(SINGLE_RUN_OPTIONS))


def _run(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> tuple[Any, ...]:
    """Return the metrics of the episodes, the final time, the final motion, and the tangential mass."""
    result = evaluate(loop, gains, scenario)
    final = _motion(scenario.bodies, result.final)
    return result.metrics, result.final_time, final, _tangential_mass(scenario, result.metrics)


@jax.jit
def _ideal_motion(scenario: Scenario, time: Any) -> tuple[Any, ...]:
    """Return the motion in the ideal contact at a time [s]."""
    return _motion(scenario.bodies, reference_final(scenario, time))


def _tangential_mass(scenario: Scenario, metrics: Metrics) -> Any:
    """Return the effective mass [kg] of the first touch along the surface: the lesser of two directions."""
    point, normal = (vector(part[:, 0]) for part in (metrics.point, metrics.normal))
    zero = jnp.zeros_like(normal.x)
    flat = jnp.abs(normal.x) < 0.9
    across = direction(cross(normal, Vector(jnp.where(flat, 1, zero), jnp.where(flat, zero, 1), zero)))
    sides = (across, cross(normal, across))
    return jnp.minimum(*(effective_mass(scenario.bodies, scenario.start, point, side) for side in sides))


def _motion(bodies: Pair, states: States) -> tuple[Any, ...]:
    """Return the values of `Final` except the time, each along a leading axis."""
    pose, twist, *motions = motion(bodies, states)
    return pose, twist, *(part for rows in motions for part in (rows[7:10], rows[10:]))
