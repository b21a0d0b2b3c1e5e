"""Continuous-time simulator of a docking rig in NumPy and SciPy that shares no code with jaxhil.

The commands are straight lines between ticks. Delays, motion simulator and sensor filter are exact for such
commands on a grid of 40 points per control period; contact is evaluated on the same grid.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

POINTS = 40  # fine points per control period
LOGGER = 15  # fine points by which a force logger with its own clock samples before the tick
WARM_UP = 0.6  # s of uniform motion before the first tick, in which the slowest drive settles to 1e-9
LONGEST = 1.5  # duration beyond which contacts count as never ending [s]


@dataclass(frozen=True)
class Rig:
    """Rig with one axis, in SI units; frequencies and cutoffs are in Hz."""

    period: float = 0.001
    mass: float = 350.0
    stiffness: float = 1.2e5
    damping: float = 0.0
    friction: float = 0.0  # Coulomb friction along the penetration
    plane: float = 0.0  # position of the mechanism's surface
    frequency: float = 15.0  # natural frequency of the motion simulator
    ratio: float = 0.8  # its damping ratio
    drive_delay: float = 0.0
    window: float = 0.0  # if positive, the motion simulator is a moving average of this length
    mode: float = 0.0  # if positive, frequency of the structure between motion simulator and contact
    mode_ratio: float = 0.02
    mode_mass: float = 19.0
    force_delay: float = 0.0
    filter_order: int = 0  # Butterworth filter of the force; order 1 is a lag
    cutoff: float = 100.0
    dead_zone: float = 0.0
    cut: bool = False  # if true, the dead zone is not subtracted from forces beyond it
    position_delay: float = 0.0
    integrator: str = "semi_implicit_euler"  # or zoh

    def force(self, position, velocity):
        """Return the contact force; the surface never pulls."""
        depth = position - self.plane
        force = self.stiffness * depth + self.damping * velocity + self.friction * np.sign(velocity)
        return np.where((depth > 0) & (force > 0), force, 0.0)

    def push(self, position, velocity):
        """Return the contact force for one position and velocity, as a float."""
        depth = position - self.plane
        if depth <= 0:
            return 0.0
        friction = self.friction if velocity > 0 else -self.friction
        return max(0.0, self.stiffness * depth + self.damping * velocity + friction)

    def read_force(self, force):
        """Return the force reading after the dead zone."""
        beyond = np.abs(force) > self.dead_zone
        return np.where(beyond, force if self.cut else force - np.sign(force) * self.dead_zone, 0.0)

    def integrate(self, position, velocity, command):
        """Return position and velocity of the numerical model one period later."""
        faster = velocity - self.period * command / self.mass
        mean = faster if self.integrator == "semi_implicit_euler" else (velocity + faster) / 2
        return position + self.period * mean, faster


class Filter:
    """Linear filter with state, exact for inputs that are piecewise linear between points."""

    def __init__(self, numerator, denominator, step, lanes):
        discrete: Any = cont2discrete((numerator, denominator), step, method="foh")
        numerator, denominator, _ = discrete
        self.numerator, self.denominator = np.ravel(numerator), denominator
        self.state = np.zeros((len(denominator) - 1, lanes))

    def __call__(self, values):
        """Return the response at the points (rows) of each lane (column)."""
        response, self.state = lfilter(self.numerator, self.denominator, values, axis=0, zi=self.state)
        return response


class Delay:
    """Delay line with linear interpolation between points."""

    def __init__(self, delay, step, lanes):
        whole, self.fraction = divmod(delay / step, 1)
        self.line = np.zeros((int(whole) + 1, lanes))

    def __call__(self, values):
        """Return the delayed values of each lane (column)."""
        line = np.concatenate([self.line, values])
        self.line = line[len(values) :]
        return (1 - self.fraction) * line[1 : len(values) + 1] + self.fraction * line[: len(values)]


class Plant:
    """Motion simulator, mechanism and sensors between two ticks, for several contacts (lanes) at once."""

    def __init__(self, rig, start):
        self.rig, self.start, self.step = rig, start, rig.period / POINTS
        lanes, step, omega = len(start), self.step, 2 * np.pi * rig.frequency
        denominator = [1, 2 * rig.ratio * omega, omega**2]
        self.drive_delay = Delay(rig.drive_delay, step, lanes)
        self.position = Filter([omega**2], denominator, step, lanes)
        self.velocity = Filter([omega**2, 0], denominator, step, lanes)
        self.force_delay = Delay(rig.force_delay, step, lanes)
        self.position_delay = Delay(rig.position_delay, step, lanes)
        self.command = np.zeros(lanes)
        self.oldest = (Delay(rig.window, step, lanes), Delay(rig.window, step, lanes))
        self.filter = None
        if rig.filter_order:
            angles = np.pi * (2 * np.arange(rig.filter_order) + rig.filter_order + 1) / (2 * rig.filter_order)
            poles = 2 * np.pi * rig.cutoff * np.exp(1j * angles)
            denominator = np.real(np.poly(poles))
            self.filter = Filter(denominator[-1:], denominator, step, lanes)
        self.structure = [(0.0, 0.0)] * lanes

    def __call__(self, commands):
        """Advance over the ticks of `commands` (rows); return force, force reading and position reading.

        The returned arrays have one row per fine point; the last row is the last tick.
        """
        targets = np.concatenate([self.command[None], commands - self.start])
        self.command = targets[-1]
        share = (np.arange(POINTS) + 1)[None, :, None] / POINTS
        lines = targets[:-1, None] + share * np.diff(targets, axis=0)[:, None]
        position, velocity = self._move(self.drive_delay(lines.reshape(-1, len(self.start))))
        force = self._touch(position, velocity)
        reading = self.force_delay(force)
        if self.filter:
            reading = self.filter(reading)
        return force, reading, self.start + self.position_delay(position)

    def _move(self, inputs):
        if not self.rig.window:
            return self.position(inputs), self.velocity(inputs)
        before, integral = (delay.line[-1] for delay in self.oldest)
        middle = (inputs + np.concatenate([before[None], inputs[:-1]])) / 2
        integrals = integral + self.step * np.cumsum(middle, axis=0)
        old, old_integral = self.oldest[0](inputs), self.oldest[1](integrals)
        return (integrals - old_integral) / self.rig.window, (inputs - old) / self.rig.window

    def _touch(self, position, velocity):
        rig, step = self.rig, self.step
        if not rig.mode:
            return rig.force(self.start + position, velocity)
        forces = np.empty_like(position)
        for lane, start in enumerate(self.start.tolist()):
            offset, rate = self.structure[lane]
            for point, (x, v) in enumerate(
                zip(position[:, lane].tolist(), velocity[:, lane].tolist(), strict=True)
            ):
                # Integrate the motion by the midpoint rule.
                acceleration = structure_acceleration(rig, offset, rate, x - step * v, v, start)
                half, half_rate = offset + step / 2 * rate, rate + step / 2 * acceleration
                acceleration = structure_acceleration(rig, half, half_rate, x - step / 2 * v, v, start)
                offset, rate = offset + step * half_rate, rate + step * acceleration
                forces[point, lane] = rig.push(start + offset, rate)
            self.structure[lane] = (offset, rate)
        return forces


def structure_acceleration(rig, offset, rate, x, v, start):
    """Return the acceleration of the structure's contact end for drive position `x` and speed `v`."""
    omega = 2 * np.pi * rig.mode
    spring = 2 * rig.mode_ratio * omega * (v - rate) + omega**2 * (x - offset)
    return spring - rig.push(start + offset, rate) / rig.mode_mass


