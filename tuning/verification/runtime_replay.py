"""Verification that the rig's runtime behaves like the simulation with which gains were tuned.

There are two comparisons with the gains of a gain file. *Replay*: the loop is recorded in JAX for the nominal
mechanism and some draws of its uncertainty. The runtime's controller gets the recorded readings at every
tick, and the force and position commands of both are compared. *Closed loop*: the nominal contacts are run
with the runtime instead of the JAX controller, and each contact's restitution is compared.

The order of operations differs, so that both agree within rounding, a small fraction of the command's range.
The exception is a decision (in contact or not, force above the contact threshold or not) so close to its
threshold that rounding decides. Such ticks are counted and compared separately; if the decisions differ, the
comparison of that lane ends.
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

REPLAY_LIMIT = 1e-11  # largest difference of commands over their range [1]
CLOSED_LOOP_LIMIT = 1e-9  # largest difference of restitution [1]
THRESHOLD_TOLERANCE = 1e-9  # relative distance from a threshold within which rounding may decide
ESTIMATE_TOLERANCE = 1e-6  # relative difference of identified parameters that shows a different decision
MIN_COMPARED_SHARE = 0.5  # least share of compared ticks for a positive verdict
DEFAULT_REPLAYED_RUNS = 6  # default number of replayed runs


class LaneReplay(msgspec.Struct, frozen=True):
    """Comparison of one recorded lane with its replay in the runtime."""

    ticks: int  # number of recorded ticks
    compared: int  # number of compared ticks
    near: int  # number of recorded ticks near a threshold
    command_range: float  # range of the force command, 0 included [N]
    difference: float  # largest difference away from thresholds over that range [1]
    near_difference: float  # largest difference near thresholds over that range [1]
    worst_tick: int  # tick of `difference`
    found: float  # runtime's command at the worst tick [N]
    expected: float  # simulated command at the worst tick [N]
    # tick at which a decision at a threshold differs, where the comparison ends; None if there is none
    parted: int | None
    status: str  # status of the runtime's controller
    position_difference: float = 0.0  # largest difference of position commands over their range [1]


class ContactComparison(msgspec.Struct, frozen=True):
    """Comparison of one nominal contact in closed loop with the simulation."""

    restitution: float | None  # with the runtime in the loop [1]
    simulated_restitution: float | None  # with the JAX controller [1]
    status: str
    simulated_status: str
    # with the runtime in the loop, peak real force and duration over those of the ideal contact [1]
    peak_force_ratio: float | None = None
    duration_ratio: float | None = None


class VerificationReport(msgspec.Struct, frozen=True):
    """Verdict of a verification and the comparisons that it follows from."""

    verdict: bool  # whether all comparisons agree
    reasons: tuple[str, ...]  # reasons of a negative verdict
    compensator: str  # name of the compensator
    replay_limit: float  # allowed difference of commands over their range [1]
    closed_loop_limit: float  # allowed difference of restitution [1]
    replay: tuple[LaneReplay, ...]  # one per lane
    closed_loop: tuple[ContactComparison, ...]  # one per contact
    stop: ControllerStop | None = None  # first stop by the gain file's limits in closed loop, if any


def verify(
    loaded: LoadedGains,
    scenarios: int = DEFAULT_REPLAYED_RUNS,
    seed: int = 0,
    progress: Callable[[str], None] = lambda message: None,
) -> VerificationReport:
    """Replay `scenarios` runs (the nominal one and draws) and run the nominal contacts in closed loop.

    `progress` is called with a description of each stage. Raise RuntimeError unless JAX computes in float64.
    """
    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError("verification compares to 1e-11: switch jax_enable_x64 on first")
    gain_file = check_gain_document(loaded.document)
    progress(f"recording {scenarios} runs")
    batch = nominal_and_draws(loaded.mechanism, scenarios, seed)
    metrics, lanes = record_lanes(loaded, batch)
    # The controller knows the drawn period and clearance. Limits are removed, since only the law is compared,
    # and the limits may rightly stop some draw.
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
        f"closed loop, contact {number}: real peak force {contact.peak_force_ratio:.3g} times, duration "
        f"{contact.duration_ratio:.3g} times the ideal contact's, expected {CONTACT_BOUNDS_SHORT_TEXT}"
        for number, contact in enumerate(comparisons, start=1)
        if outcome.unlike[number - 1, 0]
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
    """Replay a lane's signals in the runtime and compare its commands with the recorded ones."""
    controller = Controller(gain_file)
    commands, positions, stiffness, damping = compute_runtime_commands(controller, lane)
    near = find_threshold_ticks(lane.signals, gain_file)
    error, span = compute_relative_difference(commands, np.asarray(lane.command))
    parted = find_divergence_tick(error, (stiffness, damping), lane.identified, near)
    compared = len(commands) if parted is None else parted
    clear = np.where(near, 0.0, error)[:compared]
    worst = int(np.argmax(clear)) if compared else 0
    return LaneReplay(
        ticks=len(commands),
        compared=compared,
        near=int(np.sum(near)),
        command_range=span,
        difference=float(np.max(clear, initial=0.0)),
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
    """Return the runtime's commands and estimates for the lane's signals, four arrays (ticks,).

    They are force command [N], position command [m], stiffness [N/m] and damping [N s/m]. A position command
    is NaN if the next motion of the numerical model is not recorded.
    """
    controller.reset()
    readings = list(zip(*(leaf.tolist() for leaf in lane.signals), strict=True))
    results = []
    for tick, (force, position, velocity, measured, age) in enumerate(readings):
        if age == 0 and tick > 0:
            controller.next_contact()
        if age == 0:
            # The first position command tells the controller that the model is moving already.
            controller.position_command(position, velocity, 0.0)
        command = controller.step(force, position, velocity, measured)
        identified, sent = controller.identified, math.nan
        if lane.sent is not None and tick + 1 < len(readings) and readings[tick + 1][4] == age + 1:
            # Every integrator has v(n+1) = v(n) + T a.
            next_position, next_velocity = readings[tick + 1][1:3]
            acceleration = (next_velocity - velocity) / controller.control_period
            sent = controller.position_command(next_position, next_velocity, acceleration)
        results.append((0.0 if age == 0 and lane.zeroed else command, sent, *identified))
    commands, positions, stiffness, damping = np.array(results, float).reshape(-1, 4).T
    return commands, positions, stiffness, damping


def compute_position_difference(positions: np.ndarray, lane: LaneRecord) -> float:
    """Return the largest difference of the position commands from the lane's, over the range of these.

    Commands that are NaN are ignored.
    """
    if lane.sent is None:
        return 0.0
    expected = np.asarray(lane.sent)[: len(positions)]
    error, _ = compute_relative_difference(positions, np.where(np.isnan(positions), np.nan, expected))
    return float(np.max(error, initial=0.0))


def compute_command_range(commands: np.ndarray) -> float:
    """Return the range of the finite commands [N], 0 included."""
    finite = commands[np.isfinite(commands)]
    return float(np.max(finite, initial=0.0) - np.min(finite, initial=0.0))


def compute_relative_difference(commands: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the differences over the expected range, 0 where NaN is expected, and that range [N]."""
    span = compute_command_range(expected)
    error = np.where(np.isnan(expected), 0.0, np.abs(commands - expected))
    # If the expected command is always 0, only equal commands pass.
    return error / span if span > 0 else np.where(error == 0, 0.0, np.inf), span


def find_divergence_tick(
    error: np.ndarray,
    identified: Sequence[np.ndarray],
    expected: Sequence[np.ndarray | jax.Array] | None,
    near: np.ndarray,
) -> int | None:
    """Return the tick near a threshold from which both sides differ, by commands or estimates; None if none.

    `error` is that of the commands; `identified` and `expected` are the estimates of both sides, if any.
    """
    differs = error > REPLAY_LIMIT
    for estimate, recorded in zip(identified, expected or (), strict=expected is not None):
        recorded = np.asarray(recorded)[: len(error)]
        differs |= np.abs(estimate - recorded) > ESTIMATE_TOLERANCE * np.max(np.abs(recorded), initial=0.0)
    partings = np.nonzero(near & differs)[0]
    # A difference that existed before the tick near a threshold was not caused by a decision there.
    return int(partings[0]) if len(partings) and not np.any(differs[: partings[0]]) else None


def find_threshold_ticks(signals: Signals, gain_file: GainFile) -> np.ndarray:
    """Return the ticks, (ticks,), with a decision of the law within `THRESHOLD_TOLERANCE` of its threshold.

    Laws that identify have two decisions. One is the side of a surface on which the delay-aligned position
    lies, with a margin relative to the measured positions. The other, in contact, is whether |F| exceeds the
    contact threshold, with a margin relative to the larger of both. If both are 0, rounding cannot decide.
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
    """Return the measured position [m] delayed by `delay` [s], linear between ticks, uniform before a run."""
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
                f"{run}, tick {lane.worst_tick}: force command found {lane.found!r} N, expected "
                f"{lane.expected!r} N: they differ by {lane.difference:.1e} of the command's range "
                f"{lane.command_range:.4g} N, limit {REPLAY_LIMIT:.0e}"
            )
        if lane.position_difference > REPLAY_LIMIT:
            yield (
                f"{run}: position commands differ by {lane.position_difference:.1e} of their range, limit "
                f"{REPLAY_LIMIT:.0e}"
            )
    ticks, compared = sum(lane.ticks for lane in replays), sum(lane.compared for lane in replays)
    if compared < MIN_COMPARED_SHARE * ticks:
        yield (
            f"replay: {compared} of {ticks} ticks could be compared before rounding decided at a threshold, "
            f"expected at least {MIN_COMPARED_SHARE:.0%}"
        )


def _list_closed_loop_reasons(
    comparisons: list[ContactComparison], stop: ControllerStop | None
) -> Iterator[str]:
    tripped = stop is not None and stop.tripped
    for number, contact in enumerate(comparisons, start=1):
        where = f"closed loop, contact {number}"
        if tripped and contact.status == "not reached":
            # The stop is a reason of its own.
            continue
        if contact.restitution is None or contact.simulated_restitution is None:
            yield f"{where}: found {contact.status}, simulated {contact.simulated_status}, expected ok"
            continue
        difference = abs(contact.restitution - contact.simulated_restitution)
        if not difference <= CLOSED_LOOP_LIMIT:
            yield (
                f"{where}: restitution found {contact.restitution!r}, simulated "
                f"{contact.simulated_restitution!r}: they differ by {difference:.1e}, limit "
                f"{CLOSED_LOOP_LIMIT:.0e}"
            )
