"""Event-accurate oracle of the exact sampled loop: plain NumPy and SciPy, independent on purpose.

Between two breakpoints of its delayed command the motion simulator's output is the exact solution
of a linear system driven by a constant or a ramp. It is kept as a Taylor polynomial to machine
precision, so that x_a, v_a and the force can be evaluated at any real time. Contact, separation,
changes of slope and turning points are roots found by brentq; they cut the time axis into
`_Piece`s on each of which the force is one smooth formula. Everything else (delays, the sensor's
lag, work, peak) is read off these pieces.

Time inside this module is counted in control periods ("ticks", a float); all other quantities are
SI.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, floor, inf, isfinite
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import brentq, minimize_scalar

TIME_TOLERANCE = 1e-9  # ticks: closer than this, two times are the same
TAYLOR_ORDER = 24
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = (_NODES + 1.0) / 2.0, _WEIGHTS / 2.0
# s -> 3 s^2 - 2 s^3 flattens the integrand at both ends: d^1.5 becomes smooth there.
_SMOOTH_NODES = _NODES**2 * (3.0 - 2.0 * _NODES)
_SMOOTH_WEIGHTS = _WEIGHTS * 6.0 * _NODES * (1.0 - _NODES)


class NoCompensator:
    """F_c = F_measured."""

    def reset(self):
        pass

    def step(self, force_measured, x_desired, v_desired, x_measured):
        return force_measured


class PhaseLead:
    """(1 + T1 s)/(1 + T2 s) by Tustin at period T; states start at 0."""

    def __init__(self, T1, T2, T):
        self.lead, self.lag = 2.0 * T1 / T, 2.0 * T2 / T
        self.reset()

    def reset(self):
        self.force, self.output = 0.0, 0.0

    def step(self, force_measured, x_desired, v_desired, x_measured):
        numerator = (1.0 + self.lead) * force_measured + (1.0 - self.lead) * self.force
        self.output = (numerator - (1.0 - self.lag) * self.output) / (1.0 + self.lag)
        self.force = force_measured
        return self.output


def simulate(
    mechanism,
    compensator=None,
    *,
    contacts=None,
    force_noise=None,
    position_noise=None,
    noise_level=None,
    first_force_zero=True,
    index_waits_for_exit=True,
    record=False,
    time_limit=10.0,
) -> list[dict[str, Any]]:
    """Run the contacts of a mechanism (the mechanism file, parsed); one dict per contact.

    Keys: restitution, approach_velocity, peak_force [N], work_in, work_out [J], ticks (end_tick -
    begin_tick), begin_tick, end_tick, peak_command [N], excess_variation of the command [N],
    position_shortfall [m], what the velocity limit takes off the position command at most, status
    ('over' or 'timeout'); `record=True` adds per-tick `signals` (of the whole run), among them the
    force just before the tick (`force`).

    The compensator has `reset()` and `step(force, x_d, v_d, x_measured)`; with
    `position_command(x, v, a)` it leads the command, and `next_contact()`, if there, replaces
    `reset()` between contacts. `force_noise` [N] and `position_noise` [m] are sequences indexed by
    tick (a list of sequences: one per fresh run). `noise_level` [N]: below it a command has died
    out (3 noise_std + |bias| unless given). `first_force_zero`: tick 0 commands F_c = 0 whatever
    it reads.

    `index_waits_for_exit`: with clearance, the next stiffness acts only once x_a has left the
    surface (damped contact separates at F = 0 inside it, where a stiffer next entry would push
    again and count as a contact).
    """
    compensator = NoCompensator() if compensator is None else compensator
    approach = mechanism["approach"]
    contacts = int(approach.get("contacts", 1)) if contacts is None else contacts
    options = {
        "noise_level": noise_level,
        "first_force_zero": first_force_zero,
        "index_waits_for_exit": index_waits_for_exit,
        "time_limit": time_limit,
    }
    compensator.reset()
    if mechanism["contact"].get("clearance") is not None:
        noise = _noise_of_run(force_noise, 0), _noise_of_run(position_noise, 0)
        run = _Run(mechanism, compensator, approach["velocity"], 0, noise, **options)
        results = run.contacts(contacts)
        if record:
            results = [dict(result, signals=run.signals()) for result in results]
        return results
    results, velocity = [], approach["velocity"]
    for index in range(contacts):
        if index:
            getattr(compensator, "next_contact", compensator.reset)()
        noise = _noise_of_run(force_noise, index), _noise_of_run(position_noise, index)
        run = _Run(mechanism, compensator, velocity, index, noise, **options)
        (result,) = run.contacts(1)
        if record:
            result["signals"] = run.signals()
        results.append(result)
        velocity = result["restitution"] * result["approach_velocity"]
        if result["status"] != "over" or not velocity > 0.0:
            break
    return results


def delay_in_ticks(delay, period):
    """A delay in ticks; an integer number of them to within 1e-9 is exactly that integer."""
    ticks = delay / period
    return float(round(ticks)) if abs(ticks - round(ticks)) <= TIME_TOLERANCE else ticks


def simulator_matrices(simulator) -> Any:
    """(A, B, C) of G(s), or None for the ideal simulator; states scaled by the fastest pole."""
    model = simulator["model"]
    if model == "ideal":
        return None
    if model == "first_order":
        numerator, denominator = [1.0], [simulator["time_constant"], 1.0]
    elif model == "second_order":
        omega, zeta = 2.0 * np.pi * simulator["natural_frequency"], simulator["damping_ratio"]
        numerator, denominator = [1.0], [1.0 / omega**2, 2.0 * zeta / omega, 1.0]
    elif model == "third_order":
        a1, a2, a3 = simulator["coefficients"]
        numerator, denominator = [1.0], [a3, a2, a1, 1.0]
    elif model == "transfer_function":
        numerator, denominator = simulator["numerator"], simulator["denominator"]
    else:
        raise ValueError(f"unknown simulator model {model!r}")
    numerator = np.trim_zeros(np.asarray(numerator, float), "f")
    denominator = np.trim_zeros(np.asarray(denominator, float), "f")
    poles = np.roots(denominator)
    if len(numerator) >= len(denominator) or np.any(poles.real >= 0.0):
        raise ValueError("the simulator must be strictly proper and stable")
    if abs(numerator[-1] / denominator[-1] - 1.0) > 1e-9:
        raise ValueError("the simulator must have G(0) = 1")
    fastest, order = np.abs(poles).max(), len(denominator) - 1
    scaled = denominator * fastest ** np.arange(order, -1.0, -1.0)
    A = np.diag(np.ones(order - 1), 1)
    A[-1] = -scaled[:0:-1] / scaled[0]
    B = np.zeros(order)
    B[-1] = 1.0
    C = np.zeros(order)
    C[: len(numerator)] = (numerator * fastest ** np.arange(len(numerator) - 1, -1.0, -1.0))[::-1]
    return fastest * A, fastest * B, C / scaled[0]


class _Motion:
    """x_a(t) as polynomials: command c(m) -> latency, hold -> u(t) -> transport delay, G(s)."""

    def __init__(self, rig, period, position, velocity, history):
        """Command `position`, `velocity` at t = 0, uniform before; kept `history` ticks back."""
        simulator = rig["simulator"]
        self.period, self.velocity = period, velocity
        self.latency = int(rig.get("command_latency", 0))
        self.hold = rig.get("command_hold", "linear")
        if self.latency not in (0, 1) or self.hold not in ("linear", "zoh"):
            raise ValueError("command_latency is 0 or 1, command_hold linear or zoh")
        self.delay = delay_in_ticks(simulator.get("delay", 0.0), period)
        self.matrices = simulator_matrices(simulator)
        self.position = position
        self.commands: list[float] = [position]
        self.first = -ceil(self.delay + history) - 3
        self.substeps = 1
        if self.matrices is not None:
            A, B, _ = self.matrices
            self.substeps = max(1, ceil(2.0 * np.linalg.norm(A, 2) * period))
            gain: Any = -np.linalg.solve(A, B)
            if self.hold == "linear":
                start = self._command(self.first - self.latency)
                self.state = gain * start + np.linalg.solve(A, gain) * velocity
            else:
                # z = gain U - w with z(t + T) = z(t) + gain v T over every step of the staircase.
                start = self._command(self.first + 1 - self.latency)
                steps = gain * velocity * period
                transition = expm(A * period)
                self.state = gain * start - np.linalg.solve(np.eye(len(B)) - transition, steps)
        self.intervals = []

    def append(self, command):
        self.commands.append(command)

    def _command(self, m) -> float:
        if m >= 0:
            return self.commands[m]
        return self.position + self.velocity * m * self.period

    def segment(self, j, i):
        """Taylor coefficients of x_a on substep i of the interval from j + delay, theta = 0..1."""
        while self.first + len(self.intervals) <= j:
            self.intervals.append(self._solve(self.first + len(self.intervals)))
        return self.intervals[j - self.first][i]

    def _solve(self, j):
        end = self._command(j + 1 - self.latency)
        start = self._command(j - self.latency) if self.hold == "linear" else end
        if self.matrices is None:
            return [np.array([start, end - start])]
        A, B, C = self.matrices
        length, polynomials = self.period / self.substeps, []
        for i in range(self.substeps):
            ramp = (end - start) / self.substeps
            drive = [start + ramp * i, ramp] + [0.0] * TAYLOR_ORDER
            states = [self.state]
            for k in range(TAYLOR_ORDER):
                states.append(length * (A @ states[-1] + B * drive[k]) / (k + 1))
            polynomials.append(np.array([C @ z for z in states]))
            self.state = np.sum(states[::-1], axis=0)
        return polynomials

    def locate_left(self, time):
        """(j, i, theta) of a time as the end of what came before it: theta in (0, 1]."""
        scaled = (time - self.delay) * self.substeps
        q = ceil(scaled - TIME_TOLERANCE * self.substeps) - 1
        j = q // self.substeps
        return j, q - j * self.substeps, min(scaled - q, 1.0)

    def at_left(self, time):
        j, i, theta = self.locate_left(time)
        return float(polyval(theta, self.segment(j, i)))

    def segments_between(self, start, end):
        """(polynomial, origin, theta_a, theta_b) covering (start, end], in order."""
        q = floor((start - self.delay) * self.substeps + TIME_TOLERANCE)
        while True:
            origin = self.delay + q / self.substeps
            theta_a = max(0.0, (start - origin) * self.substeps)
            theta_b = min(1.0, (end - origin) * self.substeps)
            if theta_b <= TIME_TOLERANCE:
                return
            j = q // self.substeps
            if theta_b > theta_a:
                yield self.segment(j, q - j * self.substeps), origin, theta_a, theta_b
            q += 1


class _Law:
    """Contact law: force(d, d') without the clamp, and where the formula changes."""

    def __init__(self, contact, plane=0.0):
        self.kind, self.plane = contact["law"], plane
        kinds = ("linear", "kelvin_voigt", "hunt_crossley", "piecewise_linear")
        if self.kind not in (*kinds, "hardening", "depth_damped", "elastoplastic"):
            raise ValueError(f"unknown contact law {self.kind!r}")
        self.stiffness = _as_list(contact["stiffness"])
        self.damping = [0.0] if self.kind == "linear" else _as_list(contact.get("damping", 0.0))
        self.scale, self.ratio = contact.get("reference_depth"), contact.get("unloading_ratio")
        self.deepest = 0.0  # of the surface in touch, so far; elastoplastic remembers it
        self.exponent = contact.get("exponent", 1.5)
        self.depths = _as_list(contact.get("depths", [])) if self.kind == "piecewise_linear" else []
        self.tension = bool(contact.get("tension", False)) and self.kind == "kelvin_voigt"
        clearance = contact.get("clearance")
        self.clearance = inf if clearance is None else clearance

    def parameters(self, index):
        return (
            self.stiffness[min(index, len(self.stiffness) - 1)],
            self.damping[min(index, len(self.damping) - 1)],
        )

    def clamped(self, index):
        if self.kind == "elastoplastic":
            return True
        return self.parameters(index)[1] != 0.0 and not self.tension

    def damped(self):
        return any(self.damping)

    def levels(self):
        """Positions at which the formula may change."""
        levels = [0.0, *self.depths]
        far = [-self.clearance - depth for depth in levels] if isfinite(self.clearance) else []
        return [self.plane + level for level in (*levels, *far)]

    def side(self, position):
        depth = position - self.plane
        return 1 if depth > 0.0 else (-1 if depth < -self.clearance else 0)

    def penetration(self, position, side):
        depth = position - self.plane
        return depth if side > 0 else -self.clearance - depth

    def raw(self, depth, rate, index, deepest=0.0):
        stiffness, damping = self.parameters(index)
        depth = np.maximum(depth, 0.0)
        if self.kind == "hunt_crossley":
            return stiffness * depth**self.exponent * (1.0 + 1.5 * damping * rate)
        if self.kind == "piecewise_linear":
            edges = [0.0, *self.depths, inf]
            force = damping * rate
            for slope, low, high in zip(stiffness, edges[:-1], edges[1:], strict=True):
                force = force + slope * np.clip(depth - low, 0.0, high - low)
            return force
        if self.kind == "hardening":
            return stiffness * (depth + depth**3 / self.scale**2) + damping * rate
        if self.kind == "depth_damped":
            return depth * self.sign_of(depth, rate, index)
        if self.kind == "elastoplastic":
            # Two lines through the point at the deepest penetration; the virgin one is met by way of max.
            peak = np.maximum(depth, deepest)
            return stiffness * (peak - self.ratio * (peak - depth))
        return stiffness * depth + damping * rate

    def sign_of(self, depth, rate, index, deepest=0.0):
        """A function with the sign of the unclamped force, without its d^n (which hides the root)."""
        if self.kind == "hunt_crossley":
            return 1.0 + 1.5 * self.parameters(index)[1] * rate + 0.0 * depth
        if self.kind == "depth_damped":
            stiffness, damping = self.parameters(index)
            return stiffness * np.maximum(depth, 0.0) ** (self.exponent - 1.0) + damping * rate / self.scale
        return self.raw(depth, rate, index, deepest)


@dataclass
class _Piece:
    """A stretch of time on which the force is one smooth formula (0 when `side` is 0)."""

    origin: float  # ticks
    length: float  # ticks per unit of theta
    theta: tuple
    position: np.ndarray
    velocity: np.ndarray  # m/s, coefficients in theta
    side: int
    index: int
    deepest: float  # when it begins
    law: _Law = field(repr=False)

    @property
    def start(self):
        return self.origin + self.theta[0] * self.length

    @property
    def end(self):
        return self.origin + self.theta[1] * self.length

    def motion(self, theta):
        return polyval(theta, self.position), polyval(theta, self.velocity)

    def force(self, theta):
        """Force along +x's reaction: positive on the surface at 0, negative on the one at -clearance."""
        if self.side == 0:
            return np.zeros_like(np.asarray(theta, float))
        x, v = self.motion(theta)
        depth = self.law.penetration(x, self.side)
        return self.side * self.law.raw(depth, self.side * v, self.index, self.deepest)

    def force_at(self, time):
        theta = (time - self.origin) / self.length
        return float(self.force(min(max(theta, self.theta[0]), self.theta[1])))


class _Run:
    """One run of the loop from t = 0."""

    def __init__(
        self,
        mechanism,
        compensator,
        velocity,
        index,
        noise,
        *,
        noise_level,
        first_force_zero,
        index_waits_for_exit,
        time_limit,
    ):
        bodies, rig, approach = mechanism["bodies"], mechanism["rig"], mechanism["approach"]
        self.period = T = rig["control_period"]
        if "equivalent_mass" in bodies:
            self.mass = bodies["equivalent_mass"]
        else:
            m1, m2 = bodies["chaser_mass"], bodies["target_mass"]
            self.mass = m1 * m2 / (m1 + m2)
        self.integrator = rig.get("integrator", "semi_implicit_euler")
        if self.integrator not in ("semi_implicit_euler", "zoh", "explicit_euler"):
            raise ValueError(f"unknown integrator {self.integrator!r}")
        self.law = _Law(mechanism["contact"], rig.get("contact_plane", 0.0))
        self.index, self.law_index = index, index
        self.index_waits_for_exit = index_waits_for_exit
        self.compensator = compensator
        self.first_force_zero, self.time_limit = first_force_zero, time_limit
        self.force_noise, self.position_noise = noise

        sensor = rig.get("force_sensor", {})
        self.sensor = sensor
        self.force_delay = delay_in_ticks(sensor.get("delay", 0.0), T)
        self.lag = sensor.get("time_constant", 0.0)
        self.lag_state = 0.0
        std, bias = sensor.get("noise_std", 0.0), sensor.get("bias", 0.0)
        self.noisy = std != 0.0 or bias != 0.0 or self.force_noise is not None
        self.noise_level = 3.0 * std + abs(bias) if noise_level is None else noise_level
        self.quiet_ticks = self.force_delay + 20.0 * self.lag / T + 2.0
        position_sensor = rig.get("position_sensor", {})
        self.position_quantum = position_sensor.get("quantum", 0.0)
        self.position_delay = delay_in_ticks(position_sensor.get("delay", 0.0), T)

        simulator = rig["simulator"]
        if isfinite(simulator.get("acceleration_limit", inf)):
            raise NotImplementedError("acceleration_limit is not part of the oracle")
        self.velocity_limit = simulator.get("velocity_limit", inf)
        self.x = -velocity * (0.02 + approach.get("phase", 1.0 / 3.0) * T)
        self.v = velocity
        if self.x <= -self.law.clearance:
            raise ValueError("the start must lie inside the gap")
        start = self._lead(self.x, self.v, 0.0)
        self.motion = _Motion(rig, T, start, velocity, self.position_delay)
        self.ideal_zoh = self.motion.matrices is None and self.motion.hold == "zoh"
        if self.ideal_zoh and self.law.damped():
            raise ValueError("ideal simulator with zoh hold has no velocity: refuse damped laws")

        self.pieces, self.cursor = [], 0
        self.last_force_end, self.last_side = -inf, 1
        self.jump_position = None
        self.died_out, self.armed = 0.0, True
        self.log, self.shortfalls = [], [0.0]

    def contacts(self, count):
        results, n = [], 0
        while len(results) < count:
            result, n = self._contact(n)
            results.append(result)
            if result["status"] != "over":
                break
            self.index += 1
        return results

    def signals(self) -> dict[str, np.ndarray]:
        names = ("tick", "x_desired", "v_desired", "x_actual", "force", "force_measured")
        names += ("x_measured", "force_command")
        return dict(zip(names, np.array(self.log).T, strict=True))

    def _contact(self, n):
        """Ticks from n on until a contact is over; (result, first tick after it)."""
        T = self.period
        self.peak = self.work_in = self.work_out = 0.0
        self.reached = False
        begin, waiting, quiet, peak_command, approach_velocity = None, None, 0.0, 0.0, None
        first, before = n, abs(self.log[-1][2]) if self.log else self.v
        # In a gap, what is left of the last contact's command does not begin a new one.
        floor_command = self.died_out
        patience = self.time_limit / T
        if isfinite(self.law.clearance):
            patience += self.law.clearance / max(abs(self.v), 1e-9) / T
        while True:
            touched = self._advance(n)
            actual = self.motion.at_left(n)
            if not self.index_waits_for_exit or self.law.side(actual) == 0:
                self.law_index = self.index
            force, position = self._read_force(n), self._read_position(n)
            x, v = self.x, self.v
            command = float(self.compensator.step(force, x, v, position))
            if n == 0 and self.first_force_zero:
                command = 0.0
            self.log.append((n, x, v, actual, self._true_force(n), force, position, command))
            if begin is None:
                if self.noisy:
                    at_surface = self.reached or x >= 0.0 or x <= -self.law.clearance
                    begins = touched or (self.armed and at_surface)
                    # Both positions must be back in the gap before one reaches a surface again.
                    self.armed = self.armed or not at_surface
                    self.reached = False
                else:
                    begins = touched or abs(command) > floor_command
                if begins:
                    begin, approach_velocity = n, before
                    if not touched:
                        self.last_side = 1 if x > -self.law.clearance / 2.0 else -1
            status = None
            if begin is not None:
                peak_command = max(peak_command, abs(command))
                quiet = n - self.last_force_end >= self.quiet_ticks - TIME_TOLERANCE
                if quiet and v * self.last_side < 0.0:
                    waiting = n if waiting is None else waiting
                    level = max(1e-6 * peak_command, self.noise_level)
                    if abs(command) <= level or (n - waiting) * T >= 0.1 - TIME_TOLERANCE * T:
                        status, self.died_out = "over", max(level, abs(command))
                        self.armed = False
                else:
                    waiting = None
                if status is None and (n - begin) * T >= self.time_limit:
                    status = "timeout"
            elif n - first >= patience or not isfinite(command):
                status = "timeout"
            before = abs(v)
            self._integrate(command)
            if status is None and not (isfinite(command) and isfinite(self.x)):
                status = "timeout"
            n += 1
            if status is not None:
                break
        approach_velocity = before if approach_velocity is None else approach_velocity
        end = n - 1
        result = {
            "restitution": abs(v) / approach_velocity,
            "approach_velocity": approach_velocity,
            "peak_force": self.peak,
            "work_in": float(self.work_in),
            "work_out": float(self.work_out),
            "ticks": end - (end if begin is None else begin),
            "begin_tick": begin,
            "end_tick": end,
            "peak_command": peak_command,
            "excess_variation": _excess_variation([tick[-1] for tick in self.log[begin:n]]),
            "position_shortfall": 0.0 if begin is None else max(self.shortfalls[begin:n]),
            "status": status,
        }
        return result, n

    def _integrate(self, command):
        T, a = self.period, -command / self.mass
        if self.integrator == "semi_implicit_euler":
            self.v += T * a
            self.x += T * self.v
        elif self.integrator == "zoh":
            self.x += T * self.v + T * T * a / 2.0
            self.v += T * a
        else:
            self.x += T * self.v
            self.v += T * a
        last, limit = self.motion.commands[-1], self.velocity_limit * T
        wanted = self._lead(self.x, self.v, a)
        if abs(wanted - last) > limit * (1.0 + 1e-12):
            self.motion.append(last + limit if wanted > last else last - limit)
        else:
            self.motion.append(wanted)
        self.shortfalls.append(abs(wanted - self.motion.commands[-1]))

    def _lead(self, x, v, a):
        lead = getattr(self.compensator, "position_command", None)
        return x if lead is None else float(lead(x, v, a))

    def _advance(self, n):
        """Cut (n - 1, n] into pieces, add up work and peak; whether the force differed from 0 in it."""
        touched = False
        if n == 0:
            return touched
        for position, origin, a, b in self.motion.segments_between(n - 1, n):
            if self.ideal_zoh:
                self._jump(position[0])
            velocity = polyder(position) * self.motion.substeps / self.period
            for theta, side, reached, deepest in _cut(position, velocity, a, b, self.law, self.law_index):
                length = 1.0 / self.motion.substeps
                piece = _Piece(
                    origin, length, theta, position, velocity, side, self.law_index, deepest, self.law
                )
                self.pieces.append(piece)
                self.reached |= reached
                if side:
                    touched = True
                    self.last_force_end, self.last_side = piece.end, side
                    self._account(piece)
        return touched

    def _jump(self, position):
        """Work along a jump of the position (ideal simulator, zoh hold, undamped law)."""
        before, self.jump_position = self.jump_position, position
        if before is None or before == position:
            return
        for side in (1, -1):
            if side < 0 and not isfinite(self.law.clearance):
                continue
            d1, d2 = (max(0.0, self.law.penetration(p, side)) for p in (before, position))
            edges = sorted({d1, d2, *(e for e in self.law.depths if min(d1, d2) < e < max(d1, d2))})
            for low, high in pairwise(edges):
                work = quad(lambda d: float(self.law.raw(d, 0.0, self.law_index)), low, high, epsrel=1e-12)[0]
                if d2 > d1:
                    self.work_in += work
                else:
                    self.work_out += work

    def _account(self, piece):
        a, b = piece.theta
        theta = a + (b - a) * _SMOOTH_NODES
        _, v = piece.motion(theta)
        power = piece.force(theta) * v * _SMOOTH_WEIGHTS * (b - a) * piece.length * self.period
        inward = np.sum(power)  # v has one sign on a piece
        if np.sum(v) * piece.side > 0.0:
            self.work_in += inward
        else:
            self.work_out -= inward
        theta = np.concatenate([[a], theta, [b]])
        magnitude = np.abs(piece.force(theta))
        best = int(np.argmax(magnitude))
        if magnitude[best] > self.peak:
            self.peak = float(magnitude[best])
            bounds = theta[max(best - 1, 0)], theta[min(best + 1, len(theta) - 1)]
            if 0 < best < len(theta) - 1 and bounds[1] > bounds[0]:
                found: Any = minimize_scalar(
                    lambda s: -abs(float(piece.force(s))),
                    bounds=bounds,
                    method="bounded",
                    options={"xatol": 1e-10},
                )
                self.peak = max(self.peak, -float(found.fun))

    def _true_force(self, time):
        """F just before `time` (ticks); 0 before t = 0."""
        if time <= TIME_TOLERANCE:
            return 0.0
        for piece in reversed(self.pieces):
            if piece.start < time - TIME_TOLERANCE:
                return piece.force_at(time)
        return 0.0

    def _read_force(self, n):
        if self.lag > 0.0:
            force = self._lagged(n)
        else:
            force = self._true_force(n - self.force_delay)
        force += self.sensor.get("bias", 0.0)
        force += 0.0 if self.force_noise is None else self.force_noise[n]
        force = _quantise(force, self.sensor.get("quantum", 0.0))
        force = np.sign(force) * max(0.0, abs(force) - self.sensor.get("dead_zone", 0.0))
        limit = self.sensor.get("range", inf)
        return float(min(max(force, -limit), limit))

    def _lagged(self, n):
        """The lag's output at t_n: lag y' = F(t - tau_f) - y, exact over the last period."""
        if n == 0:
            return 0.0
        start, end = n - 1 - self.force_delay, n - self.force_delay
        rate = self.period / self.lag
        total = 0.0
        while self.cursor < len(self.pieces) and self.pieces[self.cursor].end <= start:
            self.cursor += 1
        for piece in self.pieces[self.cursor :]:
            a, b = max(piece.start, start), min(piece.end, end)
            if piece.start >= end:
                break
            if piece.side == 0 or b <= a:
                continue
            parts = max(1, ceil((b - a) * rate))
            edges = np.linspace(a, b, parts + 1)
            for low, high in pairwise(edges):
                if (end - high) * rate > 50.0:
                    continue
                times = low + (high - low) * _SMOOTH_NODES
                forces = piece.force((times - piece.origin) / piece.length)
                kernel = rate * np.exp(-(end - times) * rate)
                total += float(np.sum(forces * kernel * _SMOOTH_WEIGHTS) * (high - low))
        self.lag_state = float(np.exp(-rate)) * self.lag_state + total
        return self.lag_state

    def _read_position(self, n):
        position = self.motion.at_left(n - self.position_delay)
        position += 0.0 if self.position_noise is None else self.position_noise[n]
        return float(_quantise(position, self.position_quantum))


def _cut(position, velocity, a, b, law, index):
    """Cut theta in [a, b] where the force's formula changes: [((start, end), side, reached, deepest)].

    `deepest` is the law's when the piece begins; by the end of the pieces the law has that of the last.
    """

    def x(s):
        return float(polyval(s, position))

    def v(s):
        return float(polyval(s, velocity))

    turning = [a, *_roots(v, a, b), b]
    cuts = {a, b, *turning}
    for low, high in pairwise(turning):
        dent = [law.plane + law.deepest, law.plane - law.clearance - law.deepest]
        dent = dent if law.kind == "elastoplastic" else []
        for level in [
            *law.levels(),
            *(d for d in dent if isfinite(d)),
        ]:  # x is monotone here: one root at most
            cuts.update(_roots(lambda s, level=level: x(s) - level, low, high, samples=1))
    cuts = sorted(cuts)
    pieces = []
    for low, high in pairwise(cuts):
        side = law.side(x((low + high) / 2.0))
        edges = [low, high]
        clamped = side != 0 and law.clamped(index)

        def sign(s, side=side):
            return float(law.sign_of(law.penetration(x(s), side), side * v(s), index, law.deepest))

        if side == 0:
            law.deepest = 0.0
        if clamped:
            edges = [low, *_roots(sign, low, high), high]
        for start, end in pairwise(edges):
            if end - start <= 1e-14:
                continue
            active = side if not clamped or sign((start + end) / 2.0) > 0.0 else 0
            pieces.append(((start, end), active, side != 0, law.deepest))
        if side != 0:
            law.deepest = max(law.deepest, law.penetration(x(high), side))
    return pieces


def _roots(function, a, b, samples=8):
    """Sign changes of a smooth function in (a, b), each refined to rounding."""
    grid = np.linspace(a, b, samples + 1)
    values = [function(s) for s in grid]
    found = []
    for low, high, f_low, f_high in zip(grid[:-1], grid[1:], values[:-1], values[1:], strict=True):
        if f_low * f_high < 0.0:
            root: Any = brentq(function, low, high, xtol=1e-15)
            found.append(float(root))
        elif f_high == 0.0 and high < b:
            found.append(float(high))
    return found


def _excess_variation(commands):
    """Half of the command's total variation, from 0 to 0, less its range."""
    path = np.array([0.0, *commands, 0.0])
    return float(np.sum(np.abs(np.diff(path))) / 2.0 - np.ptp(path))


def _as_list(value):
    return list(value) if isinstance(value, (list, tuple)) else [value]


def _quantise(value, quantum):
    return quantum * np.round(value / quantum) if quantum > 0.0 else value


def _noise_of_run(noise, index):
    if noise is None or np.ndim(noise[0]) == 0:
        return noise
    return noise[min(index, len(noise) - 1)]
