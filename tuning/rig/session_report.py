"""Report of a session: comparison of every contact with its ideal contact, and a verdict with reasons."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxhil.mechanism.structs import Mechanism
from tuning.rig.contact_detector import MAX_CONTACT_DURATION, RigContact
from tuning.rig.rig_task import MAX_COMMAND_AGE, STALLED
from tuning.rig.session import CAUSE_CONTROLLER, LoopReport, SessionReport, SessionSettings


def ideal_restitutions(mechanism: Mechanism, contacts: Sequence[RigContact]) -> list[float]:
    """Return the ideal restitution e* of each contact at its approach speed; this imports JAX."""
    if not contacts:
        return []
    from jaxhil.simulation.jax_environment import prepare_jax

    prepare_jax()
    import jax

    from jaxhil.contact.laws import find_contact_law
    from jaxhil.simulation.outcome import parameters_by_slot
    from jaxhil.simulation.scenario import build_scenarios

    scenario = build_scenarios(mechanism)
    number = np.array([contact.number for contact in contacts])
    parameters = jax.tree.map(lambda leaf: leaf[number], scenario.contact)
    speeds = [contact.approach_velocity for contact in contacts]
    velocity = np.array([speed if speed > 0.0 else 1.0 for speed in speeds])[:, None]
    mass = np.broadcast_to(scenario.equivalent_mass, velocity.shape)
    law = find_contact_law(mechanism.contact.law).simulation_law
    ideal = jax.jit(lambda contact, *motion: law.ideal_contact(parameters_by_slot(contact), *motion))
    return [float(value) for value in np.asarray(ideal(parameters, mass, velocity).restitution)[:, 0]]


def is_stalled(contact: RigContact, setup: SessionSettings, run: LoopReport | None) -> bool:
    """Return whether the computer, and not the controller, delayed the commands during a contact.

    This is the case if a command was older than `MAX_COMMAND_AGE` periods and the controller did not cause
    any missed tick of the contact. Such a contact says nothing about the controller. If faults are injected,
    the result is always False.
    """
    if run is None or setup.injection.any or contact.oldest_command <= MAX_COMMAND_AGE:
        return False
    first, last = contact.packets
    return not np.any(run.causes[first : last + 1] == CAUSE_CONTROLLER)


def evaluate_session(
    setup: SessionSettings,
    session: SessionReport,
    references: Sequence[float],
    limit: float,
    compensator: str,
) -> dict[str, Any]:
    """Evaluate a session: return its results, the verdict and the reasons as JSON data in SI units.

    Args:
        setup: settings of the session.
        session: results of the session.
        references: ideal restitution e* of each contact.
        limit: largest permitted magnitude of the restitution error e - e* [1].
        compensator: name of the compensator.
    """
    contacts = [
        {
            **contact._asdict(),
            "status": STALLED if is_stalled(contact, setup, session.run) else contact.status,
            "reference_restitution": reference,
            "error": contact.restitution - reference if contact.status == "ok" else None,
        }
        for contact, reference in zip(session.contacts, references, strict=True)
    ]
    errors = [contact["error"] for contact in contacts if contact["status"] == "ok"]
    reasons = _failure_reasons(setup, session, [contact["status"] for contact in contacts], errors, limit)
    good = f"the controller caused no missed tick, and every restitution error is within {limit:g}."
    if session.tripped:
        good = "the injected faults caused the trip, and every command was finite and within its limits."
    return {
        "mechanism": setup.mechanism.name,
        "compensator": compensator,
        "control_period": setup.mechanism.rig.control_period,
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
        "commanded": None if session.commanded is None else session.commanded._asdict(),
        "stroke": setup.stroke,
        "tripped": session.tripped,
        "resets": session.resets,
        "interrupted": session.interrupted,
        "limit": limit,
        "reasons": reasons,
        "good": good,
        "verdict": "bad" if reasons else "good",
    }


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
    wrong = [error for error in errors if not abs(error) <= limit]
    if wrong:
        worst = max(wrong, key=abs)
        kind = "divergence" if worst > 0 else "convergence"
        reasons.append(
            f"{len(wrong)} of {len(errors)} contacts have a restitution error beyond {limit:g}; the largest "
            f"is {worst:+.4f} ({kind})."
        )
    failed = [status for status in statuses if status not in ("ok", "tripped", STALLED)]
    if failed:
        reasons.append(f"{len(failed)} contacts have no valid result: {', '.join(sorted(set(failed)))}.")
    if "timeout" in failed:
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
        reasons.append("a restitution error is NaN.")
    return reasons
