"""`jaxhil verify`: does the runtime on the rig do what was simulated and tuned? The exit code says so."""

from typing import Any

from tuning import terminal
from tuning.cli.options_rig import Verify
from tuning.front_door.verify import verify


def run(options: Verify) -> int:
    """0 if the runtime agrees; 1 if not, or if the file is corrupt; 2 if there is nothing to read."""
    found = verify(
        options.path, key=options.key, scenarios=options.scenarios, seed=options.seed, progress=True
    )
    document = found.document
    if options.json:
        terminal.emit_json(document)
    else:
        _print(document)
    return 0 if found.good else 1


def _exponential(value: float | None) -> str:
    # What is not finite comes as None.
    return "-" if value is None else f"{value:.1e}"


def _print(document: dict[str, Any]) -> None:
    from jaxhil.simulation.contact_bounds import BRIEFLY

    tables: list[Any] = list(document.get("self_test", ()))
    if "signature" in document:
        tables.append(f"Signature: {document['signature']}.")
    if "replay" in document:
        tables += [
            terminal.table(
                f"{document['mechanism']}, {document['compensator']}: recorded runs through the runtime",
                ["run", "ticks", "compared", "near a threshold", "command range [N]", "largest difference"],
                [
                    (
                        *("nominal" if number == 0 else f"draw {number}", lane["ticks"], lane["compared"]),
                        *(lane["near"], lane["command_range"], _exponential(lane["difference"])),
                    )
                    for number, lane in enumerate(document["replay"])
                ],
            ),
            terminal.table(
                "Nominal contacts with the runtime in the loop",
                ["contact", "e", "e simulated", "force / ideal", "duration / ideal", "status", "simulated"],
                [
                    (
                        *(number, terminal.figure(one["restitution"], 9)),
                        terminal.figure(one["simulated_restitution"], 9),
                        *(terminal.figure(one["peak_force_ratio"]), terminal.figure(one["duration_ratio"])),
                        one["status"],
                        one["simulated_status"],
                    )
                    for number, one in enumerate(document["closed_loop"], start=1)
                ],
                texts=(5, 6),
            ),
        ]
    if document["verdict"]:
        lines = [
            f"Good: commands agree to {document['replay_limit']:.0e} of their range, restitutions to "
            f"{document['closed_loop_limit']:.0e}; real contact: {BRIEFLY}."
        ]
    else:
        lines = [f"Bad: {reason}" for reason in document["reasons"]]
    terminal.emit(*tables, *lines)
