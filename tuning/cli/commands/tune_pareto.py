"""Pareto fronts of `jaxhil tune --pareto N`, with one gain file for each point."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxhil.errors import InputError
from jaxhil.files import make_folder, open_regular, remove_stale, report_write_errors
from tuning import terminal
from tuning.api import tune_pareto
from tuning.api.tuned_gains import TradedGains, TunedGains
from tuning.cli.options import Tune

if TYPE_CHECKING:
    from tuning.caches.checkpoints import Checkpoints

FRONT_FOLDER = "pareto"


def compute_fronts(
    options: Tune,
    done: Mapping[int, TunedGains],
    entries: Mapping[int, dict[str, Any]],
    problems: list[str],
    bar: terminal.Progress,
    checkpoints: "Checkpoints",
) -> dict[int, Any]:
    """Compute and write the Pareto front of each tuned mechanism, and return the fronts by index.

    The JSON entry of a front is added to the mechanism's entry in `entries`, and an error to `problems`.
    """
    order, fronts = sorted(done), {}
    results = [done[index] for index in order]
    arguments = options.pareto, options.pareto_against, bar, checkpoints, options.scheduler
    for number, points in tune_pareto.compute_fronts(results, *arguments):
        index = order[number]
        folder = Path(entries[index]["gain_file"]).parent
        try:
            entry = _write(options, points, folder)
        except InputError as error:
            problems.append(str(error))
            terminal.note(f"jaxhil: {error}")
            continue
        entries[index]["pareto"], fronts[index] = entry, points[0].front
    return fronts


def print_front(options: Tune, result: Any, front: Any, entry: dict[str, Any]) -> None:
    """Print the points of a Pareto front, and the point of least cost with an error within the limit."""
    rows: list[list[Any]] = [
        ["literature's rule", None, *_point_cells(result, front.literature), ""],
        ["tuned", None, *_point_cells(result, front.tuned), ""],
    ]
    for number, point in enumerate(front.points, start=1):
        equal = next(n for n, earlier in enumerate(front.points, start=1) if earlier.place == point.place)
        remark = f"as point {equal}" if equal < number else "front" if point.on_front else "dominated"
        rows.append([str(number), point.weight, *_point_cells(result, point), remark])
    axis = front.axis
    weight = axis.weight.replace("_", " ")
    headings = ["point", weight, axis.name, *([] if _is_rms_objective(result) else ["objective"])]
    table = terminal.build_table(
        f"{result.mechanism.name}: {'twist' if 'twist_error' in entry else 'restitution'} error against "
        f"{axis.words}, "
        f"{options.validation} fresh scenarios",
        [*headings, "rms", "99th pct", "max", "not ended", ""],
        rows,
        texts=(0, len(rows[0]) - 1),
    )
    paths, limit = [traded["gain_file"] for traded in entry["pareto"]["points"]], entry["limit"]
    lines = [f"wrote {paths[0]} to {paths[-1]}", f"wrote {entry['pareto']['plot']}"]
    within_limit = [
        (point.place[1], number, point.figures.rms)
        for number, point in enumerate(front.points, start=1)
        if point.figures.failed == 0 and point.figures.rms <= limit
    ]
    if within_limit:
        cost, number, rms = min(within_limit)
        texts = {
            "noise": f"Least noise within {limit:g}: point {number}, sensor noise x {cost:.4g}",
            "peak": f"Least peak command within {limit:g}: point {number}, peak x {cost:.4g}",
            "transparency": f"Best transparency within {limit:g}: point {number}, error {cost:.2g}",
        }
        lines.append(f"{texts[axis.name]}, rms {rms:.2g}.")
    else:
        lines.append(f"No point has an rms error within {limit:g}.")
    terminal.emit(table, *lines, "")


def _write(options: Tune, points: Sequence[TradedGains], folder: Path) -> dict[str, Any]:
    """Write a gain file for each point of a front, and the front's plot; return the front's JSON entry."""
    from jaxhil.simulation.contact_plot import save_figure
    from tuning.plots.tuning_results import front_plot

    front, result, entries = points[0].front, points[0].tuned.tune_result, []
    for number, point in enumerate(points, start=1):
        point_folder = folder / FRONT_FOLDER / f"{number:02d}"
        for target in (folder / FRONT_FOLDER, point_folder):
            with report_write_errors(target):
                make_folder(target)
                remove_stale(target)
        point.save(point_folder / "gains.json")
        gains = {"gain_file": str(point_folder / "gains.json"), "gains": point.document["gains"]}
        entries.append({**point.traded, **gains, "figures": point.figures, "nominal": point.point.nominal})
    _remove_stale_points(folder / FRONT_FOLDER, len(entries))
    plot = folder / "pareto.png"
    save_figure(front_plot(front, result, points[0].tuned.limit), plot)
    axis = front.axis
    others = {
        name: {axis.cost: fixed.cost, "error": fixed.error, "figures": fixed.figures}
        for name, fixed in (("literature", front.literature), ("tuned", front.tuned))
    }
    return {"against": axis.name, "points": entries, **others, "plot": str(plot)}


def _remove_stale_points(folder: Path, number: int) -> None:
    """Delete gain files of points numbered above `number`, left in the folder by an earlier, longer front."""
    for path in folder.iterdir():
        name = path.name
        is_beyond = name.isdecimal() and int(name) > number and name == f"{int(name):02d}"
        if is_beyond and not path.is_symlink() and _is_gain_file(path / "gains.json"):
            (path / "gains.json").unlink()
            if not any(path.iterdir()):
                path.rmdir()


def _is_gain_file(path: Path) -> bool:
    # The import is local because it loads jax, which must not happen if options are unusable.
    from jaxhil.simulation.gain_file import load_gain_file

    try:
        open_regular(path).close()
        load_gain_file(path)
    except (InputError, OSError):
        return False
    return True


def _is_rms_objective(result: Any) -> bool:
    """Return whether tuning minimised the rms error alone, without weights or penalties."""
    objective = result.settings.objective
    weights = (
        objective.divergence_weight,
        objective.command_weight,
        objective.chatter_weight,
        objective.transparency_weight,
    )
    return (objective.name, *weights) == ("rms", 1.0, 0.0, 0.0, 0.0)


def _point_cells(result: Any, point: Any) -> list[Any]:
    """Return the table cells of a point of a front: cost, errors, and number of failed contacts."""
    metrics = point.figures
    errors = [metrics.rms] if _is_rms_objective(result) else [point.error, metrics.rms]
    # A cost below 0.1 is an error and needs more digits than an amplification or a peak ratio.
    cost = f"x {point.cost:.3f}" if point.cost >= 0.1 else f"{point.cost:.4g}"
    return [cost, *errors, metrics.p99, metrics.max, metrics.failed]
