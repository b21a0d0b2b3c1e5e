"""Fault force_stuck: raised for a stuck force sensor, not for a sensor that truly reads no force."""

import math

import c99_cases
import numpy as np
import pytest
from c99_cases import RESULT, ROW, TARE, assert_same, controller_in_python, packed

from jaxhil.rig.faults import FORCE_STUCK
from jaxhil.rig.gain_file import GainFile
from jaxhil.rig.limits import complete_limits

PERIOD, MASS, STIFFNESS, SPEED = 1e-3, 350.0, 1.2e5, 0.02
TRAVEL = 6e-5
TARES = 7


def contact(damping_ratio: float, side: float, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position [m] and force [N] of a damped contact in closed form, from `SPEED` until release.

    M x'' = -k x - b x' until the force is zero; then the mechanism stays compressed, and the body leaves.
    """
    frequency = math.sqrt(STIFFNESS / MASS)
    damped, decay = frequency * math.sqrt(1 - damping_ratio**2), damping_ratio * frequency
    damping = 2 * damping_ratio * math.sqrt(STIFFNESS * MASS)
    time = np.arange(-0.02, math.pi / damped, PERIOD)
    pressed = np.exp(-decay * time) * np.sin(damped * time) * SPEED / damped
    rate = np.exp(-decay * time) * (np.cos(damped * time) - decay / damped * np.sin(damped * time)) * SPEED
    force = STIFFNESS * pressed + damping * rate
    released = int(np.argmax((time > 0) & (force <= 0)))
    assert released > 0 and pressed[released] > 3 * TRAVEL
    away = pressed[released] + rate[released] * (time - time[released])
    position = np.where(time < 0, SPEED * time, np.where(time < time[released], pressed, away))
    more = np.arange(1, 100)
    position = np.concatenate([position, position[-1] + rate[released] * PERIOD * more])
    force = np.concatenate([np.where((time < 0) | (time >= time[released]), 0.0, force), np.zeros(99)])
    return np.where(side > 0, position, -gap - position), side * force


def first_stuck(position, force, gap: float, bias: float = 0.0, noise: float = 0.0) -> int | None:
    """Return the tick on which Python and C report force_stuck; None if never."""
    limits = complete_limits({"force_stuck_travel": TRAVEL, "tare_ticks": float(TARES)})
    gain_file = GainFile("none", {}, PERIOD, gap if gap else math.inf, limits)
    rows = np.zeros((TARES + len(force), len(ROW)))
    rows[:TARES, 0], rows[:TARES, 1], rows[TARES:, 1] = TARE, bias, force + bias
    for name in ("desired", "measured", "x"):
        rows[:, ROW.index(name)] = np.concatenate([np.full(TARES, position[0]), position])
    rows[TARES:, ROW.index("measured")] += noise * np.random.default_rng(2).standard_normal(len(force))
    results = controller_in_python(gain_file, rows)
    if c99_cases.COMPILER is not None:
        made = c99_cases.loaded("none")
        assert made.begin(packed("none", gain_file))
        assert_same(made.run(rows, True), results, rows)
    causes = results[:, RESULT.index("cause")].astype(int)
    assert set(causes) <= {0, FORCE_STUCK}
    return int(np.argmax(causes != 0)) - TARES if np.any(causes) else None


SIDES = pytest.mark.parametrize(("side", "gap"), [(1.0, 0.0), (1.0, 0.02), (-1.0, 0.02)])


@SIDES
@pytest.mark.parametrize("damping_ratio", [0.25, 0.5, 0.8])
@pytest.mark.parametrize("dead_zone", [0.0, 2.0])
@pytest.mark.parametrize("bias", [0.0, 0.1, -3.7])
def test_force_stuck_fault_is_not_raised_for_noiseless_sensor_without_force(
    damping_ratio, dead_zone, bias, side, gap
):
    """After a damped contact the body moves several `force_stuck_travel` without force."""
    position, force = contact(damping_ratio, side, gap)
    read = np.sign(force) * np.maximum(np.abs(force) - dead_zone, 0.0)
    assert first_stuck(position, read, gap, bias) is None


@SIDES
def test_force_stuck_fault_is_not_raised_by_position_noise_without_force(side, gap):
    """Accumulated noise exceeds the travel limit, but the penetration does not increase."""
    position, force = contact(0.5, side, gap)
    assert first_stuck(position, force, gap, noise=TRAVEL / 10) is None


@SIDES
@pytest.mark.parametrize("bias", [0.0, -3.7])
def test_force_stuck_fault_is_raised_if_sensor_never_reads_force(bias, side, gap):
    position, force = contact(0.5, side, gap)
    depth = position if side > 0 else -gap - position
    stuck_tick = first_stuck(position, np.zeros_like(force), gap, bias)
    # The travel counts from the last reading before the contact.
    assert stuck_tick is not None and depth[stuck_tick - 1] <= TRAVEL < depth[stuck_tick] + SPEED * PERIOD


@SIDES
@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_force_stuck_fault_is_raised_for_constant_force_while_mechanism_moves(share, side, gap):
    position, force = contact(0.25, side, gap)
    begin = int(20 + share * (np.count_nonzero(force) - 10))
    read = force.copy()
    read[begin:] = read[begin]
    travelled = np.cumsum(np.abs(np.diff(position)))
    stuck_tick = first_stuck(position, read, gap)
    assert stuck_tick is not None and begin < stuck_tick
    assert (
        travelled[stuck_tick - 2] - travelled[begin - 1]
        <= TRAVEL
        < travelled[stuck_tick - 1] - travelled[begin - 1]
    )


def test_force_stuck_fault_is_raised_on_next_contact_if_sensor_stays_at_zero():
    position, force = contact(0.5, 1.0, 0.0)
    released = len(force) - int(np.argmax(force[::-1] > 0))
    twice = np.concatenate([position, position]), np.concatenate([force, np.zeros_like(force)])
    stuck_tick = first_stuck(*twice, gap=0.0)
    assert stuck_tick is not None and stuck_tick > len(force) > released
