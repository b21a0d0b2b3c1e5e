"""Event-accurate oracle of the exact sampled loop in plain NumPy and SciPy, independent of the simulation.

The motion simulator's output is a polynomial in time (`oracle_motion`), and the contact force is one smooth
formula on each of the segments between events (`oracle_contact`). Sensor readings (delayed, lagging,
quantised; `oracle_sensors`) are evaluated on these segments; then the compensator computes the command, and
the numerical model is integrated.
Time inside this module is counted in control periods ("ticks", a float); all other quantities are in SI
units.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyder
from oracle_contact import Law, Piece, Work, cut
from oracle_motion import TIME_TOLERANCE, Motion, delay_in_ticks
from oracle_sensors import LaggingSensor, quantise


class NoCompensator:
    """Compensator F_c = F_measured."""

    def reset(self):
        pass

    def step(self, force_measured, x_desired, v_desired, x_measured):
        return force_measured


def simulate(
    mechanism,
    compensator=None,
    *,
    contacts=None,
    force_noise=None,
    position_noise=None,
    record=False,
    **options,
) -> list[dict[str, Any]]:
    """Simulate the contacts of a mechanism (parsed mechanism file); return one dict per contact.

    Keys: restitution, approach_velocity, peak_force [N], duration [s], work_in, work_out [J], ticks (end_tick
    - begin_tick), begin_tick, end_tick, peak_command [N], excess_variation [N] of the command,
    position_shortfall [m] (largest reduction of the position command by the velocity limit), status ('over'
    or 'timeout'); `record=True` adds per-tick `signals` of the whole run, among them the force just before
    the tick (`force`). The compensator has `reset()` and `step(force, x_d, v_d, x_measured)`; an optional
    `position_command(x, v, a)` modifies the position command, and an optional `next_contact()` replaces
    `reset()` between contacts. `force_noise` [N] and `position_noise` [m] are sequences indexed by tick (a
    list of sequences: one per run). With `first_force_zero`, tick 0 commands F_c = 0 for any reading. With
    `index_waits_for_exit` and a clearance, the next stiffness applies only after x_a has left the surface. A
    damped contact separates at F = 0 while x_a is still beyond the surface, where a stiffer contact law would
    push again and count as another contact. `jitter` is the deviation of the force's delay [s] at every tick;
    `lost` and `missed` contain the ticks whose reading is lost, and that the controller misses.
    """
    compensator = NoCompensator() if compensator is None else compensator
    approach = mechanism["approach"]
    contacts = int(approach.get("contacts", 1)) if contacts is None else contacts
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


@dataclass
class _Contact:
    """State of the detection of the current contact."""

    first: int  # first tick at which the contact is searched for
    before: float  # speed on the tick before the contact [m/s]
    floor: float  # threshold of the command that starts a contact [N]
    begin: int | None = None  # tick
    approach_velocity: float | None = None  # m/s
    waiting: int | None = None  # tick since which only the decay of the command is awaited
    peak_command: float = 0.0  # N
    status: str | None = None


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
        first_force_zero=True,
        index_waits_for_exit=True,
        time_limit=10.0,
        jitter=None,
        lost=(),
        missed=(),
    ):
        bodies, rig, approach = mechanism["bodies"], mechanism["rig"], mechanism["approach"]
        self.period = T = rig["control_period"]
        self.mass = _equivalent_mass(bodies)
        self.integrator = rig.get("integrator", "semi_implicit_euler")
        if self.integrator not in ("semi_implicit_euler", "zoh", "explicit_euler"):
            raise ValueError(f"unknown integrator {self.integrator!r}")
        self.law = Law(mechanism["contact"], rig.get("contact_plane", 0.0))
        self.work = Work(self.law, T)
        self.index, self.law_index = index, index
        self.index_waits_for_exit = index_waits_for_exit
        self.compensator = compensator
        self.first_force_zero, self.time_limit = first_force_zero, time_limit
        self.force_noise, self.position_noise = noise

        sensor = rig.get("force_sensor", {})
        self.sensor = sensor
        self.force_delay = delay_in_ticks(sensor.get("delay", 0.0), T)
        self.lag = LaggingSensor(sensor, T)
        std, bias = sensor.get("noise_std", 0.0), sensor.get("bias", 0.0)
        self.noisy = std != 0.0 or bias != 0.0 or self.force_noise is not None
        self.jitter, self.lost, self.missed = jitter, lost, missed
        self.reading = self.command = 0.0
        self.quiet_ticks = (
            self.force_delay + 20.0 * self.lag.time_constant / T + 2.0 + sensor.get("jitter", 0.0) / T
        )
        position_sensor = rig.get("position_sensor", {})
        self.position_quantum = position_sensor.get("quantum", 0.0)
        self.position_delay = delay_in_ticks(position_sensor.get("delay", 0.0), T)

        simulator = rig["simulator"]
        if isfinite(simulator.get("acceleration_limit", inf)):
            raise NotImplementedError("acceleration_limit is not part of the oracle")
        self.velocity_limit = simulator.get("velocity_limit", inf)
        self.x = min(rig.get("contact_plane", 0.0), 0.0)
        self.x -= velocity * (0.02 + approach.get("phase", 1.0 / 3.0) * T)
        self.v = velocity
        if self.x <= -self.law.clearance:
            raise ValueError("the start must lie inside the gap")
        start = self._lead(self.x, self.v, 0.0)
        self.motion = Motion(rig, T, start, velocity, self.position_delay)
        self.ideal_zoh = self.motion.is_ideal and self.motion.hold == "zoh"
        if self.ideal_zoh and self.law.damped():
            raise ValueError("ideal simulator with zoh hold has no velocity: refuse damped laws")

        self.pieces = []
        self.last_force_end, self.last_side = -inf, 1
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
        """Simulate ticks from n on until a contact has ended; return the result and the next tick."""
        # In a gap, the remaining command of the last contact does not begin a new contact.
        contact = _Contact(n, abs(self.log[-1][2]) if self.log else self.v, self.died_out)
        patience = self.time_limit / self.period
        if isfinite(self.law.clearance):
            patience += self.law.clearance / max(abs(self.v), 1e-9) / self.period
        self.work.begin()
        self.reached = False
        while contact.status is None:
            touched, command = self._tick(n)
            if contact.begin is None:
                self._look_for_begin(contact, n, touched, command)
            if contact.begin is not None:
                self._look_for_end(contact, n, command)
            elif n - contact.first >= patience or not isfinite(command):
                contact.status = "timeout"
            contact.before = abs(self.v)
            self._integrate(command, n)
            if contact.status is None and not (isfinite(command) and isfinite(self.x)):
                contact.status = "timeout"
            n += 1
        return self._result(contact, n), n

    def _tick(self, n):
        """Read sensors and compute the command; also return whether a force acted since the last tick."""
        touched = self._advance(n)
        actual = self.motion.at_left(n)
        if not self.index_waits_for_exit or self.law.side(actual) == 0:
            self.law_index = self.index
        force, position = self._read_force(n), self._read_position(n)
        if n and n in self.missed:
            command = self.command
        else:
            command = float(self.compensator.step(force, self.x, self.v, position))
        if n == 0 and self.first_force_zero:
            command = 0.0
        self.log.append((n, self.x, self.v, actual, self._true_force(n), force, position, command))
        return touched, command

    def _look_for_begin(self, contact, n, touched, command):
        if self.noisy:
            at_surface = self.reached or self.x >= 0.0 or self.x <= -self.law.clearance
            begins = touched or (self.armed and at_surface)
            # Both positions must have returned to the gap before a new contact can begin.
            self.armed = self.armed or not at_surface
            self.reached = False
        else:
            begins = touched or abs(command) > contact.floor
        if begins:
            contact.begin, contact.approach_velocity = n, contact.before
            if not touched:
                self.last_side = 1 if self.x > -self.law.clearance / 2.0 else -1

    def _look_for_end(self, contact, n, command):
        T = self.period
        contact.peak_command = max(contact.peak_command, abs(command))
        quiet = n - self.last_force_end >= self.quiet_ticks - TIME_TOLERANCE
        if quiet and self.v * self.last_side < 0.0:
            contact.waiting = n if contact.waiting is None else contact.waiting
            level = 1e-6 * contact.peak_command
            waited = (n - contact.waiting) * T >= 0.1 - TIME_TOLERANCE * T
            # Between two surfaces a contact ends at the latest in the middle of the gap.
            crossed = self.last_side != (1 if self.x > -self.law.clearance / 2.0 else -1)
            if abs(command) <= level or waited or crossed:
                contact.status, self.died_out = "over", max(level, abs(command))
                self.armed = False
        else:
            contact.waiting = None
        if contact.status is None and (n - contact.begin) * T >= self.time_limit:
            contact.status = "timeout"

    def _result(self, contact, n):
        begin, end, rebound = contact.begin, n - 1, contact.before
        approach_velocity = rebound if contact.approach_velocity is None else contact.approach_velocity
        return {
            "restitution": rebound / approach_velocity,
            "approach_velocity": approach_velocity,
            "peak_force": self.work.peak,
            "duration": self.work.duration,
            "work_in": float(self.work.work_in),
            "work_out": float(self.work.work_out),
            "ticks": end - (end if begin is None else begin),
            "begin_tick": begin,
            "end_tick": end,
            "peak_command": contact.peak_command,
            "excess_variation": _excess_variation([tick[-1] for tick in self.log[begin:n]]),
            "position_shortfall": 0.0 if begin is None else max(self.shortfalls[begin:n]),
            "status": contact.status,
        }

    def _integrate(self, command, n):
        self.command = command
        if n and n in self.missed:
            self.motion.append(self.motion.commands[-1])
            self.shortfalls.append(self.shortfalls[-1])
            return
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
        """Divide (n - 1, n] at events; add work and peak force; return whether the force differed from 0."""
        touched = False
        if n == 0:
            return touched
        for position, origin, a, b in self.motion.segments_between(n - 1, n):
            if self.ideal_zoh:
                self.work.jump(position[0], self.law_index)
            velocity = polyder(position) * self.motion.substeps / self.period
            for theta, side, reached, deepest in cut(position, velocity, a, b, self.law, self.law_index):
                length = 1.0 / self.motion.substeps
                piece = Piece(
                    origin, length, theta, position, velocity, side, self.law_index, deepest, self.law
                )
                self.pieces.append(piece)
                self.reached |= reached
                if side:
                    touched = True
                    self.last_force_end, self.last_side = piece.end, side
                    self.work.add(piece)
        return touched

    def _true_force(self, time):
        """Return F just before `time` (ticks); 0 before t = 0."""
        if time <= TIME_TOLERANCE:
            return 0.0
        newest = bisect_left(self.pieces, time - TIME_TOLERANCE, key=lambda piece: piece.start)
        return self.pieces[newest - 1].force_at(time) if newest else 0.0

    def _read_force(self, n):
        if self.lag.time_constant > 0.0:
            force = self.lag.read(n, self.force_delay, self.pieces)
        else:
            late = 0.0 if self.jitter is None else self.jitter[n] / self.period
            force = self._true_force(n - self.force_delay - late)
        force += self.sensor.get("bias", 0.0)
        force += 0.0 if self.force_noise is None else self.force_noise[n]
        force = quantise(force, self.sensor.get("quantum", 0.0))
        beyond = abs(force) - self.sensor.get("dead_zone", 0.0)
        if self.sensor.get("dead_zone_kind") == "cut":
            force = force if beyond > 0.0 else 0.0
        else:
            force = np.sign(force) * max(0.0, beyond)
        limit = self.sensor.get("range", inf)
        if not (n and n in self.lost):
            self.reading = float(min(max(force, -limit), limit))
        return self.reading

    def _read_position(self, n):
        position = self.motion.at_left(n - self.position_delay)
        position += 0.0 if self.position_noise is None else self.position_noise[n]
        return float(quantise(position, self.position_quantum))


def _equivalent_mass(bodies):
    if "equivalent_mass" in bodies:
        return bodies["equivalent_mass"]
    m1, m2 = bodies["chaser_mass"], bodies["target_mass"]
    return m1 * m2 / (m1 + m2)


def _excess_variation(commands):
    """Return half of the command's total variation, from 0 to 0, minus its range."""
    path = np.array([0.0, *commands, 0.0])
    return float(np.sum(np.abs(np.diff(path))) / 2.0 - np.ptp(path))


def _noise_of_run(noise, index):
    if noise is None or np.ndim(noise[0]) == 0:
        return noise
    return noise[min(index, len(noise) - 1)]
