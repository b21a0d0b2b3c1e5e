"""A force-depth map of unknown contact, identified while it is met: slopes between knots, and dissipation.

    f(x, v, x_m) = preload + sum_j slope_j clip(x - kappa_j, 0, kappa_{j+1} - kappa_j)
                   + (damping + depth_damping x/REACH) v - unloading (x_m - x)
                   + friction v/sqrt(v^2 + SLOW^2)                                at x > 0, else 0

x_m >= x is the deepest point so far. Everything is scaled by the approach speed v0 and the mass M: depth x /
v0 [s], speed v / v0 [1], force F / (M v0) [1/s], slope k / M [1/s^2], damping b / M [1/s]. Parameters theta
(slopes, damping, depth damping, unloading, friction, preload) come first, the batch trails. They start from a
Gaussian prior whose slopes wander with depth, and are identified by recursive least squares (Kalman's update
for constant parameters). What dissipates counts with its mean given that it is not negative.
"""

import math
from functools import reduce
from operator import add
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# Depth over approach speed [s] at which a segment begins; the last goes on.
KNOTS = 1e-3 * np.array([0, 3, 8, 15, 24, 34, 46, 60, 76, 100, 140, 200])
SEGMENTS = len(KNOTS)
PLACES = range(SEGMENTS, SEGMENTS + 5)
DAMPING, DEPTH_DAMPING, UNLOADING, FRICTION, PRELOAD = PLACES
PARAMETERS = SEGMENTS + len(PLACES)
WIDTHS = np.append(np.diff(KNOTS), np.inf)
WANDERING = 0.03  # s of depth over which a slope wanders by its spread
BROAD = 0.092  # s of depth, beyond which slopes wander less and less
SLOW = 0.03  # speed at which friction turns
REACH = 0.03  # s of depth at which the depth damping is as strong as its name says
SURFACE = 1e-12  # s of depth: nearer than that is on the surface, which rounding does not decide
OUTLYING = 4.0  # times the noise's variance: a force that hardly is noise


class Map(NamedTuple):
    """What is known of theta."""

    mean: Float[Array, "parameters *batch"]  # of theta
    covariance: Float[Array, "parameters parameters *batch"]  # of theta


class Reading(NamedTuple):
    """What is read at a tick."""

    depth: Float[Array, "*batch"]  # X, as old as the force is taken to be [s]
    rate: Float[Array, "*batch"]  # V, likewise [1]
    force: Float[Array, "*batch"]  # y [1/s]
    variance: Float[Array, "*batch"]  # r of its noise [1/s^2]
    hidden: Bool[Array, "*batch"]  # whether the sensor's dead zone hides the force
    zone: Float[Array, "*batch"]  # that dead zone [1/s]
    counts: Bool[Array, "*batch"]  # whether to learn from it


class Prediction(NamedTuple):
    """What a reading will be by a map."""

    force: Float[Array, "*batch"]  # phi.theta [1/s]
    gain: Float[Array, "parameters *batch"]  # g = P phi
    variance: Float[Array, "*batch"]  # s = phi.g + that of the reading's noise [1/s^2]


class Curve(NamedTuple):
    """What counts of a map."""

    slopes: Float[Array, "segments *batch"]  # between the knots [1/s^2]
    damping: Float[Array, "*batch"]  # [1/s]
    depth_damping: Float[Array, "*batch"]  # at the depth `REACH` [1/s]
    unloading: Float[Array, "*batch"]  # [1/s^2]
    friction: Float[Array, "*batch"]  # [1/s]
    preload: Float[Array, "*batch"]  # [1/s]


