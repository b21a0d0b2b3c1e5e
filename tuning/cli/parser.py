"""The command line `jaxhil`: which command was meant, and which module acts on it.

Neither `--help` nor a wrong argument imports jax: the commands' modules are imported when they run.
"""

import importlib
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Annotated

import tyro
from tyro.conf import subcommand

from tuning.cli.options import (
    DEFAULT_PLOT,
    DEFAULT_REPLAY_PLOT,
    PICTURES,
    Compare,
    Init,
    Mechanisms,
    Replay,
    Simulate,
    Sweep,
    Tune,
)
from tuning.cli.options_identify import Identify, Monitor
from tuning.cli.options_report import Map, Report
from tuning.cli.options_rig import DEFAULT_RIG_PLOT, Export, RigOptions, Verify
from tuning.cli.timings import measured
from tuning.front_door.sweep_options import DEFAULT_DRIVERS

DESCRIPTION = """Gains that keep hardware-in-the-loop docking tests from diverging.

To begin: jaxhil init mine.toml, then jaxhil tune mine.toml. More of a command: jaxhil COMMAND --help.

jaxhil --version says which version this is. Completion by the Tab key, for bash (or zsh, tcsh):
jaxhil --tyro-write-completion bash ~/.local/share/bash-completion/completions/jaxhil"""

Command = (
    Annotated[Init, subcommand("init")]
    | Annotated[Simulate, subcommand("simulate")]
    | Annotated[Identify, subcommand("identify")]
    | Annotated[Monitor, subcommand("monitor")]
    | Annotated[Tune, subcommand("tune")]
    | Annotated[Sweep, subcommand("sweep")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Verify, subcommand("verify")]
    | Annotated[RigOptions, subcommand("rig")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Map, subcommand("map")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Mechanisms, subcommand("mechanisms")]
)


def parse(arguments: Sequence[str] | None = None) -> Callable[[], int]:
    """The command that the arguments ask for, ready to run; it returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        return _print_version
    options = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        prog="jaxhil",
        description=DESCRIPTION,
        args=complete_bare(given),
    )

    def run() -> int:
        command = type(options).__name__.removesuffix("Options").lower()
        with measured(options.timings):
            return importlib.import_module(f"tuning.cli.commands.{command}").run(options)

    return run


def _print_version() -> int:
    print(f"jaxhil {metadata.version('jaxhil')}")
    return 0


def complete_bare(arguments: list[str]) -> list[str]:
    """A `--plot`, `--drivers` or `--rare` that no value follows gets the default one."""
    completed = []
    own = {"replay": DEFAULT_REPLAY_PLOT, "rig": DEFAULT_RIG_PLOT}
    plot = own.get(arguments[0], DEFAULT_PLOT) if arguments else DEFAULT_PLOT
    for place, word in enumerate(arguments):
        completed.append(word)
        following = arguments[place + 1] if place + 1 < len(arguments) else ""
        if word == "--plot" and not following.lower().endswith(PICTURES):
            completed.append(plot)
        elif word in ("--drivers", "--rare") and not _is_number(following):
            completed.append(str(DEFAULT_DRIVERS) if word == "--drivers" else "0")
    return completed


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
