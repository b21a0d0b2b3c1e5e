"""Extreme values of the signals in recorded runs, which determine the limits of readings and commands."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tuning.watchdog.recording import RecordedSignals


class SignalExtremes(NamedTuple):
    """Extreme values of the signals in every recorded scenario (lane)."""

    reading: Float[np.ndarray, "lanes"]  # largest magnitude of the measured force [N]
    measured_lowest: Float[np.ndarray, "lanes"]  # lowest measured position [m]
    measured_highest: Float[np.ndarray, "lanes"]  # highest measured position [m]
    sent_lowest: Float[np.ndarray, "lanes"]  # lowest position command [m]
    sent_highest: Float[np.ndarray, "lanes"]  # highest position command [m]
    command: Float[np.ndarray, "lanes"]  # largest magnitude of the force command F_c [N]
    slew: Float[np.ndarray, "lanes"]  # largest rate of the force command [N/s]
    # largest distance of a run's first position command from the measured position [m]
    start: Float[np.ndarray, "lanes"]
    sent_speed: Float[np.ndarray, "lanes"]  # largest rate of the position command [m/s]
    speed: Float[np.ndarray, "lanes"]  # largest speed of the numerical model [m/s]
    acceleration: Float[np.ndarray, "lanes"]  # largest acceleration of the numerical model [m/s^2]
    # longest travel of the measured position in contact while the force reading is constant [m]
    force_stuck: Float[np.ndarray, "lanes"]
    # longest travel of the numerical model while the position reading is constant [m]
    position_stuck: Float[np.ndarray, "lanes"]
    flight_force: Float[np.ndarray, "lanes"]  # largest magnitude of the measured force in free flight [N]
    flight_spread: Float[np.ndarray, "lanes"]  # range of the measured force in free flight [N]


def find_signal_extremes(
    signals: RecordedSignals, period: float, clearance: float, free_distance: float, settling: float
) -> SignalExtremes:
    """Return the extreme values of the signals in every lane.

    Free flight is defined as in `jaxhil.rig.inputs`: the measured position has been farther than
    `free_distance` [m] from every surface for longer than `settling` [s].
    """
    live, begins = signals.live, signals.begins
    force, position, velocity, measured, command, sent = (np.where(live, leaf, 0.0) for leaf in signals[:6])
    goes_on = live[1:] & ~begins[1:]

    def largest(values, where):
        return np.max(np.where(where, values, 0.0), axis=0, initial=0.0)

    def least(values):
        return np.min(np.where(live, values, np.inf), axis=0)

    # The force command is continuous between runs, but positions jump at the start of a run.
    step = np.abs(np.diff(command, axis=0, prepend=0.0))
    flying = _find_flight_ticks(measured, begins, clearance, free_distance, settling / period) & live
    lowest = np.min(np.where(flying, force, np.inf), axis=0, initial=np.inf)
    highest = np.max(np.where(flying, force, -np.inf), axis=0, initial=-np.inf)
    spread = np.where(highest >= lowest, highest - np.where(np.isfinite(lowest), lowest, 0.0), 0.0)
    force_stuck, position_stuck = _measure_stuck_travel(signals, clearance)
    return SignalExtremes(
        reading=largest(np.abs(force), live),
        measured_lowest=least(measured),
        measured_highest=-least(-measured),
        sent_lowest=least(sent),
        sent_highest=-least(-sent),
        command=largest(np.abs(command), live),
        slew=largest(step, live) / period,
        start=largest(np.abs(sent - measured), begins & live),
        sent_speed=largest(np.abs(np.diff(sent, axis=0)), goes_on) / period,
        speed=largest(np.abs(np.diff(position, axis=0)), goes_on) / period,
        acceleration=largest(np.abs(np.diff(velocity, axis=0)), goes_on) / period,
        force_stuck=force_stuck,
        position_stuck=position_stuck,
        flight_force=largest(np.abs(force), flying),
        flight_spread=spread,
    )


def _find_flight_ticks(measured, begins, clearance, free_distance, settling):
    """Return whether the mechanism is in free flight in each tick, (ticks, lanes).

    In free flight, the measured position has been farther than `free_distance` [m] from every surface for
    more than `settling` ticks.
    """
    free = (measured < -free_distance) & (measured > free_distance - clearance)
    since = np.zeros(measured.shape[1])
    flying = np.empty(measured.shape, bool)
    for tick in range(len(measured)):
        since = np.where(begins[tick], 0.0, since)
        since = np.where(free[tick], since + 1, 0.0)
        flying[tick] = since > settling
    return flying


def _measure_stuck_travel(signals: RecordedSignals, clearance: float):
    """Return the longest travel [m] while the force reading is constant, and while the position reading is.

    Both are computed as in `jaxhil.rig.inputs.InputGuard`, each (lanes,).
    """
    zeros = np.zeros(signals.force.shape[1])
    force_travel, position_travel, most_force, most_position = zeros, zeros, zeros, zeros
    for tick in range(1, len(signals.force)):
        counted = signals.live[tick] & ~signals.begins[tick]
        now, before = signals.measured[tick], signals.measured[tick - 1]
        in_contact = (now > 0) | (now < -clearance)
        same = counted & in_contact & (signals.force[tick] == signals.force[tick - 1])
        deeper = np.where(now > 0, now - before, before - now)
        # At zero force, only net penetration counts, because a damped mechanism can separate without a force.
        pressed = np.where(signals.force[tick] == 0, np.maximum(force_travel + deeper, 0.0), np.inf)
        force_travel = np.where(same, np.minimum(pressed, force_travel + np.abs(deeper)), 0.0)
        moved = np.abs(signals.position[tick] - signals.position[tick - 1])
        position_travel = np.where(counted & (now == before), position_travel + moved, 0.0)
        most_force = np.maximum(most_force, force_travel)
        most_position = np.maximum(most_position, position_travel)
    return most_force, most_position
