"""The reference of linear contact, piece by piece: closed-form damped oscillators.

Between two depths the bodies obey M d'' = -(f + k (d - d_0) + b d'), a damped oscillator about the
depth at which the piece's line would reach zero force. A piece ends at the next depth, or where a
homogeneous solution of the same oscillator has its first zero: d' (turning point) on the way in,
F = -M d'' (separation) on the way out. Those zeros are closed forms at every damping ratio.
Only the time at which a depth is crossed is iterated for, by Newton's method, which converges
monotonically because d is concave in time throughout a contact.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

_NEWTON_STEPS = 80  # halving steps suffice even where a depth is only grazed


def chained_oscillators(
    mass: Float[Array, "*batch"],
    slopes: Float[Array, "segments *batch"],
    depths: Float[Array, "segments-1 *batch"],
    damping: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Restitution, peak force [N], duration [s]: see `jaxhil.contact.reference.piecewise_linear`."""
    segments = slopes.shape[0]
    zero = jnp.zeros_like(velocity)
    thicknesses = jnp.diff(depths, axis=0, prepend=zero[None])
    accelerations = jnp.cumsum(slopes[:-1] * thicknesses, axis=0) / mass[None]
    layers = _Layer(
        number=jnp.arange(segments),
        stiffness=slopes / mass[None],
        acceleration=jnp.concatenate([zero[None], accelerations]),
        thickness=jnp.concatenate([thicknesses, jnp.full_like(zero, jnp.inf)[None]]),
    )
    there_and_back = _Layer(*(jnp.concatenate([field, field[::-1]]) for field in layers))
    inward = jnp.arange(2 * segments) < segments
    decay = damping / (2 * mass)
    start = _State(
        depth=zero,
        velocity=velocity,
        time=zero,
        peak=2 * decay * velocity,
        segment=jnp.zeros(velocity.shape, layers.number.dtype),
        ended=jnp.zeros(velocity.shape, bool),
    )
    end, _ = lax.scan(
        lambda state, phase: (_traverse(decay, *phase, state), None),
        start,
        (there_and_back, inward),
    )
    return -end.velocity / velocity, mass * end.peak, end.time


def arccosine_over_sine(cosine):
    """acos(c) / sqrt(1 - c^2) for c >= 0, analytic at c = 1: acosh(c) / sqrt(c^2 - 1) above it."""
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


class _Layer(NamedTuple):
    """One segment, per unit mass."""

    number: Int[Array, ""]  # from 0
    stiffness: Float[Array, "*batch"]  # its slope [1/s^2]
    acceleration: Float[Array, "*batch"]  # spring force at its lower depth [m/s^2]
    thickness: Float[Array, "*batch"]  # [m]; the last one's is infinite


class _State(NamedTuple):
    """Between two segments."""

    depth: Float[Array, "*batch"]  # of the turning point above the lower depth of its segment [m]
    velocity: Float[Array, "*batch"]  # [m/s]
    time: Float[Array, "*batch"]  # since the first touch [s]
    peak: Float[Array, "*batch"]  # largest force so far over mass [m/s^2]
    segment: Int[Array, "*batch"]  # the deepest reached
    # on the way in whether it has turned, on the way out whether the bodies have separated
    ended: Bool[Array, "*batch"]


class _Piece(NamedTuple):
    """How one segment is passed: what comes after the start, and how it ends."""

    spring: Array  # force of the spring over mass at the start [m/s^2]
    velocity: Array  # at the start [m/s]
    crosses: Array  # whether it ends at the segment's far end, else by itself: turning point or separation
    target: Array  # distance to that end [m]; 0 where it ends by itself
    time: Array  # until the end, without derivative [s]
    grows: Array  # whether, on the way in, the force grows at first
    culmination: Array  # time until the force is largest [s]


def _traverse(decay, layer: _Layer, inward, state: _State) -> _State:
    """Through one segment, inward or outward, to its far end, the turning point or separation."""
    active = jnp.where(inward, ~state.ended, ~state.ended & (state.segment >= layer.number))
    piece = _piece(decay, layer, inward, state, active)
    stiffness = layer.stiffness
    distances, speeds = _travel(
        decay[None],
        stiffness[None],
        piece.spring[None],
        piece.velocity[None],
        jnp.stack([piece.time, piece.culmination]),
    )
    forces = piece.spring[None] + stiffness[None] * distances + 2 * decay[None] * speeds
    distance, speed, end_force = distances[0], speeds[0], forces[0]

    # The event is the zero of `residual`: one Newton step carries its derivative, and nothing else.
    # At the culmination none is needed: F is stationary there.
    crosses = piece.crosses
    force_rate = stiffness * speed - 2 * decay * end_force
    residual = jnp.where(crosses, distance - piece.target, jnp.where(inward, speed, end_force))
    rate = jnp.where(crosses, speed, jnp.where(inward, -end_force, force_rate))
    step = jnp.where(rate == 0, 0.0, -residual) / jnp.where(rate == 0, 1.0, rate)
    step = step - lax.stop_gradient(step)
    time = piece.time + step
    distance = jnp.where(crosses, piece.target, distance + speed * step)
    speed = speed - end_force * step
    end_force = end_force + force_rate * step
    speed = jnp.where(inward, jnp.where(crosses, jnp.maximum(speed, 0.0), 0.0), speed)

    inside = piece.grows & (piece.culmination < time)
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
    # At the innermost point, being turned ends the way in and begins the way out.
    innermost = inward & jnp.isinf(layer.thickness)
    return chosen._replace(ended=jnp.where(innermost, False, chosen.ended))


