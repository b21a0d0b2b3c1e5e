"""Test vectors: what the runtime reads and commands tick by tick, for a rig's controller to meet to the bit.

`recorded` replays runs of the simulated loop, the nominal one and draws, through the runtime; beside its
commands stand those of jax's controller. `hostile` damages pieces of the nominal run: readings and model that
are not finite, huge or stuck, ticks that come late, never, or backwards in time. Position commands are those
for the numerical model as it is integrated under the runtime's force.
"""

import csv
import io
import random
from collections.abc import Iterator, Sequence
from math import inf, nan
from typing import NamedTuple

import numpy as np

from jaxhil.mechanism.correlation import certain
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import Controller
from jaxhil.rig.faults import LAW_IN_DOUBT, names
from jaxhil.rig.gain_file import GainFile, check_gain_document
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.recording import Lane, nominal_and_draws, record_lanes
from tuning.verification.replay import (
    REPLAY_LIMIT,
    command_range,
    near_threshold,
    parting,
    relative_difference,
)
from tuning.verification.stops import Stop, find_stop, passing_limits

BEGINS, NEXT_CONTACT = 1, 2  # events of a tick; 0 for none
DRAWS = 3
LONGEST_RUN = 6000  # ticks
HOSTILE_RUNS, HOSTILE_TICKS = 48, 60
DAMAGED = 0.06  # share of the ticks
OF_ONE_RIG = ("rig.control_period", "contact.clearance")  # what the gain file says, and no draw
EXTREMES = (nan, inf, -inf, 1e308, -1e308, 1e30, -1e200, 5e-324, -0.0)


class Inputs(NamedTuple):
    """What the controller reads in one tick."""

    run: int  # number of the run
    event: int  # `BEGINS`, `NEXT_CONTACT`, or 0
    force_measured: float  # [N]
    position_desired: float  # of the numerical model [m]
    velocity_desired: float  # of the numerical model [m/s]
    position_measured: float  # [m]
    time: float | None  # [s]; None for none
    # the model's next position, velocity and acceleration [SI]; None: it is integrated
    motion: tuple[float, float, float] | None = None
    force_simulated: float = nan  # what the simulation's controller commands [N]
    zeroed: bool = False  # whether the model feels no force, whatever is commanded


class Row(NamedTuple):
    """One line of vectors.csv, in SI units."""

    run: int  # as in `Inputs`, and so the next six
    event: int
    force_measured: float
    position_desired: float
    velocity_desired: float
    position_measured: float
    time: float | None
    position: float  # the numerical model's at the next tick
    velocity: float
    acceleration: float
    force_command: float  # of the runtime
    position_command: float  # of the runtime
    faults: int  # their bits
    force_simulated: float  # nan where there is nothing to compare with


class Recorded(NamedTuple):
    """The vectors of recorded runs."""

    rows: list[Row]  # their ticks
    mass: float  # equivalent mass of the nominal run [kg]
    ended: list[str | None]  # of each run what ended the comparison with the simulation; None: nothing
    reasons: list[str]  # what disagrees, in words
    stop: Stop | None  # what the limits act on in the nominal run; None: nothing
    passing: dict[str, float] | None  # limits with which that run passes; None if there are none


def recorded(loaded: LoadedGains, gain_file: GainFile, seed: int, draws: int = DRAWS) -> Recorded:
    """The nominal run and draws of the mechanism's uncertain numbers, replayed through the runtime."""
    mechanism = one_rig(loaded.mechanism)
    batch = nominal_and_draws(mechanism, 1 + draws, seed)
    _, lanes = record_lanes(loaded, batch)
    rows, ended, reasons = [], [], []
    for run, lane in enumerate(lanes):
        mass = float(batch.equivalent_mass[run])
        controller = Controller(gain_file)
        inputs = list(_of_lane(run, lane, gain_file.control_period))
        made, identified, acting = _through(controller, inputs, mechanism.rig.integrator, mass, gain_file)
        made, end, reason = _compared(made, inputs, identified, acting, lane, gain_file)
        rows += made
        ended.append(end)
        if reason:
            reasons.append(f"{'the nominal run' if run == 0 else f'draw {run}'}, {reason}")
    stop = find_stop(gain_file, lanes[0])
    passing = None if stop is None else passing_limits(gain_file, lanes[0])
    return Recorded(rows, float(batch.equivalent_mass[0]), ended, reasons, stop, passing)


