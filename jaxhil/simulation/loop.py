"""Loop of a hardware-in-the-loop contact rig: its static structure, its constants, and the start of a run.

`jaxhil.simulation.tick` runs one tick, with the stages of notebooks/guide/model.md, section 1. Time is in
control periods, and each lane of a batch has its own. A `Loop` is static: it determines the compiled program.
`RigConstants` are arrays that stay constant during a run. `LoopState` is the state.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.contact.laws import ContactLaw
from jaxhil.laws.simulation_base import Compensator, Gains, KnownConstants
from jaxhil.simulation.cells import CellCounts, Cells, build_cells
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
from jaxhil.simulation.probe import initial_first_contact
from jaxhil.simulation.scenario import Scenario


class Loop(eqx.Module):
    """Structure of the loop, which determines the compiled program; every field is static."""

    law: ContactLaw = eqx.field(static=True)  # contact law
    compensator: Compensator = eqx.field(static=True)  # compensator
    integrator: str = eqx.field(static=True)  # integrator of the numerical model, a name of `INTEGRATORS`
    hold: str = eqx.field(static=True)  # hold of the command within a period, "linear" or "zoh"
    latency: int = eqx.field(static=True)  # latency of the command, 0 or 1 periods
    has_lag: bool = eqx.field(static=True)  # whether the force sensor has a first-order lag
    has_force_bias: bool = eqx.field(static=True)  # whether the force sensor has a bias
    has_force_noise: bool = eqx.field(static=True)  # whether the force sensor has noise
    has_position_noise: bool = eqx.field(static=True)  # whether the position sensor has noise
    # whether a reading has a quantum, a dead zone or a range
    has_sample_effects: bool = eqx.field(static=True)
    # whether the motion simulator has limits of velocity or acceleration
    has_limits: bool = eqx.field(static=True)
    # order of the lowest derivative of the mechanism's position that jumps at the ticks; 3 if higher than 2
    discontinuity_order: int = eqx.field(static=True)
    cells: CellCounts = eqx.field(static=True)  # cells of a sampling interval; `NO_CELLS` if samples suffice
    is_two_sided: bool = eqx.field(static=True)  # whether there is a second surface
    ring: int = eqx.field(static=True)  # samples in the delay lines of the sensors
    controller_ring: int = eqx.field(static=True)  # samples in the delay lines of the controller
    energies: bool = eqx.field(static=True)  # whether the work of the contact force is recorded
    probed: bool = eqx.field(static=True)  # whether scenarios have a `Probe`
    chatter: bool = eqx.field(static=True)  # whether the swings of the force command are recorded

    @property
    def reads_always(self) -> bool:
        """Return whether the force sensor reads a force without contact, due to noise or bias."""
        return self.has_force_noise or self.has_force_bias

    @property
    def is_idle_in_flight(self) -> bool:
        """Return whether nothing happens in flight before the hardware touches.

        This requires no limits of the drives, no noise, bias or rounding of readings, a compensator that
        waits for the contact, and no probe, whose time counts from x_d = 0.
        """
        uneven = self.reads_always or self.has_position_noise or self.has_sample_effects or self.has_limits
        waits = vars(type(self.compensator)).get("waits_for_contact", False)
        return waits and not (uneven or self.probed)

    @property
    def first_tick(self) -> int:
        """Return the number of the first tick: delay lines are read up to one ring back."""
        return max(self.ring, self.controller_ring)

    @property
    def has_corners(self) -> bool:
        """Return whether the real force may have its peak at a corner: at a tick or a reversal."""
        return self.discontinuity_order in (1, 2) or (self.discontinuity_order > 0 and self.law.jumps)

    @property
    def follows_intervals(self) -> bool:
        """Return whether the motion between samples is needed."""
        return self.has_lag or self.has_corners or self.energies or self.law.remembers

    @property
    def has_cells(self) -> bool:
        """Return whether the contact follows the exact motion between samples."""
        return self.cells.part > 0


class Delays(NamedTuple):
    """Delays of a loop in sampling intervals.

    With one surface the contact law is evaluated as soon as the motion is known, which is earlier than the
    motion by the transport delay. With two surfaces its parameters may change in the meantime. It is then
    evaluated when the motion takes place, and the other delays count from there.
    """

    force: SplitDelay  # delay of the force reading
    position: SplitDelay  # delay of the position reading
    real: Int[Array, "*batch"]  # intervals to look back for the newest force that acts before a tick
    contact: Int[Array, "*batch"]  # intervals after which the contact law is evaluated


class RigConstants(NamedTuple):
    """Constants of a run, per lane."""

    scenario: Scenario  # numbers of the lane
    propagation: Propagation  # discretised motion simulator
    cells: Cells | None  # cells of a sampling interval; None for a loop without cells
    delays: Delays  # in sampling intervals
    constants: KnownConstants  # rig data that the controller knows
    inverse_mass: Float[Array, "*batch"]  # inverse of the equivalent mass [1/kg]


def build_rig_constants(loop: Loop, scenario: Scenario, measured: bool = True) -> RigConstants:
    """Discretise the linear parts exactly and split every delay into sampling intervals and a fraction.

    Without `measured`, runs have no position reading, which saves time in every tick.
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
        )
    return RigConstants(
        scenario=scenario,
        propagation=discretise(
            simulator.numerator,
            simulator.denominator,
            period,
            delays.force.fraction,
            delays.position.fraction if measured else None,
            loop.hold,
            ends=loop.follows_intervals and not loop.has_cells,
        ),
        cells=cells,
        delays=delays,
        constants=KnownConstants(period, scenario.clearance),
        inverse_mass=1 / scenario.equivalent_mass,
    )


def split_delays(scenario: Scenario, is_two_sided: bool) -> Delays:
    """Return every delay of a scenario in sampling intervals."""
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
    """Start a run at `tick` in uniform motion at `position` [m], `velocity` [m/s].

    The motion simulator is in the steady state of this motion, including the hold of the command. The delay
    lines need not be filled.
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
        ),
        sensed=state.sensed._replace(
            last=no_contact(position),
            touched=jnp.zeros_like(position) if loop.has_cells else None,
            lagged=jnp.zeros_like(position),
            first_position=first_position,
        ),
        law=loop.law.init(position),
        onset_velocity=velocity,
        onset_tick=jnp.broadcast_to(tick, position.shape),
        first_contact=initial_first_contact(position) if loop.probed else None,
    )
