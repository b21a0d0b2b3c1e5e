"""The studies that `tuning.sweep` runs beside its sweep, or finds in the store where it resumes."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line
from tuning import terminal


def drivers(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """What of the document says which input drives the error. `unwritten`: see `put_off`."""
    from tuning.statistics.sobol_indices import evaluations
    from tuning.sweeps.stored_studies import IndicesRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import error_indices, independent_inputs

    number: int = options.drivers
    request = IndicesRequest(number)
    found = read_study(store, request) if options.resume else None
    if found is not None:
        _say_kept("drivers", study_path(store, request), progress)
        return found._asdict()
    # Noise, if there is any, adds an input; the bar need not know.
    total = evaluations(len(independent_inputs(sweep.mechanism)), number)
    with _running(options, store, total, "scenarios", "drivers", progress, workers) as running:
        found = error_indices(sweep, number, running)
    with put_off(unwritten):
        write_study(store, request, found)
        running.kept.remove()
    return found._asdict()


def rare(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """What of the document says how probable an error beyond a limit is. `unwritten`: see `put_off`."""
    from tuning.sweeps.stored_studies import RareRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import most_scenarios, rare_failure

    limit = float(options.rare or options.limit)
    request = RareRequest(limit)
    found = read_study(store, request) if options.resume else None
    if found is not None:
        _say_kept("subset simulation", study_path(store, request), progress)
        return _rare_document(limit, found)
    name = "subset simulation"
    with _running(options, store, most_scenarios(), "scenarios at most", name, progress, workers) as running:
        found = rare_failure(sweep, limit, running)
    with put_off(unwritten):
        write_study(store, request, found)
        running.kept.remove()
    return _rare_document(limit, found)


@contextmanager
def _running(
    options: Any, store, total: int, unit: str, study: str, progress: bool, workers: Any
) -> Iterator[Any]:
    """How a study's scenarios are run: here or by a cluster's workers, finished pieces kept in the store."""
    from tuning.caches.pieces import FOLDER, Pieces
    from tuning.sweeps.cluster import SEVERAL, points_on
    from tuning.sweeps.points import Running

    with terminal.progress(total, unit, progress) as bar:
        bar.say(study)
        kept = Pieces(store.folder / FOLDER, options.resume)
        running = Running(lambda more: bar.advance(more, study), bar.skip, kept)
        if workers is not None:
            running = running._replace(computer=points_on(workers), several=SEVERAL)
        yield running


@contextmanager
def put_off(unwritten: list[InputError]) -> Iterator[None]:
    """What cannot be written is added to the list, to be reported later."""
    try:
        yield
    except InputError as error:
        unwritten.append(error)


def _rare_document(limit: float, found) -> dict[str, Any]:
    from tuning.sweeps.studies import spread_beyond_formula

    shown = ("probability", "low", "high", "coefficient_of_variation", "formula_coefficient_of_variation")
    return {
        "limit": limit,
        **{name: getattr(found, name) for name in (*shown, "evaluations")},
        "estimates": found.estimates.tolist(),
        "spread_beyond_formula": spread_beyond_formula(found),
    }


def _say_kept(study: str, path: Path, progress: bool) -> None:
    if progress:
        terminal.note(f"{study}: as kept in {one_line(str(path))}")
