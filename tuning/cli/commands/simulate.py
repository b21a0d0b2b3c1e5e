"""`jaxhil simulate`: the contacts of one mechanism, run once."""

from typing import Any

from jaxhil.errors import InputError, one_line, shown
from jaxhil.mechanism.conversion import KeyProblem
from jaxhil.mechanism.file import from_builtins, load, to_builtins
from jaxhil.mechanism.overrides import apply_override, parse_override
from jaxhil.mechanism.structs import Mechanism
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import Simulate
from tuning.environment import prepare


def run(options: Simulate) -> int:
    """Run the contacts, report each; 0 if every error is within the limit, else 1."""
    checks.limit(options.limit)
    checks.at_least(0, seed=options.seed)
    if options.plot is not None:
        checks.picture(options.plot)
    if options.compensator is not None:
        checks.compensator(options.compensator)
    mechanism = None
    if options.gains is None or options.file is not None:
        mechanism = load(options.file, options.overrides).mechanism
    prepare()
    mechanism, compensator, gains = _gains(options, mechanism)
    contacts, status = simulate(mechanism, compensator, gains, options.seed)
    good = status == "ok" and all(abs(contact["error"]) <= options.limit for contact in contacts)
    if options.plot is not None:
        from jaxhil.simulation.motion import nominal_motion
        from tuning.pictures.plots import contact_plot, save

        motion = nominal_motion(mechanism, {"rig": (compensator, gains)}, options.seed)
        title = f"{mechanism.name}, compensation: {compensator}"
        save(contact_plot(motion, title, sensors="rig"), options.plot)
        terminal.note(f"wrote {options.plot}")
    if options.json:
        terminal.emit_json(
            {
                "mechanism": mechanism.name,
                "compensator": compensator,
                "gains": gains,
                "contacts": contacts,
                "status": status,
                "limit": options.limit,
                "verdict": "good" if good else "bad",
            }
        )
    else:
        _print(options, mechanism, compensator, contacts, status, good)
    return 0 if good else 1


def simulate(
    mechanism: Mechanism, compensator: str, gains: dict[str, float], seed: int
) -> tuple[list[dict[str, Any]], str]:
    """The contacts that were reached, in SI units, and "ok" or the status of the first that failed.

    A contact that did not end has no restitution and no error.
    """
    from jaxhil.compensators import COMPENSATORS
    from jaxhil.simulation.building import build_loop
    from jaxhil.simulation.evaluation import evaluate
    from jaxhil.simulation.metrics import NOT_REACHED, OK, STATUS_NAMES
    from jaxhil.simulation.scenario import build_scenarios

    scenarios = build_scenarios(mechanism, seed=seed)
    outcome = evaluate(build_loop(mechanism, compensator, scenarios), gains, scenarios)
    metrics = outcome.metrics
    estimates = COMPENSATORS[compensator].estimates_delay
    contacts, overall = [], "ok"
    for slot in range(mechanism.approach.contacts):
        status = int(metrics.status[slot, 0])
        if status == NOT_REACHED:
            break
        ended = status == OK

        def value(array, ended=True, slot=slot):
            return float(array[slot, 0]) if ended else float("nan")

        contacts.append(
            {
                "restitution": value(metrics.restitution, ended),
                "reference_restitution": value(outcome.reference_restitution, ended),
                "error": value(outcome.error, ended),
                "peak_force": value(metrics.peak_force),
                "reference_peak_force": value(outcome.reference_peak_force, ended),
                "peak_command": value(metrics.peak_command),
                "position_shortfall": value(metrics.position_shortfall),
                "duration": value(metrics.duration),
                "approach_velocity": value(metrics.approach_velocity),
                **({"force_delay": value(metrics.force_delay)} if estimates else {}),
                "status": STATUS_NAMES[status],
            }
        )
        if not ended:
            overall = STATUS_NAMES[status]
            break
    if overall == "ok" and len(contacts) < mechanism.approach.contacts:
        overall = STATUS_NAMES[NOT_REACHED]
    return contacts, overall


