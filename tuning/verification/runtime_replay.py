"""Verification that the rig's runtime behaves like the simulation with which gains were tuned.

Two comparisons use the gains of a gain file. *Replay*: JAX simulates and records the nominal run and some
random draws. The runtime's controller receives the recorded readings, and its force and position commands are
compared with the recorded commands. *Closed loop*: the nominal contacts are simulated with the runtime
instead of the JAX controller, and the restitution of each contact is compared.

Runtime and simulation compute in a different order. Therefore their commands differ by rounding errors, which
are a small fraction of the commands' range. There is one exception: a value can be so close to a threshold
(the surface, or the contact threshold of the force) that a rounding error decides on which side it lies. Such
ticks are counted and compared separately. If the decisions differ, the comparison of this run ends.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from jaxhil.laws.simulation_base import Signals
from jaxhil.rig import Controller
from jaxhil.rig.gain_file import GainFile, check_gain_document
from jaxhil.rig.limits import NO_LIMITS
from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS_SHORT_TEXT
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import CONTACT_STATUS_NAMES, OK, Metrics
from jaxhil.simulation.outcome import Outcome, compare_with_ideal
from jaxhil.simulation.recording import LaneRecord, nominal_and_draws, record_lanes
from tuning.verification.closed_loop import run_closed_loop
from tuning.verification.stops import ControllerStop

REPLAY_LIMIT = 1e-11  # largest difference of commands, divided by the commands' range [1]
CLOSED_LOOP_LIMIT = 1e-9  # largest difference of a contact's restitution [1]
THRESHOLD_TOLERANCE = 1e-9  # relative distance from a threshold within which a rounding error can decide [1]
ESTIMATE_TOLERANCE = 1e-6  # relative difference of identified values that proves a different decision [1]
MIN_COMPARED_SHARE = 0.5  # smallest fraction of ticks that must be compared for a positive verdict [1]
DEFAULT_REPLAYED_RUNS = 6  # default number of replayed runs: the nominal run and five draws


class LaneReplay(msgspec.Struct, frozen=True):
    """Comparison of one recorded run with its replay in the runtime."""

    ticks: int  # number of recorded ticks
    compared: int  # number of compared ticks
    near: int  # number of recorded ticks in which a value is near a threshold
    command_range: float  # range of the recorded force command, including 0 [N]
    # largest difference of force commands in the other ticks, divided by `command_range` [1]
    difference: float
    # largest difference of force commands in the `near` ticks, divided by `command_range` [1]
    near_difference: float
    worst_tick: int  # tick with the largest `difference`
    found: float  # force command of the runtime in this tick [N]
    expected: float  # recorded force command in this tick [N]
    # tick in which a decision at a threshold differs, so that the comparison ends; None if no decision
    # differs
    parted: int | None
    status: str  # status of the runtime's controller at the end of the run
    position_difference: float = 0.0  # largest difference of position commands, divided by their range [1]


class ContactComparison(msgspec.Struct, frozen=True):
    """Comparison of one nominal contact with the rig's runtime and with the JAX controller in the loop."""

    restitution: float | None  # restitution with the runtime [1]; None if the contact does not end
    simulated_restitution: float | None  # JAX controller's restitution [1]; None if the contact does not end
    status: str  # contact's status (`jaxhil.simulation.metrics`) if the runtime controls it
    simulated_status: str  # contact's status if the JAX controller controls it
    peak_force_ratio: float | None = None  # peak force with the runtime / peak force of the ideal contact [1]
    duration_ratio: float | None = None  # duration with the runtime / duration of the ideal contact [1]


class VerificationReport(msgspec.Struct, frozen=True):
    """Verdict of a verification, with all comparisons of runtime and simulation."""

    verdict: bool  # whether runtime and simulation agree in all comparisons
    reasons: tuple[str, ...]  # reasons for a negative verdict; empty if it is positive
    compensator: str  # name of the compensator
    replay_limit: float  # largest accepted difference of commands, divided by their range [1]
    closed_loop_limit: float  # largest accepted difference of restitution [1]
    replay: tuple[LaneReplay, ...]  # one comparison for each replayed run
    closed_loop: tuple[ContactComparison, ...]  # one comparison for each nominal contact
    stop: ControllerStop | None = None  # first stop in closed loop by a limit; None if no limit stops it


