"""Loop of a hardware-in-the-loop contact rig: static structure, constants, and state at the start of a run.

Three classes describe the loop. `Loop` is static and determines the compiled program. `RigConstants` contains
arrays that stay constant during a run. `LoopState` contains arrays that change from tick to tick. The module
`jaxhil.simulation.tick` computes one tick (notebooks/guide/model.md, section 1).

The arrays have batch axes. A lane is one element of the batch, that is, one scenario. Time is in control
periods, and every lane has its own control period.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactLaw
from jaxhil.laws.simulation_base import Compensator, Gains, KnownConstants
from jaxhil.mechanism.sensor_filter import FilterModes
from jaxhil.simulation.cells import CellCounts, Cells, build_cells, build_series
from jaxhil.simulation.contact_force import no_contact
from jaxhil.simulation.loop_state import LoopState, PlantState
from jaxhil.simulation.motion_simulator import (
    Propagation,
    SplitDelay,
    discretise,
    read_measured_position,
    split_delay,
    steady_state,
)
from jaxhil.simulation.moving_average import discretise_moving_average
from jaxhil.simulation.probe import initial_first_contact
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.timing import SERIES_DEGREE, no_held_values


class Loop(eqx.Module):
    """Static structure of the loop, which determines the compiled program."""

    law: ContactLaw = eqx.field(static=True)  # contact law
    compensator: Compensator = eqx.field(static=True)  # compensator
    integrator: str = eqx.field(static=True)  # integrator of the numerical model, a key of `INTEGRATORS`
    hold: str = eqx.field(static=True)  # hold of the position command: "linear" or "zoh" (zero-order hold)
    latency: int = eqx.field(static=True)  # delay of the position command, 0 or 1 [control periods]
    has_lag: bool = eqx.field(static=True)  # whether the force sensor has a lag or a filter
    # low-pass filter of the force sensor: its modes; None without a filter
    sensor_filter: FilterModes | None = eqx.field(static=True)
    has_force_bias: bool = eqx.field(static=True)  # whether the force sensor has a bias
    has_force_noise: bool = eqx.field(static=True)  # whether the force sensor has noise
    has_position_noise: bool = eqx.field(static=True)  # whether the position sensor has noise
    # whether a sensor quantises its readings or has a dead zone or a range
    has_sample_effects: bool = eqx.field(static=True)
    # whether the dead zone leaves larger readings unchanged, instead of reducing them by its half-width
    cuts_dead_zone: bool = eqx.field(static=True)
    # whether the motion simulator has a velocity limit or an acceleration limit
    has_limits: bool = eqx.field(static=True)
    # order of the lowest time derivative of the mechanism's position that jumps at the ticks, at most 3
    discontinuity_order: int = eqx.field(static=True)
    cells: CellCounts = eqx.field(static=True)  # cells of a sampling interval; `NO_CELLS` if not used
    is_two_sided: bool = eqx.field(static=True)  # whether there is a second surface
    ring: int = eqx.field(static=True)  # length of the sensors' delay lines [samples]
    controller_ring: int = eqx.field(static=True)  # length of the compensator's delay lines [samples]
    energies: bool = eqx.field(static=True)  # whether the work of the contact force is recorded
    probed: bool = eqx.field(static=True)  # whether the scenarios have a `Probe`
    chatter: bool = eqx.field(static=True)  # whether the total variation of the force command is recorded
    has_timing: bool = eqx.field(static=True, default=False)  # whether the rig has timing effects

    @property
    def reads_always(self) -> bool:
        """Return whether noise or bias makes the force sensor read a force without contact."""
        return self.has_force_noise or self.has_force_bias

    @property
    def is_idle_in_flight(self) -> bool:
        """Return whether the approach to a contact is uniform motion without any event, and can be skipped.

        Several conditions must hold. Readings have no noise, bias or quantisation. The motion simulator has
        no limits, and there are no timing effects. The compensator does nothing before the contact. The
        scenarios have no `Probe`, because a probe records the numerical model's first touch.
        """
        uneven = self.reads_always or self.has_position_noise or self.has_sample_effects or self.has_limits
        waits = vars(type(self.compensator)).get("waits_for_contact", False)
        return waits and not (uneven or self.probed or self.has_timing)

    @property
    def first_tick(self) -> int:
        """Return the number of the first tick, so large that no index into a delay line is negative."""
        return max(self.ring, self.controller_ring)

    @property
    def has_corners(self) -> bool:
        """Return whether the peak of the real force may lie at a kink or jump of the force."""
        return self.discontinuity_order in (1, 2) or (
            self.discontinuity_order > 0 and self.law.has_reversal_jump
        )

    @property
    def follows_intervals(self) -> bool:
        """Return whether results depend on the motion between the samples."""
        return self.has_lag or self.has_corners or self.energies or self.law.has_memory

    @property
    def has_cells(self) -> bool:
        """Return whether the contact is computed from the exact motion in cells of each sampling interval."""
        return self.cells.part > 0


class Delays(NamedTuple):
    """Delays of a loop, in sampling intervals.

    With one surface, the contact law is evaluated as soon as the motion is computed: one transport delay
    before the motion takes place. With two surfaces, the parameters of the contact law may change during this
    delay. The law is therefore evaluated when the motion takes place, and the delay of the force counts from
    that instant.
    """

    force: SplitDelay  # delay of the force reading
    position: SplitDelay  # delay of the position reading
    real: Int[Array, "*batch"]  # age of the last computed force that acts before the current tick
    contact: Int[Array, "*batch"]  # delay of the contact law's evaluation


class RigConstants(NamedTuple):
    """Arrays that stay constant during a run."""

    scenario: Scenario  # numbers of the scenarios
    propagation: Propagation  # discretised motion simulator
    cells: Cells | None  # cells of a sampling interval; None for a loop without cells
    delays: Delays  # delays of the loop [sampling intervals]
    constants: KnownConstants  # rig data that the compensator knows
    inverse_mass: Float[Array, "*batch"]  # reciprocal of the equivalent mass [1/kg]
    # power series of the motion in a sampling interval (`build_series`); None without jitter
    series: Float[Array, "powers columns *batch"] | None = None


def build_rig_constants(loop: Loop, scenario: Scenario, measured: bool = True) -> RigConstants:
    """Compute the constants of a run from its scenarios.

    Args:
        loop: Loop that will run the scenarios.
        scenario: Scenarios to be simulated.
        measured: Whether the position sensor is simulated. Without this sensor, every tick takes less time.
    """
    period, simulator = scenario.control_period, scenario.simulator
    delays = split_delays(scenario, loop.is_two_sided)
    cells = None
    if loop.has_cells:
        time_constant = scenario.force_sensor.time_constant
        cells = build_cells(
            loop.cells,
            simulator.numerator,
            simulator.denominator,
            period,
            delays.force.fraction,
            time_constant,
            simulator.window,
            loop.hold,
        )
    fractions = delays.force.fraction, delays.position.fraction if measured else None
    ends = loop.follows_intervals and not loop.has_cells
    if simulator.window is None:
        rows = discretise(simulator.numerator, simulator.denominator, period, *fractions, loop.hold, ends)
    else:
        rows = discretise_moving_average(simulator.window, period, *fractions, loop.hold, ends)
    series = None
    if scenario.timing is not None and scenario.timing.jitter is not None:
        series = build_series(simulator.numerator, simulator.denominator, period, SERIES_DEGREE)
    return RigConstants(
        scenario=scenario,
        propagation=rows,
        cells=cells,
        delays=delays,
        constants=KnownConstants(period, scenario.clearance),
        inverse_mass=1 / scenario.equivalent_mass,
        series=series,
    )


def no_lagged_force(loop: Loop, like: Array) -> Array:
    """Return the state of the sensor's lag or filter before a run, for a batch with the shape of `like`."""
    if loop.sensor_filter is None:
        return jnp.zeros_like(like)
    # Real and imaginary part of each mode.
    return jnp.zeros((2 * len(loop.sensor_filter.rates), *like.shape), like.dtype)


