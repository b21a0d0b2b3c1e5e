"""Simulated rig with six axes for the rehearsal: motion simulator, contact and sensors as in `simulate`.

A run has the same episodes and the same end as a run of `simulate`. The first run is the nominal run. The
phases of later runs are random, unless the mechanism file specifies the states at the start. All programs are
compiled before the session, because compiling takes seconds.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from random import Random
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, jax_context, supported_options, use_float64
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.ideal_contact import IdealContactRecord
from jaxhil.sixdof.loop import begin, build_rig_constants, complete_tick
from jaxhil.sixdof.loop_state import Loop, RigConstants, RunState, Sensed
from jaxhil.sixdof.metrics import compare_with_ideal
from jaxhil.sixdof.numerical_model import model_motion
from jaxhil.sixdof.relative import States, Wrench
from jaxhil.sixdof.rollout import SEGMENT_TICKS, EpisodeProgress, follow_tick, start_rollout, turn_over
from jaxhil.sixdof.run import episodes_of
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensing import sense
from jaxhil.sixdof.six_axes import SIX_AXES
from jaxhil.sixdof.vectors import vector
from tuning.rig.udp_protocol import AnswerPacket, Numbers

STARTS = 8  # number of random phases; later runs repeat them in turn
PAUSE_KEY = 0x80000000  # offset of the noise keys of readings between two runs


class RehearsedRun(NamedTuple):
    """Run on the simulated rig, with the final state from which its episodes (contacts) are evaluated."""

    number: int  # index of the run
    status: str  # "ok" if the run has ended by itself, else "tripped" or "stalled"
    state: Any  # state of the run at its end, see `SixAxisRig`
    # sequence numbers of the first and last packet of the run, set by `RigTask`
    packets: tuple[int, int] = (0, 0)
    # largest age of a pose command during the run [periods], set by `RigTask`
    oldest_command: int = 0

    def as_tripped(self) -> "RehearsedRun":
        """Return this run with the status "tripped"."""
        return self._replace(status="tripped")


class RunProgress(NamedTuple):
    """State of a six-axis run between two ticks."""

    progress: EpisodeProgress  # hardware, numerical model and episodes
    sensed: Sensed  # real contact and readings at the next tick


class SixAxisRig:
    """Simulated rig with six axes.

    Args:
        mechanism: mechanism and rig to simulate.
        seed: seed of the sensor noise and of the random phases (instants of contact in a control period).
    """

    axes = 6
    error_name = "twist_error"  # error that decides the verdict
    good_statuses = ("rebounded", "captured")

    def __init__(self, mechanism: SixAxisMechanism, seed: int = 0) -> None:
        self._seed, self._run, self._pauses = seed & 0xFFFFFFFF, -1, 0
        with jax_context():
            scenario = _build_starts(mechanism, seed)
            reference = SIX_AXES.with_ideal_contacts([scenario])[0].ideal_contact
            lanes = range(len(np.asarray(scenario.duration)))
            self._references = [_lane(reference, lane) for lane in lanes]
            self._starts = [_lane(scenario.start, lane) for lane in lanes]
            ticks = jnp.round(scenario.duration / scenario.control_period).astype(jnp.int32)
            self._last = [_lane(ticks, lane) for lane in lanes]
            nominal = _lane(scenario, 0)
            # The commands come from the controller's process, and the sensors always measure the pose.
            loop = dataclasses.replace(make_loop(mechanism, "none", nominal), measures_pose=True)
            self._has_several_episodes = loop.episodes > 1
            self._programs = _Programs(loop, nominal, self._references[0])
            self._before = [self._programs.enter(start) for start in self._starts]
            self._compile()

    def prepare(self, _: RehearsedRun | None) -> Numbers:
        """Prepare the next run, and return the states of both bodies at its start."""
        self._run += 1
        # Lane 0 has the nominal phase.
        lane = (self._run - 1) % max(len(self._starts) - 1, 1) + 1 if self._run else 0
        self._lane = min(lane, len(self._starts) - 1)
        self._state = None
        self._start = [float(leaf[0]) for leaf in jax.tree.leaves(self._starts[self._lane])]
        return tuple(self._start)

    def begin(self, command: Numbers) -> None:
        """Begin the prepared run in uniform motion, with this pose command of tick 0 [m, rad]."""
        lane, self._ticks, self._key = self._lane, 0, self._noise_key(self._run)
        with use_float64():
            self._state, readings = self._programs.begin(
                self._starts[lane], self._references[lane], self._key, np.array(command)[:, None]
            )
            self._readings = np.asarray(readings).tolist()

    def read(self) -> tuple[Numbers, Numbers]:
        """Return the measured wrench [N, N m] and pose [m, rad] just before this tick's command acts.

        Before the run begins, all readings belong to the state before tick 0, and only their noise differs.
        """
        if self._state is None:
            self._pauses += 1
            with use_float64():
                key = self._noise_key(PAUSE_KEY + self._pauses)
                self._readings = np.asarray(self._programs.read(self._before[self._lane], key)).tolist()
        return tuple(self._readings[:6]), tuple(self._readings[6:])

    def advance(self, answer: AnswerPacket | None, command: Numbers) -> RehearsedRun | None:
        """Advance by one control period; return the run if it ends at this tick.

        Args:
            answer: newest answer of the controller in this run, or None before the first one.
            command: pose command for the end of the period [m, rad].
        """
        wrench, bodies = (0.0,) * self.axes, self._start
        if answer is not None:
            wrench, bodies = answer.force_command, answer.bodies
        column, last, is_active = (
            np.array((*wrench, *command, *bodies))[:, None],
            self._last[self._lane],
            True,
        )
        with use_float64():
            self._state, readings = self._programs.tick(self._state, last, self._key, column)
            self._readings = np.asarray(readings).tolist()
            self._ticks += 1
            # As in `rollout`, the end of a run is checked after segments of ticks.
            if self._has_several_episodes or self._ticks % SEGMENT_TICKS == 0:
                self._state, active = self._programs.turn_over(self._state, last)
                is_active = bool(np.asarray(active)[0])
        return None if is_active else RehearsedRun(self._run, "ok", self._state)

    def continues_after(self, _: RehearsedRun) -> bool:
        """Return False: `advance` returns whole runs, so the same run has no further contact."""
        return False

    def cut(self, status: str) -> RehearsedRun | None:
        """End the current run with the given status; return this run, or None if no run has begun."""
        return None if self._state is None else RehearsedRun(self._run, status, self._state)

    def evaluate(self, contacts: Sequence[RehearsedRun]) -> list[dict[str, Any]]:
        """Return the results of all episodes (contacts) of the runs, each with the final twist of its run."""
        with jax_context():
            return [document for contact in contacts for document in self._episode_documents(contact)]

    def _episode_documents(self, contact: RehearsedRun) -> Iterator[dict[str, Any]]:
        metrics, ticks, twist = jax.device_get(self._programs.evaluate(contact.state))
        for episode in episodes_of(metrics):
            document = episode._asdict()
            yield {
                "run": contact.number,
                **document,
                "status": document["status"] if contact.status == "ok" else contact.status,
                "ticks": int(ticks[0]),
                "final_twist": twist[:, 0].tolist(),
                "packets": contact.packets,
                "oldest_command": contact.oldest_command,
            }

    def _noise_key(self, index: int) -> np.ndarray:
        """Return the key of JAX's random numbers for the sensor noise of a run or a pause."""
        return np.array([[self._seed], [index & 0xFFFFFFFF]], np.uint32)

    def _compile(self) -> None:
        """Run a few ticks, so that JAX compiles all programs of a run before the session."""
        self.prepare(None)
        self.read()
        self.begin(self._programs.command)
        for _ in range(SEGMENT_TICKS):
            self.advance(None, self._programs.command)
        self._run, self._pauses = -1, 0


