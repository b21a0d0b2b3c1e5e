"""Ideal contact of two free bodies, in continuous time and without any delay, in closed form.

All results of the rig are compared with the ideal contact: the motion M d'' = -F(d, d'), d(0) = 0,
d'(0) = v > 0, of two free bodies with the equivalent mass M until they separate. Each contact law in this
module has a closed form, or a first integral that leaves one well-conditioned scalar equation.

All parameters are floating-point arrays of one batch shape and one dtype. `damping` must not be negative, and
all others must be positive; this is not checked here. All functions can be jitted, vmapped and differentiated
once: scalar equations are solved without differentiation, then their roots get the exact first derivative.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxhil.contact.ideal_contact_segments import arccosine_over_sine, solve_chained_oscillators


class IdealContact(NamedTuple):
    """Restitution, peak force and duration of ideal contacts."""

    restitution: Float[Array, "*batch"]  # rebound speed divided by approach speed [1]
    peak_force: Float[Array, "*batch"]  # largest contact force [N]
    # time from first touch to separation [s]; infinite if the bodies never separate
    duration: Float[Array, "*batch"]


def ideal_kelvin_voigt(
    mass: Float[Array, "*batch"],
    stiffness: Float[Array, "*batch"],
    damping: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
    tension: Bool[Array, "*batch"],
) -> IdealContact:
    """Return the ideal contact with F = k d + b d', at any damping ratio xi = b / (2 sqrt(k M)).

    Without `tension`, F = max(0, k d + b d'). The bodies separate at F = 0, after the time 2 g(xi) / sqrt(k /
    M), with the restitution e = exp(-2 xi g(xi)). Here g(xi) = acos(xi) / sqrt(1 - xi^2), continued
    analytically through xi = 1. With `tension`, the bodies separate at d = 0 with e = exp(-pi xi / sqrt(1 -
    xi^2)), or stick together (e = 0, infinite duration) if xi >= 1. For xi >= 1/2 the peak force is b v, at
    the onset of contact. Source: impulse response of the damped oscillator.

    Args:
        mass: equivalent mass M [kg].
        stiffness: k [N/m].
        damping: b [N s/m].
        velocity: approach speed v [m/s].
        tension: whether the contact force may pull.
    """
    frequency = jnp.sqrt(stiffness / mass)
    damping_ratio = damping / (2 * jnp.sqrt(stiffness * mass))

    half_phase = arccosine_over_sine(damping_ratio)
    separating = jnp.exp(-2 * damping_ratio * half_phase), 2 * half_phase / frequency

    sticks = damping_ratio >= 1
    below_critical = jnp.where(sticks, 0.5, damping_ratio)
    sine = jnp.sqrt((1 - below_critical) * (1 + below_critical))
    adhering = (
        jnp.where(sticks, 0.0, jnp.exp(-np.pi * below_critical / sine)),
        jnp.where(sticks, jnp.inf, np.pi / (sine * frequency)),
    )

    # F is stationary at the phase 3 acos(xi) - pi of the oscillation, which exists for xi < 1/2 only.
    peaks_inside = damping_ratio < 0.5
    light = jnp.where(peaks_inside, damping_ratio, 0.25)
    sine = jnp.sqrt((1 - light) * (1 + light))
    relative_peak = jnp.where(
        peaks_inside,
        jnp.exp(-light / sine * (3 * jnp.arccos(light) - np.pi)),
        2 * damping_ratio,
    )
    return IdealContact(
        restitution=jnp.where(tension, adhering[0], separating[0]),
        peak_force=mass * velocity * frequency * relative_peak,
        duration=jnp.where(tension, adhering[1], separating[1]),
    )


def ideal_hunt_crossley(
    mass: Float[Array, "*batch"],
    stiffness: Float[Array, "*batch"],
    exponent: Float[Array, "*batch"],
    damping: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
) -> IdealContact:
    """Return the ideal contact with F = k d^n (1 + a d'), a = 3 chi / 2.

    With y = a d' and q = a v, the equation of motion has the first integral

        k a^2 d^(n+1) / ((n + 1) M) = G(q) - G(y),   G(y) = y - log(1 + y).

    At each depth, the inward rate y and the outward rate -p satisfy G(y) = G(-p). With the parameter
    s = (y + p) / 2, the rates are y = s + L(s) and p = s - L(s), where L(s) = s coth(s) - 1. Then
    G(y) = L(s) + log(sinh(s) / s). At the surface, s is the root S of S + L(S) = q. Hence

        e = (S - L(S)) / (S + L(S)),
        duration = 2 M / (a k) int_0^S d(s)^-n ds,

    and F is largest where G(q) - G(y) = n y / (n + 1). All three results are computed in forms that are
    regular at chi = 0. The integral uses the double-exponential rule after a substitution that removes the
    singularity at s = S. The law is from Hunt and Crossley, J. Appl. Mech. 42 (1975) 440-445; the solution is
    derived here.

    Args:
        mass: equivalent mass M [kg].
        stiffness: k [N/m^n].
        exponent: n [1].
        damping: chi [s/m].
        velocity: approach speed v [m/s].
    """
    restitution, peak, duration = _hunt_crossley_shape(1.5 * damping * velocity, exponent)
    depth = ((exponent + 1) * mass * velocity**2 / stiffness) ** (1 / (exponent + 1))
    return IdealContact(
        restitution=restitution,
        peak_force=mass * velocity**2 / depth * peak,
        duration=depth / velocity * duration,
    )


def ideal_piecewise_linear(
    mass: Float[Array, "*batch"],
    slopes: Float[Array, "segments *batch"],
    depths: Float[Array, "segments-1 *batch"],
    damping: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
) -> IdealContact:
    """Return the ideal contact with F = max(0, f(d) + b d'), f(0) = 0, f' = k_i between d_(i-1) and d_i.

    The closed form of the damped oscillator is applied segment by segment, inward and outward. The last slope
    continues beyond the last depth. With one segment the result equals `ideal_kelvin_voigt` without tension.

    Args:
        mass: equivalent mass M [kg].
        slopes: k_1, k_2, ... > 0 [N/m].
        depths: 0 < d_1 < d_2 < ... [m].
        damping: b [N s/m].
        velocity: approach speed v [m/s].
    """
    return IdealContact(*solve_chained_oscillators(mass, slopes, depths, damping, velocity))


# s coth(s) - 1 = sum_k _COTH_SERIES[k-1] s^(2k), radius of convergence pi.
_SERIES_ORDERS = np.arange(1, 9)
_MAX_SERIES_ARGUMENT = 0.3
# Values of Riemann's zeta function, zeta(2), zeta(4), ... They are listed because SciPy takes long to import.
_ZETA = np.array(
    [
        1.6449340668482264,
        1.0823232337111381,
        1.0173430619844492,
        1.0040773561979444,
        1.000994575127818,
        1.000246086553308,
        1.0000612481350588,
        1.0000152822594086,
    ]
)
_COTH_SERIES = 2 * (-1.0) ** (_SERIES_ORDERS + 1) * _ZETA / np.pi ** (2 * _SERIES_ORDERS)
# Coefficients of s^(2k) in the first integral G = s coth(s) - 1 + log(sinh(s) / s).
_POTENTIAL_SERIES = _COTH_SERIES * (1 + 1 / (2 * _SERIES_ORDERS))


def _langevin(s):
    """Return 1 - f(s) and L'(s) for s >= 0, where L'(s) is the derivative of L(s) = s f(s).

    f(s) = coth(s) - 1 / s is Langevin's function.
    """
    small = s < _MAX_SERIES_ARGUMENT
    square = jnp.where(small, s, 0.0) ** 2
    value, slope = jnp.zeros_like(s), jnp.zeros_like(s)
    for k, coefficient in zip(_SERIES_ORDERS[::-1], _COTH_SERIES[::-1], strict=True):
        value = value * square + float(coefficient)
        slope = slope * square + float(2 * k * coefficient)
    large = jnp.where(small, 1.0, s)
    decay = jnp.exp(-2 * large)
    surplus = 2 * decay / (1 - decay)  # coth(s) - 1
    closed_slope = 1 + surplus - large * surplus * (2 + surplus)
    return (
        jnp.where(small, 1 - s * value, 1 / large - surplus),
        jnp.where(small, s * slope, closed_slope),
    )


@jax.custom_jvp
def _hunt_crossley_shape(onset, exponent):
    """Return the dimensionless restitution, peak force and duration for Hunt and Crossley's law.

    The unit of force is M v^2 / D and the unit of time D / v, where the length D satisfies
    D^(n+1) = (n + 1) M v^2 / k. `onset` is q = 3 chi v / 2, and `exponent` is n. The other symbols are as in
    `ideal_hunt_crossley`.
    """
    half_span, at_peak = _solve_half_span(onset), _solve_peak(onset, exponent)
    return _shape_at_roots(half_span, at_peak, onset, exponent)


@_hunt_crossley_shape.defjvp
def _hunt_crossley_shape_jvp(primals, tangents):
    # The tangents are linear combinations of the partial derivatives with respect to `onset` and `exponent`.
    onset, exponent = primals
    root, at_peak = _solve_half_span(onset), _solve_peak(onset, exponent)
    root_slope = 1 + _langevin(root)[1]

    def shape(onset, exponent):
        half_span = root + (onset - primals[0]) / root_slope
        return _shape_at_roots(half_span, at_peak, onset, exponent)

    ones, zeros = jnp.ones_like(onset), jnp.zeros_like(onset)
    basis = jnp.stack([ones, zeros]), jnp.stack([zeros, ones])
    value, partial = jax.vmap(lambda *direction: jax.jvp(shape, primals, direction), out_axes=(None, 0))(
        *basis
    )
    return value, tuple(p[0] * tangents[0] + p[1] * tangents[1] for p in partial)


def _shape_at_roots(half_span, at_peak, onset, exponent):
    """Return the results of `_hunt_crossley_shape` from the roots S = `half_span` and u = `at_peak`.

    `_solve_half_span` and `_solve_peak` compute the roots.
    """
    symmetry, _ = _langevin(half_span)
    exponent_ratio = exponent / (exponent + 1)
    # The peak force is stationary with respect to u = `at_peak`, so that u needs no derivative.
    y = onset**2 * at_peak
    potential = _scaled_potential(jnp.stack([onset, y]))
    depth_power = potential[0] - y * at_peak * potential[1]
    peak = (exponent + 1) * depth_power**exponent_ratio * (1 + y)
    ratio = 1 / (2 - symmetry)  # S / q, also at q = 0
    duration = 2 * ratio ** (1 - 2 * exponent_ratio) * _duration_integral(half_span, exponent)
    return symmetry * ratio, peak, duration


def _solve_half_span(onset):
    """Return the root S >= 0 of S + L(S) = `onset`, where L(s) = s coth(s) - 1."""

    def newton(_, s):
        symmetry, slope = _langevin(s)
        return s - (s * (2 - symmetry) - onset) / (1 + slope)

    # L is convex and L >= max(0, S - 1): the start is not below the root, and Newton's method descends to it.
    return lax.fori_loop(0, 8, newton, jnp.minimum(onset, (onset + 1) / 2))


def _solve_peak(onset, exponent):
    """Return u = y / q^2 at the peak force, where y solves G(q) - G(y) = n y / (n + 1).

    q is `onset`, n is `exponent`, and G(y) = y - log(1 + y), as in `ideal_hunt_crossley`.
    """
    exponent_ratio = exponent / (exponent + 1)
    potential = _scaled_potential(onset)

    def newton(_, u):
        y = onset**2 * u
        residual = y * u * _scaled_potential(y) + exponent_ratio * u - potential
        return u - residual / (y / (1 + y) + exponent_ratio)

    # G is convex and G >= 0, so Newton's method descends from the start to the root.
    return lax.fori_loop(0, 8, newton, potential / exponent_ratio)


def _scaled_potential(y):
    """Return (y - log(1 + y)) / y^2 for y >= 0."""
    small = y < 0.1
    low = jnp.where(small, y, 0.0)
    # With log(1 + y) = 2 artanh(z), z = y / (2 + y), the leading terms cancel in closed form.
    square = (low / (2 + low)) ** 2
    series = jnp.zeros_like(y)
    for k in reversed(range(6)):
        series = series * square + 1 / (2 * k + 3)
    high = jnp.where(small, 1.0, y)
    return jnp.where(
        small,
        1 / (2 + low) - 2 * low / (2 + low) ** 3 * series,
        (high - jnp.log1p(high)) / high**2,
    )


# Double-exponential rule on (0, 1): tau = 1 / (1 + exp(-pi sinh(t))).
_QUADRATURE_STEPS = np.arange(-24, 25) * 0.135
_QUADRATURE_NODES = 1 / (1 + np.exp(-np.pi * np.sinh(_QUADRATURE_STEPS)))
_QUADRATURE_LOG_NODES = -np.log1p(np.exp(-np.pi * np.sinh(_QUADRATURE_STEPS)))
_QUADRATURE_WEIGHTS = (
    0.135
    * np.pi
    * np.cosh(_QUADRATURE_STEPS)
    * _QUADRATURE_NODES
    / (1 + np.exp(np.pi * np.sinh(_QUADRATURE_STEPS)))
)


def _duration_integral(half_span, exponent):
    """Integrate R^(-n/(n+1)) over tau in (0, 1), for the duration in `ideal_hunt_crossley`.

    R = (G(S) - G(s)) / (S^2 (1 - s/S)) with 1 - s/S = tau^(n+1) and G(s) = L(s) + log(sinh(s) / s). S is
    `half_span`, and n is `exponent`; L(s) is as in `ideal_hunt_crossley`.
    """
    column = (-1,) + (1,) * half_span.ndim
    log_node = jnp.asarray(_QUADRATURE_LOG_NODES, half_span.dtype).reshape(column)
    weight = jnp.asarray(_QUADRATURE_WEIGHTS, half_span.dtype).reshape(column)
    power = (exponent + 1)[None] * log_node
    # A lower bound keeps 1 - s/S away from 0, where the formula for R is undefined.
    below_end = jnp.exp(jnp.maximum(power, math.log(jnp.finfo(half_span.dtype).tiny) / 2))
    fraction = -jnp.expm1(power)

    small = half_span < _MAX_SERIES_ARGUMENT
    gap = jnp.where(
        small[None],
        _gap_by_series(jnp.where(small, half_span, 0.0)[None], fraction),
        _gap_in_closed_form(jnp.where(small, 1.0, half_span)[None], fraction, below_end),
    )
    return jnp.sum(weight * gap ** -(exponent / (exponent + 1))[None], axis=0)


def _gap_by_series(span, fraction):
    """Return R, as defined in `_duration_integral`, by a power series in S, for small S.

    With S = `span`, r = s / S = `fraction` and the coefficients g_k in `_POTENTIAL_SERIES`,
    R = (1 + r) sum_k g_k S^(2k-2) (1 + r^2 + ... + r^(2k-2)).
    """

    def term(k, carry):
        total, power, partial_sum = carry
        total = total + coefficients[k] * power * partial_sum
        return total, power * span**2, 1 + fraction**2 * partial_sum

    coefficients = jnp.asarray(_POTENTIAL_SERIES, span.dtype)
    ones = jnp.ones_like(fraction)
    total, _, _ = lax.fori_loop(0, _SERIES_ORDERS.size, term, (jnp.zeros_like(fraction), ones, ones))
    return (1 + fraction) * total


def _gap_in_closed_form(span, fraction, below_end):
    """Return R, as defined in `_duration_integral`, in closed form without cancellation near s = S.

    `span` is S, `fraction` is s / S, and `below_end` is 1 - s / S.
    """
    s, distance = span * fraction, span * below_end
    loss = -jnp.expm1(-2 * span)
    # The surplus is defined by sinh(S) = exp(S - s) sinh(s) (1 + surplus).
    surplus = jnp.exp(-2 * s) * jnp.expm1(-2 * distance) / jnp.expm1(-2 * s)
    at_end = below_end < 0.5
    log_fraction = jnp.where(
        at_end,
        jnp.log1p(-jnp.where(at_end, below_end, 0.0)),
        jnp.log(jnp.where(at_end, 1.0, fraction)),
    )
    difference = 2 * distance / loss - 2 * s * surplus / loss + jnp.log1p(surplus) + log_fraction
    return difference / (span**2 * below_end)
