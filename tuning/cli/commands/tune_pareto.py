"""`jaxhil tune --pareto N`: gains that trade accuracy for something else, a gain file for each point."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxhil.errors import InputError
from jaxhil.files import make_folder, open_plain, remove_stale, writing
from tuning import terminal
from tuning.cli.options import Tune
from tuning.front_door import tune_pareto
from tuning.front_door.tuned_gains import TradedGains, TunedGains

if TYPE_CHECKING:
    from tuning.caches.pieces import Pieces

FOLDER = "pareto"


def trade(
    options: Tune,
    done: Mapping[int, TunedGains],
    entries: Mapping[int, dict[str, Any]],
    problems: list[str],
    bar: terminal.Progress,
    pieces: "Pieces",
) -> dict[int, Any]:
    """Fronts of the mechanisms that are `done`, written beside their gains and added to their entries."""
    order, made = sorted(done), {}
    results = [done[index] for index in order]
    asked = options.pareto, options.pareto_against, bar, pieces, options.scheduler
    for place, points in tune_pareto.trade(results, *asked):
        index = order[place]
        folder = Path(entries[index]["gain_file"]).parent
        try:
            entry = _write(options, points, folder)
        except InputError as error:
            problems.append(str(error))
            terminal.note(f"jaxhil: {error}")
            continue
        entries[index]["pareto"], made[index] = entry, points[0].front
    return made


def print_front(options: Tune, result: Any, front: Any, entry: dict[str, Any]) -> None:
    """Every point, and the quietest that is accurate enough."""
    rows: list[list[Any]] = [
        ["literature's rule", None, *_numbers(result, front.literature), ""],
        ["tuned", None, *_numbers(result, front.tuned), ""],
    ]
    for number, point in enumerate(front.points, start=1):
        like = next(n for n, other in enumerate(front.points, start=1) if other.place == point.place)
        place = f"as point {like}" if like < number else "front" if point.on_front else "dominated"
        rows.append([str(number), point.weight, *_numbers(result, point), place])
    axis = front.axis
    weight = axis.weight.replace("_", " ")
    headings = ["point", weight, axis.name, *([] if _is_rms(result) else ["objective"])]
    table = terminal.table(
        f"{result.mechanism.name}: restitution error against {axis.words}, "
        f"{options.validation} fresh scenarios",
        [*headings, "rms", "99th pct", "max", "not ended", ""],
        rows,
        texts=(0, len(rows[0]) - 1),
    )
    paths = [one["gain_file"] for one in entry["points"]]
    lines = [f"wrote {paths[0]} to {paths[-1]}", f"wrote {entry['plot']}"]
    enough = [
        (point.place[1], number, point.figures.rms)
        for number, point in enumerate(front.points, start=1)
        if point.figures.failed == 0 and point.figures.rms <= options.limit
    ]
    if enough:
        cost, number, rms = min(enough)
        words = {
            "noise": f"Quietest within {options.limit:g}: point {number}, sensor noise x {cost:.4g}",
            "peak": f"Gentlest within {options.limit:g}: point {number}, peak x {cost:.4g}",
            "honesty": f"Most honest within {options.limit:g}: point {number}, error {cost:.2g}",
        }
        lines.append(f"{words[axis.name]}, rms {rms:.2g}.")
    else:
        lines.append(f"No point's rms error is within {options.limit:g}.")
    terminal.emit(table, *lines, "")


def _write(options: Tune, points: Sequence[TradedGains], folder: Path) -> dict[str, Any]:
    """Write a gain file for each point and the picture of all; what `--json` says of them."""
    from jaxhil.simulation.contact_plot import save
    from tuning.pictures.plots import front_plot

    front, result, entries = points[0].front, points[0].tuned.found, []
    for number, point in enumerate(points, start=1):
        place = folder / FOLDER / f"{number:02d}"
        for one in (folder / FOLDER, place):
            with writing(one):
                make_folder(one)
                remove_stale(one)
        point.save(place / "gains.json")
        gains = {"gain_file": str(place / "gains.json"), "gains": point.document["gains"]}
        entries.append({**point.traded, **gains, "figures": point.figures, "nominal": point.point.nominal})
    _remove_others(folder / FOLDER, len(entries))
    plot = folder / "pareto.png"
    save(front_plot(front, result, options.limit), plot)
    axis = front.axis
    beside = {
        name: {axis.cost: one.cost, "error": one.error, "figures": one.figures}
        for name, one in (("literature", front.literature), ("tuned", front.tuned))
    }
    return {"against": axis.name, "points": entries, **beside, "plot": str(plot)}


def _remove_others(folder: Path, number: int) -> None:
    """Gain files of a longer front that was written here before do not belong to this one."""
    for place in folder.iterdir():
        name = place.name
        ours = name.isdecimal() and int(name) > number and name == f"{int(name):02d}"
        if ours and not place.is_symlink() and _is_gain_file(place / "gains.json"):
            (place / "gains.json").unlink()
            if not any(place.iterdir()):
                place.rmdir()


def _is_gain_file(path: Path) -> bool:
    # Takes jax, which refusals do without.
    from jaxhil.simulation.gain_file import load_gain_file

    try:
        open_plain(path).close()
        load_gain_file(path)
    except (InputError, OSError):
        return False
    return True


def _is_rms(result: Any) -> bool:
    """Whether the objective without what is traded is the rms error itself."""
    one = result.settings.objective
    weights = one.divergence_weight, one.command_weight, one.chatter_weight, one.transparency_weight
    return (one.name, *weights) == ("rms", 1.0, 0.0, 0.0, 0.0)


def _numbers(result: Any, point: Any) -> list[Any]:
    one = point.figures
    errors = [one.rms] if _is_rms(result) else [point.error, one.rms]
    # An error is no factor.
    cost = f"x {point.cost:.3f}" if point.cost >= 0.1 else f"{point.cost:.4g}"
    return [cost, *errors, one.p99, one.max, one.failed]
