"""Audit of recorded contacts as by the watchdog, in NumPy, for many lanes at a time.

The arithmetic is that of `jaxhil.rig.watchdog` with a trailing axis of lanes: begin and end of every contact
as the rig detects them, velocities, energy-consistency test, and least squares of the measured force on the
delay-aligned measured position and its rate.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxhil.rig.filters import DelayLine
from jaxhil.rig.watchdog import FORCE_DECAY_RATIO, MAX_DECAY_WAIT
from tuning.watchdog.recording import RecordedSignals


class AuditRules(NamedTuple):
    """Parameters of the audit."""

    period: float  # control period [s]
    clearance: float  # [m]
    mass: float  # equivalent mass [kg]
    alignment: float  # delay of the force reading relative to the position reading [s]
    settling: float  # time in which force and command die out [s]
    fading: float  # largest force reading that counts as no force [N]
    has_status: bool = False  # whether the law states when it acts, and commands no force out of contact


class AuditedContacts(NamedTuple):
    """Audit of every contact."""

    approach: Float[np.ndarray, "slots lanes"]  # approach speed [m/s]
    rebound: Float[np.ndarray, "slots lanes"]  # rebound speed [m/s]
    stiffness: Float[np.ndarray, "slots lanes"]  # estimate [N/m]; 0 if not observable
    damping: Float[np.ndarray, "slots lanes"]  # estimate [N s/m]; 0 if not observable
    imbalance: Float[
        np.ndarray, "slots lanes"
    ]  # |energy balance| over the kinetic energy of the approach [1]
    duration: Float[np.ndarray, "slots lanes"]  # time from the onset to the audit [s]
    tick: Float[np.ndarray, "slots lanes"]  # tick of the onset
    begun: Bool[np.ndarray, "slots lanes"]  # whether the contact occurred

    @property
    def restitution(self) -> Float[np.ndarray, "slots lanes"]:
        """Return the rebound speed over the approach speed."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.rebound / self.approach


LEAST_SQUARES_SUMS = ("xx", "xv", "vv", "xf", "vf")


class _AuditState:
    """Current contact of every lane, and the contacts audited so far."""

    def __init__(self, rules: AuditRules, slots: int, lanes: int):
        zeros = np.zeros(lanes)
        self.rules, self.slots = rules, slots
        self.open = np.zeros(lanes, bool)
        self.count = np.zeros(lanes, int)
        self.entry, self.side, self.peak, self.work = (zeros.copy() for _ in range(4))
        self.quiet, self.ticks = zeros.copy(), zeros.copy()
        self.sums = {name: zeros.copy() for name in LEAST_SQUARES_SUMS}
        self.results = {name: np.full((slots, lanes), np.nan) for name in AuditedContacts._fields[:-1]}
        self.begun = np.zeros((slots, lanes), bool)

    def begin(self, where: Bool[np.ndarray, "lanes"], tick: int, entry: np.ndarray, side: np.ndarray) -> None:
        """Begin a contact in the lanes `where`."""
        self.open |= where
        self.entry[where] = entry[where]
        self.side[where] = side[where]
        for accumulator in (self.peak, self.work, self.quiet, self.ticks, *self.sums.values()):
            accumulator[where] = 0.0
        stored = where & (self.count < self.slots)
        index = self.count[stored], np.nonzero(stored)[0]
        self.begun[index] = True
        self.results["tick"][index] = tick

    def audit(self, where: Bool[np.ndarray, "lanes"], velocity: np.ndarray, extra: np.ndarray) -> None:
        """Audit the contacts that end with this velocity [m/s]; `extra` [J] is the last command's work."""
        lanes = np.nonzero(where & (self.count < self.slots))[0]
        mass = self.rules.mass
        entry, speed = self.entry[lanes], velocity[lanes]
        xx, xv, vv, xf, vf = (self.sums[name][lanes] for name in LEAST_SQUARES_SUMS)
        energy = 0.5 * mass * entry * entry
        balance = 0.5 * mass * speed * speed - energy + (self.work[lanes] + extra[lanes])
        with np.errstate(invalid="ignore", divide="ignore"):
            determinant = xx * vv - xv * xv
            results = {
                "approach": np.abs(entry),
                "rebound": np.abs(speed),
                "stiffness": np.where(determinant > 0, (xf * vv - vf * xv) / determinant, 0.0),
                "damping": np.where(determinant > 0, (vf * xx - xf * xv) / determinant, 0.0),
                "imbalance": np.abs(balance) / energy,
                "duration": self.ticks[lanes] * self.rules.period,
            }
        for name, values in results.items():
            self.results[name][self.count[lanes], lanes] = values
        self.count += where
        self.open &= ~where