class _Programs:
    """Compiled JAX programs for a batch with one lane (one scenario).

    In a tick, the rig's constants and the state of the run (`RunProgress`) are one array each, because a call
    with hundreds of small arrays takes longer than the computation. The start of a run has separate programs,
    because one program for all its steps takes long to compile.
    """

    def __init__(self, loop: Loop, scenario: Scenario, reference: IdealContactRecord) -> None:
        jit = partial(jax.jit, compiler_options=supported_options(SINGLE_RUN_OPTIONS))
        rig = jax.jit(partial(build_rig_constants, loop, {}))(scenario)
        numbers, unpack_rig = jax.jit(pack)(rig), build_unpacker(rig)
        enter, start = jax.jit(partial(begin, loop)), jax.jit(partial(_start, loop))
        run = enter(rig, scenario.start)
        self.command = tuple(np.asarray(run.near)[:, 0].tolist())
        unpack = build_unpacker(start(rig, run, reference, scenario.key))
        packed, read = jax.jit(_packed), jax.jit(partial(_read, loop))

        def start_run(
            states: States, reference: IdealContactRecord, key: Any, command: Any
        ) -> tuple[Array, Array]:
            """Return state and readings at the start of a run with the pose command (6, 1) of tick 0."""
            return packed(start(rig, enter(rig, states, command), reference, key))

        def compiled(function: Callable[..., Any], *static: Any) -> Callable[..., Any]:
            return partial(jit(lambda rig, *rest: function(*static, unpack_rig(rig), *rest)), numbers)

        self.begin, self.enter, self.read = start_run, partial(enter, rig), partial(read, rig)
        self.tick = compiled(_tick, loop, unpack)
        self.turn_over = compiled(_turn_over, loop, unpack)
        self.evaluate = compiled(_evaluate, unpack)


