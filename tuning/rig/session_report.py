"""Report of a session: comparison of every contact with its ideal contact, and a verdict with reasons."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tuning.rig.contact_detector import MAX_CONTACT_DURATION
from tuning.rig.rig_task import MAX_COMMAND_AGE, STALLED, SimulatedRig
from tuning.rig.session import CAUSE_CONTROLLER, LoopReport, SessionReport, SessionSettings


def is_stalled(contact: dict[str, Any], setup: SessionSettings, run: LoopReport | None) -> bool:
    """Return whether the computer, and not the controller, delayed the commands during a contact.

    This is the case if a command was older than `MAX_COMMAND_AGE` periods and the controller did not cause
    any missed tick of the contact. Such a contact says nothing about the controller. If faults are injected,
    the result is False. It is also False for a controller that this session did not start, because the causes
    of missed ticks are then unknown.
    """
    if (
        run is None
        or setup.injection.any
        or setup.port is not None
        or contact["oldest_command"] <= MAX_COMMAND_AGE
    ):
        return False
    first, last = contact["packets"]
    return not np.any(run.causes[first : last + 1] == CAUSE_CONTROLLER)


def evaluate_session(
    setup: SessionSettings,
    rig: SimulatedRig,
    session: SessionReport,
    limit: float,
    compensator: str,
) -> dict[str, Any]:
    """Evaluate a session: return its results, the verdict and the reasons as JSON data in SI units.

    Args:
        setup: settings of the session.
        rig: simulated rig of the session.
        session: results of the session.
        limit: largest permitted magnitude of the restitution error e - e*; for six axes, of the twist error
            [1].
        compensator: name of the compensator.
    """
    contacts = rig.evaluate(session.contacts)
    for contact in contacts:
        if is_stalled(contact, setup, session.run):
            contact["status"] = STALLED
    errors = [contact[rig.error_name] for contact in contacts if contact["status"] in rig.good_statuses]
    reasons = _failure_reasons(
        setup, rig, session, [contact["status"] for contact in contacts], errors, limit
    )
    good = f"the controller caused no missed tick, and every {_describe_error(rig)} is within {limit:g}."
    if setup.port is not None and session.run is not None:
        missed = f"{session.run.metrics.missed} of {session.run.metrics.ticks} ticks were missed"
        good = f"every {_describe_error(rig)} is within {limit:g}; {missed}, with unknown causes."
    if session.tripped:
        good = "the injected faults caused the trip, and every command was finite and within its limits."
    return {
        "mechanism": setup.mechanism.name,
        "axes": rig.axes,
        "compensator": compensator,
        "control_period": setup.mechanism.rig.control_period,
        "rate": setup.rate,
        "duration": setup.duration,
        "seed": setup.seed,
        "realtime": setup.priority,
        "injection": setup.injection._asdict(),
        "empty_loop": _loop_document(session.empty),
        "run": _loop_document(session.run),
        "contacts": contacts,
        "judged": len(errors),
        "stalled": sum(contact["status"] == STALLED for contact in contacts),
        "largest_error": max(errors, key=abs, default=None),
        "commanded": None if session.commanded is None else _plain(session.commanded._asdict()),
        "stroke": _plain(setup.stroke),
        "tripped": session.tripped,
        "resets": session.resets,
        "interrupted": session.interrupted,
        "limit": limit,
        "reasons": reasons,
        "good": good,
        "verdict": "bad" if reasons else "good",
    }


def _describe_error(rig: SimulatedRig) -> str:
    """Return, in words, the kind of error that decides the session's verdict."""
    return "restitution error" if rig.axes == 1 else rig.error_name.replace("_", " ")


def _plain(value: Any) -> Any:
    """Convert tuples to lists for JSON, but a tuple with a single entry (one axis) to this entry."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if not isinstance(value, tuple):
        return value
    return value[0] if len(value) == 1 else [_plain(entry) for entry in value]


def _loop_document(loop: LoopReport | None) -> dict[str, Any] | None:
    if loop is None:
        return None
    metrics = loop.metrics._asdict()
    for name in ("tick_time", "tick_cpu", "round_trip", "lateness"):
        metrics[name] = metrics[name]._asdict()
    record = {key: loop.controller[key] for key in ("ended", "status", "ignored", "stale", "made_up", "jax")}
    # The program in an older bundle may not report quality flags ("doubts").
    record["doubts"] = loop.controller.get("doubts", {})
    times = loop.controller["replayed"]["cpu"]
    return {
        **metrics,
        "controller": record,
        "replayed": len(times),
        "replayed_most": max(times, default=0) * 1e-9,
    }


def _failure_reasons(
    setup: SessionSettings,
    rig: SimulatedRig,
    session: SessionReport,
    statuses: Sequence[str],
    errors: Sequence[float],
    limit: float,
) -> list[str]:
    reasons = []
    run, commanded = session.run, session.commanded
    if run is not None:
        missed = run.metrics.missed_by_controller
        if missed:
            reasons.append(f"the controller caused {missed} missed tick{'s' if missed > 1 else ''}.")
        if run.controller["ended"] not in ("stopped",):
            reasons.append(
                f"the controller's process ended before the run (reason: {run.controller['ended']})."
            )
        ticks = setup.count_ticks(setup.duration)
        if (
            run.metrics.ticks < ticks
            and setup.port is not None
            and not (session.tripped or session.interrupted)
        ):
            reasons.append(
                f"the controller stopped answering: the run ended at tick {run.metrics.ticks} of {ticks}."
            )
    wrong = [error for error in errors if not abs(error) <= limit]
    if wrong:
        worst = max(wrong, key=abs)
        kind = f"{worst:.4f}"
        if rig.axes == 1:
            kind = f"{worst:+.4f} ({'divergence' if worst > 0 else 'convergence'})"
        reasons.append(
            f"{len(wrong)} of {len(errors)} contacts have a {_describe_error(rig)} beyond {limit:g}; the "
            f"largest is {kind}."
        )
    failed = [status for status in statuses if status not in (*rig.good_statuses, "tripped", STALLED)]
    if failed:
        reasons.append(f"{len(failed)} contacts have no valid result: {', '.join(sorted(set(failed)))}.")
    if "timeout" in failed and rig.axes == 1:
        reasons.append(f"timeout: the contact lasted longer than {MAX_CONTACT_DURATION:g} s.")
    if session.tripped and not setup.injection.any:
        reasons.append("the controller tripped although no faults were injected.")
    if commanded is not None and commanded.not_finite:
        reasons.append(f"{commanded.not_finite} commands were NaN or infinite.")
    if commanded is not None and commanded.beyond_limits:
        reasons.append(f"{commanded.beyond_limits} position commands were beyond their limits.")
    if not errors and not session.tripped and not session.interrupted:
        reasons.append("no contact could be evaluated: the run was too short, or the computer too busy.")
    if math.isnan(sum(errors)):
        reasons.append(f"a {_describe_error(rig)} is NaN.")
    return reasons
