"""Free flight: start of a run, and the number of periods that are skipped.

In uniform flight only the positions change, so the state after several periods is known. Forward-mode
derivatives pass through; the number of skipped periods counts as a constant.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.loop import Loop, RigConstants, start_uniform_motion
from jaxhil.simulation.loop_state import LoopState
from jaxhil.simulation.motion_simulator import apply_row, steady_state
from jaxhil.simulation.watch import Watch

APPROACH_TIME = 0.02  # s; free approach before a contact, in addition to its phase
SETTLING_TOLERANCE = (
    1e-6  # of the distance per period; deviation of the motion simulator from its steady state
)
FREE_FLIGHT_TOLERANCE = (
    1e-12  # of the speed; change per period below which the numerical model counts as free
)


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
    """Return the state at the start of a run, and the number of skipped periods.

    The run starts at x_d(0) = min(surface, 0) - v (0.02 s + phi T). If nothing happens before the touch, it
    starts two periods before the hardware touches.
    """
    nearer = jnp.minimum(rig.scenario.contact_plane, 0)
    position = nearer - velocity * (APPROACH_TIME + phase * rig.constants.control_period)
    entered = start_uniform_motion(loop, rig, gains, state, position, velocity, tick)
    if not (skip_flight and loop.is_idle_in_flight):
        return entered, jnp.zeros(velocity.shape, jnp.int32)
    stride = rig.constants.control_period * velocity
    left = nearer - _newest_sample(loop, rig, entered, stride)
    moves = stride > 0
    periods = jnp.floor(jnp.where(moves, left, 0) / jnp.where(moves, stride, 1)) - 2
    skipped = lax.stop_gradient(jnp.maximum(periods, 0))
    state = start_uniform_motion(loop, rig, gains, state, position + skipped * stride, velocity, tick)
    return state, skipped.astype(jnp.int32)


def advance_to_surface(
    loop: Loop, rig: RigConstants, gains: Gains, state: LoopState, watch: Watch, command: Array, tick: Array
) -> tuple[LoopState, Bool[Array, "*batch"]]:
    """Return the state shortly before the other of two surfaces, and the lanes that fly freely until then.

    The state is a whole number of periods later. A lane flies freely if its motion simulator has settled and
    no force acts; `command` is |F_c| [N].
    """
    scenario, period = rig.scenario, rig.constants.control_period
    velocity, position = state.velocity, state.position
    stride = period * velocity
    left = jnp.where(velocity > 0, -position, position + scenario.clearance)
    spare = left - APPROACH_TIME * jnp.abs(velocity) - jnp.abs(scenario.contact_plane)
    strides = spare / jnp.where(stride != 0, jnp.abs(stride), 1)
    periods = lax.stop_gradient(jnp.floor(jnp.where(stride != 0, strides, 0)))
    arrived = start_uniform_motion(loop, rig, gains, state, position + periods * stride, velocity, tick)
    uniform = start_uniform_motion(loop, rig, gains, state, position, velocity, tick)
    follows = (watch.elapsed == 0) & (watch.quiet > loop.first_tick)
    for component, steady in zip(state.plant.state, uniform.plant.state, strict=True):
        # Time is in periods, so the components of the state are of similar size.
        scale = jnp.abs(rig.propagation.steady_command[0] * stride)
        follows = follows & (jnp.abs(component - steady) <= SETTLING_TOLERANCE * scale)
    # Flight is not uniform while a force, such as noise, moves the model.
    push = command * period / scenario.equivalent_mass
    still = push <= FREE_FLIGHT_TOLERANCE * jnp.abs(velocity)
    return arrived, follows & still & (periods >= 1)


def _newest_sample(loop, rig, entered, stride):
    """Return the position [m] at the newest force sample before the run."""
    drive = entered.plant.commands[-1]
    start = drive - stride if loop.hold == "linear" else drive
    before = steady_state(rig.propagation, start, stride)
    return apply_row(rig.propagation.position, before, start, drive)