def audit_contacts(signals: RecordedSignals, rules: AuditRules, slots: int) -> AuditedContacts:
    """Audit the first `slots` contacts of every lane like the watchdog.

    A contact that has not ended is audited at the end of the record or when the next run begins.
    """
    ticks, lanes = signals.force.shape
    period, mass, clearance = rules.period, rules.mass, rules.clearance
    middle = -0.5 * clearance
    quiet_ticks, patience = rules.settling / period, (rules.settling + MAX_DECAY_WAIT) / period
    state = _AuditState(rules, slots, lanes)
    alignment = _LaneDelayLine(rules.alignment, period)
    # These are values of the previous tick; the first tick of a lane begins a run, which sets them.
    velocity_before, command_before, force_before, aligned_before = (np.zeros(lanes) for _ in range(4))
    with np.errstate(invalid="ignore", over="ignore"):
        for tick in range(ticks + 1):
            live = signals.live[tick] if tick < ticks else np.zeros(lanes, bool)
            begins = live & signals.begins[min(tick, ticks - 1)]
            after = velocity_before - period * command_before / mass
            ends = state.open & (begins | ~live)
            if np.any(ends):
                state.audit(ends, after, period * command_before * 0.5 * (velocity_before + after))
            if not np.any(live):
                break
            force, position, velocity, measured, command = (leaf[tick] for leaf in signals[:5])
            velocity_before = np.where(begins, velocity, velocity_before)
            command_before = np.where(begins, 0.0, command_before)
            deflection = _compute_deflection(alignment.step(measured, velocity, begins), clearance)
            aligned_before = np.where(begins, 0.0, aligned_before)
            in_contact = (_compute_deflection(position, clearance) != 0) | (
                _compute_deflection(measured, clearance) != 0
            )
            in_contact |= rules.has_status & (command_before != 0)
            side = np.where(position > middle, 1.0, -1.0)
            fresh = live & ~state.open & in_contact
            if np.any(fresh):
                state.begin(fresh, tick, velocity_before, side)
            going = live & state.open
            if np.any(going):
                state.quiet = np.where(in_contact, 0.0, state.quiet + 1)
                state.ticks += going
                state.work += np.where(
                    going, period * command_before * 0.5 * (velocity_before + velocity), 0.0
                )
                size = np.abs(command_before)
                state.peak = np.where(going, np.maximum(state.peak, size), state.peak)
                side_open = state.side
                inside = going & (deflection * side_open > 0) & (aligned_before * side_open > 0)
                x = np.where(inside, side_open * (deflection + aligned_before) * 0.5, 0.0)
                v = np.where(inside, side_open * (deflection - aligned_before) / period, 0.0)
                f = np.where(inside, side_open * (force + force_before) * 0.5, 0.0)
                for name, product in zip(
                    LEAST_SQUARES_SUMS, (x * x, x * v, v * v, x * f, v * f), strict=True
                ):
                    state.sums[name] += product
                unfelt = FORCE_DECAY_RATIO * mass * np.abs(state.entry) / MAX_DECAY_WAIT
                faded = (
                    (size <= FORCE_DECAY_RATIO * state.peak) | (size <= unfelt) | (state.quiet >= patience)
                )
                leaves = ~in_contact & (state.quiet >= quiet_ticks) & (side_open * velocity < 0) & faded
                over = going & (leaves | (side != side_open))
                if np.any(over):
                    state.audit(over, velocity, np.zeros(lanes))
            velocity_before = np.where(live, velocity, velocity_before)
            command_before = np.where(live, command, command_before)
            force_before, aligned_before = force, deflection
    return AuditedContacts(**state.results, begun=state.begun)


class _LaneDelayLine:
    """Vectorised `DelayLine` with one lane per element."""

    def __init__(self, delay: float, period: float):
        DelayLine(delay, period)  # Raises an error if the delay spans too many periods.
        ratio = delay / period
        self._whole = int(np.floor(ratio + 1e-9))
        self._fraction = ratio - self._whole
        self._period = period
        self._past: list[np.ndarray] = []

    def step(self, position: np.ndarray, velocity: np.ndarray, begins: np.ndarray) -> np.ndarray:
        """Return the delayed position [m]; before a run `begins`, the motion is uniform."""
        if not self._past:
            self._past = [np.zeros_like(position)] * (self._whole + 1)
        if np.any(begins):
            self._past = [
                np.where(begins, position + -(back + 1) * self._period * velocity, sample)
                for back, sample in enumerate(self._past)
            ]
        samples = [position, *self._past]
        self._past = samples[:-1]
        return (1.0 - self._fraction) * samples[self._whole] + self._fraction * samples[self._whole + 1]


def _compute_deflection(position: np.ndarray, clearance: float) -> np.ndarray:
    far = position + clearance
    return np.where(position > 0, position, np.where(far < 0, far, 0.0))


def find_first_true(beyond: Bool[np.ndarray, "slots lanes"]) -> Int[np.ndarray, "lanes"]:
    """Return the index of the first true contact of each lane; the number of slots if there is none."""
    return np.where(np.any(beyond, axis=0), np.argmax(beyond, axis=0), len(beyond))
