"""Speed of the simulation compared with the C++ baseline, and cost of its gradient.

All programs run alternately in one process, and the best of many repetitions counts. Run with `pytest -m
benchmark -s tests/benchmarks`.
"""

import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from baseline import compile_baseline

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation import evaluation
from jaxhil.simulation.jax_environment import DERIVATIVE_OPTIONS, supported_options
from jaxhil.simulation.loop import build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import ONE_AXIS
from jaxhil.simulation.rollout import run_contacts, run_until_done
from jaxhil.simulation.scenario import build_scenarios
from tuning.batches import join_batches
from tuning.gains.multistart_solver import LANES_PER_TILE

pytestmark = pytest.mark.benchmark
LANES = 16_384  # lanes of one chunk of a sweep
REPEATS = 12
WIDTHS = 8, 16  # lanes per block of the C++ loop; the faster choice depends on compensator and processor
INFORMATION = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
PROCESSOR = next((row.split(":")[1].strip() for row in INFORMATION.splitlines() if "model name" in row), "?")
INTEL = "GenuineIntel" in INFORMATION
# Required speed relative to the C++ loop at its best width, at 16 lanes per block, and for a fixed horizon.
LANE_STEPS = {"none": 0.5, "response_error": 0.5}
LANE_STEPS_16 = {"none": 0.33, "response_error": 0.43} if INTEL else {"none": 0.65, "response_error": 0.65}
JACOBIAN = 0.85  # largest time, divided by the time without compiler options
SCENARIOS = {"none": 0.4, "response_error": 0.45} if INTEL else {"none": 1.0, "response_error": 0.95}


# The built-in mechanisms that the baseline can run: 1, 1, 1 and 3 contacts.
ONE_SIDED = ("rig-300kg", "rod-100n-mm", "claw-350kg", "varying")


