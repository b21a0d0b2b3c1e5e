"""Whether a contact that lasts grows: the eigenvalues of one control period of the sampled loop in contact.

For a linear contact law and a linear compensator the loop in contact is a linear map from tick to tick of the
numerical model, the commands on their way, the motion simulator, the force sensor's lag, the readings on
their way (its delay) and the compensator's filters. The plant between ticks is its exact solution; the map's
matrix is the derivative of one period written out. The largest of its eigenvalues' magnitudes, the spectral
radius, tells how much the motion grows per control period: above 1 the contact gains energy however it is
entered. With the eigenvalue z, growth is ln|z|/T per second, and over half an oscillation, which is what a
free contact lasts, a factor exp(pi ln|z|/|arg z|).

This stands beside `jaxhil.simulation` without using its loop, which the tests hold it against.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree

from jaxhil.contact.laws import contact_law
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Compensator, Constants, Gains, Signals
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.scenario import Scenario

LINEAR_COMPENSATORS = (
    "none", "phase_lead", "multi_parameter_lead", "virtual_contact", "position_lead", "smith_predictor",
    "smith_hybrid",
)  # fmt: skip
SHORTEST_LAG = 1e-3  # control periods; where a batch has lags, one without has this much
SQUARINGS, TERMS = 12, 12  # of the exponential: to 1e-12 for norms up to 1000
DEEP = 1e-3  # m, where the loop is linearised: well in contact
PER_CHUNK = 4_000_000  # numbers of matrices at a time


class Shape(NamedTuple):
    """What shapes the program."""

    compensator: str
    integrator: str
    hold: str  # of the command
    latency: int  # of the command, periods
    has_lag: bool  # whether the force sensor has a lag
    delays: int  # readings on their way, at most


class Lane(NamedTuple):
    """Numbers of one loop in contact; arrays over lanes where there are several."""

    mass: Any  # M [kg]
    period: Any  # T [s]
    stiffness: Any  # k [N/m]
    damping: Any  # b [N s/m]
    numerator: Any  # of the motion simulator, descending powers of s, (order,)
    denominator: Any  # likewise, (order + 1,)
    delay: Any  # of motion simulator and force sensor together [s]
    lag: Any  # of the force sensor [s]


class Growth(NamedTuple):
    """Of a contact that lasts."""

    spectral_radius: float  # of one control period [1]
    per_second: float  # ln(spectral radius)/T [1/s]
    per_half_oscillation: float | None  # factor on the amplitude [1]; None where nothing oscillates
    frequency: float  # of the eigenvalue [Hz]
    by_gain: dict[str, float]  # derivative of the spectral radius [1 over the gain's unit]


def no_growth(mechanism: Mechanism, compensator: str) -> str | None:
    """Why the loop in contact is not linear, if it is not."""
    if compensator not in LINEAR_COMPENSATORS:
        return f"{compensator} is not linear"
    if not contact_law(mechanism.contact.law).is_linear:
        return f"the contact law {mechanism.contact.law} is not linear"
    return None


def spectral_radii(
    mechanism: Mechanism, compensator: str, gains: Mapping[str, Any], scenarios: Scenario
) -> np.ndarray:
    """The spectral radius of every lane, (lanes,), of that contact of the schedule in which it is largest.

    `gains` are scalars or have one value a lane.
    """
    number = len(np.asarray(scenarios.velocity))
    shape, own = _shape(mechanism, compensator, scenarios), _own(gains, number)
    found = np.zeros(number)
    for slot in _contacts(mechanism):
        lanes = _lanes(scenarios, slot)
        size = _size(shape, lanes)
        for start in range(0, number, step := max(1, PER_CHUNK // size**2)):
            part = slice(start, start + step)
            matrices = _matrices(shape, *jax.tree.map(lambda leaf, part=part: leaf[part], (lanes, own)))
            radii = np.max(np.abs(np.linalg.eigvals(np.asarray(matrices))), axis=-1)
            found[part] = np.maximum(found[part], radii)
    return found


def cost(mechanism: Mechanism, compensator: str, scenarios: Scenario) -> float:
    """Order of the work of one lane's eigenvalues: matrices, size cubed."""
    shape = _shape(mechanism, compensator, scenarios)
    return len(_contacts(mechanism)) * float(_size(shape, _lanes(scenarios, 0))) ** 3


