"""Simulated hardware of a rig in plain floats: motion simulator, contact and sensors.

    plant = Plant(mechanism, seed=0)
    plant.begin(position, velocity, command, number)  # begin a run in uniform motion towards contact `number`
    force, position = plant.read()                    # readings of the sensors at this tick
    plant.move(command)                               # apply the next position command for one period

The physics are stages 1, 4 and 5 of `jaxhil.simulation.loop` without JAX, fast enough for real time. Linear
parts are discretised exactly, and delays are exact fractions of a period (`tuning.rig.discretisation`).
"""

import math
from random import Random

from jaxhil.contact.float_law import FloatLaw
from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.structs import Contact, Mechanism
from tuning.rig.discretisation import (
    DELAY_ROUNDING_TOLERANCE,
    MotionRows,
    discretise_simulator,
    evaluate_row,
    split_delay,
)
from tuning.rig.sensor_lag import MotionState, apply_sensor_lag, deepest_penetration

# Motion at the sample of the force, at the interval's start and at its end.
SamplingInterval = tuple[MotionState, MotionState | None, MotionState | None]


class RigHardware:
    """Hardware of the rig without the controller.

    `force` [N] is the newest sample of the real contact force at this tick, `shortfall` [m] the distance by
    which rate limits keep the command from the wanted one.
    """

    def __init__(self, mechanism: Mechanism, seed: int = 0) -> None:
        rig = mechanism.rig
        simulator, period = rig.simulator, rig.control_period
        force_intervals, force_place = split_delay(simulator.delay + rig.force_sensor.delay, period)
        position_intervals, position_place = split_delay(simulator.delay + rig.position_sensor.delay, period)
        self._period, self._contact = period, mechanism.contact
        self._clearance, self._plane = mechanism.contact.clearance, rig.contact_plane
        self._hold, self._latency = rig.command_hold, rig.command_latency
        self._force_sensor, self._position_sensor = rig.force_sensor, rig.position_sensor
        self._place, self._noise = force_place * period, Random(seed)
        self._limits = simulator.velocity_limit, simulator.acceleration_limit
        self._limited = math.isfinite(min(self._limits))
        self._rows = discretise_simulator(simulator, period, rig.command_hold, force_place, position_place)
        # A sample is taken `_real` intervals after its command, and is read `_force_intervals` later.
        self._real = math.ceil(simulator.delay / period + force_place - DELAY_ROUNDING_TOLERANCE) - 1
        self._force_intervals, self._position_intervals = force_intervals - self._real, position_intervals
        self._size = 1 << (max(self._force_intervals, position_intervals, self._real) + 2).bit_length()
        self.begin(-1.0, 0.0, -1.0, 0)

    def begin(self, position: float, velocity: float, command: float, number: int) -> None:
        """Begin a run at its tick 0, in uniform motion towards contact `number` (from 0).

        The numerical model is at `position` [m] with `velocity` [m/s], and this tick's position command is
        `command` [m]. Before the run, the motion was uniform for an infinite time, without a force.
        """
        self._law, self._number, self._wanted_number = _contact_law_of(self._contact, number), number, number
        stride = self._period * velocity
        self._commands = [command - back * stride for back in range(self._latency + 1)]
        self._wanted, self._step, self.shortfall = command, stride, 0.0
        rows, linear = self._rows, self._hold == "linear"
        drive = self._commands[-1] if linear else self._commands[-1] + stride
        before = [
            c * (drive - stride) + s * stride
            for c, s in zip(rows.steady_command, rows.steady_step, strict=True)
        ]
        first = evaluate_row(rows.measured, before, drive - stride, drive if linear else drive - stride)
        self._state = [
            c * drive + s * stride for c, s in zip(rows.steady_command, rows.steady_step, strict=True)
        ]
        size = self._size
        self._forces = [0.0] * size
        self._intervals: list[SamplingInterval | None] = [None] * size
        # Interval -1, the newest before the run, is at the end of the ring buffer.
        self._positions = [first + (index - size + 1) * stride for index in range(size)]
        self._tick = 0
        self._lag = self.force = 0.0
        self._in_contact, self._deepest = False, 0.0

    def read(self) -> tuple[float, float]:
        """Read force [N] and position [m] at this tick, just before its command acts; noise is drawn."""
        last = self._size - 1
        sensor, noise = self._force_sensor, self._noise
        force = self._forces[(self._tick - 1 - self._force_intervals) & last] + sensor.bias
        if sensor.noise_std > 0.0:
            force += sensor.noise_std * noise.gauss(0.0, 1.0)
        force = _quantise(force, sensor.quantum)
        if sensor.dead_zone > 0.0:
            force = math.copysign(max(0.0, abs(force) - sensor.dead_zone), force)
        force = min(max(force, -sensor.range), sensor.range)
        position = self._positions[(self._tick - 1 - self._position_intervals) & last]
        if self._position_sensor.noise_std > 0.0:
            position += self._position_sensor.noise_std * noise.gauss(0.0, 1.0)
        return force, _quantise(position, self._position_sensor.quantum)

    def move(self, command: float) -> None:
        """Advance by one control period with the position command [m] of the tick at its end."""
        if self._limited:
            command = self._limit(command)
        commands = self._commands
        end = commands[self._latency - 1] if self._latency else command
        start = commands[self._latency] if self._hold == "linear" else end
        self._commands = [command, *commands[: self._latency]]
        rows, state, tick, last = self._rows, self._state, self._tick, self._size - 1

        def motion(place: MotionRows) -> MotionState:
            position = evaluate_row(place.position, state, start, end) - self._plane
            return MotionState(position, evaluate_row(place.velocity, state, start, end))

        if self._force_sensor.time_constant > 0.0 or self._law.loaded is not None:
            interval = motion(rows.sample), motion(rows.start), motion(rows.end)
        else:
            interval = motion(rows.sample), None, None
        self._intervals[tick & last] = interval
        self._positions[tick & last] = evaluate_row(rows.measured, state, start, end)
        self._state = [evaluate_row(row, state, start, end) for row in rows.transition]
        self._forces[tick & last] = self._contact_force(self._intervals[(tick - self._real) & last])
        self._tick = tick + 1
        self.expect(self._wanted_number)

    def expect(self, number: int) -> None:
        """Set the number (from 0) of the run's next contact, whose law applies once the mechanism is free."""
        self._wanted_number = number
        if number != self._number and not self._in_contact:
            self._law, self._number = _contact_law_of(self._contact, number), number

    def _contact_force(self, interval: SamplingInterval | None) -> float:
        """Compute the contact in the interval whose motion arrives now; return the lagged force [N]."""
        if interval is None:
            return 0.0
        sample, start, end = interval
        clearance, rest = self._clearance, self._period - self._place
        law, deepest = self._law, self._deepest
        if law.loaded is not None and start is not None and end is not None:
            at_sample = self._deeper(deepest, start, sample, self._place)
            law = law.loaded(at_sample)
            self._deepest = self._deeper(at_sample, sample, end, rest)
        else:
            at_sample = 0.0
        if sample.position > 0.0:
            self._in_contact, self.force = True, law.force(sample.position, sample.velocity)
        elif sample.position < -clearance:
            self._in_contact = True
            self.force = -law.force(-clearance - sample.position, -sample.velocity)
        else:
            self._in_contact, self.force = False, 0.0
        time_constant = self._force_sensor.time_constant
        if start is None or end is None or time_constant == 0.0:
            return self.force
        reading = apply_sensor_lag(
            self._lag, self._law, clearance, start, sample, self._place, time_constant, deepest
        )
        self._lag = apply_sensor_lag(
            reading, self._law, clearance, sample, end, rest, time_constant, at_sample
        )
        return reading

    def _deeper(self, deepest: float, start: MotionState, end: MotionState, duration: float) -> float:
        """Return the deepest penetration [m] up to the end of a stretch; it is reset when contact is lost."""
        if -self._clearance <= end.position <= 0.0:
            return 0.0
        if duration <= 0.0:  # With delays of whole periods the second stretch is empty.
            return deepest
        return max(deepest, deepest_penetration(start, end, duration, self._clearance))

    def _limit(self, wanted: float) -> float:
        """Apply the rate limits to a position command [m] (`jaxhil.simulation.rate_limits.limit_command`)."""
        velocity_limit, acceleration_limit = self._limits
        previous, before = self._commands[0], self._wanted
        largest, change = velocity_limit * self._period, acceleration_limit * self._period**2
        step = unlimited = wanted - previous
        wanted_step = wanted - before
        if math.isfinite(change):
            behind = before - previous
            more = math.floor((math.sqrt(1 + 8 * abs(behind) / change) - 1) / 2)
            step = wanted_step + behind / (more + 1) + math.copysign(change * more / 2, behind)
            step = min(max(step, self._step - change), self._step + change)
        step = min(max(step, -largest), largest)
        rounding = 2 * math.ulp(1.0) * (abs(wanted) + abs(previous) + abs(wanted_step))
        if abs(step - unlimited) <= rounding:
            command, step = wanted, unlimited
        else:
            command = previous + step
        self._wanted, self._step, self.shortfall = wanted, step, abs(wanted - command)
        return command


def _contact_law_of(contact: Contact, number: int) -> FloatLaw:
    """Return the law of contact `number` (from 0); the last entry of every list repeats."""
    stiffness = contact.stiffness[min(number, len(contact.stiffness) - 1)]
    damping = contact.damping[min(number, len(contact.damping) - 1)]
    return find_contact_law(contact.law).in_floats(contact, stiffness, damping)


def _quantise(value: float, quantum: float) -> float:
    return quantum * round(value / quantum) if quantum > 0.0 else value
