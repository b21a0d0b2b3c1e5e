"""One run of a mechanism of six axes: what became of each episode, and every tick of the way there."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.errors import InputError, shown
from jaxhil.files import write_csv
from jaxhil.laws.compensators import SIX_AXES
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.environment import ONCE, computing, known_options
from jaxhil.simulation.gain_choice import choose_gains
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

GOOD = ("rebounded", "captured")  # how an episode may end
DEEP = 0.5  # penetration from which on shapes are said to go through each other


class Episode(NamedTuple):
    """A contact with all its touches; NaN for what it does not have."""

    energy_error: float  # excess of kinetic energy over that in space, over that of the approach [1]
    twist_error: float  # deviation of the twist from that in space, over what the contact changes there [1]
    normal_part: float  # of it along the reference's impulse [1]
    lateral_part: float  # of the rest, in translation [1]
    rotational_part: float  # and in rotation [1]
    restitution: float  # e, of a single touch [1]
    reference_restitution: float  # e* in space [1]
    effective_mass: float  # m_n at the first touch [kg]
    approach_velocity: float  # along its normal [m/s]
    point: tuple[float, ...]  # of the first touch, in T axes [m]
    normal: tuple[float, ...]  # there, outward from the target
    peak_force: float  # of the real contact [N]
    reference_peak_force: float  # in space [N]
    peak_moment: float  # of the real contact about T [N m]
    reference_peak_moment: float  # in space [N m]
    duration: float  # in touch [s]
    reference_duration: float  # in space [s]
    touches: int  # candidates that began to touch
    reference_touches: int  # in space
    penetration: float  # largest depth of the real contact, over the size of its shapes [1]
    status: str  # how it ended


class Final(NamedTuple):
    """The motion at the end."""

    time: float  # [s]
    pose: tuple[float, ...]  # position and rotation vector of C against T, in T axes [m, rad]
    twist: tuple[float, ...]  # velocity and angular velocity, likewise [m/s, rad/s]
    v1: tuple[float, ...]  # of the target's centre of mass, in world axes [m/s]
    w1: tuple[float, ...]  # of the target, in body axes [rad/s]
    v2: tuple[float, ...]  # of the chaser's centre of mass, in world axes [m/s]
    w2: tuple[float, ...]  # of the chaser, in body axes [rad/s]


@dataclass(frozen=True, eq=False)
class SixAxisRun:
    """The episodes of a mechanism of six axes under a compensator, run once."""

    mechanism: SixAxisMechanism = field(repr=False)
    compensator: str  # its name
    gains: dict[str, float]  # by name, in SI units
    seed: int  # of the sensor's noise
    episodes: tuple[Episode, ...]
    status: str  # of the first episode that did not rebound or was not captured, else of the last
    final: Final  # of the numerical model
    meaning: Meaning  # of the mechanism

    @cached_property
    def reference_final(self) -> Final:
        """The motion of two free bodies in space, from the same start on, at the time of `final`."""
        return final_in_space(self.mechanism, self.final.time)

    @cached_property
    def ticks(self) -> Recorded:
        """Every tick of the run."""
        with computing():
            return record(self.mechanism, self.compensator, self.gains, self.seed, self.final.time)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the ticks, a line each, under a line of their names; numbers in SI units, to the last bit.

        Raises `InputError` when the file cannot be written.
        """
        write_csv(path, {name: column.tolist() for name, column in table(self.ticks).items()})


def simulate_six_axes(
    mechanism: SixAxisMechanism, compensator: str = "none", gains: Any = None, *, seed: int = 0
) -> SixAxisRun:
    """Run a mechanism of six axes once, as it is nominally: see `jaxhil.simulate`.

    `compensator` is "none" or "phase_lead", which leads each channel of the wrench by itself.
    """
    if compensator not in SIX_AXES:
        allowed = f"{', '.join(SIX_AXES)}: in six axes there are no others so far"
        raise InputError(f"compensator: found {shown(compensator)}, allowed {allowed}")
    number = check_seed(seed)
    name, values = choose_gains(mechanism, compensator, gains)
    with computing():
        scenario = build_scenarios(mechanism, seed=number)
        check_scenario(mechanism, scenario)
        loop = loop_of(mechanism, name, scenario)
        given = {key: jnp.asarray(one) for key, one in values.items()}
        found = jax.device_get(_compiled()(loop, given, scenario))
    return _result(mechanism, name, values, number, found)


