"""Options of the commands of `jaxhil`, read by tyro."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from tuning.api.compare import CompareOptions
from tuning.api.options import (
    CompensatorName,
    Files,
    GainSource,
    Json,
    OptionalFile,
    OptionalLimit,
    Overrides,
    Resume,
    Setting,
    Timings,
    Unset,
    folder_option,
    number_option,
    text_option,
)
from tuning.api.sweep_options import SweepOptions
from tuning.api.tune_options import TuneOptions

PLOT_SUFFIXES = (".png", ".pdf", ".svg")
DEFAULT_PLOT = "jaxhil-out/simulate.png"
DEFAULT_REPLAY_PLOT = "jaxhil-out/replay.png"


@dataclass(frozen=True)
class InitOptions:
    """Write a mechanism file to start from.

    Example: jaxhil init rig-300kg --output my-rig.toml

    A file with one axis states the meaning, unit, range and default of every key. A file with six axes is a
    copy of the built-in file with its comments; the guide's page on six axes lists its keys. An existing file
    is never overwritten.
    """

    name: Annotated[
        Positional[str | None],
        text_option(
            "[NAME]",
            "Built-in mechanism to copy, by default 'varying'; or NAME.toml, the file to write.",
        ),
    ] = None
    output: Annotated[
        str | None, text_option("FILE", "File to write; by default mechanism.toml.", aliases=("-o",))
    ] = None
    list: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Only list the names of the built-in mechanisms; write nothing."),
    ] = False
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class SimulateOptions:
    """Simulate the contacts once; report restitution, error, peak force and duration of each contact.

    Example: jaxhil simulate rig-300kg --compensator phase_lead --set approach.velocity=0.01

    The exit code is 0 if three conditions hold for every contact: |e - e*| is within the limit, the real peak
    force is at most 2 times the ideal contact's, and the duration is 0.5 to 2 times the ideal contact's.
    Otherwise it is 1.
    """

    file: OptionalFile = None
    compensator: CompensatorName = None
    setting: Setting = None
    gains: GainSource = None
    overrides: Overrides = ()
    unset: Unset = ()
    plot: Annotated[
        str | None,
        arg(metavar="[FILE]", help=f"Write a plot (.png, .pdf or .svg); without a name to {DEFAULT_PLOT}."),
    ] = None
    animate: Annotated[
        str | None,
        text_option(
            "FILM",
            "Six axes only: write an animation of the ideal contact and of the one on the rig (.gif, .mp4).",
        ),
    ] = None
    log: Annotated[
        str | None,
        text_option("FILE", "Write every tick to a CSV file; jaxhil identify reads such a file of one axis."),
    ] = None
    reference: Annotated[
        bool, arg(help="Six axes only: simulate the ideal contact of the two bodies, without the rig.")
    ] = False
    one_axis: Annotated[
        str | None,
        text_option(
            "NEW",
            "Six axes without friction: write a one-axis mechanism file with the effective mass along the "
            "normal of the first touch.",
        ),
    ] = None
    limit: OptionalLimit = None
    seed: Annotated[int, number_option("Seed of the sensor noise.")] = 0
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Tune(TuneOptions):
    """Tune a compensator's gains for each mechanism, and evaluate the tuned gains on fresh scenarios.

    Example: jaxhil tune rig-300kg varying --output study --starts 16

    Writes DIR/NAME/gains.json and plots for each mechanism NAME. The exit code is 1 if a contact does not
    end, the rms error exceeds the limit, or more than 1 % of the real contacts violate a bound: peak force at
    most 2 times, and duration 0.5 to 2 times, the ideal contact's. All this is checked with and without
    sensor noise. Warns if the force command exceeds 1.5 times the ideal peak force, or amplifies the sensor
    noise by more than a factor of 2.
    """

    files: Files = ()
    output: Annotated[str, folder_option("Folder for the results.")] = "jaxhil-out"
    overrides: Overrides = ()
    unset: Unset = ()
    resume: Resume = False
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Sweep(SweepOptions):
    """Estimate the probability of failure, and find the worst scenarios, by Monte Carlo simulation.

    Example: jaxhil sweep jaxhil-out/varying/gains.json --scenarios 1000000 --output study/sweep

    The exit code is 0 if no scenario failed. With --acceptable, it is 0 if the upper end of the probability's
    95 % confidence interval is at most the acceptable probability. Otherwise it is 1.
    """

    gains: Annotated[Positional[str], arg(metavar="GAINS", help="Gain file, or its folder.")]
    output: Annotated[
        str | None,
        text_option(
            "DIR",
            "Folder for the results; by default NAME-sweep in the folder of the gain file NAME.json.",
            aliases=("-o",),
        ),
    ] = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class ReplayOptions:
    """Run one scenario of a sweep again, and check that every number equals the stored one bit by bit.

    Example: jaxhil replay jaxhil-out/varying/gains-sweep 1234 --plot worst.png

    The exit code is 1 if any number differs from the stored one.
    """

    store: Annotated[Positional[str], arg(metavar="STORE", help="Folder with the results of a sweep.")]
    index: Annotated[Positional[int], arg(metavar="INDEX", help="Index of the scenario, from 0.")]
    plot: Annotated[
        str | None,
        arg(
            metavar="[FILE]",
            help=f"Write a plot (.png, .pdf or .svg); without a name to {DEFAULT_REPLAY_PLOT}.",
        ),
    ] = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Compare(CompareOptions):
    """Tune several compensators, and compare their errors on the same fresh scenarios.

    A compensator that has predefined settings is not tuned: each setting is evaluated.

    Example: jaxhil compare rig-300kg varying --compensators phase_lead response_error

    Writes plots, and DIR/compare.json with all gains, metrics and confidence intervals.
    All files must have the same number of axes.
    """

    files: Files = ()
    suites: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Also compare on the standard sets (suites) of mechanisms with one axis."),
    ] = False
    output: Annotated[str, folder_option("Folder for the results.")] = "jaxhil-out/compare"
    overrides: Overrides = ()
    unset: Unset = ()
    resume: Resume = False
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class MechanismsOptions:
    """List the built-in mechanism files with their literature sources and paths.

    Example: jaxhil mechanisms --json
    """

    schema: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Print only the JSON Schema of mechanism files, which editors use to check them."),
    ] = False
    json: Json = False
    timings: Timings = False
