"""Function `tuning.report`, which builds an HTML page for a review board from results of other commands."""

import os
from collections.abc import Iterable
from dataclasses import dataclass

from jaxhil.files import report_write_errors, resolve_output_path, write_atomically
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments
from tuning.api.arguments import ArgumentError


@dataclass(frozen=True)
class Report:
    """Result of `report`: the page and its verdict.

    Attributes:
        html: HTML page, encoded as UTF-8.
        verdict: "good", "bad", or "unknown" if the results do not suffice for a verdict.
        requirements: for each requirement, the texts "what", "required", "result", "margin" and "verdict".
    """

    html: bytes
    verdict: str
    requirements: list[dict[str, str]]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page to a file; if this fails, an existing file remains unchanged.

        Raises:
            InputError: If the file cannot be written.
        """
        target = arguments.check_path("path", path)
        with report_write_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(resolve_output_path(target), self.html)


@arguments.convert_os_errors
def report(
    results: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], *, progress: bool = False
) -> Report:
    """Build an HTML page of results: verdict, requirements, assumptions, gains, runs, errors and commands.

    Args:
        results: paths of results of `identify`, `monitor`, `tune`, `sweep`, `compare`, `map` and `export`, at
            most one per command. A path is that of the folder with the result, or of the JSON file in this
            folder. For `monitor`, it is that of a file with the output of `jaxhil monitor --json`.
        progress: report the progress on standard error.

    Returns:
        The page with its verdict and requirements.

    Raises:
        InputError: If a path contains no result, if a result was changed after it was written, or if results
            belong to different mechanisms or gains; the message has one line.

    Example:
        >>> import tempfile
        >>> import tuning
        >>> tuned = tuning.tune("rig-300kg", "phase_lead", scenarios=4, starts=1, validation=4)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     tuned.save(f"{folder}/gains.json")
        ...     page = tuning.report(folder)
        >>> page.verdict  # the robustness of the gains is unknown without a sweep
        'unknown'
    """
    arguments.check_booleans(progress=progress)
    listed, _ = arguments.as_list(results, (str, os.PathLike))
    if not listed:
        raise ArgumentError("results", "none", "paths of results")
    paths = [arguments.check_path("results", path) for path in listed]
    with jax_context():
        from tuning.reporting.page import build_page
        from tuning.reporting.result_files import read_results
        from tuning.reporting.study_sections import count_plots
        from tuning.reporting.verdict_sections import collect_requirements, combine_verdicts

        loaded = read_results(paths)
        with terminal.show_progress(count_plots(loaded), "plots", progress) as bar:
            html = build_page(loaded, bar.turn_to)
        evaluated = collect_requirements(loaded)
        return Report(
            html, combine_verdicts(evaluated), [dict(vars(requirement)) for requirement in evaluated]
        )


__all__ = ["Report", "report"]
