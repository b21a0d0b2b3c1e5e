"""Free flight before a contact: initial state of a run, and control periods that need not be simulated.

In uniform flight only the positions change. The state after several control periods is therefore known, and
the simulation skips these periods. Derivatives in forward mode treat the number of skipped periods as a
constant.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.contact_tracking import ContactTracker
from jaxhil.simulation.loop import Loop, RigConstants, start_uniform_motion
from jaxhil.simulation.loop_state import LoopState
from jaxhil.simulation.motion_simulator import apply_row, steady_state

APPROACH_TIME = 0.02  # duration of the approach before a contact, to which a part of a period is added [s]
# maximum deviation of a settled motion simulator from its steady state, divided by the travel in a control
# period [1].
SETTLING_TOLERANCE = 1e-6
# maximum change of a freely flying model's speed in a control period, divided by the speed [1].
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

    The numerical model starts at the position min(p, 0) - v (0.02 s + phi T). Here p is the position of the
    hardware's surface, v the approach speed, T the control period, and phi the phase: a fraction of T. With
    `skip_flight`, a flight in which nothing can happen is skipped. Only about the last two control periods
    before the hardware touches the surface are simulated.
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
    loop: Loop,
    rig: RigConstants,
    gains: Gains,
    state: LoopState,
    tracker: ContactTracker,
    command: Array,
    tick: Array,
) -> tuple[LoopState, Bool[Array, "*batch"]]:
    """Return the state shortly before the next touch of a surface, and whether a lane may skip to this state.

    The returned state lies a whole number of control periods ahead. A lane may skip to this state if it flies
    freely: its motion simulator has settled, and no force acts. `command` is the magnitude of the force
    command [N].
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
    settled = uniform.plant.state
    if rig.propagation.window is not None:
        # The state contains the commands that left the window in the last interval, a stride before.
        settled = settled[0], *(command - stride for command in settled[1:])
    follows = (tracker.elapsed == 0) & (tracker.force_free_ticks > loop.first_tick)
    for component, steady in zip(state.plant.state, settled, strict=True):
        # Time is in control periods, so that all components of the state have similar magnitudes.
        scale = jnp.abs(rig.propagation.steady_command[0] * stride)
        follows = follows & (jnp.abs(component - steady) <= SETTLING_TOLERANCE * scale)
    # A force command, for example due to noise, accelerates the model: the flight is not uniform.
    push = command * period / scenario.equivalent_mass
    still = push <= FREE_FLIGHT_TOLERANCE * jnp.abs(velocity)
    return arrived, follows & still & (periods >= 1)


def _newest_sample(loop, rig, entered, stride):
    """Return the hardware's position [m] at the last force sample before the run starts."""
    drive = entered.plant.commands[-1]
    start = drive - stride if loop.hold == "linear" else drive
    before = steady_state(rig.propagation, start, stride)
    return apply_row(rig.propagation.position, before, start, drive)
