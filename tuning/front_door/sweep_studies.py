"""The studies that `tuning.sweep` runs beside its sweep, or finds in the store where it resumes."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxhil.errors import InputError, one_line
from tuning import terminal


def drivers(options: Any, store, sweep, unwritten: list[InputError], progress: bool) -> dict[str, Any]:
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
    with terminal.progress(total, "scenarios", progress) as bar:
        bar.say("drivers")
        found = error_indices(sweep, number, lambda more: bar.advance(more, "drivers"))
    with put_off(unwritten):
        write_study(store, request, found)
    return found._asdict()


def rare(options: Any, store, sweep, unwritten: list[InputError], progress: bool) -> dict[str, Any]:
    """What of the document says how probable an error beyond a limit is. `unwritten`: see `put_off`."""
    from tuning.sweeps.stored_studies import RareRequest, read_study, study_path, write_study
    from tuning.sweeps.studies import most_scenarios, rare_failure

    limit = float(options.rare or options.limit)
    request = RareRequest(limit)
    found = read_study(store, request) if options.resume else None
    if found is not None:
        _say_kept("subset simulation", study_path(store, request), progress)
        return _rare_document(limit, found)
    with terminal.progress(most_scenarios(), "scenarios at most", progress) as bar:
        bar.say("subset simulation")
        found = rare_failure(sweep, limit, lambda more: bar.advance(more))
    with put_off(unwritten):
        write_study(store, request, found)
    return _rare_document(limit, found)


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
