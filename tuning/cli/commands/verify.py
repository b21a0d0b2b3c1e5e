"""Command `jaxhil verify`: checks that the rig's controller code reproduces the simulated controller."""

from pathlib import Path
from typing import Any

from tuning import terminal
from tuning.api.verify import verify
from tuning.cli.options_rig import Verify

NO_FMU_LOOP = (
    "The loop through the bundle's FMUs was not closed: it needs a C compiler, no force bias, and a command "
    "latency to which the master can add a period."
)


def run(options: Verify) -> int:
    """Verify a bundle or a gain file, and print the result.

    Return exit code 0 if the force commands agree with the simulated ones, and 1 if they differ or a file is
    corrupt. Raise `InputError` for an unreadable file.
    """
    result = verify(
        options.path, key=options.key, scenarios=options.scenarios, seed=options.seed, progress=True
    )
    document = result.document
    if options.json:
        terminal.emit_json("verify", document)
    else:
        _print(document)
        if result.good and Path(options.path).is_dir():
            terminal.suggest("rig", options.path)
        elif result.good:
            terminal.suggest("export", options.path, "-o", "bundle")
        elif Path(options.path).is_dir():
            terminal.suggest("export", "GAINS", "-o", options.path)
    return 0 if result.good else 1


def _format_exponential(value: float | None) -> str:
    # In the document, None stands for a value that is not finite.
    return "-" if value is None else f"{value:.1e}"


def _six_axis_tables(document: dict[str, Any]) -> list[Any]:
    """Return the tables of the replayed runs and the closed loop of a six-axis verification."""
    closed = document["closed_loop"]
    return [
        terminal.build_table(
            f"{document['mechanism']}, {document['compensator']}: recorded runs through the runtime",
            ["run", "ticks", "largest difference of wrenches", "of poses"],
            [
                (
                    *("nominal" if number == 0 else f"draw {number}", lane["ticks"]),
                    *(_format_exponential(lane["difference"]), _format_exponential(lane["pose_difference"])),
                )
                for number, lane in enumerate(document["replay"])
            ],
        ),
        _twist_table(
            f"Final twist of the nominal run with the runtime in the loop ({closed['status']})", closed
        ),
    ]


def _twist_table(title: str, final: dict[str, Any]) -> Any:
    """Return a table with two columns: the final twist found with the rig's code, and the simulated one."""
    twists = zip(("vx", "vy", "vz", "wx", "wy", "wz"), final["found"], final["simulated"], strict=True)
    rows = [(name, *(terminal.format_number(value, 9) for value in values)) for name, *values in twists]
    return terminal.build_table(title, ["", "found", "simulated"], rows)


def _fmu_table(loop: dict[str, Any]) -> Any:
    """Return the table of the loop that the two FMUs form: the nominal contacts, or the final twist."""
    if loop["final_twist"] is not None:
        return _twist_table(
            f"Final twist of the nominal run with the FMUs of FMI {loop['fmi']}, rig.command_latency = "
            f"{loop['command_latency']}",
            loop["final_twist"],
        )
    return terminal.build_table(
        f"Nominal contacts with the FMUs of FMI {loop['fmi']}, rig.command_latency = "
        f"{loop['command_latency']}",
        ["contact", "e", "e simulated", "status", "simulated"],
        [
            (
                number,
                terminal.format_number(contact["restitution"], 9),
                terminal.format_number(contact["simulated_restitution"], 9),
                contact["status"],
                contact["simulated_status"],
            )
            for number, contact in enumerate(loop["contacts"], start=1)
        ],
        texts=(3, 4),
    )


def _print(document: dict[str, Any]) -> None:
    from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS_SHORT_TEXT

    result_is_good = document["verdict"] == "good"
    tables: list[Any] = list(document.get("self_test", ()))
    if "signature" in document:
        tables.append(f"Signature: {document['signature']}.")
    if document.get("axes") == 6:
        tables += _six_axis_tables(document)
    elif "replay" in document:
        tables += [
            terminal.build_table(
                f"{document['mechanism']}, {document['compensator']}: runs replayed by the runtime",
                ["run", "ticks", "compared", "near a threshold", "command range [N]", "largest difference"],
                [
                    (
                        *("nominal" if number == 0 else f"draw {number}", lane["ticks"], lane["compared"]),
                        *(lane["near"], lane["command_range"], _format_exponential(lane["difference"])),
                    )
                    for number, lane in enumerate(document["replay"])
                ],
            ),
            terminal.build_table(
                "Nominal contacts with the runtime in the loop",
                ["contact", "e", "e simulated", "force / ideal", "duration / ideal", "status", "simulated"],
                [
                    (
                        *(number, terminal.format_number(contact["restitution"], 9)),
                        terminal.format_number(contact["simulated_restitution"], 9),
                        *(
                            terminal.format_number(contact["peak_force_ratio"]),
                            terminal.format_number(contact["duration_ratio"]),
                        ),
                        contact["status"],
                        contact["simulated_status"],
                    )
                    for number, contact in enumerate(document["closed_loop"], start=1)
                ],
                texts=(5, 6),
            ),
        ]
    notes = []
    if document.get("fmu_loop"):
        tables.append(_fmu_table(document["fmu_loop"]))
    elif "fmu_loop" in document:
        notes = [NO_FMU_LOOP]
    if result_is_good and document.get("axes") == 6:
        lines = [
            f"Good: commands agree to {document['replay_limit']:.0e} of their range, the final twist to "
            f"{document['closed_loop_limit']:.0e}."
        ]
    elif result_is_good:
        lines = [
            f"Good: commands agree to {document['replay_limit']:.0e} of their range, restitutions to "
            f"{document['closed_loop_limit']:.0e}; real contact: {CONTACT_BOUNDS_SHORT_TEXT}."
        ]
    else:
        lines = [f"Bad: {reason}" for reason in document["reasons"]]
    terminal.emit(*tables, *notes, *lines)
