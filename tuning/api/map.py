"""Function `tuning.map`: a contact's error as a function of two keys, and the margins of both keys."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from jaxhil.errors import InputError
from jaxhil.files import report_write_errors, write_atomically
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.loading import as_any_mechanism
from jaxhil.rig import digest
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments, mechanism_summary
from tuning.api.options import (
    AllowedValues,
    LimitRange,
    Resume,
    Scheduler,
    SeedRange,
    add_options,
    check_options,
    number_option,
    text_option,
)

if TYPE_CHECKING:
    from tuning.stability_map.axes import MapAxis
    from tuning.stability_map.grid import MapResults, NominalPoint

SCHEMA = "jaxhil/map/1"
DOCUMENT_FILE, PLOT = "map.json", "map.png"
MAX_POINTS = 1000  # largest number of points along an axis; the number of runs is its square


@dataclass(frozen=True)
class StabilityMap:
    """Result of `map`: error and restitution as functions of two keys, at the points of a grid.

    The error is the restitution error or, for six axes, the twist error.

    Attributes:
        document: all results, as `jaxhil map --json` prints them.
        x: values of the key along x, (columns,), in the unit of the key.
        y: values of the key along y, (rows,), in the unit of the key.
        error: error with the largest magnitude of all contacts at a point, (rows, columns) [1]; NaN if a
            contact did not end, or if there was no contact.
        restitution: restitution e of the contact with this error, (rows, columns) [1]; for six axes NaN
            unless there is a single touch.
        results: the same results as arrays, with theory and margins (`tuning.stability_map.grid.MapResults`).
    """

    document: dict[str, Any]
    x: np.ndarray
    y: np.ndarray
    error: np.ndarray
    restitution: np.ndarray
    results: "MapResults" = field(repr=False)

    def plot(self, path: str | os.PathLike[str]) -> None:
        """Write a plot of the map to a .png, .pdf or .svg file.

        Raises:
            InputError: If the file cannot be written.
        """
        from jaxhil.simulation.contact_plot import save_figure
        from tuning.plots.stability_map import map_plot

        title = f"{self.document['mechanism']}, compensation: {self.document['compensator']}"
        target = arguments.check_path("path", path)
        with report_write_errors(target):
            save_figure(map_plot(self.results, title, self.document["limit"]), target)


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Options of `map`."""

    points: Annotated[
        int, number_option("Number of points along each axis."), AllowedValues(2, MAX_POINTS)
    ] = 100
    limit: Annotated[
        float | None,
        text_option(
            "NUMBER",
            "Error that limits the margins: the restitution error, by default 0.01; in six axes the twist "
            "error, by default 0.05.",
        ),
        LimitRange,
    ] = None
    resume: Resume = False
    scheduler: Scheduler = None
    seed: Annotated[
        int, number_option("Seed of the sensor noise, which is the same at every point."), SeedRange
    ] = 0


@arguments.convert_os_errors
@add_options(MapOptions)
def map(
    mechanism: AnyMechanism | str | os.PathLike[str],
    x: str,
    y: str,
    compensator: str = "none",
    gains: Mapping[str, float] | str | os.PathLike[str] | None = None,
    *,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = False,
    **options: Any,
) -> StabilityMap:
    """Compute a stability map: the error of a contact as a function of two keys, and closed-form predictions.

    The gains at every point are those of the nominal mechanism. The map therefore shows the effect of changes
    that the controller does not know. If compensator and contact law are linear, the map also contains the
    spectral radius of the sampled loop in contact. At the nominal point, it contains the derivative of this
    radius with respect to each gain. For six axes, the error is the twist error, and there are no
    predictions.

    Args:
        mechanism: result of `jaxhil.load`, the name of a built-in mechanism, or the path of a mechanism file.
        x: key along x, "PATH" or "PATH=LOW:HIGH" in SI units, or "gains.NAME". The default range is the key's
            [uncertainty] in the file or, if there is none, 0.3 to 3 times the nominal value; for a gain, it
            is the gain's bounds. The entries of a list are scaled together, and the values along the axis are
            those of the first entry; "contact.stiffness[1]" varies a single entry.
        y: key along y, in the format of `x`.
        compensator: name of a compensator.
        gains: gains, in one of the forms that `jaxhil.simulate` accepts.
        folder: folder for map.json and map.png; None writes nothing.
        progress: report the progress on standard error.
        **options: see `MapOptions`.

    Returns:
        The values along both axes, the errors and restitutions, and all further results.

    Raises:
        InputError: If an argument is unusable, or the folder cannot be written; the message has one line.

    Example:
        >>> import tuning
        >>> result = tuning.map("rig-300kg", "rig.force_sensor.delay", "contact.stiffness", points=3)
        >>> result.error.shape
        (3, 3)
    """
    settings = MapOptions(**options)
    check_options(settings)
    arguments.check_booleans(progress=progress)
    if settings.resume and folder is None:
        raise arguments.ArgumentError("resume", "no folder", "the folder of an interrupted map")
    checked = as_any_mechanism(mechanism)
    target = None if folder is None else arguments.check_path("folder", folder)
    with jax_context():
        return _compute(checked, (x, y), compensator, gains, settings, target, progress)


