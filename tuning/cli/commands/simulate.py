"""Command `jaxhil simulate`: runs the contacts of one mechanism once."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.jax_environment import prepare_jax
from tuning import terminal
from tuning.api import arguments, mechanism_summary
from tuning.cli.commands import checks, simulate_six
from tuning.cli.commands.choice import (
    load_any_named_mechanism,
    load_six_axis_mechanism,
    select_compensator,
    suggest_next,
)
from tuning.cli.options import SimulateOptions

if TYPE_CHECKING:
    from jaxhil.simulation.run import ContactResult, Run

# Heading and decimals of the table column of each estimate; a column shows 1000 times the SI value.
ESTIMATE_COLUMNS = {"force_delay": ("force delay [ms]", 2)}


def run(options: SimulateOptions) -> int:
    """Simulate the contacts, and print a table of contacts and the verdict.

    Return the exit code: 0 if the verdict is good, that is, if `Run.reasons` is empty, else 1.
    """
    arguments.check_limit(options.limit)
    arguments.check_integers(0, seed=options.seed)
    if options.plot is not None:
        checks.check_plot(options.plot)
    for path in (options.log, options.one_axis):
        if path is not None:
            checks.check_file_path(path)
    if options.one_axis is not None:
        checks.check_is_new("--one-axis", Path(options.one_axis))
    mechanism = load_any_named_mechanism(options)
    if mechanism is None:
        prepare_jax()
        mechanism = load_six_axis_mechanism(options)
    if isinstance(mechanism, SixAxisMechanism):
        simulate_six.check_six_axis_options(options)
        prepare_jax()
        return simulate_six.run(options, mechanism)
    if options.one_axis is not None:
        allowed = "no --one-axis: the mechanism already has one axis"
        raise InputError(f"--one-axis: found {format_value(options.one_axis)}, expected {allowed}")
    if options.animate is not None:
        allowed = "no animation of a one-axis mechanism"
        raise InputError(f"--animate: found {format_value(options.animate)}, expected {allowed}")
    if options.reference:
        allowed = "a six-axis mechanism: for one axis, the table always contains e*"
        raise InputError(f"--reference: found a one-axis mechanism, expected {allowed}")
    prepare_jax()
    from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS
    from jaxhil.simulation.run import simulate

    mechanism, compensator, gains = select_compensator(options, mechanism)
    _check_simulation(mechanism, compensator, gains)
    mechanism_summary.report_summary(mechanism, None if options.json else terminal.emit)
    result = simulate(mechanism, compensator, gains, seed=options.seed)
    limit = arguments.choose_limit(options.limit, mechanism)
    reasons = result.reasons(limit)
    if options.plot is not None:
        result.plot(options.plot)
        terminal.note(f"wrote {options.plot}")
    if options.log is not None:
        result.to_csv(options.log)
        terminal.note(f"wrote {options.log}")
    contacts = [_contact_entry(contact) for contact in result.contacts]
    if options.json:
        terminal.emit_json(
            "simulate",
            {
                "mechanism": mechanism.name,
                "compensator": result.compensator,
                "gains": result.gains,
                "contacts": contacts,
                "status": result.status,
                "reason": _explain_status(result.status),
                "meaning": result.summary,
                "limit": limit,
                "bounds": CONTACT_BOUNDS,
                "reasons": reasons,
                "verdict": "bad" if reasons else "good",
            },
        )
    else:
        _print(options, limit, result, contacts, reasons)
        suggest_next(options, result.compensator)
    return 1 if reasons else 0


def _check_simulation(mechanism: Mechanism, compensator: str, gains: str | Path | None) -> None:
    """Raise `InputError` if the mechanism cannot be simulated with these gains."""
    from jaxhil.simulation.gain_choice import choose_gains
    from jaxhil.simulation.plausibility import check_run

    choose_gains(mechanism, compensator, gains)
    check_run(mechanism)


def _explain_status(status: str) -> str | None:
    """Return the explanation of a run's status, or None if the run ended well."""
    from jaxhil.simulation.metrics import CONTACT_STATUS_REASONS

    return CONTACT_STATUS_REASONS.get(status)


def _contact_entry(contact: "ContactResult") -> dict[str, Any]:
    """Return the JSON entry of a contact, with only those estimates that the compensator computes."""
    return {name: value for name, value in contact._asdict().items() if value is not None}


def _print(
    options: SimulateOptions,
    limit: float,
    result: "Run",
    contacts: list[dict[str, Any]],
    reasons: list[str],
) -> None:
    from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS_TEXT

    # A line below the table states the number of contacts that were not reached.
    contacts = [contact for contact in contacts if contact["status"] != "not reached"]
    estimates = [name for name in ESTIMATE_COLUMNS if any(name in contact for contact in contacts)]
    rows = [
        [
            number,
            contact["restitution"],
            contact["reference_restitution"],
            f"{contact['error']:+.4f}" if contact["status"] == "ok" else "-",
            contact["peak_force"],
            terminal.format_ratio(contact["peak_force"], contact["reference_peak_force"]),
            1e3 * contact["duration"],
            terminal.format_ratio(contact["duration"], contact["reference_duration"]),
            1e3 * contact["approach_velocity"],
            *(f"{1e3 * contact[name]:.{ESTIMATE_COLUMNS[name][1]}f}" for name in estimates),
            contact["status"],
        ]
        for number, contact in enumerate(contacts, start=1)
    ]
    headings = ["contact", "e", "e*", "error", "peak [N]", "/ ideal", "duration [ms]", "/ ideal"]
    headings += ["speed [mm/s]"]
    headings += [*(ESTIMATE_COLUMNS[name][0] for name in estimates), "status"]
    rule = "the gain file's gains" if options.gains is not None else "gains by the literature's rule"
    rule = rule if options.setting is None else f"gains of the setting {options.setting}"
    title = f"{result.mechanism.name}, compensation: {result.compensator}"
    title += f", {rule}" if result.compensator != "none" else ""
    total = len(result.contacts)
    lines = []
    if len(contacts) < total:
        lines.append(f"{total - len(contacts)} of {total} contacts were not reached.")
    if reasons:
        lines += [f"Bad: {reason}." for reason in reasons]
    else:
        lines.append(f"Good: every error is within {limit:g}, {CONTACT_BOUNDS_TEXT}.")
    terminal.emit(terminal.build_table(title, headings, rows, texts=(len(headings) - 1,)), *lines)