def verify(
    loaded: LoadedGains,
    scenarios: int = DEFAULT_REPLAYED_RUNS,
    seed: int = 0,
    progress: Callable[[str], None] = lambda message: None,
) -> VerificationReport:
    """Verify that the rig's runtime behaves like the simulation with the gains of a gain file.

    Args:
        loaded: gain file.
        scenarios: number of replayed runs: the nominal run and random draws.
        seed: seed of the draws.
        progress: callback, called with a description of each stage.

    Returns:
        The verdict, and the comparisons by replay and in closed loop.

    Raises:
        RuntimeError: If JAX does not compute in float64.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError("jax_enable_x64: found False, expected True (float32 is too inaccurate)")
    gain_file = check_gain_document(loaded.document)
    progress(f"recording {scenarios} runs")
    batch = nominal_and_draws(loaded.mechanism, scenarios, seed)
    metrics, lanes = record_lanes(loaded, batch)
    # The controller knows the drawn period and clearance. The replay compares the compensators alone, so
    # remove the limits, which may rightly stop some draws.
    gain_files = [
        gain_file._replace(control_period=float(period), clearance=float(clearance), limits=NO_LIMITS)
        for period, clearance in zip(batch.control_period, batch.clearance, strict=True)
    ]
    progress(f"replaying {sum(len(lane.command) for lane in lanes)} ticks through the runtime")
    replays = [replay_lane(lane, file) for lane, file in zip(lanes, gain_files, strict=True)]
    progress("running the nominal contacts with the runtime in the loop")
    closed, stop = run_closed_loop(loaded, gain_file, batch)
    contacts = loaded.mechanism.approach.contacts
    loop = build_loop(loaded.mechanism, loaded.compensator, batch)
    nominal = jax.tree.map(lambda leaf: jnp.asarray(leaf)[..., :1], batch)
    outcome = jax.device_get(compare_with_ideal(loop, nominal, jax.tree.map(jnp.asarray, closed)))
    comparisons = [_compare_contact(outcome, metrics, contact) for contact in range(contacts)]
    stopped = [] if stop is None else [f"closed loop: {stop.text}"]
    unlike = [
        f"closed loop, contact {number}: found {contact.peak_force_ratio:.3g} times the peak force and "
        f"{contact.duration_ratio:.3g} times the duration of the ideal contact, expected "
        f"{CONTACT_BOUNDS_SHORT_TEXT}"
        for number, contact in enumerate(comparisons, start=1)
        if outcome.is_unlike_ideal[number - 1, 0]
    ]
    reasons = (
        *_list_replay_reasons(replays),
        *stopped,
        *_list_closed_loop_reasons(comparisons, stop),
        *unlike,
    )
    return VerificationReport(
        verdict=not reasons,
        reasons=reasons,
        compensator=loaded.compensator,
        replay_limit=REPLAY_LIMIT,
        closed_loop_limit=CLOSED_LOOP_LIMIT,
        replay=tuple(replays),
        closed_loop=tuple(comparisons),
        stop=stop,
    )


def replay_lane(lane: LaneRecord, gain_file: GainFile) -> LaneReplay:
    """Replay a recorded run in the runtime; compare the runtime's commands with the recorded commands."""
    controller = Controller(gain_file)
    commands, positions, stiffness, damping = compute_runtime_commands(controller, lane)
    near = find_threshold_ticks(lane.signals, gain_file)
    error, span = compute_relative_difference(commands, np.asarray(lane.command))
    parted = find_divergence_tick(error, (stiffness, damping), lane.identified, near)
    compared = len(commands) if parted is None else parted
    regular_error = np.where(near, 0.0, error)[:compared]
    worst = int(np.argmax(regular_error)) if compared else 0
    return LaneReplay(
        ticks=len(commands),
        compared=compared,
        near=int(np.sum(near)),
        command_range=span,
        difference=float(np.max(regular_error, initial=0.0)),
        near_difference=float(np.max(error[:compared][near[:compared]], initial=0.0)),
        worst_tick=worst,
        found=float(commands[worst]) if compared else 0.0,
        expected=float(lane.command[worst]) if compared else 0.0,
        parted=parted,
        status=controller.status,
        position_difference=compute_position_difference(positions[:compared], lane),
    )


