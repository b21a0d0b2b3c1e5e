"""Parser of the command line `jaxhil`.

The module of a command is imported only when the command runs, so that `--help` and errors in arguments do
not import jax.
"""

import importlib
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Annotated

import tyro
from tyro.conf import subcommand

from tuning.api.sweep_options import DEFAULT_SOBOL_SCENARIOS
from tuning.cli.options import (
    DEFAULT_PLOT,
    DEFAULT_REPLAY_PLOT,
    PLOT_SUFFIXES,
    Compare,
    InitOptions,
    MechanismsOptions,
    ReplayOptions,
    SimulateOptions,
    Sweep,
    Tune,
)
from tuning.cli.options_identify import IdentifyOptions, MonitorOptions
from tuning.cli.options_report import Map, ReportOptions
from tuning.cli.options_rig import DEFAULT_RIG_PLOT, DEFAULT_SHADOW_PLOT, Export, RigOptions, Shadow, Verify
from tuning.cli.timings import report_timings

# Old names of options, which are read for one release, and their new names.
RENAMED_OPTIONS = {
    "--judged": "--evaluated",
    "--validation": "--evaluated",
    "--honesty-weight": "--transparency-weight",
    "--certify": "--global-search",
    "--no-certify": "--no-global-search",
}

RENAMED_VALUES = {("--pareto-against", "honesty"): "transparency"}  # new value by option and old value

DESCRIPTION = """Gains that keep hardware-in-the-loop docking tests from diverging.

To begin: jaxhil init mine.toml, then jaxhil tune mine.toml. Help for a command: jaxhil COMMAND --help.

jaxhil --version prints the version. Completion by the Tab key, for bash (or zsh, tcsh):
jaxhil --tyro-write-completion bash ~/.local/share/bash-completion/completions/jaxhil"""

Command = (
    Annotated[InitOptions, subcommand("init")]
    | Annotated[SimulateOptions, subcommand("simulate")]
    | Annotated[IdentifyOptions, subcommand("identify")]
    | Annotated[MonitorOptions, subcommand("monitor")]
    | Annotated[Tune, subcommand("tune")]
    | Annotated[Sweep, subcommand("sweep")]
    | Annotated[ReplayOptions, subcommand("replay")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Verify, subcommand("verify")]
    | Annotated[Shadow, subcommand("shadow")]
    | Annotated[RigOptions, subcommand("rig")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Map, subcommand("map")]
    | Annotated[ReportOptions, subcommand("report")]
    | Annotated[MechanismsOptions, subcommand("mechanisms")]
)


def parse(arguments: Sequence[str] | None = None) -> Callable[[], int]:
    """Parse the arguments, and return a function that runs the command and returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        return _print_version
    options = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        prog="jaxhil",
        description=DESCRIPTION,
        args=replace_old_names(complete_bare_options(words)),
    )

    def run() -> int:
        command = type(options).__name__.removesuffix("Options").lower()
        with report_timings(options.timings):
            return importlib.import_module(f"tuning.cli.commands.{command}").run(options)

    return run


def _print_version() -> int:
    print(f"jaxhil {metadata.version('jaxhil')}")
    return 0


def complete_bare_options(arguments: list[str]) -> list[str]:
    """Insert the default value after each `--plot`, `--drivers` or `--rare` that has no value."""
    completed = []
    default_plots = {"replay": DEFAULT_REPLAY_PLOT, "rig": DEFAULT_RIG_PLOT, "shadow": DEFAULT_SHADOW_PLOT}
    plot = default_plots.get(arguments[0], DEFAULT_PLOT) if arguments else DEFAULT_PLOT
    for index, word in enumerate(arguments):
        completed.append(word)
        following = arguments[index + 1] if index + 1 < len(arguments) else ""
        if word == "--plot" and not following.lower().endswith(PLOT_SUFFIXES):
            completed.append(plot)
        elif word in ("--drivers", "--rare") and not _is_number(following):
            completed.append(str(DEFAULT_SOBOL_SCENARIOS) if word == "--drivers" else "0")
    return completed


def replace_old_names(arguments: Sequence[str]) -> list[str]:
    """Replace the old names of options and values by the new ones; print a warning for each."""
    replaced, option = [], ""
    for word in arguments:
        old, equals, value = word.partition("=")
        new = RENAMED_VALUES.get((option, word)) or RENAMED_OPTIONS.get(old, old)
        if new != old:
            _warn(f"{old} is now {new}; the old name will be removed in the next release")
        replaced.append(new + equals + value)
        option = word
    return replaced


def _warn(text: str) -> None:
    from tuning import terminal  # imports much that --help does not need

    terminal.warn([text])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
