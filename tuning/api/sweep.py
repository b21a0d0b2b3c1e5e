"""Function `tuning.sweep`, which estimates the probability of failure and finds the worst scenarios.

A row contains the inputs and the outcome of one scenario. The rows are written to a store
(`tuning.sweeps.store`) in a permanent or temporary folder. All other results are in one JSON document, which
`jaxhil sweep --json` prints.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxhil.errors import InputError, to_one_line
from jaxhil.rig import digest
from jaxhil.simulation.jax_environment import jax_context
from tuning import terminal
from tuning.api import arguments, mechanism_summary, sweep_studies
from tuning.api.arguments import ArgumentError
from tuning.api.options import add_options
from tuning.api.sweep_options import SweepOptions

SCHEMA = "jaxhil/sweep-result/1"

if TYPE_CHECKING:
    import pyarrow

    from tuning.caches.cluster import ClusterWorkers
    from tuning.sweeps.manifest import Manifest
    from tuning.sweeps.store import SweepStore


class ConfidenceInterval(NamedTuple):
    """95 % confidence interval of a probability.

    Attributes:
        low: lower end [1].
        high: upper end [1].
    """

    low: float
    high: float


@dataclass(frozen=True)
class SweepStudy:
    """Result of `sweep`.

    Attributes:
        document: all results, as `jaxhil sweep --json` prints them.
        manifest: all inputs that determine the rows (`tuning.sweeps.manifest.Manifest`).
        folder: folder with the rows; None if the rows are only in memory.
        rows: rows in memory, one per scenario; None if the rows are in a folder.
        unwritten: errors for files that could not be written (other than the rows).
    """

    document: dict[str, Any]
    manifest: "Manifest"
    folder: Path | None
    rows: "pyarrow.Table | None"
    unwritten: list[InputError] = field(default_factory=list)

    @cached_property
    def table(self) -> "pyarrow.Table":
        """Return the rows, one per scenario, as an Arrow table whose field metadata state unit and meaning.

        Rows in a folder are read when this property is first used, because they may exceed the memory. Raise
        `InputError` if the rows no longer exist.
        """
        from tuning.sweeps.store import read_store

        if self.rows is not None:
            return self.rows
        assert self.folder is not None
        table = _read_table(read_store(self.folder))
        if table.num_rows != (scenarios := self.document["scenarios"]):
            problem = f"found {table.num_rows} scenarios, expected {scenarios}, as when the sweep ended"
            raise InputError(f"{to_one_line(str(self.folder))}: {problem}")
        return table

    @property
    def failure_probability(self) -> float:
        """Return the estimated probability [1] that a scenario fails.

        A scenario fails if an error exceeds the limit, if a contact does not end, or if a real contact is
        much harder, shorter or longer than the ideal contact.
        """
        return self.document["failure_probability"]["value"]

    @property
    def interval(self) -> ConfidenceInterval:
        """Return the 95 % confidence interval of the failure probability."""
        probability = self.document["failure_probability"]
        return ConfidenceInterval(probability["low"], probability["high"])

    @property
    def verdict(self) -> str:
        """Return the verdict, "good" or "bad".

        The verdict is "good" if no scenario failed. If an acceptable failure probability is given, the
        verdict is "good" if the upper end of the confidence interval is at most this probability.
        """
        return self.document["verdict"]

    @contextmanager
    def store(self) -> Iterator["SweepStore"]:
        """Open the store with the rows; write rows that are in memory to a temporary store first."""
        from tuning.sweeps.chunk_file import from_table
        from tuning.sweeps.store import open_store, read_store, write_chunk

        if self.folder is not None:
            yield read_store(self.folder)
            return
        with tempfile.TemporaryDirectory(prefix="jaxhil-sweep-") as temporary:
            store = open_store(Path(temporary), self.manifest, resume=False)
            for part in range(-(-self.table.num_rows // self.manifest.chunk)):
                rows = self.table.slice(part * self.manifest.chunk, self.manifest.chunk)
                write_chunk(store, part, from_table(self.manifest, rows))
            yield store


@arguments.convert_os_errors
@add_options(SweepOptions)
def sweep(
    gains: Any,
    *,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = False,
    **options: Any,
) -> SweepStudy:
    """Estimate the failure probability of gains on scenarios drawn from the mechanism's uncertainty.

    Scenario i depends only on the seed and on i. The results of a scenario equal those of `jaxhil sweep` to
    the last bit.

    Args:
        gains: path of a gain file or of its folder, or a result of `tuning.tune`.
        folder: folder for the scenarios' results and for plots; None keeps the results in memory.
        progress: report the progress on standard error.
        **options: see `SweepOptions`.

    Returns:
        The failure probability with its confidence interval, the verdict, and the results of all scenarios.

    Raises:
        InputError: If an argument is unusable, or the folder cannot be written; the message has one line.

    Example:
        >>> import tuning
        >>> tuned = tuning.tune("rig-300kg", "phase_lead", scenarios=4, starts=1, validation=4)
        >>> tuning.sweep(tuned, scenarios=64).verdict
        'bad'
    """
    settings = SweepOptions(**options)
    settings.check()
    arguments.check_booleans(progress=progress)
    if folder is not None:
        target = arguments.check_path("folder", folder)
        return run_study(gains, settings, target, progress)
    if settings.resume:
        raise ArgumentError("resume", "no folder", "the folder of an interrupted sweep")
    with tempfile.TemporaryDirectory(prefix="jaxhil-sweep-") as temporary:
        return run_study(gains, settings, Path(temporary), progress, keep=False)


def run_study(
    gains: Any, options: SweepOptions, folder: Path, progress: bool, keep: bool = True
) -> SweepStudy:
    """Compute the scenarios whose results are missing in `folder`, and the requested additional studies.

    If `keep` is true, also write plots and the JSON document to the folder. If not, return the rows of all
    scenarios in the result.
    """
    path = gains if hasattr(gains, "document") else arguments.find_gain_file(gains)
    with jax_context(), _connect_workers(options.scheduler) as workers:
        from tuning.statistics.intervals import estimate_sequence_scenarios
        from tuning.sweeps.cluster_computers import build_chunk_computer
        from tuning.sweeps.manifest import ManifestOptions, build_manifest
        from tuning.sweeps.run_sweep import run_chunks, run_sweep
        from tuning.sweeps.store import lock_store, open_store
        from tuning.sweeps.tally import estimate_failure_probability

        loaded = arguments.load_gains(path, any_axes=True)
        options = options.with_limit(loaded.mechanism)
        choices = ManifestOptions(**{name: getattr(options, name) for name in ManifestOptions._fields})
        unsupported = {"works": options.works, "precision": options.precision == "float32" and "float32"}
        arguments.check_one_axis_arguments(loaded.mechanism, **unsupported)
        mechanism_summary.check_can_be_simulated(loaded.mechanism)
        manifest = build_manifest(loaded, choices)
        with lock_store(folder):
            store = open_store(folder, manifest, options.resume)
            with terminal.show_progress(manifest.scenarios, "scenarios", progress) as bar:

                def so_far(tally) -> str:
                    probability = estimate_failure_probability(tally)
                    text = f"failed {probability.value:.3g} ({probability.low:.2g} to {probability.high:.2g})"
                    if options.until_width is None:
                        return text
                    needed = estimate_sequence_scenarios(probability.value, options.until_width)
                    return f"{text}, about {needed} needed"

                bar.reach(0, "running scenarios")
                finished_sweep, tally = run_sweep(
                    store,
                    lambda rows, _: bar.skip(rows),
                    lambda rows, tally: bar.advance(rows, so_far(tally)),
                    run_chunks if workers is None else build_chunk_computer(workers),
                )
            document = _build_document(options, store, finished_sweep, tally, bar.rate)
            if not keep:
                document["store"] = None
            unwritten = _add_studies(options, store, finished_sweep, document, progress, keep, workers)
            if keep:
                return SweepStudy(document, manifest, folder, None, unwritten)
            return SweepStudy(document, manifest, None, _read_table(store), unwritten)


def _connect_workers(address: str | None) -> AbstractContextManager["ClusterWorkers | None"]:
    """Provide a connection to the workers of a cluster, or None if no address is given."""
    from tuning.caches.cluster import connect_workers

    return nullcontext() if address is None else connect_workers(address)


def _add_studies(
    options: SweepOptions,
    store: "SweepStore",
    finished_sweep,
    document: dict[str, Any],
    progress: bool,
    keep: bool,
    workers: "ClusterWorkers | None",
) -> list[InputError]:
    """Add plots and additional studies to the JSON document of a sweep.

    If `keep`, also write the plots and, after each addition, the document to the folder. Return the errors
    of files that could not be written. They are not raised: a full disk must not lose the results.
    """
    from tuning.plots.sweep import write_plots
    from tuning.sweeps.run_sweep import compare_precisions
    from tuning.sweeps.store import write_verdict

    unwritten: list[InputError] = []

    def plots() -> list[str]:
        with sweep_studies.collect_input_errors(unwritten):
            return write_plots(store, options.acceptable) if keep else []
        return []

    def write() -> None:
        document["sha256"] = digest(terminal.to_json_data(document))
        with sweep_studies.collect_input_errors(unwritten):
            if keep:
                write_verdict(store, document)

    steps: dict[str, Callable[[], Any]] = {"plots": plots}
    if store.manifest.precision == "float32":
        steps["float32"] = lambda: compare_precisions(finished_sweep)._asdict()
    if options.drivers is not None:
        steps["drivers"] = lambda: sweep_studies.compute_sobol_indices(
            options, store, finished_sweep, unwritten, progress, workers
        )
    if options.rare is not None:
        steps["rare"] = lambda: sweep_studies.run_subset_simulation(
            options, store, finished_sweep, unwritten, progress, workers
        )
    write()
    for key, step in steps.items():
        document[key] = step()
        write()
    return unwritten


def _build_document(
    options: SweepOptions, store: "SweepStore", finished_sweep, tally, rate: float | None
) -> dict[str, Any]:
    from tuning.sweeps.run_sweep import count_outcomes
    from tuning.sweeps.tally import estimate_error_quantiles, estimate_failure_probability

    manifest = store.manifest
    probability = estimate_failure_probability(tally)
    if options.acceptable is None:
        good = tally.failed == 0
    else:
        good = probability.high <= options.acceptable
    return {
        "schema": SCHEMA,
        "store": str(store.folder),
        "sweep_sha256": manifest.sha256,
        "gains_sha256": manifest.gains_sha256,
        "mechanism": finished_sweep.mechanism.name,
        "axes": finished_sweep.model.axes,
        "compensator": finished_sweep.model.compensator_name(finished_sweep.loop),
        "scenarios": tally.scenarios,
        "most_scenarios": manifest.scenarios,
        **{key: getattr(manifest, key) for key in ("seed", "sampling", "precision", "limit", "until_width")},
        "failed": tally.failed,
        "failure_probability": probability._asdict(),
        "left_out_of_replicates": tally.left_out,
        "error_quantiles": [quantile._asdict() for quantile in estimate_error_quantiles(tally)],
        "outcomes": count_outcomes(tally),
        "worst": [_scenario_entry(store, finished_sweep.mechanism, index) for _, _, index in tally.worst],
        "scenarios_per_second": rate,
        "acceptable": options.acceptable,
        "verdict": "good" if good else "bad",
    }


def _scenario_entry(store: "SweepStore", mechanism: Any, index: int) -> dict[str, Any]:
    """Return the JSON entry of one scenario: outcome, inputs, and the worst error with its contact."""
    from tuning.sweeps.columns import list_allowed_texts, list_contact_columns
    from tuning.sweeps.store import read_row

    row = read_row(store, index)
    columns = store.manifest.columns
    numbers = {column.name: row[column.name][0].item() for column in columns if column.kind != "text"}
    errors = {slot: numbers[slot.error] for slot in list_contact_columns(mechanism)}
    worst = numbers["worst_error"]
    return {
        "index": index,
        "outcome": list_allowed_texts("outcome")[int(row["outcome"][0])],
        "worst_error": worst,
        # The number is None if no contact ended.
        "worst_contact": next((slot.number for slot, value in errors.items() if value == worst), None),
        "inputs": {column.name: numbers[column.name] for column in columns if column.kind == "input"},
    }


def _read_table(store: "SweepStore") -> "pyarrow.Table":
    """Return all rows in the store as an Arrow table, sorted by scenario index."""
    import pyarrow

    from tuning.sweeps.chunk_file import build_arrow_schema, to_table
    from tuning.sweeps.store import read_intact_chunk

    parts = (read_intact_chunk(store, part) for part in range(store.manifest.parts))
    tables = [to_table(store.manifest, rows) for rows in parts if rows is not None]
    return pyarrow.concat_tables(tables) if tables else build_arrow_schema(store.manifest).empty_table()