def compute_runtime_commands(
    controller: Controller, lane: LaneRecord
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compute the commands of the runtime's controller for the recorded signals of a run.

    Return force command [N], position command [m], identified stiffness [N/m] and identified damping [N s/m],
    each (ticks,). A position command is NaN if the record does not contain the next state of the numerical
    model.
    """
    controller.reset()
    readings = list(zip(*(leaf.tolist() for leaf in lane.signals), strict=True))
    results = []
    for tick, (force, position, velocity, measured, age) in enumerate(readings):
        if age == 0 and tick > 0:
            controller.next_contact()
        if age == 0:
            # The first position command tells the controller that the numerical model already moves.
            controller.position_command(position, velocity, 0.0)
        command = controller.step(force, position, velocity, measured)
        identified, sent = controller.identified, math.nan
        if lane.sent is not None and tick + 1 < len(readings) and readings[tick + 1][4] == age + 1:
            # All integrators compute v(n+1) = v(n) + T a, so that the record determines a.
            next_position, next_velocity = readings[tick + 1][1:3]
            acceleration = (next_velocity - velocity) / controller.control_period
            sent = controller.position_command(next_position, next_velocity, acceleration)
        results.append((0.0 if age == 0 and lane.zeroed else command, sent, *identified))
    commands, positions, stiffness, damping = np.array(results, float).reshape(-1, 4).T
    return commands, positions, stiffness, damping


def compute_position_difference(positions: np.ndarray, lane: LaneRecord) -> float:
    """Return the largest difference between `positions` and the recorded position commands.

    The difference is divided by the range of the recorded commands. NaN in `positions` is ignored.
    """
    if lane.sent is None:
        return 0.0
    expected = np.asarray(lane.sent)[: len(positions)]
    error, _ = compute_relative_difference(positions, np.where(np.isnan(positions), np.nan, expected))
    return float(np.max(error, initial=0.0))


def compute_command_range(commands: np.ndarray) -> float:
    """Return the width [N] of the range that contains 0 and all finite commands."""
    finite = commands[np.isfinite(commands)]
    return float(np.max(finite, initial=0.0) - np.min(finite, initial=0.0))


def compute_relative_difference(commands: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the differences of commands, divided by the range of the expected commands, and this range [N].

    A difference is 0 if the expected command is NaN.
    """
    span = compute_command_range(expected)
    error = np.where(np.isnan(expected), 0.0, np.abs(commands - expected))
    # If the expected command is always 0, every other command has an infinite relative difference.
    return error / span if span > 0 else np.where(error == 0, 0.0, np.inf), span


def find_divergence_tick(
    error: np.ndarray,
    identified: Sequence[np.ndarray],
    expected: Sequence[np.ndarray | jax.Array] | None,
    near: np.ndarray,
) -> int | None:
    """Return the first tick in which runtime and simulation decide differently at a threshold, or None.

    This is the first tick near a threshold in which the commands or the estimates differ. The result is None
    if there is no such tick, or if commands or estimates already differ in an earlier tick.

    Args:
        error: relative difference of the force commands, (ticks,).
        identified: stiffness and damping identified by the runtime, each (ticks,).
        expected: stiffness and damping identified in the simulation; None if not recorded.
        near: whether a value is near a threshold, (ticks,).
    """
    differs = error > REPLAY_LIMIT
    for estimate, recorded in zip(identified, expected or (), strict=expected is not None):
        recorded = np.asarray(recorded)[: len(error)]
        differs |= np.abs(estimate - recorded) > ESTIMATE_TOLERANCE * np.max(np.abs(recorded), initial=0.0)
    differing_ticks = np.nonzero(near & differs)[0]
    # If a difference existed before this tick, then the decision at the threshold did not cause it.
    if not len(differing_ticks) or np.any(differs[: differing_ticks[0]]):
        return None
    return int(differing_ticks[0])


def find_threshold_ticks(signals: Signals, gain_file: GainFile) -> np.ndarray:
    """Return for each tick whether a value of the compensator is near a threshold, (ticks,) of bool.

    Compensators that identify the contact have two kinds of threshold: the surfaces, for the delay-aligned
    position, and the contact threshold, for the magnitude of the force in contact. The position is near a
    surface if their distance is below `THRESHOLD_TOLERANCE` times the largest measured position. The force
    is near its threshold if the difference is below `THRESHOLD_TOLERANCE` times the larger of the two.
    """
    gains, clearance = gain_file.gains, gain_file.clearance
    near = np.zeros(len(signals.age), bool)
    if "contact_threshold" not in gains or not len(near):
        return near
    aligned = _align_position(signals, gains["identification_delay"], gain_file.control_period)
    margin = THRESHOLD_TOLERANCE * np.max(np.abs(signals.position_measured))
    near |= np.minimum(np.abs(aligned), np.abs(aligned + clearance)) < margin
    force, threshold = np.abs(signals.force_measured), gains["contact_threshold"]
    in_contact = (aligned > 0) | (aligned < -clearance)
    return near | in_contact & (
        np.abs(force - threshold) < THRESHOLD_TOLERANCE * np.maximum(force, threshold)
    )


def _align_position(signals: Signals, delay: float, period: float) -> np.ndarray:
    """Delay the measured position [m] by `delay` [s].

    Between ticks, the position is interpolated linearly. Before a run, the motion is assumed to be uniform.
    """
    measured, velocity, age = signals.position_measured, signals.velocity_desired, signals.age
    tick = np.arange(len(measured))
    begun = tick - age
    back = delay / period
    whole = int(np.floor(back + 1e-9))
    past = np.maximum(tick - whole, 0), np.maximum(tick - whole - 1, 0)
    between = measured[past[0]] + (back - whole) * (measured[past[1]] - measured[past[0]])
    uniform = measured[begun] + (age - back) * period * velocity[begun]
    return np.where(age <= whole, uniform, between)


def _compare_contact(outcome: Outcome, simulated: Metrics, contact: int) -> ContactComparison:
    closed = outcome.metrics
    ended = closed.status[contact, 0] == OK
    ratios = (outcome.peak_force_ratio, outcome.duration_ratio)
    return ContactComparison(
        restitution=_get_restitution(closed, contact),
        simulated_restitution=_get_restitution(simulated, contact),
        status=CONTACT_STATUS_NAMES[int(closed.status[contact, 0])],
        simulated_status=CONTACT_STATUS_NAMES[int(simulated.status[contact, 0])],
        peak_force_ratio=float(ratios[0][contact, 0]) if ended else None,
        duration_ratio=float(ratios[1][contact, 0]) if ended else None,
    )


def _get_restitution(metrics: Metrics, contact: int) -> float | None:
    return float(metrics.restitution[contact, 0]) if metrics.status[contact, 0] == OK else None


def _list_replay_reasons(replays: list[LaneReplay]) -> Iterator[str]:
    for number, lane in enumerate(replays):
        run = "the nominal run" if number == 0 else f"draw {number}"
        if lane.status != "ok":
            yield f"{run}: the runtime's controller {lane.status}"
        if lane.difference > REPLAY_LIMIT:
            yield (
                f"{run}, tick {lane.worst_tick}: force command: found {lane.found!r} N, expected "
                f"{lane.expected!r} N (simulation): the difference is {lane.difference:.1e} of the command's "
                f"range {lane.command_range:.4g} N, expected {REPLAY_LIMIT:.0e} or less"
            )
        if lane.position_difference > REPLAY_LIMIT:
            yield (
                f"{run}: position commands differ by {lane.position_difference:.1e} of their range, expected "
                f"{REPLAY_LIMIT:.0e} or less"
            )
    ticks, compared = sum(lane.ticks for lane in replays), sum(lane.compared for lane in replays)
    if compared < MIN_COMPARED_SHARE * ticks:
        yield (
            f"replay: {compared} of {ticks} ticks could be compared before a rounding error decided at a "
            f"threshold, expected at least {MIN_COMPARED_SHARE:.0%}"
        )


def _list_closed_loop_reasons(
    comparisons: list[ContactComparison], stop: ControllerStop | None
) -> Iterator[str]:
    tripped = stop is not None and stop.tripped
    for number, contact in enumerate(comparisons, start=1):
        where = f"closed loop, contact {number}"
        if tripped and contact.status == "not reached":
            # The stop is already a reason.
            continue
        if contact.restitution is None or contact.simulated_restitution is None:
            yield (
                f"{where}: status: found {contact.status} with the runtime and {contact.simulated_status} in "
                "the simulation, expected ok"
            )
            continue
        difference = abs(contact.restitution - contact.simulated_restitution)
        if not difference <= CLOSED_LOOP_LIMIT:
            yield (
                f"{where}: restitution: found {contact.restitution!r}, expected "
                f"{contact.simulated_restitution!r} (simulation): the difference is {difference:.1e}, "
                f"expected {CLOSED_LOOP_LIMIT:.0e} or less"
            )
