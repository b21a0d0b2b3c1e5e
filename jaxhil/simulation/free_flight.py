"""Free flight: where a run begins, and how much of a flight is skipped.

Nothing happens in uniform flight but that everything moves on: the state some periods later is known.
Forward-mode derivatives pass through; the number of periods skipped is constant to them.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.loop import Loop, RigConstants, enter
from jaxhil.simulation.loop_state import LoopState
from jaxhil.simulation.motion_simulator import read, steady_state
from jaxhil.simulation.watch import Watch

APPROACH = 0.02  # s of free approach before a contact, besides its phase
SETTLED = 1e-6  # of the distance flown in a period: the motion simulator follows uniformly
STILL = 1e-12  # of the speed, per period: nothing pushes the numerical model any more


def begin_approach(
    loop: Loop,
    rig: RigConstants,
    gains: Gains,
    state: LoopState,
    phase: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
    tick: Array,
    skip_flight: bool,
) -> tuple[LoopState, Int[Array, "*batch"]]:
    """A run of the schedule from its start, x_d(0) = min(plane, 0) - v (0.02 s + phi T), and 0; or, where
    nothing happens before, from two periods before the hardware touches, and the periods skipped."""
    nearer = jnp.minimum(rig.scenario.contact_plane, 0)
    position = nearer - velocity * (APPROACH + phase * rig.constants.control_period)
    entered = enter(loop, rig, gains, state, position, velocity, tick)
    if not (skip_flight and loop.is_idle_in_flight):
        return entered, jnp.zeros(velocity.shape, jnp.int32)
    stride = rig.constants.control_period * velocity
    left = nearer - _newest_sample(loop, rig, entered, stride)
    moves = stride > 0
    periods = jnp.floor(jnp.where(moves, left, 0) / jnp.where(moves, stride, 1)) - 2
    skipped = lax.stop_gradient(jnp.maximum(periods, 0))
    state = enter(loop, rig, gains, state, position + skipped * stride, velocity, tick)
    return state, skipped.astype(jnp.int32)


def arrival(
    loop: Loop, rig: RigConstants, gains: Gains, state: LoopState, watch: Watch, command: Array, tick: Array
) -> tuple[LoopState, Bool[Array, "*batch"]]:
    """Between two surfaces: the state whole periods later, shortly before the other one, and on which lanes
    there is settled free flight until then; |F_c| is `command` [N]."""
    scenario, period = rig.scenario, rig.constants.control_period
    velocity, position = state.velocity, state.position
    stride = period * velocity
    left = jnp.where(velocity > 0, -position, position + scenario.clearance)
    spare = left - APPROACH * jnp.abs(velocity) - jnp.abs(scenario.contact_plane)
    strides = spare / jnp.where(stride != 0, jnp.abs(stride), 1)
    periods = lax.stop_gradient(jnp.floor(jnp.where(stride != 0, strides, 0)))
    arrived = enter(loop, rig, gains, state, position + periods * stride, velocity, tick)
    here = enter(loop, rig, gains, state, position, velocity, tick)
    follows = (watch.elapsed == 0) & (watch.quiet > loop.first_tick)
    for component, steady in zip(state.plant.state, here.plant.state, strict=True):
        # Components of the state are in periods, hence of like size.
        scale = jnp.abs(rig.propagation.steady_command[0] * stride)
        follows = follows & (jnp.abs(component - steady) <= SETTLED * scale)
    # A force that still moves the model, noise for one, makes the flight an event.
    push = command * period / scenario.equivalent_mass
    still = push <= STILL * jnp.abs(velocity)
    return arrived, follows & still & (periods >= 1)


def _newest_sample(loop, rig, entered, stride):
    """Position of the mechanism [m] when its force was sampled last, in the interval before the run."""
    drive = entered.plant.commands[-1]
    start = drive - stride if loop.hold == "linear" else drive
    before = steady_state(rig.propagation, start, stride)
    return read(rig.propagation.position, before, start, drive)
