"""Vectorised audit of recorded contacts, which computes the same values as the watchdog on the rig.

The module computes the audit of `jaxhil.rig.watchdog` for many lanes (recorded runs) at once. An audit
consists of onset and end of the contact as the rig detects them, approach and rebound speed, the
energy-consistency test, and estimates of stiffness and damping. The estimates are the least-squares fit of
the measured force to the delay-aligned measured position and its rate.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxhil.rig.filters import DelayLine
from jaxhil.rig.watchdog import FORCE_DECAY_RATIO, MAX_DECAY_WAIT
from tuning.watchdog.recording import RecordedSignals


class AuditRules(NamedTuple):
    """Parameters of the watchdog's audit."""

    period: float  # control period [s]
    clearance: float  # distance between the two surfaces [m]; infinite for one surface
    mass: float  # equivalent mass [kg]
    alignment: float  # delay of the force reading relative to the position reading [s]
    settling: float  # time in which force and force command decay after a contact [s]
    fading: float  # largest force reading without contact, caused by noise and bias [N]
    has_status: bool = False  # whether the compensator reports a status, and commands no force out of contact


class AuditedContacts(NamedTuple):
    """Values that the watchdog computes for every contact (slot) of every run (lane)."""

    approach: Float[np.ndarray, "slots lanes"]  # approach speed [m/s]
    rebound: Float[np.ndarray, "slots lanes"]  # rebound speed [m/s]
    stiffness: Float[np.ndarray, "slots lanes"]  # estimated stiffness [N/m]; 0 if not observable
    damping: Float[np.ndarray, "slots lanes"]  # estimated damping [N s/m]; 0 if not observable
    # magnitude of the energy balance, divided by the kinetic energy of the approach [1]
    imbalance: Float[np.ndarray, "slots lanes"]
    duration: Float[np.ndarray, "slots lanes"]  # time from the onset to the audit [s]
    tick: Float[np.ndarray, "slots lanes"]  # tick of the onset
    occurred: Bool[np.ndarray, "slots lanes"]  # whether the contact occurred

    @property
    def restitution(self) -> Float[np.ndarray, "slots lanes"]:
        """Return the restitution: rebound speed divided by approach speed."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.rebound / self.approach


# Sums for the least squares of force f on penetration x and its rate v.
LEAST_SQUARES_SUMS = ("xx", "xv", "vv", "xf", "vf")


class _AuditState:
    """State of the audit: the current contact of every lane, and the results of earlier contacts."""

    def __init__(self, rules: AuditRules, slots: int, lanes: int):
        zeros = np.zeros(lanes)
        self.rules, self.slots = rules, slots
        self.open = np.zeros(lanes, bool)
        self.count = np.zeros(lanes, int)
        self.entry, self.side, self.peak, self.work = (zeros.copy() for _ in range(4))
        self.ticks_without_contact, self.ticks = zeros.copy(), zeros.copy()
        self.sums = {name: zeros.copy() for name in LEAST_SQUARES_SUMS}
        self.results = {name: np.full((slots, lanes), np.nan) for name in AuditedContacts._fields[:-1]}
        self.occurred = np.zeros((slots, lanes), bool)

    def begin(self, where: Bool[np.ndarray, "lanes"], tick: int, entry: np.ndarray, side: np.ndarray) -> None:
        """Begin a contact in the lanes `where`, with velocity `entry` [m/s] at surface `side` (1 or -1)."""
        self.open |= where
        self.entry[where] = entry[where]
        self.side[where] = side[where]
        counters = self.ticks_without_contact, self.ticks
        for accumulator in (self.peak, self.work, *counters, *self.sums.values()):
            accumulator[where] = 0.0
        stored = where & (self.count < self.slots)
        index = self.count[stored], np.nonzero(stored)[0]
        self.occurred[index] = True
        self.results["tick"][index] = tick

    def audit(self, where: Bool[np.ndarray, "lanes"], velocity: np.ndarray, extra: np.ndarray) -> None:
        """Check momentum and energy of contacts that end; the mask `where` selects their lanes.

        `velocity` [m/s] is the rebound velocity, and `extra` [J] is the work of the last force command.
        """
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
    """Audit the first `slots` contacts of every lane in the same way as the watchdog.

    A contact that does not end is audited when the next run begins, or at the end of the record.
    """
    ticks, lanes = signals.force.shape
    period, mass, clearance = rules.period, rules.mass, rules.clearance
    middle = -0.5 * clearance
    min_ticks, max_ticks = rules.settling / period, (rules.settling + MAX_DECAY_WAIT) / period
    state = _AuditState(rules, slots, lanes)
    alignment = _LaneDelayLine(rules.alignment, period)
    # Values of the previous tick. Every lane begins with a run, whose first tick sets these values.
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
            in_contact = rules.has_status & (command_before != 0)
            for deflected in (position, measured):
                in_contact |= _compute_deflection(deflected, clearance) != 0
            side = np.where(position > middle, 1.0, -1.0)
            starts = live & ~state.open & in_contact
            if np.any(starts):
                state.begin(starts, tick, velocity_before, side)
            in_progress = live & state.open
            if np.any(in_progress):
                state.ticks_without_contact = np.where(in_contact, 0.0, state.ticks_without_contact + 1)
                state.ticks += in_progress
                state.work += np.where(
                    in_progress, period * command_before * 0.5 * (velocity_before + velocity), 0.0
                )
                command_magnitude = np.abs(command_before)
                state.peak = np.where(in_progress, np.maximum(state.peak, command_magnitude), state.peak)
                side_open = state.side
                inside = in_progress & (deflection * side_open > 0) & (aligned_before * side_open > 0)
                x = np.where(inside, side_open * (deflection + aligned_before) * 0.5, 0.0)
                v = np.where(inside, side_open * (deflection - aligned_before) / period, 0.0)
                f = np.where(inside, side_open * (force + force_before) * 0.5, 0.0)
                products = (x * x, x * v, v * v, x * f, v * f)
                for name, product in zip(LEAST_SQUARES_SUMS, products, strict=True):
                    state.sums[name] += product
                negligible = FORCE_DECAY_RATIO * mass * np.abs(state.entry) / MAX_DECAY_WAIT
                free_ticks = state.ticks_without_contact
                faded = command_magnitude <= np.fmax(FORCE_DECAY_RATIO * state.peak, negligible)
                faded |= free_ticks >= max_ticks
                leaves = ~in_contact & (free_ticks >= min_ticks) & (side_open * velocity < 0) & faded
                has_ended = in_progress & (leaves | (side != side_open))
                if np.any(has_ended):
                    state.audit(has_ended, velocity, np.zeros(lanes))
            velocity_before = np.where(live, velocity, velocity_before)
            command_before = np.where(live, command, command_before)
            force_before, aligned_before = force, deflection
    return AuditedContacts(**state.results, occurred=state.occurred)


class _LaneDelayLine:
    """Vectorised `jaxhil.rig.filters.DelayLine`, with one element for each lane."""

    def __init__(self, delay: float, period: float):
        DelayLine(delay, period)  # Raises an error if the delay spans too many periods.
        ratio = delay / period
        self._whole = int(np.floor(ratio + 1e-9))
        self._fraction = ratio - self._whole
        self._period = period
        self._past: list[np.ndarray] = []

    def step(self, position: np.ndarray, velocity: np.ndarray, begins: np.ndarray) -> np.ndarray:
        """Return the delayed position [m].

        `begins` marks the lanes in which a run begins. Their motion before this tick is assumed uniform.
        """
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
    """Return the index of the first true slot of each lane, or the number of slots if all are false."""
    return np.where(np.any(beyond, axis=0), np.argmax(beyond, axis=0), len(beyond))