def growth(mechanism: Mechanism, compensator: str, gains: Mapping[str, float], scenarios: Scenario) -> Growth:
    """Of the first lane, with its derivative by every gain, of the contact that grows most."""
    shape, values = _shape(mechanism, compensator, scenarios), {k: jnp.asarray(v) for k, v in gains.items()}
    most: Growth | None = None
    for slot in _contacts(mechanism):
        lane: Lane = jax.tree.map(lambda leaf: leaf[0], _lanes(scenarios, slot))
        matrix, slopes = _with_slopes(shape, lane, values)
        found: Any = scipy.linalg.eig(np.asarray(matrix), left=True)
        eigenvalues, left, right = found
        place = int(np.argmax(np.abs(eigenvalues)))
        eigenvalue, left, right = eigenvalues[place], left[:, place].conj(), right[:, place]
        by_gain = {
            name: float((np.conj(eigenvalue) / abs(eigenvalue) * (left @ np.asarray(slope) @ right)
                         / (left @ right)).real)
            for name, slope in slopes.items()
        }  # fmt: skip
        angle, period = abs(np.angle(eigenvalue)), float(lane.period)
        rate = float(np.log(abs(eigenvalue)))
        half = float(np.exp(np.pi * rate / angle)) if angle > 0 else None
        found = Growth(
            float(abs(eigenvalue)), rate / period, half, float(angle / period / 2 / np.pi), by_gain
        )
        most = found if most is None or found.spectral_radius > most.spectral_radius else most
    assert most is not None
    return most


def _contacts(mechanism: Mechanism) -> list[int]:
    """The contacts of the schedule that differ from those before."""
    contact, pairs = mechanism.contact, {}
    for slot in range(mechanism.approach.contacts):
        own = (contact.stiffness[min(slot, len(contact.stiffness) - 1)],
               contact.damping[min(slot, len(contact.damping) - 1)])  # fmt: skip
        pairs.setdefault(own, slot)
    return sorted(pairs.values())


def _shape(mechanism: Mechanism, compensator: str, scenarios: Scenario) -> Shape:
    rig = mechanism.rig
    delay = np.asarray(scenarios.simulator.delay) + np.asarray(scenarios.force_sensor.delay)
    longest = int(np.max(np.floor(delay / np.asarray(scenarios.control_period) + 1e-9)))
    lagging = bool(np.any(np.asarray(scenarios.force_sensor.time_constant) > 0))
    return Shape(compensator, rig.integrator, rig.command_hold, rig.command_latency, lagging, longest + 1)


def _lanes(scenarios: Scenario, slot: int) -> Lane:
    sensor, simulator = scenarios.force_sensor, scenarios.simulator
    numbers = Lane(
        mass=scenarios.equivalent_mass,
        period=scenarios.control_period,
        stiffness=scenarios.contact.stiffness[slot],
        damping=scenarios.contact.damping[slot],
        numerator=np.moveaxis(np.asarray(simulator.numerator), 0, -1),
        denominator=np.moveaxis(np.asarray(simulator.denominator), 0, -1),
        delay=sensor.delay + simulator.delay,
        lag=sensor.time_constant,
    )
    return jax.tree.map(np.asarray, numbers)


def _own(gains: Mapping[str, Any], number: int) -> dict[str, np.ndarray]:
    return {name: np.broadcast_to(np.asarray(value, float), (number,)) for name, value in gains.items()}


def _size(shape: Shape, lanes: Lane) -> int:
    """Roughly the rows of a matrix."""
    return 2 + shape.latency + 1 + lanes.numerator.shape[-1] + shape.has_lag + shape.delays + 4


@partial(jax.jit, static_argnums=0)
def _matrices(shape: Shape, lanes: Lane, gains: Gains) -> jax.Array:
    return jax.vmap(partial(_matrix, shape))(lanes, gains)


@partial(jax.jit, static_argnums=0)
def _with_slopes(shape: Shape, lane: Lane, gains: Gains) -> tuple[jax.Array, Gains]:
    """The matrix, and its derivative by every gain."""
    matrix = partial(_matrix, shape, lane)
    return matrix(gains), jax.jacfwd(matrix)(gains) if gains else {}