def prior(
    stiffness: Array,
    common: Array,
    wandering: Array,
    damping: Array,
    depth_damping: Array,
    unloading: Array,
    friction: Array,
    preload: Array,
) -> Map:
    """Slopes N(K0, s_K^2 + s_S^2 min(kappa_i, kappa_j)/30 ms), what dissipates and the preload N(0, s^2);
    beyond a depth of 92 ms slopes wander ever less, as (92 ms/kappa)^4.

    stiffness K0, spreads s_K (`common`), s_S (`wandering`) and of `unloading` [1/s^2], of `damping`,
    `depth_damping`, `friction` and `preload` [1/s], of one shape.
    """
    ratio = BROAD / np.where(KNOTS > BROAD, KNOTS, BROAD)
    wandered = np.where(KNOTS > BROAD, BROAD * (4 - ratio**3) / 3, KNOTS)
    shared = _column(np.minimum.outer(wandered, wandered) / WANDERING, stiffness)
    slopes = common[None, None] ** 2 + wandering[None, None] ** 2 * shared
    zeros = jnp.zeros_like(slopes[:, :1])
    rows = [jnp.concatenate([slopes, *[zeros] * len(PLACES)], axis=1)]
    spreads = (damping, depth_damping, unloading, friction, preload)
    for place, spread in zip(PLACES, spreads, strict=True):
        row = [zeros[:1]] * PARAMETERS
        row[place] = zeros[:1] + spread[None, None] ** 2
        rows.append(jnp.concatenate(row, axis=1))
    mean = jnp.concatenate([zeros[:, 0] + stiffness[None], *[zeros[:1, 0]] * len(PLACES)])
    return Map(mean, jnp.concatenate(rows))


def ramps(depth: Float[Array, "*batch"], knots: Array | None = None) -> Float[Array, "segments *batch"]:
    """How far [s] each segment is pressed in; between `knots` [s], if they are not the usual ones."""
    if knots is None:
        knots, widths = _column(KNOTS, depth), _column(WIDTHS, depth)
    else:
        widths = jnp.concatenate([jnp.diff(knots, axis=0), jnp.full_like(knots[:1], np.inf)])
    beyond = depth[None] - knots
    return jnp.where(beyond > 0, jnp.minimum(beyond, widths), 0)


def features(
    depth: Array, speed: Array, deepest: Array, knots: Array | None = None
) -> Float[Array, "parameters *batch"]:
    """phi, of which the force is phi.theta."""
    others = jnp.stack([speed, depth * speed / REACH, depth - deepest, turning(speed), jnp.ones_like(depth)])
    return jnp.concatenate([ramps(depth, knots), others])


def predict(old: Map, phi: Array, variance: Array) -> Prediction:
    """What a reading with noise of a `variance` [1/s^2] will be by the map."""
    g = _product(jnp.swapaxes(old.covariance, 0, 1), phi[:, None])
    return Prediction(_product(old.mean, phi), g, variance + _product(g, phi))


def correct(old: Map, predicted: Prediction, force: Array, used: Bool[Array, "*batch"]) -> Map:
    """The map once the reading is known to be `force` [1/s], where `used`: g = P phi, s = variance + phi.g,
    theta += g (f - phi.theta)/s, P -= g g'/s."""
    used = used & (predicted.variance > 0)
    share = jnp.where(used, 1 / jnp.where(used, predicted.variance, 1), 0)
    scaled = share[None] * predicted.gain
    mean = old.mean + scaled * (force - predicted.force)[None]
    return Map(mean, old.covariance - scaled[:, None] * predicted.gain[None])


def tells(predicted: Prediction, force: Array, variance: Array) -> Bool[Array, "*batch"]:
    """Whether either the map or the reading itself tells of contact."""
    return (predicted.force > 0) | (force**2 > OUTLYING * variance)


def turning(speed: Array) -> Array:
    """Which way a speed goes, from -1 to 1."""
    ratio = speed / SLOW
    return ratio / jnp.sqrt(1 + ratio * ratio)


def update(
    old: Map,
    phi: Array,
    force: Array,
    variance: Array,
    enabled: Bool[Array, "*batch"],
    closes: Bool[Array, "*batch"],
) -> Map:
    """One reading of `force` [1/s] with noise of a `variance` [1/s^2], where `enabled` and the contact
    `closes` or it `tells` of contact."""
    predicted = predict(old, phi, variance)
    return correct(old, predicted, force, enabled & (closes | tells(predicted, force, variance)))


def curve(old: Map) -> Curve:
    """What counts of the map."""
    variances = jnp.stack([old.covariance[i, i] for i in PLACES[:-1]])
    lost = positive_mean(old.mean[DAMPING:PRELOAD], variances)
    return Curve(old.mean[:SEGMENTS], *lost, preload=old.mean[PRELOAD])