def hostile(
    nominal: Sequence[Row], integrator: str, mass: float, gain_file: GainFile, seed: int
) -> list[Row]:
    """Pieces of the nominal run, damaged, through the runtime; mass [kg] of the numerical model."""
    source = random.Random(seed)
    rows: list[Row] = []
    for run in range(HOSTILE_RUNS):
        begin = source.randrange(max(1, len(nominal) - HOSTILE_TICKS))
        piece = nominal[begin : begin + HOSTILE_TICKS]
        inputs = list(_damaged(source, run, piece, gain_file.control_period))
        rows += _through(Controller(gain_file), inputs, integrator, mass, gain_file)[0]
    return rows


def make_vectors(loaded: LoadedGains, seed: int, draws: int = DRAWS) -> Recorded:
    """Recorded runs, then hostile ones."""
    gain_file = check_gain_document(loaded.document)
    found = recorded(loaded, gain_file, seed, draws)
    nominal = [row for row in found.rows if row.run == 0]
    damaged = hostile(nominal, loaded.mechanism.rig.integrator, found.mass, gain_file, seed)
    last = max((row.run for row in found.rows), default=-1) + 1
    return found._replace(rows=[*found.rows, *(row._replace(run=last + row.run) for row in damaged)])


def as_csv(rows: Sequence[Row]) -> str:
    """The file's text: a line of names, then one line a tick; Python's repr of each number, '' for none."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows(["" if value is None else repr(value) for value in row] for row in rows)
    return text.getvalue()


def one_rig(mechanism: Mechanism) -> Mechanism:
    """The mechanism without uncertainty of what the gain file tells the controller."""
    return certain(mechanism, OF_ONE_RIG)


def _of_lane(run: int, lane: Lane, period: float) -> Iterator[Inputs]:
    readings = zip(*(leaf.tolist() for leaf in lane.signals), strict=True)
    for tick, (force, position, velocity, measured, age) in enumerate(readings):
        if tick == LONGEST_RUN:
            return
        event = BEGINS if tick == 0 else NEXT_CONTACT if age == 0 else 0
        zeroed = bool(age == 0 and lane.zeroed)
        simulated = nan if zeroed else float(lane.command[tick])
        yield Inputs(run, event, force, position, velocity, measured, tick * period, None, simulated, zeroed)


def _damaged(source: random.Random, run: int, piece: Sequence[Row], period: float) -> Iterator[Inputs]:
    timed = source.random() < 0.8
    time, stuck = source.uniform(0.0, 1e3), {}
    for tick, row in enumerate(piece):
        event = BEGINS if tick == 0 else NEXT_CONTACT if source.random() < DAMAGED / 4 else 0
        one = Inputs(run, event, *row[2:6], time)
        damage = source.choice(_DAMAGES) if source.random() < DAMAGED else ""
        if damage in Inputs._fields[2:6]:
            one = one._replace(**{damage: _extreme(source, getattr(one, damage))})
        elif damage == "stuck":
            name = source.choice(Inputs._fields[2:6])
            stuck[name] = (getattr(one, name), source.randrange(1, 40))
        elif damage == "clock":
            time += source.choice((1e-9, 0.4, 0.7, 1.6, 3.0, 50.0, -1.0, -50.0, 1e12)) * period
            one = one._replace(time=source.choice((time, time, time, nan, inf, -inf)))
        elif damage == "motion":
            motion = [row.position, row.velocity, row.acceleration]
            motion[source.randrange(3)] = _extreme(source, row.position)
            one = one._replace(motion=tuple(motion))
        for name, (value, left) in list(stuck.items()):
            one = one._replace(**{name: value})
            stuck[name] = (value, left - 1)
            if left <= 1:
                del stuck[name]
        yield one if timed else one._replace(time=None)
        time += period


_DAMAGES = (*Inputs._fields[2:6], "stuck", "clock", "motion")


def _extreme(source: random.Random, value: float) -> float:
    return source.choice((*EXTREMES, 1e3 * value, -value, value + source.gauss(0.0, 1.0)))


def _through(
    controller: Controller, inputs: Sequence[Inputs], integrator: str, mass: float, gain_file: GainFile
) -> tuple[list[Row], list[tuple[float, float]], list[int]]:
    """The runtime's rows, at each the stiffness and damping identified, and the faults on which it acts."""
    rows, identified, acting = [], [], []
    move = INTEGRATORS[integrator]
    inverse_mass, period = 1.0 / mass, gain_file.control_period
    for one in inputs:
        if one.event == NEXT_CONTACT:
            controller.next_contact()
        force = controller.step(*one[2:6], one.time)
        if one.motion is None:
            acceleration = -(0.0 if one.zeroed else force) * inverse_mass
            position, velocity = move(one.position_desired, one.velocity_desired, acceleration, period)
            motion = (float(position), float(velocity), acceleration)
        else:
            motion = one.motion
        command = controller.position_command(*motion)
        # The faults of a tick are known once both have been asked for.
        faults = controller.faults
        rows.append(Row(*one[:7], *motion, force, command, faults, one.force_simulated))
        identified.append(controller.identified)
        # That the law is in doubt changes no command; a trip between two contacts is no tick's fault.
        acting.append(faults & ~LAW_IN_DOUBT | controller.cause)
    return rows, identified, acting


