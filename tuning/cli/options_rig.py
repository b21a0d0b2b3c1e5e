"""The options of the commands that have to do with a rig, as tyro reads them."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from tuning.front_door.export import ExportOptions
from tuning.front_door.options import Json, Limit, Timings, folder, number, text
from tuning.front_door.verify import VerifyOptions

DEFAULT_RIG_PLOT = "jaxhil-out/rig.png"


@dataclass(frozen=True, kw_only=True)
class Export(ExportOptions):
    """A bundle for the rig: gains, controller, test vectors, self-test; nothing to install there.

    Example: jaxhil export jaxhil-out/varying/gains.json -o bundle --sweep jaxhil-out/varying/gains-sweep

    Exit code 1 if the controller on the rig does not do what was simulated, or is known to stop good runs or
    to miss bad ones more often than allowed.
    """

    gains: Annotated[Positional[str], arg(metavar="GAINS", help="Gain file, or its folder.")]
    output: Annotated[str, folder("Folder of the bundle.")] = "jaxhil-out/bundle"
    sweep: Annotated[
        str | None,
        text("STORE", "Folder of a sweep of these gains: limits and the watchdog's rates come from it."),
    ] = None
    formats: Annotated[
        UseAppendAction[tuple[str, ...]],
        text(
            "NAME[,NAME]",
            "Also the gains for ros2, matlab, csv, c99; repeatable; by default all.",
            name="format",
        ),
    ] = ()
    limits: Annotated[
        UseAppendAction[tuple[str, ...]],
        text(
            "LIMIT=VALUE",
            "A limit of the rig's own, as command_lowest=-0.05 (SI), or none; repeatable.",
            name="set",
        ),
    ] = ()
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True, kw_only=True)
class Verify(VerifyOptions):
    """Replay recorded signals through the rig's runtime; the exit code is the verdict.

    Example: jaxhil verify jaxhil-out/varying/gains.json

    Of a bundle, its self-test first. Exit code 1 also for what is corrupt, was tampered with, or is not what
    this version exports: nothing of that is run.
    """

    path: Annotated[
        Positional[str], arg(metavar="BUNDLE_OR_GAINS", help="Bundle, or gain file, or its folder.")
    ]
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class RigOptions:
    """A loop in real time: the controller as a process of its own, the rig played to it over UDP.

    Example: jaxhil rig jaxhil-out/varying/gains.json --duration 600 --plot

    An empty loop comes first, for comparison. Exit code 1 for a missed tick that is the controller's fault, a
    restitution error beyond the limit, or a trip where no faults are injected.
    """

    path: Annotated[Positional[str], arg(metavar="BUNDLE_OR_GAINS", help="Bundle, gain file, or its folder.")]
    duration: Annotated[float, arg(metavar="SECONDS", help="How long the run lasts.")] = 10.0
    drops: Annotated[
        float, arg(metavar="PROBABILITY", help="Injected: that a packet is lost, either way.")
    ] = 0.0
    jitter: Annotated[
        float, arg(metavar="SECONDS", help="Injected: width of a random delay of every packet, either way.")
    ] = 0.0
    delay: Annotated[
        float, arg(metavar="SECONDS", help="Injected: constant delay of every packet, either way.")
    ] = 0.0
    realtime: Annotated[
        FlagCreatePairsOff[bool], text(None, "Ask the system for a real-time priority for both processes.")
    ] = False
    seed: Annotated[int, number("Seed of sensor noise, contact phases and injected faults.")] = 0
    plot: Annotated[
        str | None,
        arg(metavar="[PICTURE]", help=f"Latencies to a .png, .pdf or .svg file; bare: {DEFAULT_RIG_PLOT}."),
    ] = None
    limit: Limit = 0.01
    json: Json = False
    timings: Timings = False