def drive(rig, commands):
    """Return force, logged force and position without noise under open-loop `commands`, one row per tick."""
    plant = Plant(rig, commands[:1])
    readings = [np.array([[0.0, 0.0, commands[0]]])]
    for begin in range(1, len(commands), 4000):
        _, force, position = plant(commands[begin : begin + 4000, None])
        logger = np.roll(force, LOGGER, axis=0)
        readings.append(np.column_stack([force, logger, position])[POINTS - 1 :: POINTS])
    return np.concatenate(readings).T


def touch(rig, start, speed, controller, ticks, disturb=lambda tick, force, position: (force, position)):
    """Simulate contacts (lanes) from `start` at `speed` and return their ticks.

    `controller` maps force, desired position and velocity, and measured position to the force command;
    `disturb` adds noise to the readings of a tick. The result has one row per tick and the columns largest
    real force since the last tick, force reading, force command, desired position, desired velocity, position
    reading, logged force without noise; each with one entry per lane.
    """
    plant = Plant(rig, start - speed * WARM_UP)
    approach = np.arange(round(WARM_UP / rig.period), 0, -1) - 1
    real, force, measured = plant(start - speed * rig.period * approach[:, None])
    position, velocity = start, speed
    rows = []
    for tick in range(ticks):
        reading, sensed = disturb(tick, force[-1], measured[-1])
        reading = rig.read_force(reading)
        command = controller(reading, position, velocity, sensed)
        rows.append([real.max(axis=0), reading, command, position, velocity, sensed, force[-1 - LOGGER]])
        position, velocity = rig.integrate(position, velocity, command)
        real, force, measured = plant(position[None])
    return np.array(rows).transpose(1, 0, 2)


