"""Growth of the oscillation in a contact that does not end, from the eigenvalues of the sampled loop.

For a linear contact law and a linear compensator, the loop in contact is a linear map from tick to tick. The
state of the map consists of the numerical model, the delayed commands, the motion simulator, the force
sensor's lag or filter, the delayed readings, and the compensator's filters. The motion between ticks is
solved exactly, and the matrix of the map is the derivative of one control period with respect to the state.

The spectral radius is the largest magnitude of the eigenvalues of this matrix. If it exceeds 1, the
oscillation grows. For the eigenvalue z with this magnitude, the growth rate is ln|z|/T per second, where T is
the control period. In half an oscillation, the duration of a contact that ends, the amplitude grows by the
factor exp(pi ln|z|/|arg z|).

This module does not use the loop of `jaxhil.simulation`; tests compare both.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.flatten_util import ravel_pytree

from jaxhil.contact.laws import find_contact_law
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import Compensator, Gains, KnownConstants, Signals
from jaxhil.mechanism.sensor_filter import FilterModes, find_modes
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.scenario import Scenario, build_scenarios

LINEAR_COMPENSATORS = (
    "none", "phase_lead", "multi_parameter_lead", "virtual_contact", "position_lead", "smith_predictor",
    "smith_hybrid",
)  # fmt: skip
MIN_LAG = 1e-3  # replacement of a lag of 0 in a batch in which other lanes have a lag [control periods]
# Squarings and terms of the matrix exponential; its errors are below 1e-12 for norms up to 1000.
EXPONENTIAL_SQUARINGS, EXPONENTIAL_TERMS = 12, 12
LINEARISATION_DEPTH = 1e-3  # penetration at which the loop is linearised [m]
MAX_CHUNK_ENTRIES = 4_000_000  # largest number of matrix entries that are computed together


class ProgramParameters(NamedTuple):
    """Parameters that are constants of the compiled program, and equal for all lanes."""

    compensator: str
    integrator: str
    hold: str  # hold of the command, "zoh" or "linear"
    latency: int  # latency of the command [control periods]
    # modes of the force sensor's lag or filter; None for a sensor without either
    modes: FilterModes | None
    delays: int  # number of past force readings in the state, enough for the longest delay

    @property
    def filter_size(self) -> int:
        """Return the number of states of the force sensor's lag or filter."""
        return 0 if self.modes is None else 2 * len(self.modes.rates)


class LoopParameters(NamedTuple):
    """Physical parameters of a loop in contact: scalars, or arrays with one value per lane."""

    mass: Any  # M [kg]
    period: Any  # T [s]
    stiffness: Any  # k [N/m]
    damping: Any  # b [N s/m]
    numerator: Any  # motion simulator's numerator, coefficients of descending powers of s, (order,)
    denominator: Any  # motion simulator's denominator, descending powers of s, (order + 1,)
    delay: Any  # delay of motion simulator plus force sensor [s]
    cutoff: Any  # cutoff frequency of the force sensor's lag or filter [rad/s]


class Growth(NamedTuple):
    """Growth of the oscillation in a contact that does not end."""

    spectral_radius: float  # growth factor of the amplitude per control period [1]
    per_second: float  # growth rate ln(spectral radius)/T [1/s]
    per_half_oscillation: float | None  # growth factor per half oscillation [1]; None without one
    frequency: float  # frequency of the oscillation [Hz]
    by_gain: dict[str, float]  # derivative of the radius with respect to each gain [1/unit of the gain]


def explain_nonlinearity(mechanism: Mechanism, compensator: str) -> str | None:
    """Return why the growth is not computed, for example a nonlinear contact law; None if it is computed."""
    if compensator not in LINEAR_COMPENSATORS:
        return f"{compensator} is not linear"
    if not find_contact_law(mechanism.contact.law).is_linear:
        return f"the contact law {mechanism.contact.law} is not linear"
    if mechanism.rig.simulator.model == "moving_average":
        return "the motion simulator is a moving average"
    if build_scenarios(mechanism).timing is not None:
        return "the timing varies from tick to tick"
    return None


