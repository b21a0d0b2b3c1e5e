"""Free flight before a contact: initial state of a run, and control periods that need not be simulated.

In uniform flight only the positions change. The state after several control periods is therefore known, and
the simulation skips these periods. Derivatives in forward mode treat the number of skipped periods as a
constant.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.loop import Loop, RigConstants, start_uniform_motion
from jaxhil.simulation.loop_state import LoopState
from jaxhil.simulation.motion_simulator import apply_row, steady_state
from jaxhil.simulation.watch import Watch

APPROACH_TIME = 0.02  # s; duration of the free approach before a contact, without its phase
# [1]; deviation from the steady state, as a fraction of the distance flown in a control period. Below this
# fraction the motion simulator counts as settled.
SETTLING_TOLERANCE = 1e-6
# [1]; change of the speed in a control period, as a fraction of the speed. Below this fraction the numerical
# model counts as free.
FREE_FLIGHT_TOLERANCE = 1e-12


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
    """Return the state at the start of a run, and the number of skipped control periods.

    The approach starts at the position x_d = min(surface, 0) - v (0.02 s + phi T), where phi is the phase and
    T the control period. With `skip_flight`, and if nothing can happen before the contact, the simulation
    starts only two control periods before the hardware touches the surface.
    """
    nearer = jnp.minimum(rig.scenario.contact_plane, 0)
    position = nearer - velocity * (APPROACH_TIME + phase * rig.constants.control_period)
    entered = start_uniform_motion(loop, rig, gains, state, position, velocity, tick)
    if not (skip_flight and loop.is_idle_in_flight):
        return entered, jnp.zeros(velocity.shape, jnp.int32)
    stride = rig.constants.control_period * velocity
    distance = nearer - _newest_sample(loop, rig, entered, stride)
    moves = stride > 0
    periods = jnp.floor(jnp.where(moves, distance, 0) / jnp.where(moves, stride, 1)) - 2
    skipped = lax.stop_gradient(jnp.maximum(periods, 0))
    state = start_uniform_motion(loop, rig, gains, state, position + skipped * stride, velocity, tick)
    return state, skipped.astype(jnp.int32)


def advance_to_surface(
    loop: Loop, rig: RigConstants, gains: Gains, state: LoopState, watch: Watch, command: Array, tick: Array
) -> tuple[LoopState, Bool[Array, "*batch"]]:
    """Return the state shortly before the opposite surface is reached, and whether each lane may use it.

    The state lies a whole number of control periods ahead. A lane may use the state if the lane flies freely:
    its motion simulator has settled, and no force acts. `command` is |F_c| [N].
    """
    scenario, period = rig.scenario, rig.constants.control_period
    velocity, position = state.velocity, state.position
    stride = period * velocity
    distance = jnp.where(velocity > 0, -position, position + scenario.clearance)
    spare = distance - APPROACH_TIME * jnp.abs(velocity) - jnp.abs(scenario.contact_plane)
    strides = spare / jnp.where(stride != 0, jnp.abs(stride), 1)
    periods = lax.stop_gradient(jnp.floor(jnp.where(stride != 0, strides, 0)))
    arrived = start_uniform_motion(loop, rig, gains, state, position + periods * stride, velocity, tick)
    uniform = start_uniform_motion(loop, rig, gains, state, position, velocity, tick)
    follows = (watch.elapsed == 0) & (watch.force_free_ticks > loop.first_tick)
    for component, steady in zip(state.plant.state, uniform.plant.state, strict=True):
        # Time is in control periods, so that all components of the state have similar magnitudes.
        scale = jnp.abs(rig.propagation.steady_command[0] * stride)
        follows = follows & (jnp.abs(component - steady) <= SETTLING_TOLERANCE * scale)
    # Flight is not uniform while a force command, for example due to noise, accelerates the model.
    push = command * period / scenario.equivalent_mass
    still = push <= FREE_FLIGHT_TOLERANCE * jnp.abs(velocity)
    return arrived, follows & still & (periods >= 1)


def _newest_sample(loop, rig, entered, stride):
    """Return the position [m] of the real mechanism at the last force sample before the run starts."""
    drive = entered.plant.commands[-1]
    start = drive - stride if loop.hold == "linear" else drive
    before = steady_state(rig.propagation, start, stride)
    return apply_row(rig.propagation.position, before, start, drive)
