"""Simulated hardware of a rig in plain Python: motion simulator, contact and sensors.

    plant = RigHardware(mechanism, seed=0)
    plant.begin(position, velocity, command, number)  # begin a run in uniform motion towards contact `number`
    force, position = plant.read()                    # readings of the sensors at this tick
    plant.move(command)                               # apply the next position command for one period

This module computes stages 1, 4 and 5 of `jaxhil.simulation.loop` without JAX, fast enough for real time.
`tuning.rig.discretisation` discretises the linear parts and the delays exactly.
"""

import math
from random import Random
from typing import NamedTuple

from jaxhil.contact.float_law import FloatLaw
from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.sensor_filter import find_modes
from jaxhil.mechanism.structs import Contact, Mechanism
from tuning.rig.bias_walk import BiasWalk
from tuning.rig.discretisation import (
    DELAY_ROUNDING_TOLERANCE,
    DiscreteSimulator,
    MotionRows,
    discretise_simulator,
    evaluate_row,
    split_delay,
)
from tuning.rig.moving_average import discretise_moving_average
from tuning.rig.sensor_lag import MotionState, apply_sensor_filter, apply_sensor_lag, deepest_penetration
from tuning.rig.timing import TimingEffects

# Motion of the mechanism when the force sensor samples, at the sampling interval's start and at its end.
SamplingInterval = tuple[MotionState, MotionState | None, MotionState | None]


class PlantConstants(NamedTuple):
    """Constants of the simulated hardware that follow from a mechanism."""

    rows: DiscreteSimulator  # response of the motion simulator
    sample_time: float  # time of the force sensor's sample in its sampling interval [s]
    # The force is sampled `contact_intervals` intervals after the command that causes it, and read
    # `force_intervals` intervals after the sample.
    contact_intervals: int
    force_intervals: int
    position_intervals: int  # intervals from the sample of the position to its reading
    ring_size: int  # length of the ring buffers, a power of two


def compute_plant_constants(mechanism: Mechanism) -> PlantConstants:
    """Return the constants of a mechanism's simulated hardware."""
    rig = mechanism.rig
    simulator, period = rig.simulator, rig.control_period
    force_intervals, force_fraction = split_delay(simulator.delay + rig.force_sensor.delay, period)
    position_intervals, position_fraction = split_delay(simulator.delay + rig.position_sensor.delay, period)
    contact_delay = simulator.delay / period + force_fraction
    contact_intervals = math.ceil(contact_delay - DELAY_ROUNDING_TOLERANCE) - 1
    force_intervals -= contact_intervals
    instants = period, rig.command_hold, force_fraction, position_fraction
    if simulator.window is None:
        rows = discretise_simulator(simulator, *instants)
    else:
        rows = discretise_moving_average(simulator.window, *instants)
    longest, _ = split_delay(simulator.delay + rig.force_sensor.delay + rig.force_sensor.jitter, period)
    longest = max(longest, force_intervals, position_intervals, contact_intervals, rows.window_intervals or 0)
    return PlantConstants(
        rows=rows,
        sample_time=force_fraction * period,
        contact_intervals=contact_intervals,
        force_intervals=force_intervals,
        position_intervals=position_intervals,
        ring_size=1 << (longest + 2).bit_length(),
    )