def case(compensator, lanes, names=("varying",)):
    """Return a batch of random scenarios, and the literature's gains for the last mechanism."""
    batches = []
    for name in names:
        mechanism = load(name).mechanism
        batches.append(build_scenarios(mechanism, draw(mechanism, lanes // len(names), 1)))
    scenarios = join_batches(batches)
    mechanism = load(names[-1]).mechanism
    gains = {g.name: float(g.nominal(mechanism)) for g in COMPENSATORS[compensator].gains}
    return build_loop(mechanism, compensator, scenarios), gains, scenarios


@partial(jax.jit, static_argnums=0)
def ticks_run(loop, common, per_lane, scenarios):
    """Return the ticks of the slowest lane in each tile of `shard`, (devices, tiles)."""

    def of_tile(arguments):
        gains, scenario = arguments
        return run_until_done(loop, {**common, **gains}, build_rig_constants(loop, scenario)).tick

    return jax.lax.map(lambda device: jax.lax.map(of_tile, device), (per_lane, scenarios)) - loop.first_tick


def best(*calls, repeats=REPEATS):
    """Return the shortest time of each function; the functions are called alternately."""
    times = [[] for _ in calls]
    for _ in range(repeats):
        for call, seen in zip(calls, times, strict=True):
            seen.append(call())
    return [min(seen) for seen in times]


def timed(function):
    def call():
        begin = time.perf_counter()
        jax.block_until_ready(function())
        return time.perf_counter() - begin

    return call


@pytest.mark.parametrize("names", [("varying",), ONE_SIDED], ids=["varying", "several"])
@pytest.mark.parametrize("compensator", ["none", "response_error"])
def test_rollout_reaches_required_share_of_cpp_baseline_speed(compensator, names, capsys):
    flying, skipping = ([compile_baseline(width, skips) for width in WIDTHS] for skips in (False, True))
    if None in flying:
        pytest.skip("no C++ compiler")
    loop, gains, scenarios = case(compensator, LANES, names)
    on_device = jax.tree.map(jnp.asarray, scenarios)
    rig = jax.jit(build_rig_constants, static_argnums=0)(loop, on_device)

    def horizon(baseline):
        """Return the last tick at which a lane ends."""
        return int(baseline.run(loop, rig, gains, on_device, 4000)["ticks"].max())

    # The inputs of the C++ code are also prepared before the measurement.
    batch = ONE_AXIS.place_batch(scenarios)
    arguments = *evaluation.place_gains(batch, gains), batch.scenarios
    tiles = ticks_run(loop, *arguments)
    lane_steps = int(np.sum(tiles)) * arguments[-1].velocity.shape[-1]
    flown, skipped = horizon(flying[0]), horizon(skipping[0])
    runs = [(b, flown) for b in flying] + [(b, skipped) for b in skipping]
    jax_time, whole, *cpp_times = best(
        timed(lambda: ONE_AXIS.run_tiles(loop, *arguments)),
        timed(lambda: ONE_AXIS.evaluate(loop, gains, scenarios)),
        *(lambda b=b, n=n: b.run(loop, rig, gains, on_device, n)["seconds"] for b, n in runs),
    )
    widths = len(WIDTHS)
    flying_time, skipping_time = min(cpp_times[:widths]), min(cpp_times[widths:])
    cpp_steps, ours = LANES * flown / flying_time, lane_steps / jax_time
    at_16 = ours * cpp_times[1] / (LANES * flown)
    with capsys.disabled():
        label = f"{compensator}, {' + '.join(names)}"
        print(
            f"\n{PROCESSOR}, best of {', '.join(map(str, WIDTHS))} lanes a block of C++"
            f"\n{label}: lane-steps/s of rollout over C++: {ours / cpp_steps:.2f}"
            f" ({ours:.3g} over {cpp_steps:.3g})"
            f"\n{label}: over C++ at 16 lanes a block: {at_16:.2f}"
            f"\n{label}: scenarios/s of rollout over C++ to the fixed horizon of {flown} ticks:"
            f" {flying_time / jax_time:.2f} (with sorting and padding {flying_time / whole:.2f};"
            f" a lane needs {lane_steps / LANES / flown:.2f} of the horizon)"
            f"\n{label}: over C++ that skips approaches too, to {skipped} ticks:"
            f" {skipping_time / jax_time:.2f}"
        )
    assert ours >= LANE_STEPS[compensator] * cpp_steps and at_16 >= LANE_STEPS_16[compensator]
    assert flying_time >= SCENARIOS[compensator] * jax_time


def jacobian(lanes, options):
    """Time the Jacobian of `lanes` restitutions with respect to all gains of response_error."""
    loop, gains, scenarios = case("response_error", lanes)
    rig = jax.jit(build_rig_constants, static_argnums=0)(loop, jax.tree.map(jnp.asarray, scenarios))

    def restitution(values):
        return run_contacts(loop, dict(zip(gains, values, strict=True)), rig).restitution

    program = jax.jit(jax.jacfwd(restitution), compiler_options=options)
    values = jnp.array(list(gains.values()))
    assert len(values) == 12
    jax.block_until_ready(program(values))
    return timed(partial(program, values))


def test_jacobian_is_faster_with_compiler_options_and_default_tile_size(capsys):
    tuned = best(
        jacobian(LANES_PER_TILE, supported_options(DERIVATIVE_OPTIONS)),
        jacobian(2 * LANES_PER_TILE, supported_options(DERIVATIVE_OPTIONS)),
        jacobian(2 * LANES_PER_TILE, {}),
    )
    ours, wide, plain = (
        time / lanes
        for time, lanes in zip(tuned, (LANES_PER_TILE, 2 * LANES_PER_TILE, 2 * LANES_PER_TILE), strict=True)
    )
    with capsys.disabled():
        print(
            f"\n{PROCESSOR}, Jacobian over 12 gains, time a lane in tiles of {LANES_PER_TILE} over "
            f"{2 * LANES_PER_TILE} at once"
            f" without options: {ours / plain:.2f} (with them {wide / plain:.2f})"
        )
    assert ours <= JACOBIAN * plain


@pytest.mark.parametrize("compensator", ["phase_lead", "response_error"])
def test_gradient_takes_little_longer_than_rollouts_alone(compensator, capsys):
    loop, gains, scenarios = case(compensator, 256)
    rig = jax.jit(build_rig_constants, static_argnums=0)(loop, jax.tree.map(jnp.asarray, scenarios))
    names = tuple(gains)

    def restitution(values, rig):
        return run_contacts(loop, dict(zip(names, values, strict=True)), rig).restitution

    values = jnp.array([gains[name] for name in names])
    primal, full = jax.jit(restitution), jax.jit(jax.jacfwd(restitution))
    jax.block_until_ready((primal(values, rig), full(values, rig)))
    one, jacobian = best(timed(partial(primal, values, rig)), timed(partial(full, values, rig)))
    with capsys.disabled():
        print(
            f"\n{compensator}: gradient over {len(names)} gains costs {jacobian / one:.1f} rollouts,"
            f" {jacobian / one / (1 + len(names)):.2f} (1 + P)"
        )
    assert jacobian <= 1.5 * (1 + len(names)) * one
