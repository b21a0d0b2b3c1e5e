"""Computation of a stability map: restitution or twist error on a grid of two keys, theory, margins.

The gains are the same at every point, so that the map shows the effect of changes that the controller does
not know. The margins of the nominal point follow from runs along two lines through this point, one for each
key. All runs are batch elements of one program.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhil.mechanism.file import AnyMechanism, to_plain_data
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.evaluation import RigModel
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.tile_size import find_tile_size
from tuning.caches.checkpoints import NO_CHECKPOINTS, Checkpoints, compute_digest
from tuning.caches.cluster import WorkUnit, run_on_workers
from tuning.caches.worker import get_process_setting
from tuning.stability_map.axes import MapAxis, mechanism_draws
from tuning.stability_map.closed_forms import ClosedForms, compute_closed_forms
from tuning.stability_map.contact_growth import (
    Growth,
    compute_growth,
    eigenvalue_cost,
    explain_nonlinearity,
    spectral_radii,
)

LINE_POINTS = 201  # number of points of each line through the nominal point
MAX_TILE_RUNS = 2048  # largest number of runs computed at a time on a processor
MAX_EIGENVALUE_COST = 5e7  # largest cost of all eigenvalues; at a higher cost, the grid becomes coarser
NO_THEORY_REASON = "closed forms and growth rates exist for one axis only"
MIN_COARSE_POINTS = 15  # smallest number of points along an axis of the coarser grid


class NominalMargin(NamedTuple):
    """Range of one key, around its nominal value, in which a quantity of the map stays within its limit."""

    low: float | None  # lower end [unit of the key]; None if the limit is not exceeded down to the map's end
    high: float | None  # upper end [unit of the key]; None if the limit is not exceeded up to the map's end


class SpectralRadii(NamedTuple):
    """Spectral radii of the loop in contact, on the map's grid or on a coarser grid of the same ranges."""

    x: np.ndarray  # values along x, (columns,)
    y: np.ndarray  # values along y, (rows,)
    values: np.ndarray  # spectral radii, (rows, columns) [1]


class NominalPoint(NamedTuple):
    """Results at the nominal point of a stability map; the mechanism file defines this point.

    For six axes, `error` is the twist error, and a contact is an episode (a contact with all its touches).
    """

    restitution: float | None  # e of the contact with the largest error [1]
    error: float | None  # largest error e - e* [1]; None if a contact did not end
    # largest ratio of a real contact's peak force to the ideal one's [1]; None if a contact did not end
    peak_force_ratio: float | None
    duration_ratio: float | None  # duration ratio that is farthest from 1 [1]; None if a contact did not end
    growth: Growth | None  # growth of the oscillation in contact; None if the loop is not linear
    # ranges of x and y with an error within the limit; None if the error at the nominal point exceeds it
    error_margins: tuple[NominalMargin, NominalMargin] | None
    # ranges of x and y with peak force and duration within bounds; None if the nominal point violates a bound
    contact_margins: tuple[NominalMargin, NominalMargin] | None
    # ranges of x and y with a spectral radius of at most 1; None if the radius at the nominal point exceeds 1
    radius_margins: tuple[NominalMargin, NominalMargin] | None


class MapResults(NamedTuple):
    """Results of a stability map at all points and at the nominal point."""

    axes: tuple[MapAxis, MapAxis]  # axes x and y
    x: np.ndarray  # values along x, (columns,), in the unit of its key
    y: np.ndarray  # values along y, (rows,), in the unit of its key
    restitution: np.ndarray  # e of the contact with the largest error, (rows, columns) [1]
    # largest error e - e* or, for six axes, twist error, (rows, columns) [1]; NaN if a contact did not end
    # or nothing touched
    error: np.ndarray
    peak_force_ratio: np.ndarray  # as in `NominalPoint` (rows, columns) [1]; NaN if a contact did not end
    duration_ratio: np.ndarray  # as in `NominalPoint` (rows, columns) [1]; NaN if a contact did not end
    closed: ClosedForms  # closed forms, each (rows, columns)
    radii: SpectralRadii | None  # spectral radii of the loop in contact; None if the loop is not linear
    no_growth: str | None  # reason if `radii` is None
    nominal: NominalPoint
    rig_axes: int = 1  # number of axes of the rig, 1 or 6


