"""Limit of a small control period, by closed forms and by ordinary and delay differential equations in SciPy.

Positions, delays and time are in SI units; `law(d, d')` is the contact force [N] at penetration d > 0 [m].
"""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

TIGHT = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-15}


def delayed_restitution(phase: float) -> float:
    """Return e of x'' = -omega^2 x(t - tau), phase = omega tau, by its series (model.md 6, item 1)."""

    def series(time, derivative):
        terms = range(min(40, int(time / phase) + 1))
        return sum(
            (-1) ** n
            * (time - n * phase) ** (2 * n + 1 - derivative)
            / math.factorial(2 * n + 1 - derivative)
            for n in terms
        )

    separation: float = brentq(lambda time: series(time, 0), 2.0, 4.5, xtol=1e-14)  # type: ignore[assignment]
    return abs(series(separation + phase, 1))


def separates_at_no_force(ratio: float) -> float:
    """Return e of Kelvin-Voigt contact that ends at F = 0, damping ratio < 1 (model.md section 6, item 3)."""
    root = math.sqrt(1 - ratio**2)
    return math.exp(-ratio / root * math.atan2(2 * ratio * root, 2 * ratio**2 - 1))


def separates_at_surface(ratio: float) -> float:
    """Return e of Kelvin-Voigt contact that ends at the surface, ratio < 1 (model.md section 6, item 3)."""
    return math.exp(-math.pi * ratio / math.sqrt(1 - ratio**2))


def contact(
    mass: float, velocity: float, law: Callable[[float, float], float], depths: tuple[float, ...] = ()
) -> tuple[float, float]:
    """Return (restitution, peak force [N]) of M d'' = -max(0, law) until force or penetration is zero.

    The integration is divided at `depths`, where the formula of the law changes.
    """

    def crossing(level):
        def event(_, y):
            return y[0] - level

        return event

    def slack(_, y):
        return law(*y) if y[1] < 0 else 1.0

    events = [slack, crossing(0.0), *(crossing(depth) for depth in depths)]
    for event in events:
        event.__dict__["terminal"] = True
    events[1].__dict__["direction"] = -1
    state, time, peak = np.array([0.0, velocity]), 0.0, law(0.0, velocity)
    while True:
        solution = solve_ivp(
            lambda _, y: [y[1], -max(0.0, law(*y)) / mass],
            (time, time + 10.0),
            state,
            events=events,
            max_step=1e-3,
            **TIGHT,
        )
        peak = max([peak, *(law(*y) for y in solution.y.T)])
        state, time = solution.y[:, -1], solution.t[-1]
        if solution.t_events[0].size or solution.t_events[1].size:
            return abs(state[1]) / velocity, peak
        # Step off the event; otherwise it is detected again.
        time += 1e-9
        state = state + 1e-9 * np.array([state[1], -law(*state) / mass])


def delayed_contact(
    mass: float,
    velocity: float,
    stiffness: float,
    simulator: tuple[float, float, float],
    force_delay: float,
) -> float:
    """Return the restitution of linear contact with a second-order motion simulator, by the method of steps.

    M x'' = -k max(0, x_a(t - tau_f)), x_a = G x(t - tau_p); `simulator`: angular frequency [rad/s], damping
    ratio, tau_p. The approach is uniform, and both delays are positive.
    """
    frequency, ratio, transport = simulator
    lag = 2 * ratio / frequency + transport
    step = min(transport, force_delay)
    pieces: list[tuple[float, Callable[[float], np.ndarray]]] = []

    def past(time, component):
        if time <= 0 or not pieces:
            # x = v t, and x_a is in steady state.
            return velocity * (time - (lag if component == 2 else 0.0))
        index = min(int(time / step), len(pieces) - 1)
        return pieces[index][1](time)[component]

    def slope(time, y):
        force = stiffness * max(0.0, past(time - force_delay, 2))
        pull = frequency**2 * (past(time - transport, 0) - y[2]) - 2 * ratio * frequency * y[3]
        return [y[1], -force / mass, y[3], pull]

    state = np.array([0.0, velocity, -velocity * lag, velocity])
    for start, end in pairwise(np.arange(0.0, 1.0, step)):
        solution = solve_ivp(slope, (start, end), state, dense_output=True, max_step=step / 4, **TIGHT)
        assert solution.sol is not None
        pieces.append((start, solution.sol))
        state = solution.y[:, -1]
        if state[2] < 0 and state[1] < 0 and past(end - force_delay, 2) < 0:
            return abs(state[1]) / velocity
    raise AssertionError("the contact goes on for longer than a second")
