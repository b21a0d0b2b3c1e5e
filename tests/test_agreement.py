"""Agreement of the independent runtime and JAX compensators on the same readings.

On the recorded ticks of every built-in mechanism and on a million random ticks, the force commands agree to
1e-11 of the command's range, or to 1e-9 for compensators with a long recursion. Two groups are counted and
compared separately:

- ticks whose decisions lie within 1e-9 of a threshold (see `tuning.verification.runtime_replay`);
- lanes that amplify rounding errors. In these lanes, one unit in the last place of every operation changes
  the runtime's own command by as much as the difference (Monte Carlo arithmetic: Parker, Pierce and Eggert
  2000). This happens if successive regressors of the identification are nearly parallel, or if the prior
  variance is 1e15 times the noise variance.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from jax import lax
from jittered import Jittered

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.simulation_base import KnownConstants, Signals
from jaxhil.mechanism.file import builtin_names, load
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.limits import LIMITS
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.recording import LaneRecord, nominal_and_draws, record_lanes
from tuning.gain_file import build_document
from tuning.verification.runtime_replay import REPLAY_LIMIT, LaneReplay, replay_lane

pytestmark = pytest.mark.users_options

RING = 256  # more than any identification delay at the shortest period [samples]
RUNS = 6  # recorded runs of a mechanism
RECORD = 3072  # longer than any record, so that all mechanisms share programs [ticks]
# Compare the compensators without the controller, also beyond the controller's limits.
UNLIMITED = {
    name: limit.default if limit.default in (0.0, 0.5, 1.0) else math.copysign(math.inf, limit.default)
    for name, limit in LIMITS.items()
}
MECHANISMS = [
    load(name, [f"rig.control_period={period}"]).mechanism
    for name, period in (("varying", 0.00025), ("rattling", 0.001), ("claw-350kg", 0.004))
]


class Readings(NamedTuple):
    """Batch of lanes: signals (ticks, lanes), gains and constants (lanes,), inputs of both controllers."""

    signals: Signals
    gains: dict[str, np.ndarray]
    constants: KnownConstants


class Count(NamedTuple):
    """Numbers of compared ticks; the largest differences are fractions of the command's range."""

    ticks: int
    compared: int
    near: int
    parted: int
    magnified: int
    difference: float
    magnified_difference: float


@functools.partial(jax.jit, static_argnums=0)
def simulate(name, signals, gains, constants):
    """Return the JAX compensator's force commands and identified parameters, (ticks, lanes)."""
    law = COMPENSATORS[name]
    prepared = law.prepare(gains, constants)

    def tick(state, now):
        index, signals = now
        begins = (signals.age == 0) & (index > RING)
        state = law.restart(gains, state, begins, begins)
        command, state = law.step(prepared, state, signals, index)
        return state, (command, law.identified(state))

    ticks = jnp.arange(signals.age.shape[0], dtype=jnp.int32) + RING
    return lax.scan(tick, law.init(gains, constants, RING), (ticks, signals))[1]


def lane_replays(name: str, readings: Readings, ticks: list[int] | None = None) -> list[LaneReplay]:
    """Replay every lane's readings, or the first `ticks` of each, through both controllers."""
    command, identified = jax.device_get(simulate(name, *readings))
    lanes = []
    for lane in range(command.shape[1]):
        end = ticks[lane] if ticks else len(command)
        signals = Signals(*(leaf[:end, lane] for leaf in readings.signals))
        seen = None if identified is None else (identified[0][:end, lane], identified[1][:end, lane])
        gains = {gain: float(values[lane]) for gain, values in readings.gains.items()}
        constants = readings.constants
        period, clearance = float(constants.control_period[lane]), float(constants.clearance[lane])
        gain_file = GainFile(name, gains, period, clearance, UNLIMITED)
        lanes.append(replay_lane(LaneRecord(signals, command[:end, lane], seen, False), gain_file))
    return lanes


def rounding_spread(name: str, readings: Readings, lane: int, ticks: int) -> float:
    """Return the spread [N] of the runtime's commands in the first `ticks` under random rounding."""
    gains = {gain: Jittered(values[lane]) for gain, values in readings.gains.items()}
    period, clearance = readings.constants.control_period[lane], readings.constants.clearance[lane]
    signals = [leaf[:ticks, lane].tolist() for leaf in readings.signals]
    commands = []
    for seed in range(4):
        Jittered.generator.seed(seed)
        controller = ON_THE_RIG[name](gains, Jittered(period), Jittered(clearance))
        for tick, (*numbers, age) in enumerate(zip(*signals, strict=True)):
            if age == 0 and tick > 0:
                controller.next_contact()
            commands.append(controller.step(*map(Jittered, numbers)))
    return float(np.max(np.ptp(np.reshape(commands, (4, ticks)), axis=0)))


