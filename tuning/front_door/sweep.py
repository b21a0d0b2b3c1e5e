"""`tuning.sweep`: how probable is a failure, how close do the worst scenarios come to one?

The rows are the store's (`tuning.sweeps.store`), in a folder that stays, or in one that is gone when the
sweep is done. Beside them stands one document, which `jaxhil sweep --json` prints.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxhil.errors import InputError, one_line
from jaxhil.rig import digest
from jaxhil.simulation.environment import computing
from tuning import terminal
from tuning.front_door import arguments, meaning, sweep_studies
from tuning.front_door.arguments import ArgumentError
from tuning.front_door.options import takes
from tuning.front_door.sweep_options import SweepOptions

if TYPE_CHECKING:
    import pyarrow

    from tuning.caches.cluster import Workers
    from tuning.sweeps.manifest import Manifest
    from tuning.sweeps.store import Store


class Interval(NamedTuple):
    """Ends of an interval of 95 %."""

    low: float
    high: float


@dataclass(frozen=True)
class SweepStudy:
    """What `sweep` returns.

    document: all that is known, as `jaxhil sweep --json` prints it.
    manifest: everything that the rows follow from.
    folder: where the rows are kept; None if they are not.
    rows: those that are kept in no folder.
    unwritten: what could not be written beside the rows, and why.
    """

    document: dict[str, Any]
    manifest: "Manifest"
    folder: Path | None
    rows: "pyarrow.Table | None"
    unwritten: list[InputError] = field(default_factory=list)

    @cached_property
    def table(self) -> "pyarrow.Table":
        """The rows, one a scenario, as an Arrow table; units and meanings are its fields' metadata.

        Those in a folder are read when they are first asked for: there may be more than memory holds. Raises
        `InputError` where they are no longer there.
        """
        from tuning.sweeps.store import read_store

        if self.rows is not None:
            return self.rows
        assert self.folder is not None
        table = _table(read_store(self.folder))
        if table.num_rows != (there := self.document["scenarios"]):
            found = f"found {table.num_rows} scenarios, allowed the study's {there}"
            raise InputError(f"{one_line(str(self.folder))}: {found}")
        return table

    @property
    def failure_probability(self) -> float:
        """The share of scenarios that failed: an error beyond the limit, or a run that does not end well."""
        return self.document["failure_probability"]["value"]

    @property
    def interval(self) -> Interval:
        """In which the failure probability lies, with 95 % confidence."""
        known = self.document["failure_probability"]
        return Interval(known["low"], known["high"])

    @property
    def verdict(self) -> str:
        """ "good" if no scenario failed or, with an acceptable probability, if the interval ends below it,
        else "bad"."""
        return self.document["verdict"]

    @contextmanager
    def store(self) -> Iterator["Store"]:
        """The rows in a store: the folder's, or one that is there within the context alone."""
        from tuning.sweeps.parts import from_table
        from tuning.sweeps.store import open_store, read_store, write_part

        if self.folder is not None:
            yield read_store(self.folder)
            return
        with tempfile.TemporaryDirectory(prefix="jaxhil-sweep-") as temporary:
            store = open_store(Path(temporary), self.manifest, resume=False)
            for part in range(-(-self.table.num_rows // self.manifest.chunk)):
                rows = self.table.slice(part * self.manifest.chunk, self.manifest.chunk)
                write_part(store, part, from_table(self.manifest, rows))
            yield store


@arguments.entry
@takes(SweepOptions)
def sweep(
    gains: Any,
    *,
    folder: str | os.PathLike[str] | None = None,
    progress: bool = False,
    **options: Any,
) -> SweepStudy:
    """Monte Carlo robustness of a gain file: scenarios drawn from its mechanism's uncertainty and run.

    Scenario i depends on the seed and on i alone; its row is that of `jaxhil sweep`, to the bit.

    Args:
        gains: a gain file's path, or its folder's, or what `tuning.tune` returned.
        folder: where to keep the rows, with pictures; None keeps nothing.
        progress: say on standard error how far it is.
    OPTIONS

    Raises:
        InputError: one line, for an argument that will not do, or a folder that cannot be written.
    """
    asked = SweepOptions(**options)
    asked.check()
    arguments.flags(progress=progress)
    if folder is not None:
        target = arguments.folder("folder", folder)
        return run_study(gains, asked, target, progress)
    if asked.resume:
        raise ArgumentError("resume", "without a folder", "with the folder of a sweep")
    with tempfile.TemporaryDirectory(prefix="jaxhil-sweep-") as temporary:
        return run_study(gains, asked, Path(temporary), progress, keep=False)


def run_study(
    gains: Any, options: SweepOptions, folder: Path, progress: bool, keep: bool = True
) -> SweepStudy:
    """Compute what the store in the folder lacks; what is to `keep` gets pictures and the document too."""
    path = gains if hasattr(gains, "document") else arguments.readable_gain_file(gains)
    with computing(), _cluster(options.scheduler) as workers:
        from tuning.statistics.intervals import scenarios_needed
        from tuning.sweeps.cluster import parts_on
        from tuning.sweeps.manifest import Choices, build_manifest
        from tuning.sweeps.run import run_parts, run_sweep
        from tuning.sweeps.store import locked, open_store
        from tuning.sweeps.tally import failure_probability

        choices = Choices(**{name: getattr(options, name) for name in Choices._fields})
        loaded = arguments.gain_file(path, any_axes=True)
        asked = {"works": options.works, "precision": options.precision == "float32" and "float32"}
        arguments.not_in_six_axes(loaded.mechanism, **asked)
        meaning.check(loaded.mechanism)
        manifest = build_manifest(loaded, choices)
        with locked(folder):
            store = open_store(folder, manifest, options.resume)
            with terminal.progress(manifest.scenarios, "scenarios", progress) as bar:

                def so_far(tally) -> str:
                    known = failure_probability(tally)
                    text = f"failed {known.value:.3g} ({known.low:.2g} to {known.high:.2g})"
                    if options.until_width is None:
                        return text
                    needed = scenarios_needed(known.value, options.until_width)
                    return f"{text}, about {needed} wanted"

                bar.reach(0, "running scenarios")
                done, tally = run_sweep(
                    store,
                    lambda rows, _: bar.skip(rows),
                    lambda rows, tally: bar.advance(rows, so_far(tally)),
                    run_parts if workers is None else parts_on(workers),
                )
            document = _document(options, store, done, tally, bar.rate)
            if not keep:
                document["store"] = None
            unwritten = _complete(options, store, done, document, progress, keep, workers)
            if keep:
                return SweepStudy(document, manifest, folder, None, unwritten)
            return SweepStudy(document, manifest, None, _table(store), unwritten)


def _cluster(address: str | None) -> AbstractContextManager["Workers | None"]:
    """The workers of a cluster; None where everything is computed here."""
    from tuning.caches.cluster import connected

    return nullcontext() if address is None else connected(address)


def _complete(
    options: SweepOptions,
    store: "Store",
    done,
    document: dict[str, Any],
    progress: bool,
    keep: bool,
    workers: "Workers | None",
) -> list[InputError]:
    """Add what belongs beside the verdict, and keep all that is known in the store after every step.

    What could not be written is returned, to be reported after the verdict, which no full disk is to cost.
    """
    from tuning.sweeps.pictures import write_pictures
    from tuning.sweeps.run import compare_precisions
    from tuning.sweeps.store import write_verdict

    unwritten: list[InputError] = []

    def plots() -> list[str]:
        with sweep_studies.put_off(unwritten):
            return write_pictures(store, options.acceptable) if keep else []
        return []

    def write() -> None:
        document["sha256"] = digest(terminal.finite(document))
        with sweep_studies.put_off(unwritten):
            if keep:
                write_verdict(store, document)

    steps: dict[str, Callable[[], Any]] = {"plots": plots}
    if store.manifest.precision == "float32":
        steps["float32"] = lambda: compare_precisions(done)._asdict()
    if options.drivers is not None:
        steps["drivers"] = lambda: sweep_studies.drivers(options, store, done, unwritten, progress, workers)
    if options.rare is not None:
        steps["rare"] = lambda: sweep_studies.rare(options, store, done, unwritten, progress, workers)
    write()
    for key, step in steps.items():
        document[key] = step()
        write()
    return unwritten


def _document(options: SweepOptions, store: "Store", done, tally, rate: float | None) -> dict[str, Any]:
    from tuning.sweeps.run import describe_outcomes
    from tuning.sweeps.tally import error_quantiles, failure_probability

    manifest = store.manifest
    probability = failure_probability(tally)
    if options.acceptable is None:
        good = tally.failed == 0
    else:
        good = probability.high <= options.acceptable
    return {
        "store": str(store.folder),
        "sweep_sha256": manifest.sha256,
        "gains_sha256": manifest.gains_sha256,
        "mechanism": done.mechanism.name,
        "axes": done.model.axes,
        "compensator": done.model.compensator_name(done.loop),
        "scenarios": tally.scenarios,
        "most_scenarios": manifest.scenarios,
        **{key: getattr(manifest, key) for key in ("seed", "sampling", "precision", "limit", "until_width")},
        "failed": tally.failed,
        "failure_probability": probability._asdict(),
        "left_out_of_replicates": tally.left_out,
        "error_quantiles": [one._asdict() for one in error_quantiles(tally)],
        "outcomes": describe_outcomes(tally),
        "worst": [_scenario(store, done.mechanism, index) for _, _, index in tally.worst],
        "scenarios_per_second": rate,
        "acceptable": options.acceptable,
        "verdict": "good" if good else "bad",
    }


def _scenario(store: "Store", mechanism: Any, index: int) -> dict[str, Any]:
    """What is said of one scenario: how it ended, its worst contact, what was drawn."""
    from tuning.sweeps.columns import slots, texts_of
    from tuning.sweeps.store import read_row

    row = read_row(store, index)
    columns = store.manifest.columns
    numbers = {one.name: row[one.name][0].item() for one in columns if one.kind != "text"}
    errors = {slot: numbers[slot.error] for slot in slots(mechanism)}
    worst = numbers["worst_error"]
    return {
        "index": index,
        "outcome": texts_of("outcome")[int(row["outcome"][0])],
        "worst_error": worst,
        # None if no contact ended.
        "worst_contact": next((slot.number for slot, value in errors.items() if value == worst), None),
        "inputs": {one.name: numbers[one.name] for one in columns if one.kind == "input"},
    }


def _table(store: "Store") -> "pyarrow.Table":
    """All rows of the store, in the order of their indices."""
    import pyarrow

    from tuning.sweeps.parts import schema, to_table
    from tuning.sweeps.store import kept_part

    parts = (kept_part(store, part) for part in range(store.manifest.parts))
    tables = [to_table(store.manifest, rows) for rows in parts if rows is not None]
    return pyarrow.concat_tables(tables) if tables else schema(store.manifest).empty_table()