Unpack = Callable[[Array], RunProgress]


def _build_starts(mechanism: SixAxisMechanism, seed: int) -> Scenario:
    """Build scenarios with the nominal phase, then with `STARTS` random phases.

    The phase is the fraction of a control period at which the contact begins. If the mechanism file specifies
    the states at the start, there is only one scenario.
    """
    if mechanism.approach is None:
        return build_scenarios(mechanism, seed=seed)
    random = Random(seed + 1)
    phases = [mechanism.approach.phase, *(random.random() for _ in range(STARTS))]
    return build_scenarios(mechanism, {"approach.phase": np.array(phases)}, seed)


def _lane(tree: Any, lane: int) -> Any:
    """Return one lane (scenario) of a tree of arrays (..., lanes), as a batch with one lane."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[..., lane : lane + 1], tree)


def _start(
    loop: Loop, rig: RigConstants, run: RunState, reference: IdealContactRecord, key: Array
) -> RunProgress:
    """Return progress and readings at the start of a run; `run` is the state of the loop before tick 0."""
    rig = rig._replace(key=key)
    return RunProgress(start_rollout(loop, rig, run, reference), sense(loop, rig, run))


def _read(loop: Loop, rig: RigConstants, run: RunState, key: Array) -> Array:
    """Return the readings of wrench and pose before tick 0, (12,)."""
    return _readings(sense(loop, rig._replace(key=key), run))


def _tick(
    loop: Loop, unpack: Unpack, rig: RigConstants, state: Array, last: Array, key: Array, answer: Array
) -> tuple[Array, Array]:
    """Complete a tick of a run with the controller's `answer`, (38, 1).

    The answer contains the wrench command, the pose command, and the states of both bodies. Return the state
    of the run after the tick, and the readings at the next tick.
    """
    rig, (progress, sensed) = rig._replace(key=key), unpack(state)
    command = Wrench(vector(answer[:3]), vector(answer[3:6]))
    states = jax.tree.unflatten(jax.tree.structure(progress.run.states), list(answer[12:]))
    position, _, twist = model_motion(rig.bodies, states)
    after, seen = complete_tick(
        loop, rig, progress.run, sensed, command, (states, position, twist), answer[6:12]
    )
    progress = follow_tick(rig, last, progress, after, seen)
    return _packed(RunProgress(progress, sense(loop, rig, after)))


def _turn_over(
    loop: Loop, unpack: Unpack, rig: RigConstants, state: Array, last: Array
) -> tuple[Array, Array]:
    """Store the results of an episode (contact) that has ended; begin the next episode, or end the run.

    Return the state of the run, and whether the run continues.
    """
    progress, sensed = unpack(state)
    progress = turn_over(loop, rig, last, progress)
    return _packed(RunProgress(progress, sensed))[0], progress.active


def _evaluate(unpack: Unpack, rig: RigConstants, state: Array) -> tuple[Any, ...]:
    """Return metrics of the episodes, number of ticks of the run, and final twist of the model (6, 1)."""
    progress = unpack(state).progress
    twist = model_motion(rig.bodies, progress.run.states)[2]
    return compare_with_ideal(rig.bodies, progress.episodes), progress.elapsed, twist


def pack(tree: Any) -> Array:
    """Return the numbers of all arrays in a tree as one array."""
    return jnp.concatenate([jnp.ravel(leaf).astype(float) for leaf in jax.tree.leaves(tree)])


def build_unpacker(tree: Any) -> Callable[[Array], Any]:
    """Return the inverse of `pack` for trees with the structure, shapes and types of this tree."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([leaf.size for leaf in leaves])

    def unpack(numbers: Array) -> Any:
        parts = [numbers[end - leaf.size : end] for end, leaf in zip(ends, leaves, strict=True)]
        return structure.unflatten(
            [part.reshape(leaf.shape).astype(leaf.dtype) for part, leaf in zip(parts, leaves, strict=True)]
        )

    return unpack


def _packed(run: RunProgress) -> tuple[Array, Array]:
    """Return the state of a run as one array, and the readings."""
    return pack(run), _readings(run.sensed)


def _readings(sensed: Sensed) -> Array:
    """Return the readings of wrench and pose as one array, (12,)."""
    signals = sensed.signals
    assert signals.pose_measured is not None
    return jnp.concatenate([*signals.wrench, signals.pose_measured[:, 0]])
