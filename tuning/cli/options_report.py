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
    """Compute a stability map: the error of a contact as a function of two keys, and closed-form predictions.

    Example: jaxhil map rig-300kg --x contact.stiffness=5e4:5e5 --y rig.force_sensor.delay

    Writes DIR/map.json and DIR/map.png. The gains at every point are those of the nominal mechanism. The
    error is the restitution error. For six axes, it is the twist error, and there are no predictions.
    """

    x: Annotated[
        str,
        text_option(
            AXIS_METAVAR,
            "Key of the mechanism file (in SI units), or gains.NAME, on the horizontal axis. The default "
            "range is the key's [uncertainty], or else 0.3 to 3 times the nominal value; for a gain, its "
            "bounds.",
        ),
    ]
    y: Annotated[str, text_option(AXIS_METAVAR, "Key or gain on the vertical axis, in the format of --x.")]
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

    The page needs no other file, and is readable without JavaScript and on paper. The exit code is 1 if the
    page's verdict is bad.
    """

    results: Annotated[
        Positional[tuple[str, ...]],
        text_option(
            "RESULT [RESULT ...]",
            "Folders or files with the results for one mechanism, at most one result of each command; for "
            "monitor, a file with the output of --json.",
        ),
    ] = ()
    output: Annotated[
        str, text_option("FILE", "HTML file to write; by default jaxhil-out/report.html.", aliases=("-o",))
    ] = "jaxhil-out/report.html"
    json: Json = False
    timings: Timings = False