def compute_map(
    mechanism: AnyMechanism,
    compensator: str,
    gains: Mapping[str, float],
    axes: tuple[MapAxis, MapAxis],
    points: int,
    limit: float,
    seed: int,
    tell: Callable[[str, float], None],
    scheduler: str | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> MapResults:
    """Compute a stability map: errors and theory on a grid of two keys, and margins of the nominal point.

    The error is the restitution error or, for six axes, the twist error. The theory consists of closed forms
    and spectral radii; there is none for six axes.

    Args:
        mechanism: nominal mechanism.
        compensator: name of the compensator.
        gains: gains at the nominal point, and at all points unless an axis is a gain [SI units].
        axes: axes x and y.
        points: number of values along each axis.
        limit: limit of the error [1], which defines the margins of the nominal point.
        seed: seed of the sensor noise.
        tell: called with the current activity, and the number of finished runs out of `count_runs(points)`.
        scheduler: address of a cluster's scheduler, whose workers simulate the contacts; None for this
            process.
        checkpoints: store of the results of finished runs, which are not repeated.

    Returns:
        The results at all points and at the nominal point.
    """

    model = choose_rig_model(mechanism)

    def batch(values: np.ndarray) -> tuple[dict[str, Any], Any]:
        return _point_gains(gains, axes, values), _build_scenarios(mechanism, axes, values, seed)

    x, y = (axis.values(points) for axis in axes)
    lines = [axis.values(LINE_POINTS) for axis in axes]
    middle = np.array([[axis.nominal for axis in axes]])
    on_lines = np.tile(middle, (2 * LINE_POINTS, 1))  # points along x, then points along y
    on_lines[:LINE_POINTS, 0], on_lines[LINE_POINTS:, 1] = lines
    point_gains, scenarios = batch(np.concatenate([_grid_points(x, y), on_lines, middle]))
    work = model, mechanism, compensator, point_gains, scenarios
    worst = _run_tiles(*work, tell, scheduler, checkpoints)
    restitution, error, force, duration = (row[: points**2].reshape(points, points) for row in worst[:4])

    nominal, radii = _nominal_point(worst, points**2, axes, lines, limit), None
    if isinstance(mechanism, Mechanism):
        tell("eigenvalues of the loop in contact", count_runs(points))
        reason = explain_nonlinearity(mechanism, compensator)
        closed = compute_closed_forms(mechanism, compensator, batch(_grid_points(x, y))[1])
    else:
        reason = NO_THEORY_REASON
        closed = ClosedForms(None, None, None, reason)
    if isinstance(mechanism, Mechanism) and reason is None:
        plain = {name: float(value) for name, value in gains.items()}
        nominal_growth = compute_growth(mechanism, compensator, plain, batch(middle)[1])
        cost = eigenvalue_cost(mechanism, compensator, scenarios)
        coarse = min(points, max(MIN_COARSE_POINTS, int((MAX_EIGENVALUE_COST / cost) ** 0.5)))
        grid = [axis.values(coarse) for axis in axes]
        of_points = batch(np.concatenate([_grid_points(*grid), on_lines]))
        all_radii = spectral_radii(mechanism, compensator, *of_points)
        radii = SpectralRadii(grid[0], grid[1], all_radii[: coarse**2].reshape(coarse, coarse))
        of_lines = all_radii[coarse**2 :].reshape(2, LINE_POINTS)
        margins = _line_margins(axes, lines, of_lines, 1.0) if nominal_growth.spectral_radius <= 1 else None
        nominal = nominal._replace(growth=nominal_growth, radius_margins=margins)
    return MapResults(
        axes=axes,
        x=x,
        y=y,
        restitution=restitution,
        error=error,
        peak_force_ratio=force,
        duration_ratio=duration,
        closed=_reshape_forms(closed, points),
        radii=radii,
        no_growth=reason,
        nominal=nominal,
        rig_axes=model.axes,
    )


def _nominal_point(
    worst: np.ndarray,
    size: int,
    axes: tuple[MapAxis, MapAxis],
    lines: list[np.ndarray],
    limit: float,
) -> NominalPoint:
    """Return the results at the nominal point, with its margins along the two lines through this point.

    `worst` contains the results of `_worst_contact` for each run: first the `size` runs of the map, then the
    runs along both lines, then the nominal run.
    """
    restitution, error, force, duration, unlike = worst
    if not np.isfinite(error[-1]):
        return NominalPoint(
            restitution=None,
            error=None,
            peak_force_ratio=None,
            duration_ratio=None,
            growth=None,
            error_margins=None,
            contact_margins=None,
            radius_margins=None,
        )
    errors = np.nan_to_num(np.abs(error[size:-1]), nan=np.inf).reshape(2, LINE_POINTS)
    bounds = np.nan_to_num(unlike[size:-1], nan=1.0).reshape(2, LINE_POINTS)
    return NominalPoint(
        restitution=float(restitution[-1]),
        error=float(error[-1]),
        peak_force_ratio=float(force[-1]),
        duration_ratio=float(duration[-1]),
        growth=None,
        error_margins=_line_margins(axes, lines, errors, limit) if abs(error[-1]) <= limit else None,
        contact_margins=_line_margins(axes, lines, bounds, 0.5) if not unlike[-1] else None,
        radius_margins=None,
    )


def count_runs(points: int) -> int:
    """Return the number of simulated runs of a map with `points` values along each axis."""
    return points**2 + 2 * LINE_POINTS + 1


def run_tile(
    model: RigModel, loop: Any, gains: Mapping[str, Any], scenarios: Any, at_least: int
) -> np.ndarray:
    """Simulate a tile (scenarios that are computed together); return the results of `_worst_contact`.

    The results have the shape (5, lanes). A smaller tile is padded to `at_least` scenarios, so that all
    tiles share a compiled program.
    """
    outcome = model.evaluate(loop, gains, scenarios, at_least=at_least)
    return np.stack(_worst_contact(model.select_verdict_error(outcome)))


def _run_tiles(
    model: RigModel,
    mechanism: AnyMechanism,
    compensator: str,
    gains: Mapping[str, Any],
    scenarios: Any,
    tell: Callable[[str, float], None],
    scheduler: str | None,
    checkpoints: Checkpoints,
) -> np.ndarray:
    """Simulate all runs in tiles, and return the results of `_worst_contact`, (5, lanes).

    Each tile (runs that are computed together) contains both long and short runs, for a similar time per
    tile.
    """
    loop = model.loop(mechanism, compensator, scenarios)
    order = np.argsort(model.expected_duration(scenarios))
    worst = np.empty((5, len(order)))
    tiles = -(-len(order) // find_tile_size(len(order), MAX_TILE_RUNS))
    lanes = [order[number::tiles] for number in range(tiles)]
    inputs = compute_digest((to_plain_data(mechanism), compensator, gains, jax.tree.leaves(scenarios)))
    finished = 0
    tell("running the contacts", finished)

    def store(number: int, values: np.ndarray) -> None:
        nonlocal finished
        worst[:, lanes[number]] = values
        finished += len(lanes[number])
        tell("running the contacts", finished)

    def work_units(numbers: Iterable[int]) -> Iterator[WorkUnit]:
        for number in numbers:
            tile = lanes[number]
            tile_gains = {name: value[tile] if np.ndim(value) else value for name, value in gains.items()}
            tile_scenarios = jax.tree.map(lambda leaf, tile=tile: np.asarray(leaf)[..., tile], scenarios)
            yield WorkUnit(number, (model, loop, tile_gains, tile_scenarios, len(lanes[0])))

    missing = []
    for number in range(tiles):
        stored = checkpoints.read(f"part {number}", (inputs, tiles, number), np.ndarray)
        missing.append(number) if stored is None else store(number, stored)
    if scheduler is None:
        computed = ((number, run_tile(*arguments)) for number, arguments in work_units(missing))
    else:
        computed = run_on_workers(
            scheduler, run_tile, work_units(missing), get_process_setting(), f"map-{inputs[:16]}"
        )
    for number, values in computed:
        checkpoints.write(f"part {number}", (inputs, tiles, number), values)
        store(number, values)
    return worst


def _grid_points(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the points (x, y) of a grid, row by row, (rows x columns, 2)."""
    across, up = np.meshgrid(x, y)
    return np.stack([across.ravel(), up.ravel()], axis=1)


def _reshape_forms(closed: ClosedForms, points: int) -> ClosedForms:
    """Reshape the closed forms from lanes to rows and columns of the map, (points, points)."""
    series, root, critical = (
        None if values is None else values.reshape(points, points) for values in closed[:3]
    )
    return ClosedForms(series, root, critical, closed.reason)


def _build_scenarios(
    mechanism: AnyMechanism, axes: tuple[MapAxis, MapAxis], values: np.ndarray, seed: int
) -> Any:
    """Build the scenarios for points `values`, (lanes, 2), all with the same sensor noise."""
    # This array determines the number of lanes, even if both axes are gains.
    period = {"rig.control_period": np.full(len(values), mechanism.rig.control_period)}
    if isinstance(mechanism, Mechanism):
        period = {"approach.phase": np.full(len(values), mechanism.approach.phase)}
    draws = period | mechanism_draws(mechanism, axes, values)
    scenarios = choose_rig_model(mechanism).scenarios(mechanism, draws, seed)
    # All lanes get the noise of the first lane, so that points differ only in the keys of the axes.
    return scenarios._replace(key=np.broadcast_to(scenarios.key[:, :1], scenarios.key.shape))


def _point_gains(
    gains: Mapping[str, float], axes: tuple[MapAxis, MapAxis], values: np.ndarray
) -> dict[str, Any]:
    """Return the gains for points `values`, (lanes, 2).

    If an axis is a gain, all gains are arrays (lanes,); otherwise they are scalars.
    """
    varied = {
        axis.key.partition(".")[2]: values[:, index] for index, axis in enumerate(axes) if not axis.path
    }
    if not varied:
        return dict(gains)
    return {name: varied.get(name, np.full(len(values), value)) for name, value in gains.items()}


def _worst_contact(outcome: Outcome) -> tuple[np.ndarray, ...]:
    """Return five arrays (lanes,) with the worst values among the contacts of each lane.

    The first two values are restitution and error of the contact with the largest error. The next two
    compare contacts with their ideal contacts: the largest ratio of the peak forces, and the ratio of the
    durations that is farthest from 1. The last value is 1 if a contact's peak force or duration is out of
    bounds, else 0. All values are NaN if a contact did not end, or if there is no contact.
    """
    used = outcome.is_scheduled & outcome.good
    ended = np.any(outcome.is_scheduled, axis=0) & ~np.any(outcome.is_scheduled & ~outcome.good, axis=0)

    def at_largest(size: Any, *values: Any) -> Iterator[np.ndarray]:
        index = np.argmax(np.where(used, np.nan_to_num(size), -1.0), axis=0)[None]
        for value in values:
            yield np.where(ended, np.take_along_axis(np.asarray(value, float), index, axis=0)[0], np.nan)

    force, duration = outcome.peak_force_ratio, outcome.duration_ratio
    with np.errstate(divide="ignore"):
        deviation = np.abs(np.log(duration))
    return (
        *at_largest(np.abs(outcome.error), outcome.metrics.restitution, outcome.error),
        *at_largest(force, force),
        *at_largest(deviation, duration),
        *at_largest(outcome.is_unlike_ideal.astype(float), outcome.is_unlike_ideal),
    )


def _line_margins(
    axes: tuple[MapAxis, MapAxis], lines: list[np.ndarray], values: np.ndarray, most: float
) -> tuple[NominalMargin, NominalMargin]:
    """Return for each axis the range around the nominal value in which `values` stay at or below `most`.

    `lines` holds the points on each axis, (points,), and `values` has the shape (axes, points).
    """
    margins = []
    for axis, line, line_values in zip(axes, lines, values, strict=True):
        below, above = line < axis.nominal, line > axis.nominal
        margins.append(
            NominalMargin(
                _first_crossing(line[below][::-1], line_values[below][::-1], most),
                _first_crossing(line[above], line_values[above], most),
            )
        )
    return margins[0], margins[1]


def _first_crossing(line: np.ndarray, values: np.ndarray, most: float) -> float | None:
    """Return the first point of `line` at which the interpolated `values` exceed `most`, or None."""
    beyond = np.flatnonzero(values > most)
    if not len(beyond):
        return None
    index = int(beyond[0])
    if index == 0 or not np.isfinite(values[index]):
        return float(line[index])
    share = (most - values[index - 1]) / (values[index] - values[index - 1])
    return float(line[index - 1] + share * (line[index] - line[index - 1]))