def elastic(now: Curve, depth: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Force [1/s] that does not depend on how the contact came there, 0 out of contact."""
    return jnp.where(depth > 0, now.preload + _pressed(now.slopes, depth), 0)


@jax.custom_jvp
def _pressed(slopes: Array, depth: Array) -> Array:
    """sum_j slope_j clip(x - kappa_j, 0, kappa_{j+1} - kappa_j) [1/s]."""
    return _product(slopes, ramps(depth))


@_pressed.defjvp
def _pressed_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (slopes, depth), (rates, rate) = primals, tangents
    beyond = depth[None] - _column(KNOTS, depth)
    here = jnp.where((beyond > 0) & (beyond <= _column(WIDTHS, depth)), slopes, 0)
    pressed = ramps(depth)
    return _product(slopes, pressed), _product(rates, pressed) + reduce(add, here) * rate


def force(now: Curve, depth: Array, speed: Array, deepest: Array) -> Float[Array, "*batch"]:
    """f [1/s], 0 out of contact; the deepest point so far may be short of the depth."""
    pressed = jnp.where(depth > 0, depth, 0)
    drag = (now.damping + now.depth_damping * pressed / REACH) * speed
    back = jnp.where(deepest > pressed, deepest - pressed, 0)
    lost = drag + now.friction * turning(speed) - now.unloading * back
    return elastic(now, depth) + jnp.where(depth > 0, lost, 0)


def peak_force(now: Curve) -> Float[Array, "*batch"]:
    """Force [1/s] where a contact entered at speed 1 comes to rest without dissipation: that up to which
    int f dx = 1/2, at least 1. At knots where the map pulls the force counts as 0."""
    widths = _column(WIDTHS[:-1], now.damping)
    first = jnp.zeros_like(now.slopes[:1])
    at_knots = now.preload[None] + jnp.concatenate([first, jnp.cumsum(now.slopes[:-1] * widths, axis=0)])
    forces = jnp.where(at_knots > 0, at_knots, 0)
    energies = jnp.cumsum(0.5 * (forces[:-1] + forces[1:]) * widths, axis=0)
    rises = jnp.concatenate([(forces[1:] - forces[:-1]) / widths, now.slopes[-1:]])
    place = jnp.sum(energies < 0.5, axis=0)[None]

    def there(values):
        return jnp.take_along_axis(values, place, axis=0)[0]

    left = 0.5 - there(jnp.concatenate([first, energies]))
    rise = there(rises)
    square = there(forces) ** 2 + 2 * jnp.where(rise > 0, rise, 0) * left
    return jnp.sqrt(jnp.where(square > 1, square, 1))


def positive_mean(mean: Float[Array, "*batch"], variance: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Mean of N(mean, variance), given that it is not negative.

    Of N(m, s^2) truncated at 0: s (t + phi(t)/Phi(t)), t = m/s, phi and Phi the normal density and
    distribution, with Boyd's bound of Mills' ratio, (1 - Phi(u))/phi(u) = pi/((pi - 1) u + sqrt(u^2 + 2 pi)),
    which is exact at 0 and far out, and (1 + u^2/512)^-256 for the density's exponential: algebraic, the same
    on every machine.
    """
    spread = jnp.sqrt(jnp.where(variance > 0, variance, 1))
    ratio = mean / spread
    root = jnp.sqrt(ratio**2 + 2 * math.pi)
    # (ratio + root)/pi, without the cancellation far below 0.
    negative = jnp.where(ratio > 0, 0, ratio)
    below = 2 / (jnp.sqrt(negative**2 + 2 * math.pi) - negative)
    positive = jnp.where(ratio > 0, ratio, 0)
    mills = math.pi / ((math.pi - 1) * positive + root)
    # The power of what is at most 1: the other way round it overflows, and so does its derivative.
    density = (1 / (1 + positive**2 / 512)) ** 256 / math.sqrt(2 * math.pi)
    above = positive + density / (1 - density * mills)
    return jnp.where(variance > 0, spread * jnp.where(ratio > 0, above, below), jnp.where(mean > 0, mean, 0))


def _product(a: Float[Array, "terms *shape"], b: Float[Array, "terms *other"]) -> Float[Array, "*shape"]:
    """sum_j a_j b_j, where b has 1 or as many along each other axis.

    Term by term: what the compiler takes for a reduction it computes lane by lane, or by a library's call
    that breaks up the loop around it.
    """
    return reduce(add, (a[j] * b[j] for j in range(len(a))))


def _column(values: np.ndarray, like: Array) -> Array:
    """Constants along leading axes, of the type and with the trailing axes of `like`."""
    return jnp.asarray(values.reshape(*values.shape, *[1] * like.ndim), like.dtype)