def _compared(
    rows: list[Row],
    inputs: Sequence[Inputs],
    identified: Sequence[tuple[float, float]],
    acting: Sequence[int],
    lane: Lane,
    gain_file: GainFile,
) -> tuple[list[Row], str | None, str | None]:
    """The rows, with jax's force as far as it can be compared; why it ends before; what disagrees.

    It ends with the first tick at which a guard acts, and, as in verification, with the first at which
    rounding decided at a threshold.
    """
    number = len(rows)
    if not number:
        return rows, None, None
    faulty = np.flatnonzero(acting)
    found = np.array([row.force_command for row in rows])
    sent = np.array([row.position_command for row in rows])
    expected = np.array([one.force_simulated for one in inputs])
    error, span = relative_difference(found, expected)
    near = near_threshold(type(lane.signals)(*(leaf[:number] for leaf in lane.signals)), gain_file)
    end, why = number, None
    if len(faulty):
        end = int(faulty[0])
        why = f"tick {end}: the controller acts on {', '.join(names(acting[end]))}"
    parted = parting(error, list(np.array(identified).T), lane.identified, near)
    if parted is not None and parted < end:
        end = parted
        why = f"tick {end}: rounding decides at a threshold"
    wrong = np.flatnonzero(error[:end] > REPLAY_LIMIT)
    reason = None
    if len(wrong):
        tick = int(wrong[0])
        reason = (
            f"tick {tick}: force command found {found[tick].item()!r} N, simulated "
            f"{expected[tick].item()!r} N: they differ by {error[tick]:.1e} of the command's range "
            f"{span:.4g} N, allowed {REPLAY_LIMIT:.0e}"
        )
    elif lane.sent is not None:
        simulated = np.asarray(lane.sent)[:end]
        apart, span = relative_difference(sent[:end], simulated)
        if np.any(apart > REPLAY_LIMIT):
            tick = int(np.argmax(apart > REPLAY_LIMIT))
            reason = (
                f"tick {tick}: position command found {sent[tick].item()!r} m, simulated "
                f"{simulated[tick].item()!r} m: they differ by {apart[tick]:.1e} of the command's range "
                f"{span:.4g} m, allowed {REPLAY_LIMIT:.0e}"
            )
    # A fraction of what is left to compare has to do, for who reads the file sees no more.
    kept = expected.copy()
    kept[end:] = nan
    late = np.flatnonzero(np.abs(found - kept) > REPLAY_LIMIT * command_range(kept))
    if len(late):
        kept[int(late[0]) :] = nan
    return (
        [row._replace(force_simulated=float(one)) for row, one in zip(rows, kept, strict=True)],
        why,
        reason,
    )
