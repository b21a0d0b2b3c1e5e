"""The options of each command of `jaxhil`, as tyro reads them."""

from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

PICTURES = (".png", ".pdf", ".svg")
DEFAULT_PLOT = "jaxhil-out/simulate.png"
DEFAULT_REPLAY_PLOT = "jaxhil-out/replay.png"
DEFAULT_DRIVERS = 1024


def number(meaning: str):
    return arg(metavar="NUMBER", help=meaning)


def folder(meaning: str):
    return arg(aliases=("-o",), metavar="DIR", help=meaning)


def text(metavar: str | None, meaning: str, **more: Any):
    """An option whose help says itself what holds by default."""
    return arg(metavar=metavar, help=meaning, help_behavior_hint="", **more)


OptionalFile = Annotated[
    Positional[str | None],
    text("[FILE]", "Mechanism file, or the name of a built-in one; by default 'varying'."),
]
Files = Annotated[
    Positional[tuple[str, ...]],
    text("[FILE ...]", "Mechanism files, or names of built-in ones; by default 'varying'."),
]
Overrides = Annotated[
    UseAppendAction[tuple[str, ...]],
    text(
        "PATH=VALUE",
        "Any key of the mechanism file by its dotted path, as approach.velocity=0.01; repeatable.",
        name="set",
    ),
]
Unset = Annotated[
    UseAppendAction[tuple[str, ...]],
    text(
        "PATH",
        "A key to take out of the mechanism file, and what [uncertainty] says of it, after all --set; "
        "repeatable.",
        name="unset",
    ),
]
Limit = Annotated[float, arg(metavar="NUMBER", help="Restitution error beyond which the verdict is bad.")]
Json = Annotated[
    FlagCreatePairsOff[bool], text(None, "One JSON document on standard output, nothing else there.")
]
Timings = Annotated[FlagCreatePairsOff[bool], text(None, "Say on standard error where the time went.")]
Scheduler = Annotated[
    str | None,
    arg(metavar="ADDRESS", help="Scheduler of a dask.distributed cluster whose workers do the computing."),
]
Resume = Annotated[
    bool,
    arg(name="resume", metavar="", help="Go on after an interruption: what is finished is not done again."),
]
CompensatorName = Annotated[
    str | None, arg(metavar="NAME", help="Compensator, at the literature's gains; 'none' by default.")
]
GainSource = Annotated[
    str | None,
    arg(metavar="GAINS", help="Gain file: its compensator and gains and, without FILE, its mechanism."),
]
Setting = Annotated[
    str | None,
    text("NAME", "Take a set of gains that the compensator has for any mechanism, by its name."),
]


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


