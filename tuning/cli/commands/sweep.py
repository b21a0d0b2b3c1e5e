"""Command `jaxhil sweep`: estimates the failure probability from many scenarios, and lists the worst ones."""

from pathlib import Path

from jaxhil.simulation.jax_environment import prepare_jax
from tuning import terminal
from tuning.api.arguments import find_gain_file
from tuning.api.sweep import run_study
from tuning.cli.commands import sweep_tables
from tuning.cli.options import Sweep


def run(options: Sweep) -> int:
    """Compute the scenarios that are not stored yet, and print the results of all scenarios.

    Return the exit code: 0 if the verdict is good, 1 if it is bad, 2 if a result could not be
    written.
    """
    options.check()
    path = find_gain_file(options.gains)
    prepare_jax()
    folder = path.with_name(f"{path.stem}-sweep") if options.output is None else Path(options.output)
    study = run_study(path, options, folder, progress=True)
    if options.json:
        terminal.emit_json("sweep", study.document)
    else:
        sweep_tables.print_sweep(study.document)
        if study.verdict == "good":
            terminal.suggest("export", str(path), "--sweep", str(folder), "-o", "bundle")
        elif study.document["worst"]:
            terminal.suggest("replay", str(folder), str(study.document["worst"][0]["index"]))
    if study.unwritten:
        terminal.note(f"jaxhil: {study.unwritten[0]}")
        return 2
    return 0 if study.verdict == "good" else 1