def _compute(
    mechanism: AnyMechanism,
    keys: tuple[str, str],
    compensator: str,
    gains: Any,
    settings: MapOptions,
    target: Path | None,
    progress: bool,
) -> StabilityMap:
    """Compute the stability map over two `keys`; unless `target` is None, write it to this folder."""
    from jaxhil.simulation.gain_choice import choose_gains
    from tuning.caches.checkpoints import CHECKPOINT_FOLDER, Checkpoints
    from tuning.stability_map.grid import compute_map, count_runs

    name, values = choose_gains(mechanism, compensator, gains)
    axes = _axes(mechanism, name, values, *keys)
    mechanism_summary.check_can_be_simulated(mechanism)
    points, seed = settings.points, settings.seed
    limit = arguments.choose_limit(settings.limit, mechanism)
    checkpoints = Checkpoints(None if target is None else target / CHECKPOINT_FOLDER, settings.resume)
    with terminal.show_progress(count_runs(points), "runs", progress) as bar:
        others = settings.scheduler, checkpoints
        computed = compute_map(mechanism, name, values, axes, points, limit, seed, bar.tell, *others)
    document = _build_document(mechanism, name, values, computed, limit, seed)
    arrays = computed.x, computed.y, computed.error, computed.restitution
    stability_map = StabilityMap(document, *arrays, computed)
    if target is not None:
        _write(stability_map, target)
        checkpoints.remove()
    return stability_map


def _axes(
    mechanism: AnyMechanism, compensator: str, gains: Mapping[str, float], x: str, y: str
) -> "tuple[MapAxis, MapAxis]":
    """Build the axes x and y of the stability map; an `InputError` names the option that is wrong."""
    from jaxhil.laws.compensators import axes_of, get_compensator
    from tuning.stability_map.axes import check_axes, parse_axis

    law = get_compensator(compensator, axes_of(mechanism))
    try:
        axes = parse_axis("x", x, mechanism, law, gains), parse_axis("y", y, mechanism, law, gains)
        check_axes(mechanism, axes)
    except InputError as error:
        error.__dict__.setdefault("option", f"--{error}" if str(error)[:1] in "xy" else str(error))
        raise
    return axes


def _write(stability_map: StabilityMap, folder: Path) -> None:
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / DOCUMENT_FILE, terminal.format_json(stability_map.document).encode("ascii"))
    stability_map.plot(folder / PLOT)


def _build_document(
    mechanism: AnyMechanism,
    compensator: str,
    gains: Mapping[str, float],
    computed: "MapResults",
    limit: float,
    seed: int,
) -> dict[str, Any]:
    from jaxhil.simulation.contact_bounds import CONTACT_BOUNDS
    from jaxhil.simulation.source_fingerprint import dependency_versions
    from tuning.gain_file import VERSIONED_PACKAGES, to_json_data

    closed, radii = computed.closed, computed.radii
    document = {
        "schema": SCHEMA,
        "verdict": "good",  # a map has no requirement that could be violated
        "mechanism": mechanism.name,
        "axes": computed.rig_axes,
        "compensator": compensator,
        "gains": dict(gains),
        **{
            name: {"key": axis.key, "unit": axis.unit, "nominal": axis.nominal, "values": values}
            for name, axis, values in zip("xy", computed.axes, (computed.x, computed.y), strict=True)
        },
        "limit": limit,
        "seed": seed,
        "error": computed.error,
        "restitution": computed.restitution,
        "peak_force_ratio": computed.peak_force_ratio,
        "duration_ratio": computed.duration_ratio,
        "bounds": CONTACT_BOUNDS,
        "theory": {
            "series": closed.series,
            "characteristic_root": closed.characteristic_root,
            "delay_over_critical": closed.delay_over_critical,
            "none_because": closed.reason,
        },
        "spectral_radius": {
            **({} if radii is None else {"x": radii.x, "y": radii.y, "values": radii.values}),
            "none_because": computed.no_growth,
        },
        "nominal": _nominal(computed.nominal),
        "versions": dependency_versions(VERSIONED_PACKAGES),
    }
    document = to_json_data(document)
    return {**document, "sha256": digest(document)}


def _nominal(nominal: "NominalPoint") -> dict[str, Any]:
    margins = {
        "error": nominal.error_margins,
        "contact": nominal.contact_margins,
        "spectral_radius": nominal.radius_margins,
    }
    fields = ("restitution", "error", "peak_force_ratio", "duration_ratio", "growth")
    return {
        **{name: getattr(nominal, name) for name in fields},
        "margins": {
            name: None if pair is None else {"x": pair[0]._asdict(), "y": pair[1]._asdict()}
            for name, pair in margins.items()
        },
    }


__all__ = ["MapOptions", "StabilityMap", "map"]