def compare(name: str, readings: Readings, ticks: list[int] | None = None) -> Count:
    """Compare both controllers; fail if a difference exceeds the limit and the effect of rounding."""
    replays = lane_replays(name, readings, ticks)
    limit = 1e-9 if name in LONG_LAWS else REPLAY_LIMIT
    assert {lane.status for lane in replays} == {"ok"}
    differences, magnified = [0.0], [0.0]
    for number, lane in enumerate(replays):
        difference = max(lane.difference, lane.near_difference)
        if difference <= limit:
            differences.append(difference)
            continue
        spread = rounding_spread(name, readings, number, lane.worst_tick + 1) / lane.command_range
        assert difference <= 10 * spread, f"lane {number}, tick {lane.worst_tick}: rounding explains {spread}"
        magnified.append(difference)
    return Count(
        ticks=sum(lane.ticks for lane in replays),
        compared=sum(lane.compared for lane in replays),
        near=sum(lane.near for lane in replays),
        parted=sum(lane.parted is not None for lane in replays),
        magnified=len(magnified) - 1,
        difference=max(differences),
        magnified_difference=max(magnified),
    )


def random_gains(name: str, rng: np.random.Generator, mechanism) -> dict[str, float]:
    """Draw each gain within its bounds; in half of the cases at a bound or by the literature's rule."""
    gains = {}
    for gain in COMPENSATORS[name].gains:
        lower, upper = gain.lower(mechanism), gain.upper(mechanism)
        share = rng.random()
        inside = lower * (upper / lower) ** share if gain.logarithmic else lower + (upper - lower) * share
        choice = rng.integers(6)
        gains[gain.name] = (lower, upper, gain.nominal(mechanism), inside, inside, inside)[choice]
    return gains


def random_readings(name: str, lanes: int, ticks: int, seed: int) -> Readings:
    """Draw white noise and contacts of all sizes: plain, noisy, coarsely quantised, or with pauses."""
    rng = np.random.default_rng(seed)
    mechanisms = [MECHANISMS[lane % len(MECHANISMS)] for lane in range(lanes)]
    gains = [random_gains(name, rng, mechanism) for mechanism in mechanisms]
    period = np.array([mechanism.rig.control_period for mechanism in mechanisms])
    clearance = np.where(rng.random(lanes) < 0.5, np.inf, 0.002)
    size = 10 ** rng.uniform(-5, -2, lanes)
    stiffness = 10 ** rng.uniform(4, 6, lanes)
    rate = 2 * np.pi * rng.uniform(1, 10, lanes)
    angle = rate * period * np.arange(ticks)[:, None] + rng.uniform(0, 2 * np.pi, lanes)

    def sine(delay):
        return size * np.sin(angle - rate * delay)

    def noise(scale):
        return scale * rng.standard_normal((ticks, lanes))

    depth = sine(0.018)
    depth = np.where(depth > 0, depth, np.where(depth < -clearance, depth + clearance, 0))
    force, position, measured = stiffness * depth, sine(0.0), sine(0.01)
    velocity = size * rate * np.cos(angle)
    kind = np.arange(lanes) // len(MECHANISMS) % 5
    white, noisy, quantised, still = (kind == n for n in (1, 2, 3, 4))
    force = np.where(white, noise(size * stiffness), force + np.where(noisy, noise(3.0), 0))
    position = np.where(white, noise(size), position)
    velocity = np.where(white, noise(size * rate), velocity)
    measured = np.where(white, noise(size), measured + np.where(noisy, noise(1e-6), 0))
    step, quantum = size / 8, size * stiffness / 16
    measured = np.where(quantised, step * np.round(measured / step), measured)
    force = np.where(quantised, quantum * np.round(force / quantum), force)
    halted = still & (np.arange(ticks)[:, None] > ticks - 200)
    force, velocity = np.where(halted, 100.0, force), np.where(halted, 0.0, velocity)
    position, measured = np.where(halted, size, position), np.where(halted, 0.9 * size, measured)
    index = np.arange(ticks)[:, None]
    begins = (rng.random((ticks, lanes)) < 1 / 400) | (index == 0)
    age = index - np.maximum.accumulate(np.where(begins, index, 0), axis=0)
    return Readings(
        Signals(force, position, velocity, measured, age.astype(np.int32)),
        {gain: np.array([lane[gain] for lane in gains]) for gain in gains[0]},
        KnownConstants(period, clearance),
    )


LONG_LAWS = ("impulse_ledger",)
# Random readings make the ledger's covariance ill-conditioned, so that more lanes amplify rounding.
MAGNIFIED = {"impulse_ledger": 0.1}  # allowed share of lanes; 0.02 for other compensators


@pytest.mark.parametrize(
    "name, lanes, ticks",
    [
        *((name, 12, 500) if name in LONG_LAWS else (name, 60, 2000) for name in COMPENSATORS),
        *(pytest.param(name, 60, 2000, marks=pytest.mark.slow) for name in LONG_LAWS),
        pytest.param("response_error", 510, 2000, marks=pytest.mark.slow),
    ],
)
def test_runtime_and_jax_commands_agree_on_random_ticks(name, lanes, ticks):
    count = compare(name, random_readings(name, lanes, ticks, seed=1))
    print(name, count)
    assert count.ticks == ticks * lanes
    assert count.compared >= 0.98 * count.ticks
    assert count.magnified <= MAGNIFIED.get(name, 0.02) * lanes


