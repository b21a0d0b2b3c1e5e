"""Ideal contact of the piecewise-linear law: one damped oscillator for each segment, in closed form.

In a segment that starts at the depth d_0 with the spring force f, M d'' = -(f + k (d - d_0) + b d'). The
motion leaves the segment at the next depth, or ends at d' = 0 (inward: turning point) or at F = -M d'' = 0
(outward: separation). d' and d'' are homogeneous solutions of the oscillator, and their first zeros have
closed forms at every damping ratio. Only the time at which the motion crosses a depth needs iterations:
Newton's method converges monotonically, because d is concave in time throughout a contact.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

_NEWTON_STEPS = 80  # enough even if the motion turns at a segment's end: each step then only halves the error


def solve_chained_oscillators(
    mass: Float[Array, "*batch"],
    slopes: Float[Array, "segments *batch"],
    depths: Float[Array, "segments-1 *batch"],
    damping: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Return restitution, peak force [N] and duration [s] of ideal contacts with a piecewise-linear force.

    Each segment contributes a damped oscillation. `ideal_piecewise_linear` describes the arguments.
    """
    count = slopes.shape[0]
    zero = jnp.zeros_like(velocity)
    thicknesses = jnp.diff(depths, axis=0, prepend=zero[None])
    accelerations = jnp.cumsum(slopes[:-1] * thicknesses, axis=0) / mass[None]
    segments = _Segment(
        number=jnp.arange(count),
        stiffness=slopes / mass[None],
        acceleration=jnp.concatenate([zero[None], accelerations]),
        thickness=jnp.concatenate([thicknesses, jnp.full_like(zero, jnp.inf)[None]]),
    )
    inward_and_outward = _Segment(*(jnp.concatenate([field, field[::-1]]) for field in segments))
    inward = jnp.arange(2 * count) < count
    decay = damping / (2 * mass)
    start = _State(
        depth=zero,
        velocity=velocity,
        time=zero,
        peak=2 * decay * velocity,
        segment=jnp.zeros(velocity.shape, segments.number.dtype),
        ended=jnp.zeros(velocity.shape, bool),
    )
    end, _ = lax.scan(
        lambda state, phase: (_traverse(decay, *phase, state), None),
        start,
        (inward_and_outward, inward),
    )
    return -end.velocity / velocity, mass * end.peak, end.time


def arccosine_over_sine(cosine):
    """Return acos(c) / sqrt(1 - c^2) for 0 <= c < 1 and its analytic continuation for c >= 1.

    For c > 1 the function is acosh(c) / sqrt(c^2 - 1).
    """
    near = jnp.abs(cosine - 1) < 0.02
    below = (cosine < 1) & ~near
    above = (cosine > 1) & ~near

    # Gauss' series 2F1(1, 1; 3/2; (1 - c) / 2), whose terms have the ratio (n + 1) / (n + 3/2) z.
    half = jnp.where(near, (1 - cosine) / 2, 0.0)
    series = jnp.ones_like(half)
    for n in reversed(range(8)):
        series = 1 + (n + 1) / (n + 1.5) * half * series

    low = jnp.where(below, cosine, 0.5)
    high = jnp.where(above, cosine, 2.0)
    sine = jnp.sqrt((high - 1) * (high + 1))
    circular = jnp.arccos(low) / jnp.sqrt((1 - low) * (1 + low))
    hyperbolic = jnp.log(high + sine) / sine
    return jnp.where(near, series, jnp.where(below, circular, hyperbolic))


class _Segment(NamedTuple):
    """Segment of the piecewise-linear force; force and slope are divided by the equivalent mass."""

    number: Int[Array, ""]  # index, from 0
    stiffness: Float[Array, "*batch"]  # slope [1/s^2]
    acceleration: Float[Array, "*batch"]  # spring force / mass at the lower depth [m/s^2]
    thickness: Float[Array, "*batch"]  # distance from the lower to the upper depth [m]; infinite for the last


