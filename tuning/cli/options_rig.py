"""Options of the commands `export`, `verify`, `shadow` and `rig`, read by tyro."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from tuning.api.export import ExportOptions
from tuning.api.options import Json, OptionalLimit, Timings, folder_option, number_option, text_option
from tuning.api.shadow import ShadowOptions
from tuning.api.verify import VerifyOptions
from tuning.cli.options_identify import ColumnMap

DEFAULT_RIG_PLOT = "jaxhil-out/rig.png"
DEFAULT_SHADOW_PLOT = "jaxhil-out/shadow.png"


@dataclass(frozen=True, kw_only=True)
class Export(ExportOptions):
    """Write a bundle for the rig: gains, a controller without dependencies, test vectors and a self-test.

    Example: jaxhil export jaxhil-out/varying/gains.json -o bundle --sweep jaxhil-out/varying/gains-sweep

    The exit code is 1 if the rig's controller differs from the simulated one, or if its watchdog is known to
    stop good runs, or to miss bad ones, more often than allowed.
    """

    gains: Annotated[Positional[str], arg(metavar="GAINS", help="Gain file, or its folder.")]
    output: Annotated[str, folder_option("Folder of the bundle.")] = "jaxhil-out/bundle"
    sweep: Annotated[
        str | None,
        text_option(
            "STORE",
            "Folder with a sweep of these gains, from which limits and alarm rates are computed; with six "
            "axes, limits from fewer than 512 scenarios stop more good runs.",
        ),
    ] = None
    formats: Annotated[
        UseAppendAction[tuple[str, ...]],
        text_option(
            "NAME[,NAME]",
            "Additional format: ros2, matlab, csv, c99, fmu, rehearsal; repeatable; default: the first four.",
            name="format",
        ),
    ] = ()
    limits: Annotated[
        UseAppendAction[tuple[str, ...]],
        text_option(
            "LIMIT=VALUE",
            "Set a limit of this rig, such as command_lowest=-0.05 (SI units), or LIMIT=none; repeatable.",
            name="set",
        ),
    ] = ()
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Verify(VerifyOptions):
    """Check that the rig's controller code (runtime) returns the same force commands as the simulation.

    Example: jaxhil verify jaxhil-out/varying/gains.json

    The files of a bundle are checked first. If a file is corrupt or differs from what this version exports,
    the exit code is 1 and no code of the bundle runs. Otherwise the bundle's self-test runs next. The exit
    code is also 1 if the self-test fails or the commands differ.
    """

    path: Annotated[
        Positional[str],
        arg(metavar="BUNDLE_OR_GAINS", help="Bundle, or gain file, or folder of a gain file."),
    ]
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Shadow(ShadowOptions):
    """Show what the controller would have commanded on the readings in a rig's logs; nothing is sent.

    Example: jaxhil shadow jaxhil-out/bundle day1/contact_*.csv --map logs.toml --plot

    The controller gets the readings tick by tick, with the time stamps of the log, and its commands are
    compared with the logged ones. The exit code is 1 if the controller would have tripped.
    """

    path: Annotated[
        Positional[str],
        arg(metavar="BUNDLE_OR_GAINS", help="Bundle, or gain file, or folder of a gain file."),
    ]
    logs: Annotated[
        Positional[tuple[str, ...]],
        text_option("LOG [LOG ...]", "Logs of contacts, in any format that jaxhil identify reads."),
    ] = ()
    map: ColumnMap = None
    plot: Annotated[
        str | None,
        arg(
            metavar="[FILE]",
            help="Write a plot of the commands (.png, .pdf or .svg); without a name to "
            f"{DEFAULT_SHADOW_PLOT}.",
        ),
    ] = None
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class RigOptions:
    """Run the controller in real time, in a separate process, against a simulated rig over UDP.

    Example: jaxhil rig jaxhil-out/varying/gains.json --duration 600 --plot

    First, an empty loop, which only exchanges packets, runs for comparison. The exit code is 1 if the
    controller causes a missed tick, if a restitution error (six axes: twist error) exceeds the limit, or if
    the controller trips although no faults are injected.
    """

    path: Annotated[
        Positional[str],
        arg(metavar="BUNDLE_OR_GAINS", help="Bundle, or gain file, or folder of a gain file."),
    ]
    duration: Annotated[float, arg(metavar="SECONDS", help="Duration of the run, in simulated time.")] = 10.0
    rate: Annotated[
        float,
        arg(metavar="NUMBER", help="Simulated time divided by real time: below 1, the run is slower."),
    ] = 1.0
    drops: Annotated[
        float,
        arg(metavar="PROBABILITY", help="Injected fault: probability that a packet is lost, per direction."),
    ] = 0.0
    jitter: Annotated[
        float,
        arg(
            metavar="SECONDS",
            help="Injected fault: largest random delay of a packet (uniform from 0), per direction.",
        ),
    ] = 0.0
    delay: Annotated[
        float, arg(metavar="SECONDS", help="Injected fault: constant delay of every packet, per direction.")
    ] = 0.0
    realtime: Annotated[
        FlagCreatePairsOff[bool], text_option(None, "Request real-time priority for both processes.")
    ] = False
    connect: Annotated[
        int | None,
        text_option(
            "PORT",
            "UDP port on this computer of a running controller, such as the bundle's rt_loop; by default the "
            "bundle's Python controller is started.",
        ),
    ] = None
    seed: Annotated[int, number_option("Seed of sensor noise, contact phases and injected faults.")] = 0
    plot: Annotated[
        str | None,
        arg(
            metavar="[FILE]",
            help=f"Write a plot of latencies (.png, .pdf or .svg); without a name to {DEFAULT_RIG_PLOT}.",
        ),
    ] = None
    limit: OptionalLimit = None
    json: Json = False
    timings: Timings = False