@pytest.mark.parametrize(
    "mechanism_name",
    [pytest.param(name, marks=() if name == "varying" else pytest.mark.slow) for name in builtin_names()],
)
def test_runtime_and_jax_commands_agree_on_recorded_ticks(mechanism_name):
    mechanism, sha256, _ = load(mechanism_name)
    law = COMPENSATORS["response_error"]
    gains = {gain.name: gain.nominal(mechanism) for gain in law.gains}
    loaded = check_document(build_document(law.name, gains, mechanism, sha256, {}, {}, 0, {}))
    batch = nominal_and_draws(mechanism, RUNS, seed=2)
    _, lanes = record_lanes(loaded, batch)
    for index, lane in enumerate(lanes):
        gain_file = GainFile(law.name, gains, mechanism.rig.control_period, mechanism.contact.clearance)
        seen = replay_lane(lane, gain_file)
        assert seen.status == "ok" and seen.ticks > 100 and seen.parted is None, (index, seen)
        assert max(seen.difference, seen.near_difference) <= REPLAY_LIMIT, (index, seen)
    # Pad the readings to a common length and reuse them for every compensator with random gains.
    ticks = [len(lane.command) for lane in lanes]
    assert max(ticks) <= RECORD
    signals = Signals(
        *(
            np.stack([np.pad(leaf, (0, RECORD - len(leaf)), mode="edge") for leaf in leaves], axis=1)
            for leaves in zip(*(lane.signals for lane in lanes), strict=True)
        )
    )
    rng = np.random.default_rng(3)
    for name in COMPENSATORS:
        drawn = [random_gains(name, rng, mechanism) for _ in lanes]
        columns = {gain: np.array([lane[gain] for lane in drawn]) for gain in drawn[0]}
        constants = KnownConstants(batch.control_period, batch.clearance)
        count = compare(name, Readings(signals, columns, constants), ticks)
        print(mechanism_name, name, count)
        assert count.ticks == count.compared == sum(ticks)
        # One of the draws has a very large prior variance.
        assert count.magnified <= (name in LONG_LAWS)


def test_runtime_and_jax_commands_agree_in_a_long_contact():
    """Penetrate, hold for 1e4 ticks, and leave: no state may grow without bound."""
    forgetting = np.array([0.8, 0.9, 0.98])
    gains = {
        gain.name: np.full(3, gain.nominal(MECHANISMS[0])) for gain in COMPENSATORS["response_error"].gains
    }
    gains["forgetting"] = forgetting
    depth = 2e-4 * np.sin(
        np.pi / 2 * np.r_[np.arange(-50, 200) / 200, np.ones(10_000), np.arange(200, -50, -1) / 200]
    )
    position = np.repeat(depth[:, None], 3, axis=1)
    period = np.full(3, 1e-3)
    velocity = np.gradient(position, 1e-3, axis=0)
    force = np.where(position > 0, 1.2e5 * position + 200.0 * velocity, 0)
    age = np.repeat(np.arange(len(depth), dtype=np.int32)[:, None], 3, axis=1)
    signals = Signals(force, position, velocity, position - 1e-3 * velocity, age)
    count = compare("response_error", Readings(signals, gains, KnownConstants(period, np.full(3, np.inf))))
    assert count.ticks == 3 * len(depth) and count.compared >= 0.99 * count.ticks and count.magnified == 0


@st.composite
def small_readings(draw):
    """Draw contacts on a lattice, where many values lie exactly on a threshold, with gains within bounds."""
    mechanism = draw(st.sampled_from(MECHANISMS))
    shares = hnp.arrays(np.int64, (4, 64), elements=st.integers(-8, 8))
    force, position, velocity, measured = draw(shares) / 8.0
    age = np.arange(64) - 32 * (np.arange(64) >= 32)
    gains = {}
    for gain in COMPENSATORS["response_error"].gains:
        lower, upper = gain.lower(mechanism), gain.upper(mechanism)
        share = draw(st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0))
        gains[gain.name] = np.array([min(lower + (upper - lower) * share, upper)])
    clearance = draw(st.sampled_from([np.inf, 2.0**-9]))
    columns = (force * 64.0, position * 2.0**-8, velocity * 2.0**-6, measured * 2.0**-8)
    return Readings(
        Signals(*(leaf[:, None] for leaf in columns), age[:, None].astype(np.int32)),
        gains,
        KnownConstants(np.array([mechanism.rig.control_period]), np.array([clearance])),
    )


@settings(max_examples=60, deadline=None)
@given(small_readings())
def test_runtime_and_jax_commands_agree_for_readings_exactly_at_thresholds(readings):
    count = compare("response_error", readings)
    assert count.ticks == 64
