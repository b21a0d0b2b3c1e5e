"""A batch of runs on the rig: from the approach until the episodes that count are over.

An episode is a contact with all its touches: it begins with the first one and is over when nothing has
touched for as long as a reading takes, the numerical model is free, too, and its wrench has died out. Ticks
run in short stretches; what begins and ends is looked at between them. The program ends with its slowest
lane.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.watch import FADED, LONGEST_FADING, RUNAWAY
from jaxhil.sixdof.bodies import SHARES
from jaxhil.sixdof.forces import deepest
from jaxhil.sixdof.loop import Loop, Rig, RunState, Tick, begin, build_rig, tick
from jaxhil.sixdof.peaks import Peak, higher, no_peak
from jaxhil.sixdof.relative import States, Wrench, advance, relative
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensor import Sensor
from jaxhil.sixdof.space import choose
from jaxhil.sixdof.vectors import dot, norm

STRETCH = 16  # ticks between looks at what began and ended
SLOW = 1e-3  # m/s: of what enters more slowly, growth is reckoned from here on
MISS, REBOUNDED, CAPTURED, JAMMED, TIMEOUT, DIVERGED, NON_FINITE, REACH = range(8)
STATUS_NAMES = ("miss", "rebounded", "captured", "jammed", "timeout", "diverged", "non-finite", "reach")


class Watch(NamedTuple):
    """The episode under way."""

    begun: Bool[Array, "*batch"]
    entry: States  # of the numerical model: free, and without an episode
    entry_tick: Int[Array, "*batch"]
    entry_energy: Float[Array, "*batch"]  # of the relative motion then [J]
    touching: tuple[Bool[Array, "candidates *batch"], ...]
    touches: Int[Array, "*batch"]  # candidates that began to touch
    touched: Int[Array, "*batch"]  # ticks at which something touched
    quiet: Int[Array, "*batch"]  # ticks since anything touched
    caught: Bool[Array, "*batch"]  # whether a latch holds
    force: Peak  # of the real contact [N]
    moment: Peak  # about T's origin [N m]
    # Largest sizes of the force [N] and of the moment [N m] on the numerical model.
    highest: tuple[Array, Array]
    faded: Int[Array, "*batch"]  # ticks since it died out
    end: States  # of the numerical model, at the tick since which nothing of it is left
    penetration: Float[Array, "*batch"]  # largest depth, over the size of its shapes
    beyond: Bool[Array, "*batch"]  # whether an axis was sent where it cannot be


class Episode(NamedTuple):
    """What became of episodes, (episodes, *batch)."""

    entry: States  # of the numerical model before
    end: States  # of the numerical model at the end
    entry_time: Float[Array, "episodes *batch"]  # [s]
    end_time: Float[Array, "episodes *batch"]  # [s]
    touches: Int[Array, "episodes *batch"]
    duration: Float[Array, "episodes *batch"]  # in which something touched [s]
    peak_force: Float[Array, "episodes *batch"]  # [N]
    peak_moment: Float[Array, "episodes *batch"]  # about T's origin [N m]
    penetration: Float[Array, "episodes *batch"]  # largest depth, over the size of its shapes
    status: Int[Array, "episodes *batch"]  # index of `STATUS_NAMES`


class Progress(NamedTuple):
    """Runs on their way."""

    run: RunState
    watch: Watch
    episodes: Episode
    index: Int[Array, "*batch"]  # of the episode under way or ahead
    active: Bool[Array, "*batch"]
    lasted: Int[Array, "*batch"]  # ticks that each has run


class Outcome(NamedTuple):
    """What became of runs."""

    episodes: Episode
    final: States  # of the numerical model, at the end of the run
    final_time: Float[Array, "*batch"]  # [s]


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> Outcome:
    """The episodes of every lane; `gains` as for `jaxhil.sixdof.loop.build_rig`."""
    rig = build_rig(loop, gains, scenario)
    last = jnp.round(scenario.duration / rig.period).astype(jnp.int32)

    def one(progress: Progress, _) -> tuple[Progress, Wrench | None]:
        after, command = _tick(loop, rig, last, progress)
        return after, command if loop.pushed else None

    def body(progress: Progress) -> Progress:
        after, commands = lax.scan(one, progress, None, STRETCH)
        if commands is not None:
            after = _enter_late(loop, rig, progress, after, commands)
        return _turn_over(loop, rig, last, after)

    start = _start(loop, rig, scenario.start)
    ended = lax.while_loop(lambda progress: jnp.any(progress.active), body, start)
    time = ended.lasted.astype(rig.period.dtype) * rig.period
    return Outcome(ended.episodes, ended.run.states, time)


def _start(loop: Loop, rig: Rig, states: States) -> Progress:
    run = begin(loop, rig, states)
    like, none = jnp.zeros_like(rig.period), jnp.zeros(rig.period.shape, jnp.int32)
    _, energy = _look(rig, states)
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
    zero, none = jnp.zeros_like(rig.period), jnp.zeros(rig.period.shape, jnp.int32)
    peak = no_peak(zero)
    touching = tuple(group.parameters.damping > jnp.inf for group in rig.groups)
    return Watch(
        begun=none > 0,
        entry=states,
        entry_tick=now,
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
    """One tick, and the wrench that moved the model; where the run is over the bodies stand still."""
    run, watch = progress.run, progress.watch
    after, seen = tick(loop, rig, run)
    goes = progress.active & (progress.lasted < last) & ~watch.beyond
    beyond = ~rig.kinematics.reaches(after.hardware.commands[0])
    end = choose(_since(rig, watch) < 0, after.states, watch.end)
    watched = choose(goes, _watch(rig, watch, seen)._replace(end=end, beyond=beyond), watch)
    moved = progress._replace(
        run=after._replace(states=choose(goes, after.states, run.states)),
        watch=watched,
        lasted=progress.lasted + goes.astype(jnp.int32),
    )
    return moved, seen.command


def _enter_late(loop: Loop, rig: Rig, before: Progress, after: Progress, commands: Wrench) -> Progress:
    """Where the model came into contact in a stretch, the entry is the last tick at which it was free.

    Readings that are not 0 without a contact move it up to there.
    """
    free, _ = _look(rig, after.run.states)
    comes = after.active & ~free & (after.watch.entry_tick == before.lasted)

    def follow(watch: Watch) -> Watch:
        def step(carry: tuple[States, Array, Array], command: Wrench):
            states, ticks, still = carry
            moved = advance(rig.bodies, states, command, rig.period, SHARES[loop.integrator])
            still = still & (deepest(rig.groups, relative(rig.bodies, moved)[0]) < 0)
            return (choose(still, moved, states), ticks + still.astype(ticks.dtype), still), None

        start = watch.entry, watch.entry_tick, comes
        (entry, ticks, _), _ = lax.scan(step, start, commands)
        return watch._replace(entry=entry, entry_tick=ticks)

    return after._replace(watch=lax.cond(jnp.any(comes), follow, lambda watch: watch, after.watch))


def _watch(rig: Rig, watch: Watch, seen: Tick) -> Watch:
    touching = tuple(forces.touch.depth > 0 for forces in seen.forces)
    caught = watch.caught
    for held in seen.held:
        caught = caught | jnp.any(held.caught, axis=0)
    now, touches = caught, watch.touches
    for one, before in zip(touching, watch.touching, strict=True):
        now = now | jnp.any(one, axis=0)
        touches = touches + jnp.sum(one & ~before, axis=0, dtype=touches.dtype)
    penetration = watch.penetration
    for group, forces in zip(rig.groups, seen.forces, strict=True):
        share = jnp.max(forces.touch.depth / group.candidates.size, axis=0)
        penetration = jnp.maximum(penetration, share)
    command = norm(seen.command.force), norm(seen.command.moment)
    highest = tuple(jnp.maximum(a, b) for a, b in zip(watch.highest, command, strict=True))
    # No threshold depends on the noise: see `jaxhil.simulation.watch`.
    faded = (command[0] <= FADED * highest[0]) & (command[1] <= FADED * highest[1])
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


def _look(rig: Rig, states: States) -> tuple[Array, Array]:
    """Whether the numerical model is free, and the energy of its relative motion [J], coupling left out."""
    pose, (linear, angular) = relative(rig.bodies, states)
    energy = dot(linear, linear) / _share(rig) + dot(angular, rig.bodies.chaser.inertia @ angular)
    return deepest(rig.groups, pose) < 0, energy


def _share(rig: Rig) -> Array:
    """One over the reduced mass [1/kg]."""
    return 1 / rig.bodies.target.mass + 1 / rig.bodies.chaser.mass


def quiet_time(sensor: Sensor, period: Array) -> Array:
    """Time [s] without a touch after which a contact is over: tau_f + 20 sensor time constants + 2 T."""
    return sensor.delay + 20 * sensor.time_constant + 2 * period


def _still(rig: Rig) -> Array:
    """Ticks without a touch after which a contact is over."""
    return jnp.floor(quiet_time(rig.sensor, rig.period) / rig.period + 1e-9).astype(jnp.int32) + 1


def _since(rig: Rig, watch: Watch) -> Array:
    """For how many ticks nothing has been left of a contact on the hardware; negative as long as there is."""
    still = _still(rig)
    patience = still + jnp.ceil(LONGEST_FADING / rig.period).astype(jnp.int32)
    return jnp.maximum(jnp.minimum(watch.quiet - still, watch.faded - 1), watch.quiet - patience)


def _turn_over(loop: Loop, rig: Rig, last: Array, progress: Progress) -> Progress:
    """Enter the episodes that are over; where the model is free and none is under way, one may begin."""
    watch, run, period = progress.watch, progress.run, rig.period
    free, energy = _look(rig, run.states)
    age = progress.lasted
    since = _since(rig, watch)
    over = watch.begun & free & (since >= 0) & progress.active
    status = _failure(rig, watch, energy)
    out = (age >= last) | (status != MISS)
    held = jnp.where(watch.caught, CAPTURED, jnp.where(watch.quiet < _still(rig), JAMMED, TIMEOUT))
    status = jnp.where(status != MISS, status, jnp.where(over, REBOUNDED, jnp.where(watch.begun, held, MISS)))
    ends = progress.active & (over | out)
    entry_time, end_time = (
        ticks.astype(period.dtype) * period for ticks in (watch.entry_tick, age - jnp.where(over, since, 0))
    )
    found = Episode(
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
    here = (slot == progress.index[None]) & (ends & (status != MISS))[None]
    episodes = jax.tree.map(lambda one, all_: jnp.where(here, one[None], all_), found, progress.episodes)
    index = progress.index + (ends & (status != MISS)).astype(jnp.int32)
    active = progress.active & ~out
    if not loop.whole:
        active = active & (index < loop.episodes)
    fresh = _fresh(rig, run.states, age, energy)._replace(touching=watch.touching)
    watch = choose(over, fresh, watch)
    ahead = watch._replace(entry=run.states, entry_tick=age, entry_energy=energy)
    watch = choose(free & ~watch.begun & active, ahead, watch)
    return progress._replace(watch=watch, episodes=episodes, index=index, active=active)


def _failure(rig: Rig, watch: Watch, energy: Array) -> Array:
    """DIVERGED, NON_FINITE, or REACH where an axis is to be where it cannot be; else MISS."""
    entry = jnp.maximum(watch.entry_energy, SLOW**2 / _share(rig))
    wild = jnp.where(energy > RUNAWAY**2 * entry, DIVERGED, MISS)
    wild = jnp.where(watch.beyond, REACH, wild)
    return jnp.where(jnp.isfinite(energy), wild, NON_FINITE).astype(jnp.int32)