def _matrix(shape: Shape, lane: Lane, gains: Gains) -> jax.Array:
    """The matrix of one control period, (size, size)."""
    law = COMPENSATORS[shape.compensator]
    constants = Constants(lane.period, jnp.full_like(lane.period, jnp.inf))
    plant = jnp.zeros(lane.numerator.shape[0] + shape.has_lag)
    start = (
        jnp.full_like(lane.period, DEEP), jnp.zeros_like(lane.period), jnp.full(shape.latency + 1, DEEP),
        plant, jnp.zeros(shape.delays), law.init(gains, constants, 16),
    )  # fmt: skip
    flat, unravel = ravel_pytree(start)
    transition, reading = _plant(shape, lane)

    def one_period(flat: jax.Array) -> jax.Array:
        after = _period(shape, law, lane, gains, constants, transition, reading, unravel(flat))
        return ravel_pytree(after)[0]

    return jax.jacfwd(one_period)(flat)


def _period(
    shape: Shape, law: Compensator, lane: Lane, gains: Gains, constants: Constants, transition: jax.Array,
    reading: jax.Array, before: Any,
) -> Any:  # fmt: skip
    """One control period of the loop in contact, from tick to tick."""
    position, velocity, commands, plant, readings, state = before
    # What is read at a tick was sampled so many whole periods before the newest sample.
    force = readings[jnp.floor(lane.delay / lane.period + 1e-9).astype(int)]
    signals = Signals(force, position, velocity, position, jnp.asarray(1))
    command, state = law.step(law.prepare(gains, constants), state, signals, jnp.asarray(1))
    acceleration = -command / lane.mass
    position, velocity = INTEGRATORS[shape.integrator](position, velocity, acceleration, lane.period)
    led, state = law.position_command(gains, state, position, velocity, acceleration)
    sent = jnp.concatenate([led[None], commands])
    end = sent[shape.latency]
    driven = jnp.concatenate(
        [plant, jnp.stack([sent[shape.latency + 1] if shape.hold == "linear" else end, end])]
    )
    readings = jnp.concatenate([(reading @ driven)[None], readings[:-1]])
    return position, velocity, sent[:-1], transition @ driven, readings, state


def _plant(shape: Shape, lane: Lane) -> tuple[jax.Array, jax.Array]:
    """Motion simulator, contact and sensor lag over a control period: rows of the next state, and the row of
    the reading on its way, of (state, command at the period's start, command at its end).

    The exponential of the system augmented by its input and the input's slope (Van Loan 1978), time in
    control periods; the command is a straight line over the period.
    """
    order, period = lane.numerator.shape[0], lane.period
    size = order + shape.has_lag
    command, slope = size, size + 1
    generator = jnp.zeros((size + 2, size + 2)).at[command, slope].set(1.0)
    position = jnp.zeros(size + 2)
    if order == 0:
        position = position.at[command].set(1.0)
    for place in range(order):
        # Powers of s in ascending order, in units that make the command's weight 1.
        scale = period ** (order - place) / lane.denominator[0]
        position = position.at[place].set(lane.numerator[order - 1 - place] * scale)
        generator = generator.at[order - 1, place].set(-lane.denominator[order - place] * scale)
        if place < order - 1:
            generator = generator.at[place, place + 1].set(1.0)
    if order:
        generator = generator.at[order - 1, command].set(1.0)
    force = lane.stiffness * position + lane.damping / period * (position @ generator)
    if shape.has_lag:
        ratio = 1.0 / jnp.maximum(lane.lag / period, SHORTEST_LAG)
        generator = generator.at[order].set(ratio * force).at[order, order].add(-ratio)
        force = jnp.zeros(size + 2).at[order].set(1.0)
    # A reading at a tick takes the value just before the tick acts: a place in (0, 1].
    place = 1.0 - (lane.delay / period - jnp.floor(lane.delay / period + 1e-9))
    whole, part = (_exponential(generator * share) for share in (jnp.ones_like(place), place))
    rows = jnp.concatenate([whole[:size], (force @ part)[None]])
    rows = rows.at[:, command].add(-rows[:, slope])
    return rows[:size], rows[size]


def _exponential(matrix: jax.Array) -> jax.Array:
    """By scaling, Taylor and squaring: `jax.scipy.linalg.expm` takes many times as long to compile."""
    identity, scaled = jnp.eye(len(matrix)), matrix / 2**SQUARINGS

    def horner(step: Any, total: jax.Array) -> jax.Array:
        return identity + scaled @ total / (TERMS - step)

    total = jax.lax.fori_loop(0, TERMS, horner, identity)
    return jax.lax.fori_loop(0, SQUARINGS, lambda _, total: total @ total, total)