class _State(NamedTuple):
    """State of the motion at the boundary between two segments."""

    depth: Float[Array, "*batch"]  # depth of the turning point minus the lower depth of its segment [m]
    velocity: Float[Array, "*batch"]  # [m/s]
    time: Float[Array, "*batch"]  # time since the first touch [s]
    peak: Float[Array, "*batch"]  # largest force so far, divided by mass [m/s^2]
    segment: Int[Array, "*batch"]  # index of the deepest segment reached
    # inward: whether the turning point is reached; outward: whether the bodies have separated
    ended: Bool[Array, "*batch"]


class _SegmentPassage(NamedTuple):
    """Motion of the bodies, inward or outward, through one segment of the piecewise-linear force."""

    spring: Array  # spring force at the start, divided by mass [m/s^2]
    velocity: Array  # velocity at the start [m/s]
    crosses: Array  # whether the motion crosses the far depth of the segment, instead of ending within it
    target: Array  # distance to the far depth [m]; 0 if the motion ends before it
    time: Array  # duration, without derivative [s]
    grows: Array  # whether the motion is inward and the force increases at the start
    culmination: Array  # time until the force is largest [s]


def _traverse(decay, segment: _Segment, inward, state: _State) -> _State:
    """Advance the state through one segment: to its other end, the turning point or the separation.

    The other end is the deeper one for the inward motion, and the shallower one for the outward motion.
    """
    active = jnp.where(inward, ~state.ended, ~state.ended & (state.segment >= segment.number))
    passage = _compute_passage(decay, segment, inward, state, active)
    stiffness = segment.stiffness
    distances, speeds = _free_motion(
        decay[None],
        stiffness[None],
        passage.spring[None],
        passage.velocity[None],
        jnp.stack([passage.time, passage.culmination]),
    )
    forces = passage.spring[None] + stiffness[None] * distances + 2 * decay[None] * speeds
    distance, speed, end_force = distances[0], speeds[0], forces[0]

    # The event is the zero of `residual`. A Newton step whose value is 0 adds the derivative of the event's
    # time. The culmination needs no such step, since F is stationary there.
    crosses = passage.crosses
    force_rate = stiffness * speed - 2 * decay * end_force
    residual = jnp.where(crosses, distance - passage.target, jnp.where(inward, speed, end_force))
    rate = jnp.where(crosses, speed, jnp.where(inward, -end_force, force_rate))
    step = jnp.where(rate == 0, 0.0, -residual) / jnp.where(rate == 0, 1.0, rate)
    step = step - lax.stop_gradient(step)
    time = passage.time + step
    distance = jnp.where(crosses, passage.target, distance + speed * step)
    speed = speed - end_force * step
    end_force = end_force + force_rate * step
    speed = jnp.where(inward, jnp.where(crosses, jnp.maximum(speed, 0.0), 0.0), speed)

    inside = passage.grows & (passage.culmination < time)
    peak = jnp.where(inside, forces[1], jnp.where(inward, end_force, 0.0))
    new = _State(
        depth=jnp.where(inward & ~crosses, distance, state.depth),
        velocity=speed,
        time=state.time + time,
        peak=jnp.where(peak > state.peak, peak, state.peak),
        segment=jnp.where(inward & crosses, state.segment + 1, state.segment),
        ended=~crosses,
    )
    chosen = _State(*(jnp.where(active, a, b) for a, b in zip(new, state, strict=True)))
    # After the last segment the outward motion begins, so that `ended` is reset.
    innermost = inward & jnp.isinf(segment.thickness)
    return chosen._replace(ended=jnp.where(innermost, False, chosen.ended))