def _gains(options: Simulate, mechanism: Mechanism | None) -> tuple[Mechanism, str, dict[str, float]]:
    """Mechanism, compensator and gains: the gain file's, or the literature's gains."""
    from jaxhil.compensators import literature_gains

    if options.gains is None:
        assert mechanism is not None
        compensator = options.compensator or "none"
        checks.setting(compensator, options.setting)
        return mechanism, compensator, literature_gains(mechanism, compensator, options.setting)

    from tuning.gain_file import load_gain_file

    if options.setting is not None:
        raise InputError(f"--setting: found {shown(options.setting)}, allowed none beside a gain file")
    loaded = load_gain_file(options.gains)
    label = one_line(options.gains)
    if options.compensator not in (None, loaded.compensator):
        raise InputError(
            f"--compensator: found {options.compensator}, allowed {loaded.compensator}, which {label} is for"
        )
    if mechanism is None:
        mechanism = _overridden(loaded.mechanism, options.overrides, label)
    _check_fit(mechanism, loaded, label)
    return mechanism, loaded.compensator, loaded.gains


def _overridden(mechanism: Mechanism, overrides: tuple[str, ...], label: str) -> Mechanism:
    raw = to_builtins(mechanism)
    for text in overrides:
        try:
            raw = apply_override(raw, *parse_override(text))
        except KeyProblem as problem:
            raise InputError(f"{label}: --set {one_line(text, 60)}: {problem}") from None
    return from_builtins(raw, label) if overrides else mechanism


def _check_fit(mechanism: Mechanism, loaded, label: str) -> None:
    """Gains act per control period, and a delay line is as long as a gain's bound."""
    from jaxhil.compensators import COMPENSATORS

    period, tuned = mechanism.rig.control_period, loaded.mechanism.rig.control_period
    if period != tuned:
        raise InputError(f"{label}: control_period: found {tuned:g} s, allowed {period:g} s of the mechanism")
    for gain in COMPENSATORS[loaded.compensator].gains:
        value, lower, upper = loaded.gains[gain.name], gain.lower(mechanism), gain.upper(mechanism)
        margin = 1e-9 * max(abs(lower), abs(upper))
        if not lower - margin <= value <= upper + margin:
            raise InputError(
                f"{label}: gains.{gain.name}: found {value:.6g}, allowed {lower:.6g} to {upper:.6g} "
                f"{gain.unit} for this mechanism"
            )


def _print(options, mechanism, compensator, contacts, status, good) -> None:
    estimates = any("force_delay" in contact for contact in contacts)
    rows = [
        [
            number,
            contact["restitution"],
            contact["reference_restitution"],
            f"{contact['error']:+.4f}" if contact["status"] == "ok" else "-",
            contact["peak_force"],
            1e3 * contact["duration"],
            1e3 * contact["approach_velocity"],
            *([f"{1e3 * contact['force_delay']:.2f}"] if estimates else []),
            contact["status"],
        ]
        for number, contact in enumerate(contacts, start=1)
    ]
    headings = ["contact", "e", "e*", "error", "peak force [N]", "duration [ms]", "approach [mm/s]"]
    headings += ["force delay [ms]"] * estimates + ["status"]
    rule = "the gain file's gains" if options.gains is not None else "gains by the literature's rule"
    title = f"{mechanism.name}, compensation: {compensator}"
    title += f", {rule}" if compensator != "none" else ""
    wanted = mechanism.approach.contacts
    lines = []
    if len(contacts) < wanted:
        lines.append(f"{wanted - len(contacts)} of {wanted} contacts were not reached.")
    if good:
        lines.append(f"Good: every error is within {options.limit:g}.")
    elif status != "ok":
        lines.append(f"Bad: the run ended with status '{status}'.")
    else:
        worst = max((contact["error"] for contact in contacts), key=abs)
        kind = "divergence" if worst > 0 else "convergence"
        lines.append(f"Bad: the largest error is {worst:+.4f} ({kind}), allowed {options.limit:g}.")
    terminal.emit(terminal.table(title, headings, rows, texts=(len(headings) - 1,)), *lines)