def spectral_radii(
    mechanism: Mechanism, compensator: str, gains: Mapping[str, Any], scenarios: Scenario
) -> np.ndarray:
    """Return the spectral radius of the loop in contact for each scenario of a batch, (lanes,).

    The value of a scenario is the largest spectral radius of its contacts. `gains` are scalars or have one
    value per lane.
    """
    number = len(np.asarray(scenarios.velocity))
    shape, lane_gains = _program_parameters(mechanism, compensator, scenarios), _per_lane(gains, number)
    largest = np.zeros(number)
    for slot in _distinct_contacts(mechanism):
        lanes = _lane_parameters(scenarios, slot)
        size = _matrix_size(shape, lanes)
        for start in range(0, number, step := max(1, MAX_CHUNK_ENTRIES // size**2)):
            chunk = slice(start, start + step)
            matrices = _period_matrices(
                shape, *jax.tree.map(lambda leaf, chunk=chunk: leaf[chunk], (lanes, lane_gains))
            )
            radii = np.max(np.abs(np.linalg.eigvals(np.asarray(matrices))), axis=-1)
            largest[chunk] = np.maximum(largest[chunk], radii)
    return largest


def eigenvalue_cost(mechanism: Mechanism, compensator: str, scenarios: Scenario) -> float:
    """Estimate how many operations it takes to compute the eigenvalues for one scenario."""
    shape = _program_parameters(mechanism, compensator, scenarios)
    return (
        len(_distinct_contacts(mechanism)) * float(_matrix_size(shape, _lane_parameters(scenarios, 0))) ** 3
    )


def compute_growth(
    mechanism: Mechanism, compensator: str, gains: Mapping[str, float], scenarios: Scenario
) -> Growth:
    """Return the growth of the first scenario's oscillation in its contact of largest spectral radius."""
    shape, values = (
        _program_parameters(mechanism, compensator, scenarios),
        {k: jnp.asarray(v) for k, v in gains.items()},
    )
    most: Growth | None = None
    for slot in _distinct_contacts(mechanism):
        lane: LoopParameters = jax.tree.map(lambda leaf: leaf[0], _lane_parameters(scenarios, slot))
        matrix, slopes = _matrix_derivatives(shape, lane, values)
        solution: Any = scipy.linalg.eig(np.asarray(matrix), left=True)
        eigenvalues, left, right = solution
        index = int(np.argmax(np.abs(eigenvalues)))
        eigenvalue, left, right = eigenvalues[index], left[:, index].conj(), right[:, index]
        by_gain = {
            name: float((np.conj(eigenvalue) / abs(eigenvalue) * (left @ np.asarray(slope) @ right)
                         / (left @ right)).real)
            for name, slope in slopes.items()
        }  # fmt: skip
        angle, period = abs(np.angle(eigenvalue)), float(lane.period)
        rate = float(np.log(abs(eigenvalue)))
        half = float(np.exp(np.pi * rate / angle)) if angle > 0 else None
        candidate = Growth(
            float(abs(eigenvalue)), rate / period, half, float(angle / period / 2 / np.pi), by_gain
        )
        most = candidate if most is None or candidate.spectral_radius > most.spectral_radius else most
    assert most is not None
    return most


def _distinct_contacts(mechanism: Mechanism) -> list[int]:
    """Return the index of one contact for each different pair of stiffness and damping in the schedule."""
    contact, pairs = mechanism.contact, {}
    for slot in range(mechanism.approach.contacts):
        pair = (contact.stiffness[min(slot, len(contact.stiffness) - 1)],
               contact.damping[min(slot, len(contact.damping) - 1)])  # fmt: skip
        pairs.setdefault(pair, slot)
    return sorted(pairs.values())


def _program_parameters(mechanism: Mechanism, compensator: str, scenarios: Scenario) -> ProgramParameters:
    """Return the values that are fixed in the program compiled for a batch of scenarios."""
    rig = mechanism.rig
    delay = np.asarray(scenarios.simulator.delay) + np.asarray(scenarios.force_sensor.delay)
    longest = int(np.max(np.floor(delay / np.asarray(scenarios.control_period) + 1e-9)))
    low_pass, modes = rig.force_sensor.filter, None
    if low_pass is not None:
        modes = find_modes(low_pass.kind, low_pass.order)
    elif np.any(np.asarray(scenarios.force_sensor.time_constant) > 0):
        modes = find_modes("butterworth", 1)
    return ProgramParameters(
        compensator, rig.integrator, rig.command_hold, rig.command_latency, modes, longest + 1
    )


def _lane_parameters(scenarios: Scenario, slot: int) -> LoopParameters:
    """Return the physical parameters of every lane in contact `slot` of the schedule."""
    sensor, simulator = scenarios.force_sensor, scenarios.simulator
    cutoff = sensor.cutoff
    if cutoff is None:
        cutoff = 1.0 / np.maximum(sensor.time_constant, MIN_LAG * np.asarray(scenarios.control_period))
    numbers = LoopParameters(
        mass=scenarios.equivalent_mass,
        period=scenarios.control_period,
        stiffness=scenarios.contact.stiffness[slot],
        damping=scenarios.contact.damping[slot],
        numerator=np.moveaxis(np.asarray(simulator.numerator), 0, -1),
        denominator=np.moveaxis(np.asarray(simulator.denominator), 0, -1),
        delay=sensor.delay + simulator.delay,
        cutoff=cutoff,
    )
    return jax.tree.map(np.asarray, numbers)


def _per_lane(gains: Mapping[str, Any], number: int) -> dict[str, np.ndarray]:
    """Return the gains as arrays with one value per lane, (number,); scalars are repeated."""
    return {name: np.broadcast_to(np.asarray(value, float), (number,)) for name, value in gains.items()}


def _matrix_size(shape: ProgramParameters, lanes: LoopParameters) -> int:
    """Return the approximate number of rows of the matrix that advances the loop by one control period."""
    return 2 + shape.latency + 1 + lanes.numerator.shape[-1] + shape.filter_size + shape.delays + 4


@partial(jax.jit, static_argnums=0)
def _period_matrices(shape: ProgramParameters, lanes: LoopParameters, gains: Gains) -> jax.Array:
    """Return, for every lane, the matrix that advances the loop by one period, (lanes, size, size)."""
    return jax.vmap(partial(_period_matrix, shape))(lanes, gains)


@partial(jax.jit, static_argnums=0)
def _matrix_derivatives(
    shape: ProgramParameters, lane: LoopParameters, gains: Gains
) -> tuple[jax.Array, Gains]:
    """Return the matrix that advances the loop by one period, and its derivative by each gain."""
    matrix = partial(_period_matrix, shape, lane)
    return matrix(gains), jax.jacfwd(matrix)(gains) if gains else {}


def _period_matrix(shape: ProgramParameters, lane: LoopParameters, gains: Gains) -> jax.Array:
    """Return the matrix that maps the state of the loop from one tick to the next, (size, size)."""
    law = COMPENSATORS[shape.compensator]
    constants = KnownConstants(lane.period, jnp.full_like(lane.period, jnp.inf))
    plant = jnp.zeros(lane.numerator.shape[0] + shape.filter_size)
    start = (
        jnp.full_like(lane.period, LINEARISATION_DEPTH),
        jnp.zeros_like(lane.period),
        jnp.full(shape.latency + 1, LINEARISATION_DEPTH),
        plant,
        jnp.zeros(shape.delays),
        law.init(gains, constants, 16),
    )
    flat, unravel = ravel_pytree(start)
    transition, reading = _plant_transition(shape, lane)

    def one_period(flat: jax.Array) -> jax.Array:
        after = _advance_period(shape, law, lane, gains, constants, transition, reading, unravel(flat))
        return ravel_pytree(after)[0]

    return jax.jacfwd(one_period)(flat)


def _advance_period(
    shape: ProgramParameters,
    law: Compensator,
    lane: LoopParameters,
    gains: Gains,
    constants: KnownConstants,
    transition: jax.Array,
    reading: jax.Array,
    before: Any,
) -> Any:
    """Advance the loop by one control period in contact; return the state that follows the state `before`."""
    position, velocity, commands, plant, readings, state = before
    # The reading at a tick is older than the newest reading by a whole number of periods.
    force = readings[jnp.floor(lane.delay / lane.period + 1e-9).astype(int)]
    signals = Signals(force, position, velocity, position, jnp.asarray(1))
    command, state = law.step(law.prepare(gains, constants), state, signals, jnp.asarray(1))
    acceleration = -command / lane.mass
    position, velocity = INTEGRATORS[shape.integrator](position, velocity, acceleration, lane.period)
    position_command, state = law.position_command(gains, state, position, velocity, acceleration)
    sent = jnp.concatenate([position_command[None], commands])
    end = sent[shape.latency]
    driven = jnp.concatenate(
        [plant, jnp.stack([sent[shape.latency + 1] if shape.hold == "linear" else end, end])]
    )
    readings = jnp.concatenate([(reading @ driven)[None], readings[:-1]])
    return position, velocity, sent[:-1], transition @ driven, readings, state


def _plant_transition(shape: ProgramParameters, lane: LoopParameters) -> tuple[jax.Array, jax.Array]:
    """Return the transition matrix of simulator and sensor lag for a period, and the row of the reading.

    Matrix and row multiply the vector (state, command at the start of the period, command at the end). The
    product with the matrix is the state at the end, and the product with the row is the new force reading.
    Both follow from the exponential of the system augmented by its input and the slope of the input (Van Loan
    1978). Time is in control periods, and the command is linear within a period.
    """
    order, period = lane.numerator.shape[0], lane.period
    size = order + shape.filter_size
    command, slope = size, size + 1
    generator = jnp.zeros((size + 2, size + 2)).at[command, slope].set(1.0)
    position = jnp.zeros(size + 2)
    if order == 0:
        position = position.at[command].set(1.0)
    for power in range(order):
        # The powers of s ascend; the state is scaled such that the coefficient of the command is 1.
        scale = period ** (order - power) / lane.denominator[0]
        position = position.at[power].set(lane.numerator[order - 1 - power] * scale)
        generator = generator.at[order - 1, power].set(-lane.denominator[order - power] * scale)
        if power < order - 1:
            generator = generator.at[power, power + 1].set(1.0)
    if order:
        generator = generator.at[order - 1, command].set(1.0)
    force = lane.stiffness * position + lane.damping / period * (position @ generator)
    if shape.modes is not None:
        force, inputs = jnp.zeros(size + 2), force
        for mode, (rate, weight) in enumerate(zip(*shape.modes, strict=True)):
            # Real part u and imaginary part v of a mode, (u + j v)' = rate cutoff (force - u - j v).
            u = order + 2 * mode
            v, turn, decay = u + 1, rate.imag * lane.cutoff * period, rate.real * lane.cutoff * period
            generator = generator.at[u].set(decay * inputs).at[v].set(turn * inputs)
            generator = generator.at[u, u].add(-decay).at[u, v].add(turn)
            generator = generator.at[v, u].add(-turn).at[v, v].add(-decay)
            force = force.at[u].set(weight.real).at[v].set(-weight.imag)
    # A reading is the force just before a tick. Its time, as a share of the period, is thus in (0, 1].
    time = 1.0 - (lane.delay / period - jnp.floor(lane.delay / period + 1e-9))
    to_end, to_reading = (_matrix_exponential(generator * t) for t in (jnp.ones_like(time), time))
    rows = jnp.concatenate([to_end[:size], (force @ to_reading)[None]])
    rows = rows.at[:, command].add(-rows[:, slope])
    return rows[:size], rows[size]


def _matrix_exponential(matrix: jax.Array) -> jax.Array:
    """Return the exponential of a matrix by scaling and squaring; jax's `expm` compiles much more slowly."""
    identity, scaled = jnp.eye(len(matrix)), matrix / 2**EXPONENTIAL_SQUARINGS

    def horner(step: Any, total: jax.Array) -> jax.Array:
        return identity + scaled @ total / (EXPONENTIAL_TERMS - step)

    total = jax.lax.fori_loop(0, EXPONENTIAL_TERMS, horner, identity)
    return jax.lax.fori_loop(0, EXPONENTIAL_SQUARINGS, lambda _, total: total @ total, total)
