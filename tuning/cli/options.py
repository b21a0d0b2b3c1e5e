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
    Limit,
    OptionalFile,
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
    """Write a mechanism file to start from, with the meaning, unit, range and default of every key.

    Example: jaxhil init rig-300kg --output my-rig.toml

    An existing file is never overwritten.
    """

    name: Annotated[
        Positional[str | None],
        text_option(
            "[NAME]",
            "Built-in mechanism to copy the values from, by default 'varying'; or the file, NAME.toml.",
        ),
    ] = None
    output: Annotated[
        str | None, text_option("FILE", "File to write; by default mechanism.toml.", aliases=("-o",))
    ] = None
    list: Annotated[FlagCreatePairsOff[bool], text_option(None, "Only list the names; write nothing.")] = (
        False
    )
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class SimulateOptions:
    """Run the contacts once; report restitution, reference, error, peak force and duration of each.

    Example: jaxhil simulate rig-300kg --compensator phase_lead --set approach.velocity=0.01

    Exit code 0 if every |e - e*| is within the limit, every real contact's peak force is at most 2 times, and
    its duration 0.5 to 2 times that of the ideal contact; otherwise 1.
    """

    file: OptionalFile = None
    compensator: CompensatorName = None
    setting: Setting = None
    gains: GainSource = None
    overrides: Overrides = ()
    unset: Unset = ()
    plot: Annotated[
        str | None, arg(metavar="[FILE]", help=f"Plot to a .png, .pdf or .svg file; bare: {DEFAULT_PLOT}.")
    ] = None
    animate: Annotated[
        str | None,
        text_option(
            "FILM", "Six axes: animate the ideal contact beside the one on the rig, to a .gif or .mp4 file."
        ),
    ] = None
    log: Annotated[
        str | None,
        text_option("FILE", "Write every tick to a CSV file; for one axis it is a log that identify reads."),
    ] = None
    reference: Annotated[
        bool, arg(help="Six axes: simulate only the ideal contact of the two bodies, without the rig.")
    ] = False
    limit: Limit = 0.01
    seed: Annotated[int, number_option("Seed of the sensor noise.")] = 0
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Tune(TuneOptions):
    """Tune a compensator's gains for every mechanism; evaluate them on fresh scenarios.

    Example: jaxhil tune rig-300kg varying --output study --starts 16

    Writes DIR/NAME/gains.json and plots. Exit code 1 if a tuned rms error exceeds the limit, with or without
    sensor noise, or if more than 1 % of the real contacts have a peak force above 2 times, or a duration
    below 0.5 or above 2 times that of the ideal contact. Warns if the force command peaks above 1.5 ideal
    peaks, or amplifies the sensor noise more than twice.
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
    """Monte Carlo robustness: the probability of failure, and the worst scenarios.

    Example: jaxhil sweep jaxhil-out/varying/gains.json --scenarios 1000000 --output study/sweep

    Exit code 0 if no scenario failed or, with --acceptable, if the confidence interval ends below it;
    otherwise 1.
    """

    gains: Annotated[Positional[str], arg(metavar="GAINS", help="Gain file, or its folder_option.")]
    output: Annotated[
        str | None,
        text_option(
            "DIR",
            "Folder of the store; by default NAME-sweep beside the gain file NAME.json.",
            aliases=("-o",),
        ),
    ] = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class ReplayOptions:
    """Run one scenario of a sweep again, and check that all its numbers are the same to the last bit.

    Example: jaxhil replay jaxhil-out/varying/gains-sweep 1234 --plot worst.png

    Exit code 1 if any number differs from the stored one.
    """

    store: Annotated[Positional[str], arg(metavar="STORE", help="Folder that a sweep wrote.")]
    index: Annotated[Positional[int], arg(metavar="INDEX", help="Number of the scenario.")]
    plot: Annotated[
        str | None,
        arg(metavar="[FILE]", help=f"Plot to a .png, .pdf or .svg file; bare: {DEFAULT_REPLAY_PLOT}."),
    ] = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Compare(CompareOptions):
    """Compare compensators, each tuned, on the same fresh scenarios, with confidence intervals.

    Compensators with settings for any mechanism use these settings, untuned.

    Example: jaxhil compare rig-300kg varying --compensators phase_lead response_error

    Writes DIR/compare.json with all metrics and gains, and plots.
    """

    files: Files = ()
    suites: Annotated[
        FlagCreatePairsOff[bool], text_option(None, "Also the standard suites, in addition to the files.")
    ] = False
    output: Annotated[str, folder_option("Folder for the results.")] = "jaxhil-out/compare"
    overrides: Overrides = ()
    unset: Unset = ()
    resume: Resume = False
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class MechanismsOptions:
    """List the built-in mechanism files, with their sources and paths.

    Example: jaxhil mechanisms --json
    """

    schema: Annotated[
        FlagCreatePairsOff[bool],
        text_option(None, "Print the JSON Schema of mechanism files instead, for editors."),
    ] = False
    json: Json = False
    timings: Timings = False
