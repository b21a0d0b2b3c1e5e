"""Command `jaxhil replay`: runs one scenario of a sweep again and compares it bit by bit."""

from pathlib import Path
from typing import Any

from jaxhil.files import follow
from jaxhil.simulation.environment import prepare
from tuning import terminal
from tuning.cli.commands import checks
from tuning.cli.options import Replay
from tuning.front_door import arguments

KEYS = ("restitution", "reference_restitution", "error", "peak_force", "reference_peak_force", "peak_command")
KEYS = (*KEYS, "duration", "reference_duration", "position_shortfall", "approach_velocity")
KEYS = (*KEYS, "energy_in", "energy_out")


def run(options: Replay) -> int:
    """Run the scenario and print its contacts; return 0 if all numbers equal the stored ones, else 1."""
    arguments.integers(0, index=options.index)
    if options.plot is not None:
        checks.check_plot(options.plot)
    prepare()
    from tuning.sweeps.manifest import unlike_here
    from tuning.sweeps.replay import replay
    from tuning.sweeps.store import read_store

    store = read_store(Path(options.store))
    result = replay(store, options.index)
    document = _document(options, store, result)
    document["unlike"] = unlike_here(store.manifest)
    if options.plot is not None:
        from jaxhil.simulation.contact_plot import save
        from tuning.plots.scenarios import scenario_plot

        title = f"{document['mechanism']}, scenario {options.index} of {store.folder.resolve().name}"
        save(scenario_plot(result.sweep, options.index, title), follow(options.plot))
        terminal.note(f"wrote {options.plot}")
    if options.json:
        terminal.emit_json(document)
    else:
        _print(document)
    return 0 if document["verdict"] == "good" else 1


def _document(options: Replay, store, result) -> dict[str, Any]:
    """Return the JSON document of the replayed scenario."""
    from tuning.sweeps.columns import ERRORS_IN_SPACE, PER_EPISODE, slots, texts_of

    row = {
        name: texts_of(name)[int(values[0])] if name.startswith(("status_", "outcome")) else values[0].item()
        for name, values in result.again.items()
    }
    mechanism = result.sweep.mechanism
    model = result.sweep.model
    keys = KEYS if model.axes == 1 else (*ERRORS_IN_SPACE, *PER_EPISODE)
    return {
        "store": str(store.folder),
        "index": options.index,
        "mechanism": mechanism.name,
        "compensator": model.compensator_name(result.sweep.loop),
        "inputs": {
            column.name: row[column.name] for column in store.manifest.columns if column.kind == "input"
        },
        f"{model.run_name}s": [
            {**{key: row[f"{key}_{number}"] for key in keys}, "status": row[f"status_{number}"]}
            for number in sorted({slot.number for slot in slots(mechanism)})
        ],
        "outcome": row["outcome"],
        "different": result.different,
        "verdict": "bad" if result.different else "good",
    }


def _print(document: dict[str, Any]) -> None:
    """Print inputs, contacts and the verdict."""
    inputs = terminal.table(
        f"{document['mechanism']}, compensation: {document['compensator']}, scenario {document['index']}",
        ["input", "drawn"],
        [(name, terminal.figure(value, 6)) for name, value in document["inputs"].items()],
    )
    lines = [f"Outcome: {document['outcome']}."]
    if document["verdict"] == "good":
        lines.append("Good: every number is the stored one, to the bit.")
    else:
        lines.append(f"Bad: differs from what is stored in {', '.join(document['different'][:8])}.")
    lines += [f"The store was made elsewhere: {difference}." for difference in document["unlike"]]
    terminal.emit(inputs, _contacts(document), *lines)


def _contacts(document: dict[str, Any]) -> Any:
    """Return the table of contacts (one axis) or episodes (six axes)."""
    if "contacts" in document:
        kind, runs, errors = "contact", document["contacts"], ["error"]
        cells = [[terminal.signed(run["error"])] for run in runs]
    else:
        kind, runs, errors = "episode", document["episodes"], ["energy error", "twist error"]
        cells = [[terminal.signed(run["energy_error"]), run["twist_error"]] for run in runs]
    rows = [
        (
            *(number, entry["restitution"], entry["reference_restitution"], *error),
            *(entry["peak_force"], terminal.ratio(entry["peak_force"], entry["reference_peak_force"])),
            *(1e3 * entry["duration"], terminal.ratio(entry["duration"], entry["reference_duration"])),
            *(1e3 * entry["approach_velocity"], entry["status"]),
        )
        for number, (entry, error) in enumerate(zip(runs, cells, strict=True), start=1)
    ]
    headings = [kind, "e", "e*", *errors, "peak [N]", "/ ideal", "duration [ms]", "/ ideal"]
    headings += ["speed [mm/s]", "status"]
    return terminal.table(f"{kind.capitalize()}s", headings, rows, texts=(len(headings) - 1,))
