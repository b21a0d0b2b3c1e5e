"""The options of each command of `jaxhil`, as tyro reads them."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from tuning.front_door.compare import CompareOptions
from tuning.front_door.options import (
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
    folder,
    number,
    text,
)
from tuning.front_door.sweep_options import SweepOptions
from tuning.front_door.tune_options import TuneOptions

PICTURES = (".png", ".pdf", ".svg")
DEFAULT_PLOT = "jaxhil-out/simulate.png"
DEFAULT_REPLAY_PLOT = "jaxhil-out/replay.png"


@dataclass(frozen=True)
class Init:
    """Write a mechanism file to start from: every key with its meaning, unit, range and default.

    Example: jaxhil init rig-300kg --output my-rig.toml

    It is never written over a file that is there.
    """

    name: Annotated[
        Positional[str | None],
        text(
            "[NAME]", "Built-in mechanism whose values it has, by default 'varying'; or the file, NAME.toml."
        ),
    ] = None
    output: Annotated[str | None, text("FILE", "The file; by default mechanism.toml.", aliases=("-o",))] = (
        None
    )
    list: Annotated[FlagCreatePairsOff[bool], text(None, "Only list the names, writing nothing.")] = False
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class Simulate:
    """Run the contacts once; per contact restitution, reference, error, peak force, duration.

    Example: jaxhil simulate rig-300kg --compensator phase_lead --set approach.velocity=0.01

    Exit code 0 if every |e - e*| is within the limit, and every real contact's peak force at most 2 times and
    its duration 0.5 to 2 times that of the ideal contact, else 1.
    """

    file: OptionalFile = None
    compensator: CompensatorName = None
    setting: Setting = None
    gains: GainSource = None
    overrides: Overrides = ()
    unset: Unset = ()
    plot: Annotated[
        str | None, arg(metavar="[PICTURE]", help=f"Plot to a .png, .pdf or .svg file; bare: {DEFAULT_PLOT}.")
    ] = None
    animate: Annotated[
        str | None,
        text(
            "FILM", "Of a mechanism of six axes: the contact in space beside that on the rig, .gif or .mp4."
        ),
    ] = None
    log: Annotated[
        str | None,
        text("FILE", "Write every tick to a CSV file; of one axis it is a rig's log, which identify reads."),
    ] = None
    reference: Annotated[
        bool, arg(help="Of a mechanism of six axes: the two bodies in space alone, without the rig.")
    ] = False
    limit: Limit = 0.01
    seed: Annotated[int, number("Seed of the sensor noise.")] = 0
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Tune(TuneOptions):
    """Tune a compensator's gains for every mechanism; judge them on scenarios that tuning never saw.

    Example: jaxhil tune rig-300kg varying --output study --starts 16

    Writes DIR/NAME/gains.json and plots. Exit code 1 if a tuned rms error exceeds the limit, with the noise
    of the sensors or without, or more than 1 % of the real contacts have more than 2 times the ideal
    contact's peak force, or less than 0.5 or more than 2 times its duration. Warns of commands that peak
    beyond 1.5 ideal peaks, and of noise amplified more than twice.
    """

    files: Files = ()
    output: Annotated[str, folder("Folder for what is written.")] = "jaxhil-out"
    overrides: Overrides = ()
    unset: Unset = ()
    resume: Resume = False
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Sweep(SweepOptions):
    """Monte Carlo robustness: how probable is a failure, how close do the worst scenarios come to one?

    Example: jaxhil sweep jaxhil-out/varying/gains.json --scenarios 1000000 --output study/sweep

    Exit code 0 if no scenario failed or, with --acceptable, if the interval ends below it; else 1.
    """

    gains: Annotated[Positional[str], arg(metavar="GAINS", help="Gain file, or its folder.")]
    output: Annotated[
        str | None,
        text(
            "DIR",
            "Folder of the store; by default beside the gain file and named by it: NAME-sweep for NAME.json.",
            aliases=("-o",),
        ),
    ] = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class Replay:
    """Run one scenario of a sweep again, and see whether it does the same, to the bit.

    Example: jaxhil replay jaxhil-out/varying/gains-sweep 1234 --plot worst.png

    Exit code 1 if any number differs from the stored one.
    """

    store: Annotated[Positional[str], arg(metavar="STORE", help="Folder that a sweep wrote.")]
    index: Annotated[Positional[int], arg(metavar="INDEX", help="Number of the scenario.")]
    plot: Annotated[
        str | None,
        arg(metavar="[PICTURE]", help=f"Plot to a .png, .pdf or .svg file; bare: {DEFAULT_REPLAY_PLOT}."),
    ] = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Compare(CompareOptions):
    """Compensators, each tuned to its best, on the same fresh scenarios, with intervals.

    Those with settings for any mechanism are judged with these, untuned.

    Example: jaxhil compare rig-300kg varying --compensators phase_lead response_error

    Writes DIR/compare.json, with every figure and all gains, and pictures.
    """

    files: Files = ()
    suites: Annotated[
        FlagCreatePairsOff[bool], text(None, "The standard suites, besides what files are given.")
    ] = False
    output: Annotated[str, folder("Folder for what is written.")] = "jaxhil-out/compare"
    overrides: Overrides = ()
    unset: Unset = ()
    resume: Resume = False
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class Mechanisms:
    """The built-in mechanism files, with their sources and paths.

    Example: jaxhil mechanisms --json
    """

    schema: Annotated[
        FlagCreatePairsOff[bool], text(None, "Instead the JSON Schema of mechanism files, for editors.")
    ] = False
    json: Json = False
    timings: Timings = False
