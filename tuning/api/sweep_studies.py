"""Additional studies of `tuning.sweep`: Sobol indices and subset simulation.

With `--resume`, a study that is already in the store is read instead of computed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, to_one_line
from tuning import terminal


def compute_sobol_indices(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """Return the JSON entry of the error's Sobol indices; compute them unless the store contains them.

    If the indices cannot be written to the store, the error is added to `unwritten` instead of raised.
    """
    from tuning.statistics.sobol_indices import count_evaluations
    from tuning.sweeps.stored_studies import IndicesRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import compute_error_indices, group_independent_inputs

    number: int = options.drivers
    request = IndicesRequest(number)
    indices = read_study(store, request) if options.resume else None
    if indices is not None:
        _report_stored("drivers", study_path(store, request), progress)
        return indices._asdict()
    # This estimate, for the progress bar, ignores that sensor noise is a further input.
    total = count_evaluations(len(group_independent_inputs(sweep.mechanism)), number)
    with _study_runner(options, store, total, "scenarios", "drivers", progress, workers) as running:
        indices = compute_error_indices(sweep, number, running)
    with collect_input_errors(unwritten):
        write_study(store, request, indices)
        running.checkpoints.remove()
    return indices._asdict()


def run_subset_simulation(
    options: Any, store, sweep, unwritten: list[InputError], progress: bool, workers: Any = None
) -> dict[str, Any]:
    """Return the JSON entry of the subset simulation of rare failures; run it unless the store contains it.

    If the result cannot be written to the store, the error is added to `unwritten` instead of raised.
    """
    from tuning.sweeps.stored_studies import RareFailureRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import count_most_scenarios, estimate_rare_failure

    limit = float(options.rare or store.manifest.error_limit)
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
        running.checkpoints.remove()
    return _subset_simulation_entry(limit, estimate)


@contextmanager
def _study_runner(
    options: Any, store, total: int, unit: str, study: str, progress: bool, workers: Any
) -> Iterator[Any]:
    """Context manager: show the progress of a study, and provide the settings for running its scenarios."""
    from tuning.caches.checkpoints import CHECKPOINT_FOLDER, Checkpoints
    from tuning.sweeps.cluster_computers import BATCHES_PER_STUDY, build_point_computer
    from tuning.sweeps.point_batches import PointRunSettings

    with terminal.show_progress(total, unit, progress) as bar:
        bar.say(study)
        checkpoints = Checkpoints(store.folder / CHECKPOINT_FOLDER, options.resume)
        running = PointRunSettings(lambda more: bar.advance(more, study), bar.skip, checkpoints)
        if workers is not None:
            running = running._replace(computer=build_point_computer(workers), max_batches=BATCHES_PER_STUDY)
        yield running


@contextmanager
def collect_input_errors(unwritten: list[InputError]) -> Iterator[None]:
    """Context manager: catch an `InputError` of the `with` block, and add it to the list `unwritten`."""
    try:
        yield
    except InputError as error:
        unwritten.append(error)


def _subset_simulation_entry(limit: float, estimate) -> dict[str, Any]:
    """Return the JSON entry of a subset simulation: limit, probability with interval, and replicates."""
    from tuning.sweeps.studies import is_spread_beyond_formula

    names = ("probability", "low", "high", "coefficient_of_variation", "formula_coefficient_of_variation")
    return {
        "limit": limit,
        **{name: getattr(estimate, name) for name in (*names, "evaluations")},
        "estimates": estimate.estimates.tolist(),
        "spread_beyond_formula": is_spread_beyond_formula(estimate),
    }


def _report_stored(study: str, path: Path, progress: bool) -> None:
    """Print a note that a study was read from a file instead of computed, if `progress` is shown."""
    if progress:
        terminal.note(f"{study}: read from {to_one_line(str(path))}")