def split_delays(scenario: Scenario, is_two_sided: bool) -> Delays:
    """Convert the delays of the scenarios to sampling intervals."""
    period, simulator = scenario.control_period, scenario.simulator
    force = split_delay(simulator.delay + scenario.force_sensor.delay, period)
    position = split_delay(simulator.delay + scenario.position_sensor.delay, period)
    behind = simulator.delay / period + force.fraction
    real = jnp.ceil(behind - 1e-9).astype(jnp.int32) - 1
    now = jnp.zeros_like(real)
    if is_two_sided:
        return Delays(force._replace(intervals=force.intervals - real), position, now, real)
    return Delays(force, position, real, now)


def start_uniform_motion(
    loop: Loop,
    rig: RigConstants,
    gains: Gains,
    state: LoopState,
    position: Array,
    velocity: Array,
    tick: Array,
) -> LoopState:
    """Return the loop's state for a run that starts in uniform motion.

    The motion simulator is in the steady state of this motion. The delay lines keep their content, because
    samples from before the start of the run are never read.

    Args:
        loop: Structure of the loop.
        rig: Constants of the run.
        gains: Gains of the compensator.
        state: State from which the compensator's state and the delay lines are taken.
        position: Position of the numerical model at the start [m].
        velocity: Velocity of the numerical model [m/s].
        tick: Number of the first tick of the run.
    """
    stride = rig.constants.control_period * velocity
    commands = tuple(
        loop.compensator.position_command(
            gains, state.controller, position - back * stride, velocity, jnp.zeros_like(velocity)
        )[0]
        for back in range(loop.latency + 1)
    )
    drive = commands[-1] if loop.hold == "linear" else commands[-1] + stride
    start = drive - stride
    end = drive if loop.hold == "linear" else start
    first_position = read_measured_position(
        rig.propagation, steady_state(rig.propagation, start, stride), start, end
    )
    return state._replace(
        position=position,
        velocity=velocity,
        plant=PlantState(
            commands,
            stride,
            steady_state(rig.propagation, drive, stride),
            commands[0] if loop.has_limits else None,
            None if rig.propagation.window is None else commands[-1],
        ),
        sensed=state.sensed._replace(
            last=no_contact(position),
            contact_time=jnp.zeros_like(position) if loop.has_cells else None,
            lagged=no_lagged_force(loop, position),
            first_position=first_position,
        ),
        law=loop.law.init(position),
        onset_velocity=velocity,
        onset_tick=jnp.broadcast_to(tick, position.shape),
        first_contact=initial_first_contact(position) if loop.probed else None,
        held=None if state.held is None else no_held_values(position),
        bias_walk=None if state.bias_walk is None else jnp.zeros_like(position),
    )