@dataclass(frozen=True)
class Tune:
    """Tune a compensator's gains for every mechanism; judge them on scenarios that tuning never saw.

    Example: jaxhil tune rig-300kg varying --output study --starts 16

    Writes DIR/NAME/gains.json and plots. Exit code 1 if a tuned rms error exceeds the limit, with the noise
    of the sensors or without, or more than 1 % of the real contacts have more than 2 times the ideal
    contact's peak force, or less than 0.5 or more than 2 times its duration. Warns of commands that peak
    beyond 1.5 ideal peaks, and of noise amplified more than twice.
    """

    files: Files = ()
    compensator: Annotated[str, arg(metavar="NAME", help="Compensator to tune.")] = "response_error"
    setting: Setting = None
    output: Annotated[str, folder("Folder for what is written.")] = "jaxhil-out"
    scenarios: Annotated[
        int | None, text("NUMBER", "Scenarios to tune on; by default 32, or 128 where sensors are noisy.")
    ] = None
    starts: Annotated[int, number("Starts of the solver, and of each further lot where they disagree.")] = 4
    start: Annotated[
        tuple[str, ...],
        text(
            "GAINS [GAINS ...]",
            "Gain files of the same compensator: each mechanism is tuned from the gains of the nearest "
            "of their mechanisms too.",
        ),
    ] = ()
    steps: Annotated[int, number("Most solver steps from each start.")] = 25
    validation: Annotated[int, number("Fresh scenarios to judge on.")] = 511
    objective: Annotated[
        str,
        arg(metavar="NAME", help="Of the errors e - e*: rms, cvar (mean of the worst 5 percent) or worst."),
    ] = "rms"
    divergence_weight: Annotated[
        float, number("How much more a squared divergence (e > e*) counts than a squared convergence.")
    ] = 1.0
    command_weight: Annotated[
        float | None,
        text(
            "NUMBER",
            "How many times the limit a command is worth that peaks one ideal peak too high; by default 0.3 "
            "for impulse_ledger, 0 for others.",
        ),
    ] = None
    noise_weight: Annotated[
        float | None,
        text(
            "NUMBER",
            "How many times the limit it is worth to amplify sensor noise once more. Where sensors are noisy "
            "and no weight is given: the quietest gains within the limit; 0: the least error.",
        ),
    ] = None
    chatter_weight: Annotated[
        float | None,
        text(
            "NUMBER",
            "How many times the limit a command is worth that swings once too often by the ideal peak force.",
        ),
    ] = None
    transparency_weight: Annotated[
        float | None,
        text(
            "NUMBER",
            "How much errors of the same scenarios count with a push on the hardware, and damped; by "
            "default 1 for impulse_ledger, 0 for others.",
            aliases=("--honesty-weight",),
        ),
    ] = None
    pareto: Annotated[int, number("Points of a trade-off of restitution error, each a gain file.")] = 0
    pareto_against: Annotated[
        str | None,
        text(
            "NAME",
            "What --pareto trades the error against: noise, peak (of the command) or honesty; by "
            "default noise, or peak for impulse_ledger.",
        ),
    ] = None
    global_search: Annotated[
        bool,
        arg(
            name="global-search",
            aliases=("--certify",),
            metavar="",
            help="Also search all gains' whole ranges, with 50 times the evaluations: is there better?",
        ),
    ] = False
    seed: Annotated[int, number("Seed of scenarios and starts.")] = 0
    overrides: Overrides = ()
    unset: Unset = ()
    limit: Limit = 0.01
    resume: Resume = False
    scheduler: Scheduler = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class Sweep:
    """Monte Carlo robustness: how probable is a failure, how close do the worst scenarios come to one?

    Example: jaxhil sweep jaxhil-out/varying/gains.json --scenarios 1000000 --output study/sweep

    Exit code 0 if no scenario failed or, with --acceptable, if the interval ends below it; else 1.
    """

    gains: Annotated[Positional[str], arg(metavar="GAINS", help="Gain file, or its folder.")]
    scenarios: Annotated[int, number("Scenarios to draw and run.")] = 100_000
    seed: Annotated[int, number("Seed; scenario i depends on it and on i alone.")] = 0
    sampling: Annotated[
        str, arg(metavar="NAME", help="random, or sobol (scrambled, several replicates).")
    ] = "random"
    precision: Annotated[
        str, arg(metavar="NAME", help="float64, or float32: faster, and compared with float64 on a subset.")
    ] = "float64"
    works: Annotated[
        bool,
        arg(name="works", metavar="", help="Also the real force's works, to 1e-6; tens of times the time."),
    ] = False
    limit: Limit = 0.01
    until_width: Annotated[
        float | None,
        text("WIDTH", "Stop once the probability's interval is so narrow; --scenarios is then the most."),
    ] = None
    drivers: Annotated[
        int | None,
        text(
            "[NUMBER]", f"Also Sobol indices: what drives the error. A power of two; bare: {DEFAULT_DRIVERS}."
        ),
    ] = None
    rare: Annotated[
        float | None,
        text("[LIMIT]", "Also subset simulation of an error beyond this, however rare; bare, or 0: --limit."),
    ] = None
    acceptable: Annotated[
        float | None,
        text(
            "PROBABILITY",
            "Failure probability that the interval's upper end may reach; by default no run may fail.",
        ),
    ] = None
    output: Annotated[
        str | None,
        text(
            "DIR",
            "Folder of the store; by default beside the gain file and named by it: NAME-sweep for NAME.json.",
            aliases=("-o",),
        ),
    ] = None
    resume: Resume = False
    chunk: Annotated[int, number("Scenarios computed at a time, and rows of each part.")] = 16384
    scheduler: Scheduler = None
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


@dataclass(frozen=True)
class Compare:
    """Compensators, each tuned to its best, on the same fresh scenarios, with intervals.

    Those with settings for any mechanism are judged with these, untuned.

    Example: jaxhil compare rig-300kg varying --compensators phase_lead response_error

    Writes DIR/compare.json, with every figure and all gains, and pictures.
    """

    files: Files = ()
    suites: Annotated[
        FlagCreatePairsOff[bool], text(None, "The standard suites, besides what files are given.")
    ] = False
    compensators: Annotated[
        tuple[str, ...],
        text("NAME [NAME ...]", "Compensators to compare; by default all that are published and our own."),
    ] = ()
    output: Annotated[str, folder("Folder for what is written.")] = "jaxhil-out/compare"
    untuned: Annotated[
        FlagCreatePairsOff[bool],
        text(None, "Tune nothing: judge the literature's gains, and a compensator's settings, as they are."),
    ] = False
    scenarios: Annotated[int, number("Scenarios to tune on.")] = 32
    judged: Annotated[int, number("Fresh scenarios to judge on.")] = 256
    overrides: Overrides = ()
    unset: Unset = ()
    limit: Annotated[float, arg(metavar="NUMBER", help="Restitution error that counts as a failure.")] = 0.01
    resume: Resume = False
    scheduler: Scheduler = None
    seed: Annotated[int, number("Seed of scenarios, starts and resampling.")] = 0
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
