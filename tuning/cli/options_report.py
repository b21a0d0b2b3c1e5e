"""The options of `jaxhil map` and `jaxhil report`, as tyro reads them."""

from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional

from tuning.front_door.map import MapOptions
from tuning.front_door.options import (
    CompensatorName,
    GainSource,
    Json,
    OptionalFile,
    Overrides,
    Setting,
    Timings,
    Unset,
    folder,
    text,
)

AXIS = "PATH[=LOW:HIGH]"


@dataclass(frozen=True, kw_only=True)
class Map(MapOptions):
    """Stability map: the restitution error over two keys, its contours, and what theory says there.

    Example: jaxhil map rig-300kg --x contact.stiffness=5e4:5e5 --y rig.force_sensor.delay

    Writes DIR/map.json and DIR/map.png. The gains are the nominal ones at every point.
    """

    x: Annotated[
        str,
        text(
            AXIS,
            "Key along x, in SI units, or gains.NAME. Without ends: what is drawn of it, else 0.3 to 3 times "
            "its value; of a gain its bounds.",
        ),
    ]
    y: Annotated[str, text(AXIS, "Key along y, likewise.")]
    file: OptionalFile = None
    compensator: CompensatorName = None
    setting: Setting = None
    gains: GainSource = None
    overrides: Overrides = ()
    unset: Unset = ()
    output: Annotated[str, folder("Folder for what is written.")] = "jaxhil-out/map"
    json: Json = False
    timings: Timings = False


@dataclass(frozen=True)
class Report:
    """One HTML page for a review board, of what identify, tune, sweep, compare, map and export wrote.

    Example: jaxhil report jaxhil-out/varying jaxhil-out/varying/gains-sweep jaxhil-out/bundle

    It needs nothing else, and is readable without JavaScript and on paper. Exit code 1 if its verdict is bad.
    """

    results: Annotated[
        Positional[tuple[str, ...]],
        text(
            "RESULT [RESULT ...]",
            "Results of one mechanism, at most one of each command: folders or files; of monitor what --json "
            "printed.",
        ),
    ] = ()
    output: Annotated[str, text("FILE", "The page; by default jaxhil-out/report.html.", aliases=("-o",))] = (
        "jaxhil-out/report.html"
    )
    json: Json = False
    timings: Timings = False
