"""Command `jaxhil replay`: runs one scenario of a sweep again, and compares its numbers bit by bit."""

from pathlib import Path
from typing import Any

from jaxhil.files import resolve_output_path
from jaxhil.simulation.jax_environment import prepare_jax
from tuning import terminal
from tuning.api import arguments
from tuning.cli.commands import checks
from tuning.cli.options import ReplayOptions

# Metrics of a contact in the document.
CONTACT_KEYS = (
    "restitution",
    "reference_restitution",
    "error",
    "peak_force",
    "reference_peak_force",
    "peak_command",
    "duration",
    "reference_duration",
    "position_shortfall",
    "approach_velocity",
    "energy_in",
    "energy_out",
)


def run(options: ReplayOptions) -> int:
    """Run the scenario again, and print its contacts.

    Return the exit code: 0 if all numbers equal the stored ones, else 1.
    """
    arguments.check_integers(0, index=options.index)
    if options.plot is not None:
        checks.check_plot(options.plot)
    prepare_jax()
    from tuning.sweeps.manifest import list_process_differences
    from tuning.sweeps.replay import replay_scenario
    from tuning.sweeps.store import read_store

    store = read_store(Path(options.store))
    result = replay_scenario(store, options.index)
    document = _build_document(options, store, result)
    document["unlike"] = list_process_differences(store.manifest)
    if options.plot is not None:
        from jaxhil.simulation.contact_plot import save_figure
        from tuning.plots.scenarios import scenario_plot

        title = f"{document['mechanism']}, scenario {options.index} of {store.folder.resolve().name}"
        save_figure(scenario_plot(result.sweep, options.index, title), resolve_output_path(options.plot))
        terminal.note(f"wrote {options.plot}")
    if options.json:
        terminal.emit_json("replay", document)
    else:
        _print(document)
        if options.plot is None:
            terminal.suggest("replay", options.store, str(options.index), "--plot")
        else:
            terminal.suggest("report", options.store)
    return 0 if document["verdict"] == "good" else 1


def _build_document(options: ReplayOptions, store, result) -> dict[str, Any]:
    from tuning.sweeps.columns import (
        EPISODE_METRICS,
        SIX_AXIS_ERRORS,
        list_allowed_texts,
        list_contact_columns,
    )

    row = {
        name: list_allowed_texts(name)[int(values[0])]
        if name.startswith(("status_", "outcome"))
        else values[0].item()
        for name, values in result.again.items()
    }
    mechanism = result.sweep.mechanism
    model = result.sweep.model
    keys = CONTACT_KEYS if model.axes == 1 else (*SIX_AXIS_ERRORS, *EPISODE_METRICS)
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
            for number in sorted({slot.number for slot in list_contact_columns(mechanism)})
        ],
        "outcome": row["outcome"],
        "different": result.different_columns,
        "verdict": "bad" if result.different_columns else "good",
    }


def _print(document: dict[str, Any]) -> None:
    inputs = terminal.build_table(
        f"{document['mechanism']}, compensation: {document['compensator']}, scenario {document['index']}",
        ["input", "drawn"],
        [
            (terminal.format_key(name), terminal.format_number(value, 6))
            for name, value in document["inputs"].items()
        ],
    )
    lines = [f"Outcome: {document['outcome']}."]
    if document["verdict"] == "good":
        lines.append("Good: every number is the stored one, to the bit.")
    else:
        lines.append(f"Bad: differs from what is stored in {', '.join(document['different'][:8])}.")
    lines += [f"The sweep was computed differently: {difference}." for difference in document["unlike"]]
    terminal.emit(inputs, _contact_table(document), *lines)


def _contact_table(document: dict[str, Any]) -> Any:
    if "contacts" in document:
        kind, runs, errors = "contact", document["contacts"], ["error"]
        cells = [[terminal.format_error(run["error"])] for run in runs]
    else:
        kind, runs, errors = "episode", document["episodes"], ["energy error", "twist error"]
        cells = [[terminal.format_error(run["energy_error"]), run["twist_error"]] for run in runs]
    rows = [
        (
            *(number, entry["restitution"], entry["reference_restitution"], *error),
            *(entry["peak_force"], terminal.format_ratio(entry["peak_force"], entry["reference_peak_force"])),
            *(1e3 * entry["duration"], terminal.format_ratio(entry["duration"], entry["reference_duration"])),
            *([1e3 * entry["approach_velocity"]] if kind == "contact" else []),
            entry["status"],
        )
        for number, (entry, error) in enumerate(zip(runs, cells, strict=True), start=1)
    ]
    duration = "duration [ms]" if kind == "contact" else "in touch [ms]"
    headings = [kind, "e", "e*", *errors, "peak [N]", "/ ideal", duration, "/ ideal"]
    headings += [*(["speed [mm/s]"] if kind == "contact" else []), "status"]
    return terminal.build_table(f"{kind.capitalize()}s", headings, rows, texts=(len(headings) - 1,))
