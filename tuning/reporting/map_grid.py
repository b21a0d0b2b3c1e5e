"""A stability map: the restitution error over two keys, what theory says there, how far the nominal point is
from where it ends.

Gains stay what they are over the whole map: it shows what a controller meets that is not told. All points,
and two lines through the nominal one, are lanes of one program.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhil.mechanism.file import to_builtins
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.one_axis import ONE_AXIS, evaluate
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.scenario import Scenario, build_scenarios
from tuning.caches.cluster import Piece, on_workers
from tuning.caches.pieces import NOTHING_KEPT, Pieces, digest_of
from tuning.caches.worker import setting
from tuning.reporting.closed_forms import ClosedForms, closed_forms
from tuning.reporting.contact_growth import Growth, cost, growth, no_growth, spectral_radii
from tuning.reporting.map_axes import MapAxis, draws

LINE = 201  # points of each line through the nominal point
PART = 2048  # runs at a time
MOST_WORK = 5e7  # of eigenvalues: where the whole map would take more, the spectral radius has a coarser grid
FEWEST = 15  # points along an axis of that


class Margin(NamedTuple):
    """Where one key, going from its nominal value, meets a limit; None where the map ends first."""

    low: float | None  # the nearest value below the nominal one [unit of the key]
    high: float | None  # the nearest one above it


class Radii(NamedTuple):
    """The spectral radius of the loop in contact, over a grid of its own."""

    x: np.ndarray  # (columns,)
    y: np.ndarray  # (rows,)
    values: np.ndarray  # (rows, columns) [1]


class Nominal(NamedTuple):
    """The point that the file describes."""

    restitution: float | None  # e of the contact with the largest error [1]
    error: float | None  # its e - e* [1]; None where a contact did not end
    # of all its contacts the largest real force over the ideal contact's peak force [1]; None likewise
    peak_force_ratio: float | None
    duration_ratio: float | None  # likewise of the duration, the one farthest from 1 [1]
    growth: Growth | None  # of a contact that lasts, where the loop in contact is linear
    error_margins: tuple[Margin, Margin] | None  # along x and y, to the limit; None where the error is beyond
    # to the bounds on real peak force and duration; None where the nominal point is beyond
    contact_margins: tuple[Margin, Margin] | None
    radius_margins: tuple[Margin, Margin] | None  # along x and y, to a spectral radius of 1


class Map(NamedTuple):
    """All that is known of a map."""

    axes: tuple[MapAxis, MapAxis]  # x and y
    x: np.ndarray  # (columns,), in the unit of its key
    y: np.ndarray  # (rows,)
    restitution: np.ndarray  # e of the contact with the largest error (rows, columns) [1]
    error: np.ndarray  # its e - e* (rows, columns) [1]; NaN where a contact did not end
    peak_force_ratio: np.ndarray  # as of `Nominal` (rows, columns) [1]; NaN likewise
    duration_ratio: np.ndarray  # likewise
    closed: ClosedForms  # each (rows, columns)
    radii: Radii | None  # of a contact that lasts
    no_growth: str | None  # why there are no radii
    nominal: Nominal


def compute_map(
    mechanism: Mechanism,
    compensator: str,
    gains: Mapping[str, float],
    axes: tuple[MapAxis, MapAxis],
    points: int,
    limit: float,
    seed: int,
    tell: Callable[[str, float], None],
    scheduler: str | None = None,
    kept: Pieces = NOTHING_KEPT,
) -> Map:
    """The map of so many points along either axis; `tell` is called with what is going on, and how many of
    all `runs` are done. With a `scheduler` the workers of a cluster run the contacts; parts of them are
    `kept` when finished."""

    def batch(values: np.ndarray) -> tuple[dict[str, Any], Scenario]:
        return _gains(gains, axes, values), _scenarios(mechanism, axes, values, seed)

    x, y = (axis.values(points) for axis in axes)
    lines = [axis.values(LINE) for axis in axes]
    middle = np.array([[axis.nominal for axis in axes]])
    across, up = np.repeat(middle, LINE, axis=0), np.repeat(middle, LINE, axis=0)
    across[:, 0], up[:, 1] = lines
    own, scenarios = batch(np.concatenate([_grid(x, y), across, up, middle]))
    found = _run(mechanism, compensator, own, scenarios, tell, scheduler, kept)
    restitution, error, force, duration, _ = found
    size = points**2

    tell("eigenvalues of the loop in contact", runs(points))
    reason = no_growth(mechanism, compensator)
    radii = on_lines = grown = None
    if reason is None:
        plain = {name: float(value) for name, value in gains.items()}
        grown = growth(mechanism, compensator, plain, batch(middle)[1])
        few = min(points, max(FEWEST, int((MOST_WORK / cost(mechanism, compensator, scenarios)) ** 0.5)))
        grid = [axis.values(few) for axis in axes]
        every = spectral_radii(mechanism, compensator, *batch(np.concatenate([_grid(*grid), across, up])))
        radii = Radii(grid[0], grid[1], every[: few**2].reshape(few, few))
        on_lines = every[few**2 :].reshape(2, LINE)
    closed = closed_forms(mechanism, compensator, batch(_grid(x, y))[1])
    nominal = _nominal(found, size, axes, lines, limit)
    if on_lines is not None and grown is not None:
        margins = _margins(axes, lines, on_lines, 1.0) if grown.spectral_radius <= 1 else None
        nominal = nominal._replace(growth=grown, radius_margins=margins)
    shape = points, points
    return Map(
        axes=axes,
        x=x,
        y=y,
        restitution=restitution[:size].reshape(shape),
        error=error[:size].reshape(shape),
        peak_force_ratio=force[:size].reshape(shape),
        duration_ratio=duration[:size].reshape(shape),
        closed=_reshaped(closed, points),
        radii=radii,
        no_growth=reason,
        nominal=nominal,
    )


def _nominal(
    found: np.ndarray,
    size: int,
    axes: tuple[MapAxis, MapAxis],
    lines: list[np.ndarray],
    limit: float,
) -> Nominal:
    """Return the nominal point, the last of all runs, and its margins along the lines; the first `size` runs
    are the map's."""
    restitution, error, force, duration, unlike = found
    if not np.isfinite(error[-1]):
        return Nominal(
            restitution=None,
            error=None,
            peak_force_ratio=None,
            duration_ratio=None,
            growth=None,
            error_margins=None,
            contact_margins=None,
            radius_margins=None,
        )
    errors = np.nan_to_num(np.abs(error[size:-1]), nan=np.inf).reshape(2, LINE)
    bounds = np.nan_to_num(unlike[size:-1], nan=1.0).reshape(2, LINE)
    return Nominal(
        restitution=float(restitution[-1]),
        error=float(error[-1]),
        peak_force_ratio=float(force[-1]),
        duration_ratio=float(duration[-1]),
        growth=None,
        error_margins=_margins(axes, lines, errors, limit) if abs(error[-1]) <= limit else None,
        contact_margins=_margins(axes, lines, bounds, 0.5) if not unlike[-1] else None,
        radius_margins=None,
    )