def _compute_passage(decay, segment: _Segment, inward, state: _State, active) -> _SegmentPassage:
    """Compute the motion of the `active` batch elements through a segment.

    In differentiation, the times in the result are constants; `_traverse` adds the derivative of `time`.
    """
    stiffness, turns_here = segment.stiffness, state.segment == segment.number
    # The outward motion starts at the turning point, and enters each further segment at its deeper end.
    depth = jnp.where(inward, 0.0, jnp.where(turns_here, state.depth, segment.thickness))
    depth = jnp.where(active, depth, 0.0)
    velocity = jnp.where(active, state.velocity, 0.0)
    spring = segment.acceleration + stiffness * depth
    force = jnp.maximum(spring + 2 * decay * velocity, 0.0)

    # If the motion does not cross the other end, it ends at d' = 0 (inward) or F = 0 (outward). In the
    # inward motion, F is largest at the start, at the end, or (if F increases at the start) where F' = 0.
    fixed = lax.stop_gradient((decay, stiffness, spring, velocity))
    growth = stiffness * velocity - 2 * decay * force
    grows = inward & (growth > 0)
    event, culmination = lax.stop_gradient(
        _first_zero(
            decay[None],
            stiffness[None],
            jnp.stack([jnp.where(inward, velocity, force), jnp.where(grows, growth, 0.0)]),
            jnp.stack([jnp.where(inward, spring, -stiffness * velocity), stiffness * force]),
        )
    )
    farthest, _ = _free_motion(*fixed, event)
    boundary = jnp.where(inward, segment.thickness, -depth)
    # In the first segment the bodies always separate: without damping, force and depth vanish together.
    crosses = jnp.where(inward, farthest > boundary, (farthest < boundary) & (segment.number > 0))
    target = jnp.where(crosses, boundary, 0.0)
    start = jnp.where(crosses & ~inward, event, 0.0)
    crossing = _crossing_time(*fixed, *lax.stop_gradient((target, start)))
    time = jnp.where(crosses, crossing, event)
    return _SegmentPassage(spring, velocity, crosses, target, time, grows, culmination)


def _crossing_time(decay, stiffness, spring, velocity, target, start):
    """Return the time [s] in which the motion covers the distance `target` [m]; 0 if `target` is 0.

    `start` is 0 for the inward motion, and the time of separation for the outward motion. Since d is concave
    in time, Newton's method approaches the crossing from `start` without overshoot, until rounding stops it.
    """

    def advance(carry):
        count, time, moving = carry
        distance, speed = _free_motion(decay, stiffness, spring, velocity, time)
        step = (target - distance) / jnp.where(speed == 0, 1.0, speed)
        progress = jnp.where(target > 0, step, -step)
        return (
            count + 1,
            jnp.where(moving, time + step, time),
            moving & (progress > 4 * jnp.finfo(time.dtype).eps * time),
        )

    def unfinished(carry):
        return (carry[0] < _NEWTON_STEPS) & jnp.any(carry[2])

    return lax.while_loop(unfinished, advance, (jnp.array(0), start, target != 0))[1]


def _first_zero(decay, stiffness, value, slope_share):
    """Return the time of the first zero of a damped oscillation y(t) [s].

    The oscillation satisfies y'' + 2 a y' + k y = 0 with y(0) >= 0 and y'(0) = -(2 a y(0) + c), c >= 0. The
    arguments are a, k, y(0) and c. With w^2 = k - a^2 the solution is
    e^(-a t) (y(0) cos(w t) - (a y(0) + c) sin(w t) / w). Its zero is artanh(h y(0) / (a y(0) + c)) / h,
    h^2 = -w^2, for either sign of w^2. For k > a^2 the zero lies in the first quarter period.
    """
    over, rate = _characteristic_root(decay, stiffness)
    circular = jnp.arctan2(rate * value, decay * value + slope_share) / rate
    # The form a - h = k / (a + h) is accurate even for a large damping ratio.
    gap = stiffness / (decay + rate) * value + slope_share
    is_used = over & (value > 0)
    hyperbolic = jnp.log1p(jnp.where(is_used, 2 * rate * value, 0.0) / jnp.where(is_used, gap, 1.0))
    return jnp.where(over, hyperbolic / (2 * rate), circular)