class RigHardware:
    """Simulated hardware of the rig: motion simulator, contact and sensors.

    Attributes:
        force: newest sample of the real contact force [N].
        shortfall: distance between the requested and the rate-limited position command [m].
    """

    def __init__(self, mechanism: Mechanism, seed: int = 0) -> None:
        rig = mechanism.rig
        simulator, constants = rig.simulator, compute_plant_constants(mechanism)
        self._period, self._contact = rig.control_period, mechanism.contact
        self._clearance, self._plane = mechanism.contact.clearance, rig.contact_plane
        self._hold, self._latency = rig.command_hold, rig.command_latency
        self._force_sensor, self._position_sensor = rig.force_sensor, rig.position_sensor
        self._sample_time, self._noise = constants.sample_time, Random(seed)
        self._limits = simulator.velocity_limit, simulator.acceleration_limit
        self._has_rate_limits = math.isfinite(min(self._limits))
        self._rows, self._size = constants.rows, constants.ring_size
        low_pass, self._rates, self._weights = rig.force_sensor.filter, [], ()
        if low_pass is not None:
            modes = find_modes(low_pass.kind, low_pass.order)
            self._rates = [2.0 * math.pi * low_pass.cutoff * rate for rate in modes.rates]
            self._weights = modes.weights
        self._contact_intervals = constants.contact_intervals
        self._force_intervals = constants.force_intervals
        self._position_intervals = constants.position_intervals
        self._timing, self._bias_walk = TimingEffects(mechanism, seed), BiasWalk(mechanism, seed)
        self.begin(-1.0, 0.0, -1.0, 0)

    def begin(self, position: float, velocity: float, command: float, number: int, scenario: int = 0) -> None:
        """Begin a run at tick 0, in the steady state of a uniform motion without contact.

        Args:
            position: position of the numerical model [m].
            velocity: velocity of the numerical model [m/s].
            command: position command of tick 0 [m].
            number: index of the first contact in the mechanism's lists of stiffness and damping.
            scenario: index of the scenario to which the run belongs, for the random walk of the bias.
        """
        self._law, self._number, self._next_number = _contact_law_of(self._contact, number), number, number
        stride = self._period * velocity
        self._commands = [command - back * stride for back in range(self._latency + 1)]
        self._requested, self._step, self.shortfall = command, stride, 0.0
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
        # The last element of the ring buffer is interval -1, the newest interval before the run.
        self._positions = [first + (index - size + 1) * stride for index in range(size)]
        # Commands of the drives at the ends of the intervals; only a moving average reads them.
        self._drives = [self._commands[-1] + (index - size + 1) * stride for index in range(size)]
        self._tick = 0
        self._timing.begin(size)
        self._bias_walk.begin(scenario)
        self._lag = self.force = 0.0
        self._modes = [0j] * len(self._rates)
        self._in_contact, self._deepest = False, 0.0

    def read(self) -> tuple[float, float]:
        """Return the measured force [N] and position [m] just before this tick's command acts."""
        last = self._size - 1
        sensor, noise = self._force_sensor, self._noise
        force = self._timing.late_force(self._tick, self._law)
        if force is None:
            force = self._forces[(self._tick - 1 - self._force_intervals) & last]
        force += sensor.bias + self._bias_walk.read(self._tick, self._next_number)
        if sensor.noise_std > 0.0:
            force += sensor.noise_std * noise.gauss(0.0, 1.0)
        force = _quantise(force, sensor.quantum)
        if sensor.dead_zone_kind == "cut":
            force = force if abs(force) > sensor.dead_zone else 0.0
        elif sensor.dead_zone > 0.0:
            force = math.copysign(max(0.0, abs(force) - sensor.dead_zone), force)
        force = self._timing.hold_lost(self._tick, min(max(force, -sensor.range), sensor.range))
        position = self._positions[(self._tick - 1 - self._position_intervals) & last]
        if self._position_sensor.noise_std > 0.0:
            position += self._position_sensor.noise_std * noise.gauss(0.0, 1.0)
        return force, _quantise(position, self._position_sensor.quantum)

    def move(self, command: float) -> None:
        """Advance by one control period; `command` [m] is the position command at the end of the period."""
        if self._has_rate_limits:
            command = self._limit(command)
        commands = self._commands
        end = commands[self._latency - 1] if self._latency else command
        start = commands[self._latency] if self._hold == "linear" else end
        self._commands = [command, *commands[: self._latency]]
        rows, state, tick, last = self._rows, self._state, self._tick, self._size - 1
        if rows.window_intervals is not None:
            self._drives[tick & last] = end
            oldest = tick - rows.window_intervals - 2
            state[1:] = [self._drives[(oldest + later) & last] for later in range(3)]

        def motion(motion_rows: MotionRows) -> MotionState:
            position = evaluate_row(motion_rows.position, state, start, end) - self._plane
            return MotionState(position, evaluate_row(motion_rows.velocity, state, start, end))

        if self._force_sensor.time_constant > 0.0 or self._rates or self._law.loaded_law is not None:
            interval = motion(rows.sample), motion(rows.start), motion(rows.end)
        else:
            interval = motion(rows.sample), None, None
        self._intervals[tick & last] = interval
        self._timing.store(tick, state, start, end)
        self._positions[tick & last] = evaluate_row(rows.measured, state, start, end)
        self._state = [evaluate_row(row, state, start, end) for row in rows.transition]
        contact_interval = self._intervals[(tick - self._contact_intervals) & last]
        self._forces[tick & last] = self._contact_force(contact_interval)
        self._tick = tick + 1
        self.expect(self._next_number)

    def expect(self, number: int) -> None:
        """Set the index of the next contact; switch to its contact law once the current contact has ended."""
        self._next_number = number
        if number != self._number and not self._in_contact:
            self._law, self._number = _contact_law_of(self._contact, number), number

    def _contact_force(self, interval: SamplingInterval | None) -> float:
        """Compute the contact in a sampling interval; return the force [N] after the sensor's lag or filter.

        The force belongs to the sensor's sampling time. It is 0 for None, an interval before the run.
        """
        if interval is None:
            return 0.0
        sample, start, end = interval
        clearance, rest = self._clearance, self._period - self._sample_time
        law, deepest = self._law, self._deepest
        if law.loaded_law is not None and start is not None and end is not None:
            at_sample = self._deepest_until(deepest, start, sample, self._sample_time)
            law = law.loaded_law(at_sample)
            self._deepest = self._deepest_until(at_sample, sample, end, rest)
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
        if self._rates and start is not None and end is not None:
            segments = (start, sample, self._sample_time, deepest), (sample, end, rest, at_sample)
            return self._filter(clearance, *segments)
        if start is None or end is None or time_constant == 0.0:
            return self.force
        reading = apply_sensor_lag(
            self._lag, self._law, clearance, start, sample, self._sample_time, time_constant, deepest
        )
        self._lag = apply_sensor_lag(
            reading, self._law, clearance, sample, end, rest, time_constant, at_sample
        )
        return reading

    def _filter(self, clearance: float, *segments: tuple[MotionState, MotionState, float, float]) -> float:
        """Advance the force sensor's filter by two segments; return its output [N] after the first segment.

        A segment contains the motion at both ends, the duration [s] and the deepest penetration before [m].
        """
        outputs = []
        for start, end, duration, deepest in segments:
            self._modes = apply_sensor_filter(
                self._modes, self._law, clearance, start, end, duration, self._rates, deepest
            )
            pairs = zip(self._weights, self._modes, strict=True)
            outputs.append(sum((weight * mode).real for weight, mode in pairs))
        return outputs[0]

    def _deepest_until(self, deepest: float, start: MotionState, end: MotionState, duration: float) -> float:
        """Return the contact's deepest penetration [m] up to `end`; 0 if the contact has ended at `end`."""
        if -self._clearance <= end.position <= 0.0:
            return 0.0
        if duration <= 0.0:  # If the force delay is a whole number of periods, the second segment is empty.
            return deepest
        return max(deepest, deepest_penetration(start, end, duration, self._clearance))

    def _limit(self, requested: float) -> float:
        """Limit velocity and acceleration of a position command [m] like `jaxhil.simulation.rate_limits`."""
        velocity_limit, acceleration_limit = self._limits
        previous, before = self._commands[0], self._requested
        largest, change = velocity_limit * self._period, acceleration_limit * self._period**2
        step = unlimited = requested - previous
        requested_step = requested - before
        if math.isfinite(change):
            behind = before - previous
            more = math.floor((math.sqrt(1 + 8 * abs(behind) / change) - 1) / 2)
            step = requested_step + behind / (more + 1) + math.copysign(change * more / 2, behind)
            step = min(max(step, self._step - change), self._step + change)
        step = min(max(step, -largest), largest)
        rounding = 2 * math.ulp(1.0) * (abs(requested) + abs(previous) + abs(requested_step))
        if abs(step - unlimited) <= rounding:
            command, step = requested, unlimited
        else:
            command = previous + step
        self._requested, self._step, self.shortfall = requested, step, abs(requested - command)
        return command


def _contact_law_of(contact: Contact, number: int) -> FloatLaw:
    """Return the law of contact `number`; contacts beyond the end of a list use its last entry."""
    stiffness = contact.stiffness[min(number, len(contact.stiffness) - 1)]
    damping = contact.damping[min(number, len(contact.damping) - 1)]
    return find_contact_law(contact.law).as_float_law(contact, stiffness, damping)


def _quantise(value: float, quantum: float) -> float:
    return quantum * round(value / quantum) if quantum > 0.0 else value
