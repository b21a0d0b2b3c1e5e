"""`jaxhil verify`: does the runtime on the rig do what was simulated and tuned? The exit code says so.

A bundle is checked against its manifest from here, then by its own self-test in a bare interpreter, and then
as its gain file is.
"""

from pathlib import Path
from typing import Any

from jaxhil.errors import InputError
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options_rig import Verify
from tuning.environment import prepare


def run(options: Verify) -> int:
    """0 if the runtime agrees; 1 if not, or if the file is corrupt; 2 if there is nothing to read."""
    checks.at_least(1, scenarios=options.scenarios)
    checks.at_least(0, seed=options.seed)
    from tuning.bundle.manifest import is_bundle

    folder = checks.folder(options.path)
    if folder is None or not is_bundle(folder):
        return _finish(options, _verified(options, checks.gain_file(options.path)))
    from tuning.bundle.checking import check_bundle

    checked = check_bundle(folder)
    document: dict[str, Any] = {"bundle": str(folder), "self_test": checked.lines}
    if checked.reasons:
        document.update(verdict=False, reasons=checked.reasons)
    else:
        document.update(_verified(options, folder / "gains.json"))
    return _finish(options, document)


def _verified(options: Verify, path: Path) -> dict[str, Any]:
    """What verification finds of a gain file."""
    prepare()
    import msgspec

    from tuning.gain_file import load_gain_file
    from tuning.verification.replay import verify

    document: dict[str, Any] = {"file": str(path)}
    try:
        loaded = load_gain_file(path)
    except InputError as error:
        document.update(verdict=False, reasons=[str(error)])
    else:
        with terminal.stages(3) as stages:
            found = verify(loaded, options.scenarios, options.seed, stages.begin)
        document.update(mechanism=loaded.mechanism.name, **msgspec.to_builtins(found))
    return document


def _finish(options: Verify, document: dict[str, Any]) -> int:
    if options.json:
        terminal.emit_json(document)
    else:
        _print(document)
    return 0 if document["verdict"] else 1


def _exponential(value: float | None) -> str:
    # What is not finite comes as None.
    return "-" if value is None else f"{value:.1e}"


def _print(document: dict[str, Any]) -> None:
    tables: list[Any] = list(document.get("self_test", ()))
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
                ["contact", "e", "e simulated", "status", "status simulated"],
                [
                    (
                        *(number, terminal.figure(one["restitution"], 9)),
                        *(terminal.figure(one["simulated_restitution"], 9), one["status"]),
                        one["simulated_status"],
                    )
                    for number, one in enumerate(document["closed_loop"], start=1)
                ],
                texts=(3, 4),
            ),
        ]
    if document["verdict"]:
        lines = [
            f"Good: commands agree to {document['replay_limit']:.0e} of their range, restitutions to "
            f"{document['closed_loop_limit']:.0e}."
        ]
    else:
        lines = [f"Bad: {reason}" for reason in document["reasons"]]
    terminal.emit(*tables, *lines)
