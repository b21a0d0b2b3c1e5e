"""`tuning.map`: where on two keys of the mechanism the loop diverges, and how far from there it is."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import arg

from jaxhil.errors import InputError
from jaxhil.files import write_whole, writing
from jaxhil.mechanism.loading import as_mechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import digest
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments, meaning
from tuning.front_door.options import (
    Allowed,
    AnyLimit,
    Resume,
    Scheduler,
    Seed,
    check_options,
    number,
    takes,
)

if TYPE_CHECKING:
    from tuning.reporting.map_grid import Map

SCHEMA = "jaxhil/map/1"
DOCUMENT, PICTURE = "map.json", "map.png"
MOST_POINTS = 1000


@dataclass(frozen=True)
class StabilityMap:
    """What `map` returns; arrays are NumPy's, rows along y and columns along x."""

    document: dict[str, Any]  # all that is known, as `jaxhil map --json` prints it
    x: np.ndarray  # values along x, (columns,), in the unit of its key
    y: np.ndarray  # values along y, (rows,)
    error: np.ndarray  # e - e* of the contact where it is largest, (rows, columns) [1]; NaN: did not end
    restitution: np.ndarray  # e of that contact, (rows, columns) [1]
    found: "Map" = field(repr=False)

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Draw the map; the name ends in .png, .pdf or .svg. Raises `InputError` if it cannot be written."""
        from jaxhil.simulation.contact_plot import save
        from tuning.reporting.map_picture import map_picture

        title = f"{self.document['mechanism']}, compensation: {self.document['compensator']}"
        target = arguments.folder("path", path)
        with writing(target):
            save(map_picture(self.found, title, self.document["limit"]), target)


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Options of `map`."""

    points: Annotated[int, number("Points along either axis."), Allowed(2, MOST_POINTS)] = 100
    limit: Annotated[
        float, arg(metavar="NUMBER", help="Restitution error to which margins are told."), AnyLimit
    ] = 0.01
    resume: Resume = False
    scheduler: Scheduler = None
    seed: Annotated[int, number("Seed of the sensor noise, the same at every point."), Seed] = 0


@arguments.entry
@takes(MapOptions)
def map(
    mechanism: Mechanism | str | os.PathLike[str],
    x: str,
    y: str,
    compensator: str = "none",
    gains: Mapping[str, float] | str | os.PathLike[str] | None = None,
    *,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = False,
    **options: Any,
) -> StabilityMap:
    """The restitution error over two keys of a mechanism, with what theory says there.

    The gains are the same at every point, those of the nominal mechanism: the map shows what happens to a
    controller that is not told. Where compensator and contact law are linear there is also the spectral
    radius of the sampled loop in contact, at the nominal point with its derivative by every gain.

    Args:
        mechanism: a `Mechanism`, the name of a built-in one, or a file's path.
        x: the key along x, "PATH" or "PATH=LOW:HIGH" in SI units, or "gains.NAME"; without ends from the
            file's [uncertainty], else 0.3 to 3 times the nominal value, of a gain its bounds. A list scales
            as a whole and its first entry says how far; "contact.stiffness[1]" is one entry.
        y: the key along y, likewise.
        compensator: a law's name.
        gains: as those of `jaxhil.simulate`.
        folder: where to write map.json and map.png; None writes nothing.
        progress: say on standard error what is going on.
    OPTIONS

    Raises:
        InputError: one line, for an argument that will not do, or a folder that cannot be written.
    """
    asked = MapOptions(**options)
    check_options(asked)
    arguments.flags(progress=progress)
    if asked.resume and folder is None:
        raise arguments.ArgumentError("resume", "without a folder", "with that of a map")
    checked, target = as_mechanism(mechanism), None if folder is None else arguments.folder("folder", folder)
    with computing():
        from jaxhil.laws.compensators import COMPENSATORS
        from jaxhil.simulation.gain_choice import choose_gains
        from tuning.caches.pieces import FOLDER, Pieces
        from tuning.reporting.map_axes import check_axes, parse_axis
        from tuning.reporting.map_grid import compute_map, runs

        name, values = choose_gains(checked, compensator, gains)
        law = COMPENSATORS[name]
        try:
            axes = parse_axis("x", x, checked, law, values), parse_axis("y", y, checked, law, values)
            check_axes(checked, axes)
        except InputError as error:
            error.__dict__.setdefault("option", f"--{error}" if str(error)[:1] in "xy" else str(error))
            raise
        meaning.check(checked)
        with terminal.progress(runs(asked.points), "runs", progress) as bar:
            kept = Pieces(None if target is None else target / FOLDER, asked.resume)
            found = compute_map(
                checked,
                name,
                values,
                axes,
                asked.points,
                asked.limit,
                asked.seed,
                bar.tell,
                asked.scheduler,
                kept,
            )
        document = _document(checked, name, values, found, asked.limit, asked.seed)
        made = StabilityMap(document, found.x, found.y, found.error, found.restitution, found)
        if target is not None:
            _write(made, target)
            kept.remove()
    return made


def _write(made: StabilityMap, folder: Path) -> None:
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / DOCUMENT, terminal.as_json(made.document).encode("ascii"))
    made.plot(folder / PICTURE)


def _document(
    mechanism: Mechanism, compensator: str, gains: Mapping[str, float], found: "Map", limit: float, seed: int
) -> dict[str, Any]:
    from jaxhil.simulation.contact_bounds import BOUNDS
    from jaxhil.simulation.sources import versions
    from tuning.gain_file import VERSIONED, plain

    closed, radii, nominal = found.closed, found.radii, found.nominal
    keys = ("low", "high")
    document = {
        "schema": SCHEMA,
        "mechanism": mechanism.name,
        "compensator": compensator,
        "gains": dict(gains),
        **{
            name: {"key": axis.key, "unit": axis.unit, "nominal": axis.nominal, "values": values}
            for name, axis, values in zip("xy", found.axes, (found.x, found.y), strict=True)
        },
        "limit": limit,
        "seed": seed,
        "error": found.error,
        "restitution": found.restitution,
        "peak_force_ratio": found.peak_force_ratio,
        "duration_ratio": found.duration_ratio,
        "bounds": BOUNDS,
        "theory": {
            "series": closed.series,
            "characteristic_root": closed.characteristic_root,
            "delay_over_critical": closed.delay_over_critical,
            "none_because": closed.reason,
        },
        "spectral_radius": {
            **({} if radii is None else {"x": radii.x, "y": radii.y, "values": radii.values}),
            "none_because": found.no_growth,
        },
        "nominal": {
            "restitution": nominal.restitution,
            "error": nominal.error,
            "peak_force_ratio": nominal.peak_force_ratio,
            "duration_ratio": nominal.duration_ratio,
            "growth": nominal.growth,
            "margins": {
                what: None
                if margins is None
                else {
                    axis: dict(zip(keys, margin, strict=True))
                    for axis, margin in zip("xy", margins, strict=True)
                }
                for what, margins in (
                    ("error", nominal.error_margins),
                    ("contact", nominal.contact_margins),
                    ("spectral_radius", nominal.radius_margins),
                )
            },
        },
        "versions": versions(VERSIONED),
    }
    document = plain(document)
    return {**document, "sha256": digest(document)}


__all__ = ["MapOptions", "StabilityMap", "map"]
