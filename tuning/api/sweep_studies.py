"""Additional studies of `tuning.sweep`, which are computed, or read from the store on resuming."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, to_one_line
from tuning import terminal


def compute_sobol_indices(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """Return the document's entry of Sobol indices; write errors are added to `unwritten`."""
    from tuning.statistics.sobol_indices import count_evaluations
    from tuning.sweeps.stored_studies import IndicesRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import compute_error_indices, group_independent_inputs

    number: int = options.drivers
    request = IndicesRequest(number)
    indices = read_study(store, request) if options.resume else None
    if indices is not None:
        _report_stored("drivers", study_path(store, request), progress)
        return indices._asdict()
    # Sensor noise adds an input, which the progress bar may ignore.
    total = count_evaluations(len(group_independent_inputs(sweep.mechanism)), number)
    with _study_runner(options, store, total, "scenarios", "drivers", progress, workers) as running:
        indices = compute_error_indices(sweep, number, running)
    with collect_input_errors(unwritten):
        write_study(store, request, indices)
        running.kept.remove()
    return indices._asdict()


def run_subset_simulation(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """Return the document's entry of the subset simulation; write errors are added to `unwritten`."""
    from tuning.sweeps.stored_studies import RareFailureRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import count_most_scenarios, estimate_rare_failure

    limit = float(options.rare or options.limit)
    request = RareFailureRequest(limit)
    estimate = read_study(store, request) if options.resume else None
    if estimate is not None:
        _report_stored("subset simulation", study_path(store, request), progress)
        return _subset_simulation_entry(limit, estimate)
    name = "subset simulation"
    with _study_runner(
        options, store, count_most_scenarios(), "scenarios at most", name, progress, workers
    ) as running:
        estimate = estimate_rare_failure(sweep, limit, running)
    with collect_input_errors(unwritten):
        write_study(store, request, estimate)
        running.kept.remove()
    return _subset_simulation_entry(limit, estimate)


@contextmanager
def _study_runner(
    options: Any, store, total: int, unit: str, study: str, progress: bool, workers: Any
) -> Iterator[Any]:
    """Provide the function that runs a study's scenarios, here or on a cluster, with checkpoints."""
    from tuning.caches.checkpoints import CHECKPOINT_FOLDER, Checkpoints
    from tuning.sweeps.cluster_computers import BATCHES_PER_STUDY, build_point_computer
    from tuning.sweeps.point_batches import PointRunSettings

    with terminal.show_progress(total, unit, progress) as bar:
        bar.say(study)
        checkpoints = Checkpoints(store.folder / CHECKPOINT_FOLDER, options.resume)
        running = PointRunSettings(lambda more: bar.advance(more, study), bar.skip, checkpoints)
        if workers is not None:
            running = running._replace(computer=build_point_computer(workers), several=BATCHES_PER_STUDY)
        yield running


@contextmanager
def collect_input_errors(unwritten: list[InputError]) -> Iterator[None]:
    """Add an `InputError` within the context to the list, so that it is reported later."""
    try:
        yield
    except InputError as error:
        unwritten.append(error)


def _subset_simulation_entry(limit: float, estimate) -> dict[str, Any]:
    """Return the document's entry of a subset simulation."""
    from tuning.sweeps.studies import is_spread_beyond_formula

    names = ("probability", "low", "high", "coefficient_of_variation", "formula_coefficient_of_variation")
    return {
        "limit": limit,
        **{name: getattr(estimate, name) for name in (*names, "evaluations")},
        "estimates": estimate.estimates.tolist(),
        "spread_beyond_formula": is_spread_beyond_formula(estimate),
    }


def _report_stored(study: str, path: Path, progress: bool) -> None:
    """Report that a study was read from a file."""
    if progress:
        terminal.note(f"{study}: as kept in {to_one_line(str(path))}")
