"""The rig's loop in six degrees of freedom, without compensation: one tick after the other.

A tick reads the wrench that the real contact had a force delay ago, moves the two bodies of the numerical
model by it, and sends their relative pose to the motion simulator, on which the contact happens. The wrench
is formed on the hardware's pose, in T axes about T's origin, and acts at the model's T.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.sixdof.bodies import SHARES
from jaxhil.sixdof.forces import ContactGroup, Memory, contact_wrench
from jaxhil.sixdof.relative import (
    Coordinates,
    Pair,
    States,
    Wrench,
    advance,
    coordinates,
    interface_frame,
    motion_of,
    relative_motion,
)
from jaxhil.sixdof.task_space import Hardware, TaskSpace, actuate, enter, sampled
from jaxhil.sixdof.vectors import vector


class Loop(eqx.Module):
    """What shapes the compiled loop; every field is static."""

    integrator: str = eqx.field(static=True)  # of the numerical model, a name of `SHARES`
    hold: str = eqx.field(static=True)  # of the command within a period, "linear" or "zoh"
    latency: int = eqx.field(static=True)  # of the command, 0 or 1 periods
    ring: int = eqx.field(static=True)  # samples that are kept, a power of two beyond the longest delay


class Rig(NamedTuple):
    """What stays constant during a run."""

    bodies: Pair  # of the numerical model
    plant: TaskSpace  # motion simulator and force delay
    groups: tuple[ContactGroup, ...]  # the real contact
    period: Float[Array, "*batch"]  # T [s]


class RunState(NamedTuple):
    """What is carried from tick to tick."""

    states: States  # of the numerical model
    hardware: Hardware
    memories: tuple[Memory, ...]  # of the contact's laws
    tick: Int[Array, ""]


class Tick(NamedTuple):
    """What is recorded of a tick."""

    states: States  # of the numerical model, at the tick
    wrench: Wrench  # that moves it


def run(loop: Loop, rig: Rig, states: States, ticks: int) -> tuple[States, Tick]:
    """The numerical model's states after so many ticks, and every tick, (ticks, ...).

    Before the start the command was in uniform motion, at the states' relative pose and rates.
    """
    at, rates = _command(rig.bodies, states)
    hardware = enter(rig.plant, at, rates * rig.period[None], rig.period, loop.hold, loop.latency, loop.ring)
    begin = RunState(states, hardware, tuple(group.init() for group in rig.groups), jnp.array(0, jnp.int32))
    end, seen = lax.scan(lambda state, _: _tick(loop, rig, state), begin, None, length=ticks)
    return end.states, seen


def _tick(loop: Loop, rig: Rig, state: RunState) -> tuple[RunState, Tick]:
    found = sampled(rig.plant, state.hardware, state.tick, rig.period)
    at, rates = (Coordinates(vector(part[:3]), vector(part[3:])) for part in found)
    wrench, memories = contact_wrench(rig.groups, state.memories, *motion_of(at, rates), rig.period)
    states = advance(rig.bodies, state.states, wrench, rig.period, SHARES[loop.integrator])
    command, _ = _command(rig.bodies, states)
    hardware = actuate(rig.plant, state.hardware, state.tick, command, loop.hold, loop.latency)
    return RunState(states, hardware, memories, state.tick + 1), Tick(state.states, wrench)


def _command(bodies: Pair, states: States) -> tuple[Array, Array]:
    """Coordinates (6, *batch) of C against T in the numerical model, and their rates."""
    frames = [interface_frame(*one) for one in zip(bodies, states, strict=True)]
    at, rates = coordinates(*relative_motion(*frames))
    return jnp.stack(jax.tree.leaves(at)), jnp.stack(jax.tree.leaves(rates))