def _piece(decay, layer: _Layer, inward, state: _State, active) -> _Piece:
    """How a segment is passed where `active`; times are found without derivative."""
    stiffness, turns_here = layer.stiffness, state.segment == layer.number
    # Outward, a segment is entered at its upper depth, the turning segment where it was left.
    depth = jnp.where(inward, 0.0, jnp.where(turns_here, state.depth, layer.thickness))
    depth = jnp.where(active, depth, 0.0)
    velocity = jnp.where(active, state.velocity, 0.0)
    spring = layer.acceleration + stiffness * depth
    force = jnp.maximum(spring + 2 * decay * velocity, 0.0)

    # The piece ends by itself at d' = 0 or at F = 0. On the way in F is largest at an end of the piece or, if
    # it grows at first, where F' = 0.
    fixed = lax.stop_gradient((decay, stiffness, spring, velocity))
    growth = stiffness * velocity - 2 * decay * force
    grows = inward & (growth > 0)
    by_itself, culmination = lax.stop_gradient(
        _first_zero(
            decay[None],
            stiffness[None],
            jnp.stack([jnp.where(inward, velocity, force), jnp.where(grows, growth, 0.0)]),
            jnp.stack([jnp.where(inward, spring, -stiffness * velocity), stiffness * force]),
        )
    )
    farthest, _ = _travel(*fixed, by_itself)
    boundary = jnp.where(inward, layer.thickness, -depth)
    # Without damping force and depth vanish together in the first segment: always a separation.
    crosses = jnp.where(inward, farthest > boundary, (farthest < boundary) & (layer.number > 0))
    target = jnp.where(crosses, boundary, 0.0)
    start = jnp.where(crosses & ~inward, by_itself, 0.0)
    crossing = _crossing_time(*fixed, *lax.stop_gradient((target, start)))
    return _Piece(
        spring, velocity, crosses, target, jnp.where(crosses, crossing, by_itself), grows, culmination
    )


def _crossing_time(decay, stiffness, spring, velocity, target, start):
    """The time, without derivative, at which the distance travelled is `target`; 0 if that is 0.

    d is concave, so Newton moves from `start` (0 on the way in, the separation on the way out)
    towards the crossing without overshooting it. Rounding shows as a step back: a lane that no
    longer advances is done.
    """

    def advance(carry):
        count, time, moving = carry
        distance, speed = _travel(decay, stiffness, spring, velocity, time)
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
    """First zero of y'' + 2 a y' + k y = 0 from y(0) = y >= 0 and y'(0) = -(2 a y + c), c >= 0.

    Args: a, k, y, c. With w^2 = k - a^2 the solution is y cos(w t) - (a y + c) sin(w t) / w under
    e^(-a t); whatever the sign of w^2 the zero is artanh(h y / (a y + c)) / h, h^2 = -w^2. At
    k > a^2 it lies in the first quarter of a turn.
    """
    over, rate = _rate(decay, stiffness)
    circular = jnp.arctan2(rate * value, decay * value + slope_share) / rate
    # a - h = k / (a + h): exact also when the damping ratio is large.
    gap = stiffness / (decay + rate) * value + slope_share
    used = over & (value > 0)
    hyperbolic = jnp.log1p(jnp.where(used, 2 * rate * value, 0.0) / jnp.where(used, gap, 1.0))
    return jnp.where(over, hyperbolic / (2 * rate), circular)


def _travel(decay, stiffness, spring, velocity, time):
    """Distance and velocity after `time`, from `velocity` and the spring force over mass `spring`.

    With the impulse response S: distance = v S - f int S, velocity = v S' - f S.
    """
    impulse, slope, integral = _impulse_response(decay, stiffness, time)
    return velocity * impulse - spring * integral, velocity * slope - spring * impulse


@jax.custom_jvp
def _impulse_response(decay, stiffness, time):
    """S = e^(-a t) sin(w t) / w, S' and int S, at any damping ratio; w^2 = k - a^2."""
    over, rate = _rate(decay, stiffness)
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
    # By hand because the square root in w has no derivative at critical damping, where S
    # is analytic.
    decay, stiffness, time = primals
    impulse, slope, integral = _impulse_response(decay, stiffness, time)
    discriminant = decay**2 - stiffness
    angle = discriminant * time**2
    near = jnp.abs(angle) < 0.005
    series = jnp.zeros_like(angle)
    for k in (4, 3, 2, 1):
        series = series * angle + k / math.factorial(2 * k + 1)
    # dS/d(a^2 - k) at fixed a under the exponential
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


def _rate(decay, stiffness):
    """Whether overdamped, and sqrt(|a^2 - k|), kept from 0: all that uses it has a limit there."""
    discriminant = decay**2 - stiffness
    floor = float(jnp.finfo(discriminant.dtype).tiny)
    return discriminant > 0, jnp.sqrt(jnp.maximum(jnp.abs(discriminant), floor))
