"""What readings tell of a contact's energy, onset and turning: springs and dampers in closed form."""

import math

import pytest

from jaxhil.runtime.laws.balance import DAMPER, DELAY, MISSING, OFF, Balance
from jaxhil.runtime.laws.force_depth_map import KNOTS, SEGMENTS, Curve

PERIOD = 1e-4
RATE = 20.0  # of the spring's motion [1/s]: its peak force, and the root of its stiffness
NOISE = 1e-8  # the variance of a reading [1/s^2]


def spring(damping=0.0):
    """The map of a spring of stiffness RATE^2, and of a damper beside it."""
    curve = Curve()
    curve.slopes = [RATE**2] * SEGMENTS
    curve.at_knots = [RATE**2 * knot for knot in KNOTS]
    curve.damping = damping
    return curve


def unexplained(curve, reading, noise=NOISE):
    """Of one contact x = sin(RATE t)/RATE; `reading` is the force by depth and speed."""
    balance, deepest = Balance(), 1 / RATE
    for tick in range(1, math.ceil(math.pi / RATE / PERIOD)):
        time = tick * PERIOD
        depth, speed = math.sin(RATE * time) / RATE, math.cos(RATE * time)
        farthest = depth if speed > 0 else deepest
        balance.take(curve, depth, 0.0, speed, farthest, reading(depth, speed), noise, 0.0)
    return balance.unexplained(curve, RATE, deepest, 0.0, 1.0)


def test_what_is_stored_is_the_integral_of_the_elastic_force():
    curve = Curve()
    curve.slopes = [100.0 * (place % 3) - 20.0 for place in range(SEGMENTS)]
    curve.at_knots = [1.5]
    for place in range(SEGMENTS - 1):
        width = KNOTS[place + 1] - KNOTS[place]
        curve.at_knots.append(curve.at_knots[-1] + curve.slopes[place] * width)
    assert curve.stored(0.0) == curve.stored(-0.01) == 0.0
    for depth in (0.001, 0.003, 0.05, 0.2, 0.31):
        steps = 20000
        middles = (curve.elastic(depth * (place + 0.5) / steps) for place in range(steps))
        assert curve.stored(depth) == pytest.approx(sum(middles) * depth / steps, rel=1e-6)


@pytest.mark.parametrize("share", [-1.2, -0.8, 0.8, 1.2])
def test_energy_of_a_force_older_or_newer_than_told(share):
    """By d: K (x - d v), the energy K d int v^2 dt = pi/2 K d/RATE is given, or taken where d < 0."""
    late = share * OFF / (math.pi / 2 * RATE)
    odd = unexplained(spring(), lambda depth, speed: RATE**2 * (depth - late * speed))
    assert odd == (abs(share) > 1)


@pytest.mark.parametrize(("jump", "odd"), [(1.0, False), (0.8, False), (0.6, True), (0.0, True)])
def test_a_loss_like_a_wrong_delay_s_wants_the_jump_of_a_damper(jump, odd):
    """The map knows the loss, but not how the force began."""
    damping = 2 * OFF / (math.pi / 2) * RATE
    curve = spring(damping)
    curve.at_knots[0] = (jump - 1) * damping
    assert abs(DAMPER - 0.7) < 0.05
    assert unexplained(curve, lambda depth, speed: RATE**2 * depth + damping * speed) == odd


def test_a_loss_beyond_any_wrong_delay_is_a_contact_s():
    damping = 1.2 * DELAY * RATE**2
    curve = spring(damping)
    curve.at_knots[0] = -damping
    assert not unexplained(curve, lambda depth, speed: RATE**2 * depth + damping * speed)


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_friction_is_missing_at_the_turning(share):
    """It pushes on the way in, and as much less on the way out: twice that is missing. Of the energy the map
    is told, so that the turning alone is odd."""
    friction = share * MISSING * RATE
    curve = spring()

    def reading(depth, speed):
        return RATE**2 * depth - (0.0 if speed > 0 else 2 * friction)

    balance, deepest = Balance(), 1 / RATE
    for tick in range(1, math.ceil(0.55 * math.pi / RATE / PERIOD)):
        depth, speed = math.sin(RATE * tick * PERIOD) / RATE, math.cos(RATE * tick * PERIOD)
        farthest = depth if speed > 0 else deepest
        balance.take(curve, depth, 0.0, speed, farthest, reading(depth, speed), NOISE, 0.0)
    assert balance.unexplained(curve, RATE, deepest, 0.0, 1.0) == (share > 0.5)


def test_noise_excuses_what_it_may_do():
    late = -1.5 * OFF / (math.pi / 2 * RATE)
    one = spring(), lambda depth, speed: RATE**2 * (depth - late * speed)
    assert unexplained(*one) and not unexplained(*one, noise=4.0)


def test_a_contact_that_a_spring_and_a_damper_explain():
    assert not unexplained(spring(), lambda depth, speed: RATE**2 * depth)
    assert not unexplained(spring(2.0), lambda depth, speed: RATE**2 * depth + 2.0 * speed)
    assert unexplained(spring(), lambda depth, speed: RATE**2 * depth + 2.0 * speed)
