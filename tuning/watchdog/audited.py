"""The watchdog's audit of recorded contacts, many lanes at a time: what it will see on the rig, in NumPy.

The accumulators are those of `jaxhil.rig.watchdog`, of which this is the same arithmetic with a trailing
axis of lanes: begin and end of every contact on the rig's terms, velocities, energy balance, and the least
squares of the measured force on the delay-aligned measured position and its rate.
"""

from typing import NamedTuple

import numpy as np
from jaxhil.rig.filters import DelayLine
from jaxtyping import Bool, Float, Int

from jaxhil.rig.watchdog import FADED, PATIENCE
from tuning.watchdog.recorded import Signals


class Rules(NamedTuple):
    """By what the numerical model is audited."""

    period: float  # control period [s]
    clearance: float  # [m]
    mass: float  # equivalent mass [kg]
    alignment: float  # delay of the force reading against the position reading [s]
    settling: float  # time that force and command need to die out [s]
    fading: float  # force reading that counts as none [N]
    has_status: bool = False  # whether the law says when it acts, and commands nothing out of contact


class Audited(NamedTuple):
    """Contact by contact, what the audit sees."""

    approach: Float[np.ndarray, "slots lanes"]  # speed before [m/s]
    rebound: Float[np.ndarray, "slots lanes"]  # speed after [m/s]
    # identified [N/m]; 0 where there is nothing to identify it from
    stiffness: Float[np.ndarray, "slots lanes"]
    damping: Float[np.ndarray, "slots lanes"]  # likewise [N s/m]
    imbalance: Float[np.ndarray, "slots lanes"]  # energy out of balance, over the approach's
    duration: Float[np.ndarray, "slots lanes"]  # until the audit [s]
    tick: Float[np.ndarray, "slots lanes"]  # on which the contact began
    begun: Bool[np.ndarray, "slots lanes"]  # whether there was such a contact

    @property
    def restitution(self) -> Float[np.ndarray, "slots lanes"]:
        """Speed after over speed before."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.rebound / self.approach


SUMS = ("xx", "xv", "vv", "xf", "vf")


class _Lanes:
    """The contact under way in every lane, and the contacts audited so far."""

    def __init__(self, rules: Rules, slots: int, lanes: int):
        zeros = np.zeros(lanes)
        self.rules, self.slots = rules, slots
        self.open = np.zeros(lanes, bool)
        self.count = np.zeros(lanes, int)
        self.entry, self.side, self.peak, self.work = (zeros.copy() for _ in range(4))
        self.quiet, self.ticks = zeros.copy(), zeros.copy()
        self.sums = {name: zeros.copy() for name in SUMS}
        self.found = {name: np.full((slots, lanes), np.nan) for name in Audited._fields[:-1]}
        self.begun = np.zeros((slots, lanes), bool)

    def begin(self, where: Bool[np.ndarray, "lanes"], tick: int, entry: np.ndarray, side: np.ndarray) -> None:
        """A contact begins."""
        self.open |= where
        self.entry[where] = entry[where]
        self.side[where] = side[where]
        for each in (self.peak, self.work, self.quiet, self.ticks, *self.sums.values()):
            each[where] = 0.0
        known = where & (self.count < self.slots)
        place = self.count[known], np.nonzero(known)[0]
        self.begun[place] = True
        self.found["tick"][place] = tick

    def audit(self, where: Bool[np.ndarray, "lanes"], velocity: np.ndarray, extra: np.ndarray) -> None:
        """Contacts are over, with this velocity; `extra` work of the last command comes in besides."""
        lanes = np.nonzero(where & (self.count < self.slots))[0]
        mass = self.rules.mass
        entry, speed = self.entry[lanes], velocity[lanes]
        xx, xv, vv, xf, vf = (self.sums[name][lanes] for name in SUMS)
        energy = 0.5 * mass * entry * entry
        balance = 0.5 * mass * speed * speed - energy + (self.work[lanes] + extra[lanes])
        with np.errstate(invalid="ignore", divide="ignore"):
            determinant = xx * vv - xv * xv
            found = {
                "approach": np.abs(entry),
                "rebound": np.abs(speed),
                "stiffness": np.where(determinant > 0, (xf * vv - vf * xv) / determinant, 0.0),
                "damping": np.where(determinant > 0, (vf * xx - xf * xv) / determinant, 0.0),
                "imbalance": np.abs(balance) / energy,
                "duration": self.ticks[lanes] * self.rules.period,
            }
        for name, values in found.items():
            self.found[name][self.count[lanes], lanes] = values
        self.count += where
        self.open &= ~where


def audit_contacts(signals: Signals, rules: Rules, slots: int) -> Audited:
    """The first `slots` contacts of every lane, as the watchdog will audit them.

    At the end of a lane's record the contact under way is audited, as it is where a next one begins.
    """
    ticks, lanes = signals.force.shape
    period, mass, clearance = rules.period, rules.mass, rules.clearance
    middle = -0.5 * clearance
    quiet_ticks, patience = rules.settling / period, (rules.settling + PATIENCE) / period
    state = _Lanes(rules, slots, lanes)
    alignment = _Alignment(rules.alignment, period)
    # Of the tick before; a lane's first tick is one at which a run begins.
    velocity_before, given, force_before, aligned_before = (np.zeros(lanes) for _ in range(4))
    with np.errstate(invalid="ignore", over="ignore"):
        for tick in range(ticks + 1):
            live = signals.live[tick] if tick < ticks else np.zeros(lanes, bool)
            begins = live & signals.begins[min(tick, ticks - 1)]
            after = velocity_before - period * given / mass
            ends = state.open & (begins | ~live)
            if np.any(ends):
                state.audit(ends, after, period * given * 0.5 * (velocity_before + after))
            if not np.any(live):
                break
            force, position, velocity, measured, command = (leaf[tick] for leaf in signals[:5])
            velocity_before = np.where(begins, velocity, velocity_before)
            given = np.where(begins, 0.0, given)
            deflection = _deflection(alignment.step(measured, velocity, begins), clearance)
            aligned_before = np.where(begins, 0.0, aligned_before)
            in_contact = (_deflection(position, clearance) != 0) | (_deflection(measured, clearance) != 0)
            in_contact |= rules.has_status & (given != 0)
            side = np.where(position > middle, 1.0, -1.0)
            fresh = live & ~state.open & in_contact
            if np.any(fresh):
                state.begin(fresh, tick, velocity_before, side)
            going = live & state.open
            if np.any(going):
                state.quiet = np.where(in_contact, 0.0, state.quiet + 1)
                state.ticks += going
                state.work += np.where(going, period * given * 0.5 * (velocity_before + velocity), 0.0)
                size = np.abs(given)
                state.peak = np.where(going, np.maximum(state.peak, size), state.peak)
                own = state.side
                inside = going & (deflection * own > 0) & (aligned_before * own > 0)
                x = np.where(inside, own * (deflection + aligned_before) * 0.5, 0.0)
                v = np.where(inside, own * (deflection - aligned_before) / period, 0.0)
                f = np.where(inside, own * (force + force_before) * 0.5, 0.0)
                for name, product in zip(SUMS, (x * x, x * v, v * v, x * f, v * f), strict=True):
                    state.sums[name] += product
                unfelt = FADED * mass * np.abs(state.entry) / PATIENCE
                faded = (size <= FADED * state.peak) | (size <= unfelt) | (state.quiet >= patience)
                leaves = ~in_contact & (state.quiet >= quiet_ticks) & (own * velocity < 0) & faded
                over = going & (leaves | (side != own))
                if np.any(over):
                    state.audit(over, velocity, np.zeros(lanes))
            velocity_before = np.where(live, velocity, velocity_before)
            given = np.where(live, command, given)
            force_before, aligned_before = force, deflection
    return Audited(**state.found, begun=state.begun)


class _Alignment:
    """`DelayLine` of every lane."""

    def __init__(self, delay: float, period: float):
        DelayLine(delay, period)  # refuses a delay that spans too many periods
        ratio = delay / period
        self._whole = int(np.floor(ratio + 1e-9))
        self._fraction = ratio - self._whole
        self._period = period
        self._past: list[np.ndarray] = []

    def step(self, position: np.ndarray, velocity: np.ndarray, begins: np.ndarray) -> np.ndarray:
        """The delayed position; where a run `begins`, the past is uniform motion."""
        if not self._past:
            self._past = [np.zeros_like(position)] * (self._whole + 1)
        if np.any(begins):
            self._past = [
                np.where(begins, position + -(back + 1) * self._period * velocity, one)
                for back, one in enumerate(self._past)
            ]
        samples = [position, *self._past]
        self._past = samples[:-1]
        return (1.0 - self._fraction) * samples[self._whole] + self._fraction * samples[self._whole + 1]


def _deflection(position: np.ndarray, clearance: float) -> np.ndarray:
    far = position + clearance
    return np.where(position > 0, position, np.where(far < 0, far, 0.0))


def first_reached(beyond: Bool[np.ndarray, "slots lanes"]) -> Int[np.ndarray, "lanes"]:
    """Number of the first contact of each lane for which it holds; the number of slots if for none."""
    return np.where(np.any(beyond, axis=0), np.argmax(beyond, axis=0), len(beyond))
