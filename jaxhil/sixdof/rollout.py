"""Rollout of a batch of runs on the rig, from the approach until the evaluated episodes are over.

An episode is a contact with all its touches. It begins with the first one. It is over when nothing has
touched for the duration of a reading, the numerical model is free as well, and its wrench has decayed. Ticks
run in short segments ("stretches"), between which begin and end of episodes are checked. The program ends
with its slowest lane.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.watch import COMMAND_DECAY_RATIO, DIVERGENCE_SPEED_RATIO, MAX_DECAY_WAIT
from jaxhil.sixdof.bodies import SHARES
from jaxhil.sixdof.forces import deepest
from jaxhil.sixdof.loop import Loop, Rig, RunState, Tick, begin, build_rig, tick
from jaxhil.sixdof.peaks import Peak, higher, no_peak
from jaxhil.sixdof.relative import States, Wrench, advance, relative
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensor import Sensor
from jaxhil.sixdof.space import choose
from jaxhil.sixdof.vectors import dot, norm

STRETCH = 16  # ticks between checks of begin and end
SLOW = 1e-3  # m/s; least approach speed to which the growth of the speed is related
MISS, REBOUNDED, CAPTURED, JAMMED, TIMEOUT, DIVERGED, NON_FINITE, REACH = range(8)
STATUS_NAMES = ("miss", "rebounded", "captured", "jammed", "timeout", "diverged", "non-finite", "reach")


class Watch(NamedTuple):
    """Record of the current episode."""

    begun: Bool[Array, "*batch"]
    entry: States  # last states of the numerical model that are free and without an episode
    onset_tick: Int[Array, "*batch"]
    entry_energy: Float[Array, "*batch"]  # energy of the relative motion then [J]
    touching: tuple[Bool[Array, "candidates *batch"], ...]
    touches: Int[Array, "*batch"]  # number of onsets of touch, over all candidates
    touched: Int[Array, "*batch"]  # ticks in touch
    quiet: Int[Array, "*batch"]  # ticks since the last touch
    caught: Bool[Array, "*batch"]  # whether a latch holds
    force: Peak  # peak force of the real contact [N]
    moment: Peak  # peak moment about T's origin [N m]
    highest: tuple[Array, Array]  # largest force [N] and moment [N m] on the numerical model
    faded: Int[Array, "*batch"]  # ticks since the wrench on the numerical model decayed
    end: States  # numerical model at the tick from which on the contact is over
    penetration: Float[Array, "*batch"]  # largest penetration, over the size of its shapes [1]
    beyond: Bool[Array, "*batch"]  # whether an axis was commanded beyond its workspace


class Episode(NamedTuple):
    """Results of episodes, (episodes, *batch)."""

    entry: States  # numerical model before the episode
    end: States  # numerical model at its end
    entry_time: Float[Array, "episodes *batch"]  # [s]
    end_time: Float[Array, "episodes *batch"]  # [s]
    touches: Int[Array, "episodes *batch"]  # number of onsets of touch, over all candidates
    duration: Float[Array, "episodes *batch"]  # time in touch [s]
    peak_force: Float[Array, "episodes *batch"]  # [N]
    peak_moment: Float[Array, "episodes *batch"]  # about T's origin [N m]
    penetration: Float[Array, "episodes *batch"]  # largest penetration, over the size of its shapes [1]
    status: Int[Array, "episodes *batch"]  # index of `STATUS_NAMES`


class Progress(NamedTuple):
    """State of a batch of runs."""

    run: RunState
    watch: Watch
    episodes: Episode
    index: Int[Array, "*batch"]  # index of the current or next episode
    active: Bool[Array, "*batch"]
    lasted: Int[Array, "*batch"]  # number of ticks of each run so far


class Outcome(NamedTuple):
    """Results of runs."""

    episodes: Episode
    final: States  # numerical model at the end of the run
    final_time: Float[Array, "*batch"]  # [s]


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> Outcome:
    """Return the episodes of every lane; `gains` are those of `jaxhil.sixdof.loop.build_rig`."""
    rig = build_rig(loop, gains, scenario)
    last = jnp.round(scenario.duration / rig.period).astype(jnp.int32)

    def one_tick(progress: Progress, _) -> tuple[Progress, Wrench | None]:
        after, command = _tick(loop, rig, last, progress)
        return after, command if loop.pushed else None

    def body(progress: Progress) -> Progress:
        after, commands = lax.scan(one_tick, progress, None, STRETCH)
        if commands is not None:
            after = _enter_late(loop, rig, progress, after, commands)
        return _turn_over(loop, rig, last, after)

    start = _start(loop, rig, scenario.start)
    ended = lax.while_loop(lambda progress: jnp.any(progress.active), body, start)
    time = ended.lasted.astype(rig.period.dtype) * rig.period
    return Outcome(ended.episodes, ended.run.states, time)


def _start(loop: Loop, rig: Rig, states: States) -> Progress:
    """Return the state at the start of the runs."""
    run = begin(loop, rig, states)
    like, none = jnp.zeros_like(rig.period), jnp.zeros(rig.period.shape, jnp.int32)
    _, energy = _freedom_and_energy(rig, states)
    watch = _fresh(rig, states, none, energy)
    slots: Any = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (loop.episodes, *leaf.shape)), states)
    numbers = jnp.zeros((loop.episodes, *like.shape), like.dtype)
    counts = numbers.astype(jnp.int32)
    episodes = Episode(
        entry=slots,
        end=slots,
        entry_time=numbers,
        end_time=numbers,
        touches=counts,
        duration=numbers,
        peak_force=numbers,
        peak_moment=numbers,
        penetration=numbers,
        status=counts + MISS,
    )
    return Progress(run, watch, episodes, none, none == 0, none)


def _fresh(rig: Rig, states: States, now: Array, energy: Array) -> Watch:
    """Return the record before an episode."""
    zero, none = jnp.zeros_like(rig.period), jnp.zeros(rig.period.shape, jnp.int32)
    peak = no_peak(zero)
    touching = tuple(group.parameters.damping > jnp.inf for group in rig.groups)
    return Watch(
        begun=none > 0,
        entry=states,
        onset_tick=now,
        entry_energy=energy,
        touching=touching,
        touches=none,
        touched=none,
        quiet=none,
        caught=none > 0,
        force=peak,
        moment=peak,
        highest=(zero, zero),
        faded=none,
        end=states,
        penetration=zero,
        beyond=none > 0,
    )


def _tick(loop: Loop, rig: Rig, last: Array, progress: Progress) -> tuple[Progress, Wrench]:
    """Run one tick; return the state and the wrench that moved the model.

    In lanes whose run is over the bodies stand still.
    """
    run, watch = progress.run, progress.watch
    after, seen = tick(loop, rig, run)
    runs = progress.active & (progress.lasted < last) & ~watch.beyond
    beyond = ~rig.kinematics.reaches(after.hardware.commands[0])
    end = choose(_since(rig, watch) < 0, after.states, watch.end)
    watched = choose(runs, _watch(rig, watch, seen)._replace(end=end, beyond=beyond), watch)
    moved = progress._replace(
        run=after._replace(states=choose(runs, after.states, run.states)),
        watch=watched,
        lasted=progress.lasted + runs.astype(jnp.int32),
    )
    return moved, seen.command


def _enter_late(loop: Loop, rig: Rig, before: Progress, after: Progress, commands: Wrench) -> Progress:
    """Set the entry to the last free tick of a model that came into contact within a segment.

    Readings that are not 0 without a contact move the model until then.
    """
    free, _ = _freedom_and_energy(rig, after.run.states)
    enters = after.active & ~free & (after.watch.onset_tick == before.lasted)

    def follow(watch: Watch) -> Watch:
        def step(carry: tuple[States, Array, Array], command: Wrench):
            states, ticks, is_free = carry
            moved = advance(rig.bodies, states, command, rig.period, SHARES[loop.integrator])
            is_free = is_free & (deepest(rig.groups, relative(rig.bodies, moved)[0]) < 0)
            return (choose(is_free, moved, states), ticks + is_free.astype(ticks.dtype), is_free), None

        start = watch.entry, watch.onset_tick, enters
        (entry, ticks, _), _ = lax.scan(step, start, commands)
        return watch._replace(entry=entry, onset_tick=ticks)

    return after._replace(watch=lax.cond(jnp.any(enters), follow, lambda watch: watch, after.watch))


def _watch(rig: Rig, watch: Watch, seen: Tick) -> Watch:
    """Update the record with a tick."""
    touching = tuple(forces.touch.depth > 0 for forces in seen.forces)
    caught = watch.caught
    for latch in seen.held:
        caught = caught | jnp.any(latch.caught, axis=0)
    now, touches = caught, watch.touches
    for flags, before in zip(touching, watch.touching, strict=True):
        now = now | jnp.any(flags, axis=0)
        touches = touches + jnp.sum(flags & ~before, axis=0, dtype=touches.dtype)
    penetration = watch.penetration
    for group, forces in zip(rig.groups, seen.forces, strict=True):
        share = jnp.max(forces.touch.depth / group.candidates.size, axis=0)
        penetration = jnp.maximum(penetration, share)
    command = norm(seen.command.force), norm(seen.command.moment)
    highest = tuple(jnp.maximum(a, b) for a, b in zip(watch.highest, command, strict=True))
    # No threshold depends on the noise; `jaxhil.simulation.watch` gives the reason.
    faded = (command[0] <= COMMAND_DECAY_RATIO * highest[0]) & (
        command[1] <= COMMAND_DECAY_RATIO * highest[1]
    )
    return watch._replace(
        begun=watch.begun | now,
        touching=touching,
        touches=touches,
        touched=watch.touched + now.astype(touches.dtype),
        quiet=jnp.where(now, 0, watch.quiet + 1),
        caught=caught,
        force=higher(watch.force, norm(seen.contact.force), rig.period),
        moment=higher(watch.moment, norm(seen.contact.moment), rig.period),
        highest=(highest[0], highest[1]),
        faded=jnp.where(faded, watch.faded + 1, 0),
        penetration=penetration,
    )


def _freedom_and_energy(rig: Rig, states: States) -> tuple[Array, Array]:
    """Return whether the numerical model is free, and the energy of its relative motion [J].

    The energy neglects the coupling of translation and rotation.
    """
    pose, (linear, angular) = relative(rig.bodies, states)
    energy = dot(linear, linear) / _share(rig) + dot(angular, rig.bodies.chaser.inertia @ angular)
    return deepest(rig.groups, pose) < 0, energy


def _share(rig: Rig) -> Array:
    """Return the inverse of the reduced mass [1/kg]."""
    return 1 / rig.bodies.target.mass + 1 / rig.bodies.chaser.mass


def quiet_time(sensor: Sensor, period: Array) -> Array:
    """Return the time [s] without a touch after which a contact is over.

    It is tau_f + 20 sensor time constants + 2 T.
    """
    return sensor.delay + 20 * sensor.time_constant + 2 * period


def _still(rig: Rig) -> Array:
    """Return the number of ticks without a touch after which a contact is over."""
    return jnp.floor(quiet_time(rig.sensor, rig.period) / rig.period + 1e-9).astype(jnp.int32) + 1


def _since(rig: Rig, watch: Watch) -> Array:
    """Return the number of ticks since the contact was over on the hardware; negative before."""
    still = _still(rig)
    patience = still + jnp.ceil(MAX_DECAY_WAIT / rig.period).astype(jnp.int32)
    return jnp.maximum(jnp.minimum(watch.quiet - still, watch.faded - 1), watch.quiet - patience)


def _turn_over(loop: Loop, rig: Rig, last: Array, progress: Progress) -> Progress:
    """Write finished episodes; where the model is free and has no episode, move the entry to this tick."""
    watch, run, period = progress.watch, progress.run, rig.period
    free, energy = _freedom_and_energy(rig, run.states)
    age = progress.lasted
    since = _since(rig, watch)
    over = watch.begun & free & (since >= 0) & progress.active
    status = _failure(rig, watch, energy)
    out = (age >= last) | (status != MISS)
    cut = jnp.where(watch.caught, CAPTURED, jnp.where(watch.quiet < _still(rig), JAMMED, TIMEOUT))
    status = jnp.where(status != MISS, status, jnp.where(over, REBOUNDED, jnp.where(watch.begun, cut, MISS)))
    ends = progress.active & (over | out)
    entry_time, end_time = (
        ticks.astype(period.dtype) * period for ticks in (watch.onset_tick, age - jnp.where(over, since, 0))
    )
    episode = Episode(
        entry=watch.entry,
        end=choose(over, watch.end, run.states),
        entry_time=entry_time,
        end_time=end_time,
        touches=watch.touches,
        duration=watch.touched.astype(period.dtype) * period,
        peak_force=watch.force.largest,
        peak_moment=watch.moment.largest,
        penetration=watch.penetration,
        status=status,
    )
    slot = jnp.arange(loop.episodes, dtype=jnp.int32).reshape(-1, *[1] * period.ndim)
    mask = (slot == progress.index[None]) & (ends & (status != MISS))[None]
    episodes = jax.tree.map(lambda new, old: jnp.where(mask, new[None], old), episode, progress.episodes)
    index = progress.index + (ends & (status != MISS)).astype(jnp.int32)
    active = progress.active & ~out
    if not loop.whole:
        active = active & (index < loop.episodes)
    fresh = _fresh(rig, run.states, age, energy)._replace(touching=watch.touching)
    watch = choose(over, fresh, watch)
    ahead = watch._replace(entry=run.states, onset_tick=age, entry_energy=energy)
    watch = choose(free & ~watch.begun & active, ahead, watch)
    return progress._replace(watch=watch, episodes=episodes, index=index, active=active)


def _failure(rig: Rig, watch: Watch, energy: Array) -> Array:
    """Return DIVERGED, NON_FINITE, REACH for an axis commanded beyond its workspace, or else MISS."""
    entry = jnp.maximum(watch.entry_energy, SLOW**2 / _share(rig))
    status = jnp.where(energy > DIVERGENCE_SPEED_RATIO**2 * entry, DIVERGED, MISS)
    status = jnp.where(watch.beyond, REACH, status)
    return jnp.where(jnp.isfinite(energy), status, NON_FINITE).astype(jnp.int32)
