"""Integration of the whole hybrid loop by SciPy's `solve_ivp`: slow, and independent of the oracle.

Method of steps: the simulator's differential equation is restarted at every break of its delayed command and
at every event of the contact. The sensor's lag is then integrated numerically for the resulting force.
"""

from math import exp, pi

import numpy as np
from scipy.integrate import solve_ivp

OPTIONS = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-16}
BEFORE = -300  # ticks: start so early that the initial transient has decayed at t = 0


def brute_force(case, compensator, ticks, mass, velocity):
    """Return the desired velocity v_d [m/s] at every tick, for a second-order motion simulator."""
    T = case["rig"]["control_period"]
    x, v = -velocity * (0.02 + T / 3), velocity
    commands = {m: x + velocity * m * T for m in range(-2000, 1)}
    contact, simulator = _Contact(case["contact"]), _Simulator(case["rig"], commands, velocity)
    lag = _Lag(case["rig"]["force_sensor"], contact, simulator)
    simulator.move(0.0, contact)
    lagged, speeds = 0.0, []
    for n in range(ticks):
        if n:
            simulator.move(n * T, contact)
            lagged = lag.over((n - 1) * T, n * T, lagged)
        speeds.append(v)
        command = compensator.step(lagged, x, v, simulator.state[0])
        v -= T * command / mass
        x += T * v
        commands[n + 1] = x
    return np.array(speeds)


class _Contact:
    """Force of Kelvin-Voigt or Hertzian contact, and the depths at which its formula changes."""

    def __init__(self, contact):
        self.is_hertzian = contact["law"] == "hunt_crossley"
        self.k, self.b = contact["stiffness"][0], contact["damping"][0]

    def force(self, state):
        depth, rate = state
        if self.is_hertzian:
            return self.k * max(depth, 0.0) ** 1.5 * (1 + 1.5 * self.b * rate)
        return max(0.0, self.k * depth + self.b * rate) if depth > 0 else 0.0

    def events(self):
        def surface(t, y):
            return y[0]

        def no_force(t, y):
            return self.k * y[0] + self.b * y[1]

        for event in (surface, no_force):
            event.__dict__["terminal"] = True
        return [surface, no_force]


class _Simulator:
    """Position and velocity of a second-order simulator with transport delay."""

    def __init__(self, rig, commands, velocity):
        simulator = rig["simulator"]
        self.T, self.delay, self.latency = rig["control_period"], simulator["delay"], rig["command_latency"]
        self.zoh = rig["command_hold"] == "zoh"
        self.w, self.zeta = 2 * pi * simulator["natural_frequency"], simulator["damping_ratio"]
        self.commands = commands
        self.time = (BEFORE + self.delay / self.T) * self.T
        self.state = np.array([commands[BEFORE + 1 - self.latency], velocity])
        self.dense = []  # (start, end, solution)

    def move(self, until, contact):
        while self.time < until - 1e-15:
            j = int(np.floor((self.time - self.delay) / self.T + 1e-7))
            end = min(until, (j + 1) * self.T + self.delay)
            self._solve(self._equation(j), end, contact.events())
            self.time = end

    def _equation(self, j):
        u1 = self.commands[j + 1 - self.latency]
        u0 = u1 if self.zoh else self.commands[j - self.latency]
        origin, w = j * self.T + self.delay, self.w

        def rhs(t, y):
            u = u0 + (u1 - u0) * (t - origin) / self.T
            return [y[1], w * w * (u - y[0]) - 2 * self.zeta * w * y[1]]

        return rhs

    def _solve(self, rhs, end, events):
        while end - self.time > 1e-15:
            span = self.time, end
            solution = solve_ivp(rhs, span, self.state, events=events, dense_output=True, **OPTIONS)
            self.dense.append((self.time, solution.t[-1], solution.sol))
            self.time, self.state = solution.t[-1], solution.y[:, -1]
            if solution.status == 1 and end - self.time > 1e-12:  # continue just after the event
                nudge = solve_ivp(rhs, (self.time, self.time + 1e-12), self.state, **OPTIONS)
                self.time, self.state = nudge.t[-1], nudge.y[:, -1]


class _Lag:
    """Force after the delay and first-order lag of the sensor."""

    def __init__(self, sensor, contact, simulator):
        self.delay, self.time_constant = sensor["delay"], sensor["time_constant"]
        self.contact, self.simulator = contact, simulator

    def over(self, a, b, value):
        """Return the sensor's output at time b [s] for output `value` at time a [s]."""
        lag = self.time_constant
        for start, end, solution in self.simulator.dense[-60:]:
            low, high = max(start + self.delay, a), min(end + self.delay, b)
            if not high > low >= self.delay:
                continue

            def force(t, solution=solution):
                return self.contact.force(solution(t - self.delay))

            if force((low + high) / 2) == 0.0:
                value *= exp(-(high - low) / lag)
                continue
            solved = solve_ivp(lambda t, y, f=force: (f(t) - y) / lag, (low, high), [value], **OPTIONS)
            value = solved.y[0, -1]
        return value
