"""Options of `jaxhil map` and `jaxhil report`, read by tyro."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional

from tuning.api.map import MapOptions
from tuning.api.options import (
    CompensatorName,
    GainSource,
    Json,
    OptionalFile,
    Overrides,
    Setting,
    Timings,
    Unset,
    folder_option,
    text_option,
)

AXIS_METAVAR = "PATH[=LOW:HIGH]"


@dataclass(frozen=True, kw_only=True)
class Map(MapOptions):
    """Stability map: the restitution error over two keys, its contours, and closed-form theory.

    Example: jaxhil map rig-300kg --x contact.stiffness=5e4:5e5 --y rig.force_sensor.delay

    Writes DIR/map.json and DIR/map.png. Every point uses the gains of the nominal mechanism.
    """

    x: Annotated[
        str,
        text_option(
            AXIS_METAVAR,
            "Key along x, in SI units, or gains.NAME. Default range: the key's uncertainty, else 0.3 to 3 "
            "times its value; for a gain its bounds.",
        ),
    ]
    y: Annotated[str, text_option(AXIS_METAVAR, "Key along y, like x.")]
    file: OptionalFile = None
    compensator: CompensatorName = None
    setting: Setting = None
    gains: GainSource = None
    overrides: Overrides = ()
    unset: Unset = ()
    output: Annotated[str, folder_option("Folder for the results.")] = "jaxhil-out/map"
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class ReportOptions:
    """Write one HTML page for a review board from the results of the other commands.

    Example: jaxhil report jaxhil-out/varying jaxhil-out/varying/gains-sweep jaxhil-out/bundle

    The page needs no other file, and is readable without JavaScript and on paper. Exit code 1 if its verdict
    is bad.
    """

    results: Annotated[
        Positional[tuple[str, ...]],
        text_option(
            "RESULT [RESULT ...]",
            "Results for one mechanism, at most one of each command: folders or files; for monitor the "
            "output of --json.",
        ),
    ] = ()
    output: Annotated[
        str, text_option("FILE", "File of the page; by default jaxhil-out/report.html.", aliases=("-o",))
    ] = "jaxhil-out/report.html"
    json: Json = False
    timings: Timings = False