def _result(
    mechanism: SixAxisMechanism, compensator: str, gains: dict[str, float], seed: int, found: Any
) -> SixAxisRun:
    metrics, time, final, tangential = found
    check_followed(mechanism, metrics)
    episodes = tuple(
        _episode(metrics, slot)
        for slot in range(metrics.status.shape[0])
        if slot == 0 or STATUS_NAMES[int(metrics.status[slot, 0])] != "miss"
    )
    bad = [episode.status for episode in episodes if episode.status not in GOOD]
    first = episodes[0]
    held = bool(metrics.reference_captured[0, 0])
    means = meaning(
        mechanism, first.effective_mass, float(tangential[0]), math.nan if held else first.reference_duration,
        first.reference_peak_force, first.reference_restitution,
    )  # fmt: skip
    deep = max(episode.penetration for episode in episodes)
    if deep > DEEP:
        expected = f"at most {DEEP:g}: shapes that are too soft, or meet too fast, go through each other"
        warning = f"contact: found a depth of {deep:.2g} of the size of its shapes, expected {expected}"
        means = means._replace(warnings=(*means.warnings, warning))
    status = [*bad, episodes[-1].status][0]
    return SixAxisRun(
        mechanism=mechanism,
        compensator=compensator,
        gains=gains,
        seed=seed,
        episodes=episodes,
        status=status,
        final=_final(float(time[0]), final),
        meaning=means,
    )


def final_in_space(mechanism: SixAxisMechanism, time: float) -> Final:
    """The motion of two free bodies in space, from a mechanism's start on, at a time [s]."""
    with computing():
        scenario = build_scenarios(mechanism)
        return _final(time, jax.device_get(_in_space(scenario, np.array([time]))))


def check_followed(mechanism: SixAxisMechanism, metrics: Metrics) -> None:
    """The contact in space was followed to its end. Raises `InputError`."""
    if not np.all(np.isfinite(metrics.reference_duration)):
        raise InputError(f"{mechanism.name}: {_stiffest(mechanism)}")


def _stiffest(mechanism: SixAxisMechanism) -> str:
    """What to change where a contact in space takes too many steps."""
    rubbing = {name: contact.friction for name, contact in mechanism.contact.items() if contact.friction}
    slips = {name: one.slip / max(one.coefficient, 1e-9) for name, one in rubbing.items() if one.slip}
    if slips:
        name = min(slips, key=slips.__getitem__)
        found = f"contact.{name}.friction.slip: found {rubbing[name].slip:g} m/s"
        allowed = "a larger one, or friction = { law = 'bristle', ... }"
    else:
        name = next(iter(mechanism.contact))
        found, allowed = f"contact.{name}: found forces", "a softer contact"
    return f"{found} that take too many steps to follow in space, allowed {allowed}"


def _episode(metrics: Metrics, slot: int) -> Episode:
    def value(name: str) -> Any:
        found = np.asarray(getattr(metrics, name))[..., slot, 0]
        if name == "status":
            return STATUS_NAMES[int(found)]
        return tuple(found.tolist()) if found.ndim else found.item()

    return Episode(*map(value, Episode._fields))


def _final(time: float, motion: Any) -> Final:
    at, twist, *each = (tuple(np.asarray(one, float)[:, 0].tolist()) for one in motion)
    return Final(time, at, twist, *each)


@cache
def _compiled() -> Callable[..., Any]:
    return jax.jit(_run, static_argnums=0, compiler_options=known_options(ONCE))


def _run(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> tuple[Any, ...]:
    """Figures of the episodes, the time at the end, the motion then, and the mass along the surface."""
    found = evaluate(loop, gains, scenario)
    final = _motion(scenario.bodies, found.final)
    return found.metrics, found.final_time, final, _tangential_mass(scenario, found.metrics)


@jax.jit
def _in_space(scenario: Scenario, time: Any) -> tuple[Any, ...]:
    return _motion(scenario.bodies, reference_final(scenario, time))


def _tangential_mass(scenario: Scenario, metrics: Metrics) -> Any:
    """Mass [kg] that the first touch meets along the surface, where it is less of two directions."""
    point, normal = (vector(one[:, 0]) for one in (metrics.point, metrics.normal))
    zero = jnp.zeros_like(normal.x)
    flat = jnp.abs(normal.x) < 0.9
    across = direction(cross(normal, Vector(jnp.where(flat, 1, zero), jnp.where(flat, zero, 1), zero)))
    sides = (across, cross(normal, across))
    return jnp.minimum(*(effective_mass(scenario.bodies, scenario.start, point, side) for side in sides))


def _motion(bodies: Pair, states: States) -> tuple[Any, ...]:
    """What `Final` says but the time, each along a leading axis."""
    at, twist, *each = motion(bodies, states)
    return at, twist, *(part for one in each for part in (one[7:10], one[10:]))
