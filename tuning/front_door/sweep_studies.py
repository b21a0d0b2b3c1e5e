"""Additional studies of `tuning.sweep`, which are computed, or read from the store on resuming."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line
from tuning import terminal


def drivers(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """Return the document's entry of Sobol indices; write errors are added to `unwritten`."""
    from tuning.statistics.sobol_indices import evaluations
    from tuning.sweeps.stored_studies import IndicesRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import error_indices, independent_inputs

    number: int = options.drivers
    request = IndicesRequest(number)
    indices = read_study(store, request) if options.resume else None
    if indices is not None:
        _say_kept("drivers", study_path(store, request), progress)
        return indices._asdict()
    # Sensor noise adds an input, which the progress bar may ignore.
    total = evaluations(len(independent_inputs(sweep.mechanism)), number)
    with _running(options, store, total, "scenarios", "drivers", progress, workers) as running:
        indices = error_indices(sweep, number, running)
    with put_off(unwritten):
        write_study(store, request, indices)
        running.kept.remove()
    return indices._asdict()


def rare(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """Return the document's entry of the subset simulation; write errors are added to `unwritten`."""
    from tuning.sweeps.stored_studies import RareRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import most_scenarios, rare_failure

    limit = float(options.rare or options.limit)
    request = RareRequest(limit)
    estimate = read_study(store, request) if options.resume else None
    if estimate is not None:
        _say_kept("subset simulation", study_path(store, request), progress)
        return _rare_document(limit, estimate)
    name = "subset simulation"
    with _running(options, store, most_scenarios(), "scenarios at most", name, progress, workers) as running:
        estimate = rare_failure(sweep, limit, running)
    with put_off(unwritten):
        write_study(store, request, estimate)
        running.kept.remove()
    return _rare_document(limit, estimate)


@contextmanager
def _running(
    options: Any, store, total: int, unit: str, study: str, progress: bool, workers: Any
) -> Iterator[Any]:
    """Provide the function that runs a study's scenarios, here or on a cluster, with checkpoints."""
    from tuning.caches.pieces import FOLDER, Pieces
    from tuning.sweeps.cluster import SEVERAL, points_on
    from tuning.sweeps.points import Running

    with terminal.progress(total, unit, progress) as bar:
        bar.say(study)
        checkpoints = Pieces(store.folder / FOLDER, options.resume)
        running = Running(lambda more: bar.advance(more, study), bar.skip, checkpoints)
        if workers is not None:
            running = running._replace(computer=points_on(workers), several=SEVERAL)
        yield running


@contextmanager
def put_off(unwritten: list[InputError]) -> Iterator[None]:
    """Add an `InputError` within the context to the list, so that it is reported later."""
    try:
        yield
    except InputError as error:
        unwritten.append(error)


def _rare_document(limit: float, estimate) -> dict[str, Any]:
    """Return the document's entry of a subset simulation."""
    from tuning.sweeps.studies import spread_beyond_formula

    names = ("probability", "low", "high", "coefficient_of_variation", "formula_coefficient_of_variation")
    return {
        "limit": limit,
        **{name: getattr(estimate, name) for name in (*names, "evaluations")},
        "estimates": estimate.estimates.tolist(),
        "spread_beyond_formula": spread_beyond_formula(estimate),
    }


def _say_kept(study: str, path: Path, progress: bool) -> None:
    """Report that a study was read from a file."""
    if progress:
        terminal.note(f"{study}: as kept in {one_line(str(path))}")