def _free_motion(decay, stiffness, spring, velocity, time):
    """Return distance [m] and velocity [m/s] after a `time` [s] of motion within one segment.

    S is the impulse response, f = `spring` the spring force per mass at the start, and v = `velocity` the
    velocity at the start. The distance is v S minus f times the integral of S. The velocity is v S' - f S.
    """
    impulse, slope, integral = _impulse_response(decay, stiffness, time)
    return velocity * impulse - spring * integral, velocity * slope - spring * impulse


@jax.custom_jvp
def _impulse_response(decay, stiffness, time):
    """Return the impulse response S = e^(-a t) sin(w t) / w, its rate S' and its integral.

    a is `decay`, k is `stiffness`, t is `time`, and w^2 = k - a^2.
    """
    over, rate = _characteristic_root(decay, stiffness)
    half = jnp.where(over, 0.0, rate * time) / 2
    sine = jnp.sin(half)
    fade = jnp.exp(-decay * time)
    impulse = 2 * fade * sine * jnp.cos(half) / rate
    versine = 2 * fade * sine**2
    slope = fade - versine - decay * impulse
    deficit = -jnp.expm1(-decay * time) + versine - decay * impulse

    fast = decay + rate
    slow = stiffness / fast
    slow_loss = jnp.expm1(-slow * time)
    slow_impulse = -(1 + slow_loss) * jnp.expm1(-2 * rate * time) / (2 * rate)
    impulse = jnp.where(over, slow_impulse, impulse)
    slope = jnp.where(over, jnp.exp(-fast * time) - slow * slow_impulse, slope)
    deficit = jnp.where(over, -slow_loss - slow * slow_impulse, deficit)
    return impulse, slope, deficit / stiffness


@_impulse_response.defjvp
def _impulse_response_jvp(primals, tangents):
    # Automatic differentiation fails at critical damping: the square root in w has no derivative there,
    # although S is analytic.
    decay, stiffness, time = primals
    impulse, slope, integral = _impulse_response(decay, stiffness, time)
    discriminant = decay**2 - stiffness
    angle = discriminant * time**2
    near = jnp.abs(angle) < 0.005
    series = jnp.zeros_like(angle)
    for k in (4, 3, 2, 1):
        series = series * angle + k / math.factorial(2 * k + 1)
    # This is dS/d(a^2 - k), with the a in the exponential held fixed.
    bend = jnp.where(
        near,
        jnp.exp(-decay * time) * time**3 * series,
        (time * (slope + decay * impulse) - impulse) / (2 * jnp.where(near, 1.0, discriminant)),
    )
    by_decay = (
        2 * decay * bend - time * impulse,
        2 * (decay * time - 1) * impulse + (2 * stiffness - 4 * decay**2) * bend,
        -2 * bend,
    )
    by_stiffness = (
        -bend,
        decay * bend - time * impulse / 2,
        (time * impulse / 2 + decay * bend - integral) / stiffness,
    )
    by_time = (slope, -2 * decay * slope - stiffness * impulse, impulse)
    tangent_decay, tangent_stiffness, tangent_time = tangents

    def total(output):
        return (
            by_decay[output] * tangent_decay
            + by_stiffness[output] * tangent_stiffness
            + by_time[output] * tangent_time
        )

    return (impulse, slope, integral), (total(0), total(1), total(2))


def _characteristic_root(decay, stiffness):
    """Return whether a^2 > k (overdamped), and sqrt(|a^2 - k|) > 0, for a = `decay` and k = `stiffness`."""
    discriminant = decay**2 - stiffness
    floor = float(jnp.finfo(discriminant.dtype).tiny)
    return discriminant > 0, jnp.sqrt(jnp.maximum(jnp.abs(discriminant), floor))
