"""`jaxhil replay`: one scenario of a sweep again; the exit code says whether it is the same to the bit."""

from pathlib import Path
from typing import Any

from jaxhil.files import follow
from jaxhil.simulation.environment import prepare
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import Replay
from tuning.front_door import arguments

KEYS = ("restitution", "reference_restitution", "error", "peak_force", "peak_command", "duration")
KEYS = (*KEYS, "position_shortfall", "approach_velocity", "energy_in", "energy_out")


def run(options: Replay) -> int:
    """Run the scenario, print its contacts; 0 if all numbers are the stored ones, else 1."""
    arguments.integers(0, index=options.index)
    if options.plot is not None:
        checks.picture(options.plot)
    prepare()
    from tuning.sweeps.manifest import unlike_here
    from tuning.sweeps.replay import motion_of, replay
    from tuning.sweeps.store import read_store

    store = read_store(Path(options.store))
    found = replay(store, options.index)
    document = _document(options, store, found)
    document["unlike"] = unlike_here(store.manifest)
    if options.plot is not None:
        from jaxhil.simulation.contact_plot import contact_plot, save

        title = f"{document['mechanism']}, scenario {options.index} of {store.folder.resolve().name}"
        save(contact_plot(motion_of(found.sweep, options.index), title, sensors="rig"), follow(options.plot))
        terminal.note(f"wrote {options.plot}")
    if options.json:
        terminal.emit_json(document)
    else:
        _print(document)
    return 0 if document["verdict"] == "good" else 1


def _document(options: Replay, store, found) -> dict[str, Any]:
    from tuning.sweeps.columns import texts_of

    row = {
        name: texts_of(name)[int(values[0])] if name.startswith(("status_", "outcome")) else values[0].item()
        for name, values in found.again.items()
    }
    contacts = range(1, found.sweep.mechanism.approach.contacts + 1)
    return {
        "store": str(store.folder),
        "index": options.index,
        "mechanism": found.sweep.mechanism.name,
        "compensator": found.sweep.loop.compensator.name,
        "inputs": {
            column.name: row[column.name] for column in store.manifest.columns if column.kind == "input"
        },
        "contacts": [
            {**{key: row[f"{key}_{number}"] for key in KEYS}, "status": row[f"status_{number}"]}
            for number in contacts
        ],
        "outcome": row["outcome"],
        "different": found.different,
        "verdict": "bad" if found.different else "good",
    }


def _print(document: dict[str, Any]) -> None:
    inputs = terminal.table(
        f"{document['mechanism']}, compensation: {document['compensator']}, scenario {document['index']}",
        ["input", "drawn"],
        [(name, terminal.figure(value, 6)) for name, value in document["inputs"].items()],
    )
    rows = []
    for number, contact in enumerate(document["contacts"], start=1):
        rows.append(
            (
                *(number, contact["restitution"], contact["reference_restitution"]),
                terminal.signed(contact["error"]),
                *(contact["peak_force"], 1e3 * contact["duration"], 1e3 * contact["approach_velocity"]),
                contact["status"],
            )
        )
    headings = ["contact", "e", "e*", "error", "peak force [N]", "duration [ms]", "approach [mm/s]", "status"]
    lines = [f"Outcome: {document['outcome']}."]
    if document["verdict"] == "good":
        lines.append("Good: every number is the stored one, to the bit.")
    else:
        lines.append(f"Bad: differs from what is stored in {', '.join(document['different'][:8])}.")
    lines += [f"The store was made elsewhere: {difference}." for difference in document["unlike"]]
    terminal.emit(inputs, terminal.table("Contacts", headings, rows, texts=(7,)), *lines)