def restitution(rig, speed, law, phase=1 / 3):
    """Return the restitution of the rig's first contact under a compensator's `step`, without noise.

    `phase` states at which point of a control period the contact begins (0 to 1).

    As stated in the guide, the contact ends when no real force has acted for longer than the sensor's memory,
    and the command has fallen below 1e-6 of its peak (at most 0.1 s later).
    """
    start = min(rig.plane, 0.0) - speed * (0.02 + phase * rig.period)

    def controller(force, position, velocity, measured):
        values = (float(v[0]) for v in (force, position, velocity, measured))
        return np.array([law(*values)])

    ticks = round(LONGEST / rig.period)
    memory = rig.force_delay + 2 * rig.period
    memory += 20 * rig.filter_order / (2 * np.pi * rig.cutoff) if rig.filter_order else 0.0
    real, _, command, _, velocity, *_ = touch(rig, np.array([start]), np.array([speed]), controller, ticks)[
        :, :, 0
    ]
    peak = np.maximum.accumulate(np.abs(command))
    last = np.flatnonzero(real > 0)
    # Find the last contact before the final release of the body.
    for index, end in enumerate(last):
        quiet_until = last[index + 1] if index + 1 < len(last) else ticks
        over = np.arange(end + 1 + int(memory / rig.period), quiet_until)
        waited = (over - end) * rig.period - memory > 0.1
        done = over[(velocity[over] < 0) & (waited | (np.abs(command[over]) < 1e-6 * peak[over]))]
        if len(done):
            return float(-velocity[done[0]] / speed)
    return np.inf


def ideal_restitution(rig, speed):
    """Return the restitution of the same contact without delays and with an ideal drive."""
    rig = replace(rig, plane=0.0)

    def rates(_, state):
        x, v, offset, rate = state
        if not rig.mode:
            return [v, -rig.push(x, v) / rig.mass, 0.0, 0.0]
        acceleration = structure_acceleration(rig, offset, rate, x, v, 0.0)
        return [v, -rig.push(offset, rate) / rig.mass, rate, acceleration]

    duration = 2 * np.pi * np.sqrt(rig.mass / rig.stiffness)
    result = solve_ivp(
        rates,
        (0, duration),
        [0, speed, 0, speed if rig.mode else 0],
        max_step=duration / 4000,
        rtol=1e-8,
        atol=1e-12,
    )
    return float(-result.y[1, -1] / speed)