def runs(points: int) -> int:
    """How many runs a map of so many points along either axis takes."""
    return points**2 + 2 * LINE + 1


def run_part(loop: Loop, gains: Mapping[str, Any], scenarios: Scenario, at_least: int) -> np.ndarray:
    """Return what `_worst` says of each lane of a part, (5, lanes)."""
    return np.stack(_worst(evaluate(loop, gains, scenarios, at_least=at_least)))


def _run(
    mechanism: Mechanism,
    compensator: str,
    gains: Mapping[str, Any],
    scenarios: Scenario,
    tell: Callable[[str, float], None],
    scheduler: str | None,
    kept: Pieces,
) -> np.ndarray:
    """Return what `_worst` says of each lane, part by part: each has lanes that take long and that do not."""
    loop, order = (
        build_loop(mechanism, compensator, scenarios),
        np.argsort(ONE_AXIS.expected_duration(scenarios)),
    )
    found = np.empty((5, len(order)))
    parts = -(-len(order) // PART)
    lanes = [order[number::parts] for number in range(parts)]
    inputs = digest_of((to_builtins(mechanism), compensator, gains, jax.tree.leaves(scenarios)))
    done = 0
    tell("running the contacts", done)

    def take(number: int, values: np.ndarray) -> None:
        nonlocal done
        found[:, lanes[number]] = values
        done += len(lanes[number])
        tell("running the contacts", done)

    def asked(numbers: Iterable[int]) -> Iterator[Piece]:
        for number in numbers:
            part = lanes[number]
            own = {name: value[part] if np.ndim(value) else value for name, value in gains.items()}
            some = jax.tree.map(lambda leaf, part=part: np.asarray(leaf)[..., part], scenarios)
            yield Piece(number, (loop, own, some, len(lanes[0])))

    missing = []
    for number in range(parts):
        known = kept.read(f"part {number}", (inputs, number), np.ndarray)
        missing.append(number) if known is None else take(number, known)
    if scheduler is None:
        computed = ((number, run_part(*arguments)) for number, arguments in asked(missing))
    else:
        computed = on_workers(scheduler, run_part, asked(missing), setting(), f"map-{inputs[:16]}")
    for number, values in computed:
        kept.write(f"part {number}", (inputs, number), values)
        take(number, values)
    return found


def _grid(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Points of a grid row by row, (rows x columns, 2)."""
    across, up = np.meshgrid(x, y)
    return np.stack([across.ravel(), up.ravel()], axis=1)


def _reshaped(closed: ClosedForms, points: int) -> ClosedForms:
    """Rows and columns instead of lanes."""
    series, root, critical = (None if one is None else one.reshape(points, points) for one in closed[:3])
    return ClosedForms(series, root, critical, closed.reason)


def _scenarios(
    mechanism: Mechanism, axes: tuple[MapAxis, MapAxis], values: np.ndarray, seed: int
) -> Scenario:
    phase = {"approach.phase": np.full(len(values), mechanism.approach.phase)}
    made = build_scenarios(mechanism, phase | draws(mechanism, axes, values), seed)
    # The noise of every lane is that of the first.
    return made._replace(key=np.broadcast_to(made.key[:, :1], made.key.shape))  # pyright: ignore[reportArgumentType]


def _gains(gains: Mapping[str, float], axes: tuple[MapAxis, MapAxis], values: np.ndarray) -> dict[str, Any]:
    """One value a lane of all of them where a gain varies."""
    moving = {
        axis.key.partition(".")[2]: values[:, place] for place, axis in enumerate(axes) if not axis.path
    }
    if not moving:
        return dict(gains)
    return {name: moving.get(name, np.full(len(values), value)) for name, value in gains.items()}


def _worst(outcome: Outcome) -> tuple[np.ndarray, ...]:
    """Return of each lane e and e - e* of the contact with the largest error, the largest peak force ratio,
    the duration ratio farthest from 1, and whether a contact is unlike the ideal one.

    All are NaN where a contact did not end.
    """
    used = outcome.wanted & outcome.good
    ended = ~np.any(outcome.wanted & ~outcome.good, axis=0)

    def at_largest(size: Any, *values: Any) -> Iterator[np.ndarray]:
        place = np.argmax(np.where(used, np.nan_to_num(size), -1.0), axis=0)[None]
        for one in values:
            yield np.where(ended, np.take_along_axis(np.asarray(one, float), place, axis=0)[0], np.nan)

    force, duration = outcome.peak_force_ratio, outcome.duration_ratio
    with np.errstate(divide="ignore"):
        apart = np.abs(np.log(duration))
    return (
        *at_largest(np.abs(outcome.error), outcome.metrics.restitution, outcome.error),
        *at_largest(force, force),
        *at_largest(apart, duration),
        *at_largest(outcome.unlike.astype(float), outcome.unlike),
    )


def _margins(
    axes: tuple[MapAxis, MapAxis], lines: list[np.ndarray], values: np.ndarray, most: float
) -> tuple[Margin, Margin]:
    """Where `values` (axes, points) along the lines, each through the nominal point, first exceed `most`."""
    found = []
    for axis, line, along in zip(axes, lines, values, strict=True):
        below, above = line < axis.nominal, line > axis.nominal
        found.append(
            Margin(
                _crossing(line[below][::-1], along[below][::-1], most),
                _crossing(line[above], along[above], most),
            )
        )
    return found[0], found[1]


def _crossing(line: np.ndarray, values: np.ndarray, most: float) -> float | None:
    """The first place at which values exceed the most, between two points along a straight line."""
    beyond = np.flatnonzero(values > most)
    if not len(beyond):
        return None
    place = int(beyond[0])
    if place == 0 or not np.isfinite(values[place]):
        return float(line[place])
    share = (most - values[place - 1]) / (values[place] - values[place - 1])
    return float(line[place - 1] + share * (line[place] - line[place - 1]))
