"""New scenarios replayed through the C controller, with all guards and the exported limits.

Scenarios of a seed that calibration does not use are recorded and passed to the compiled controller tick by
tick with its clock. A run is bad if the restitution error of a contact exceeds the limit, or if a contact
does not end. A bad run is missed unless the controller trips before the tick on which the next contact begins
(for the last contact: before the next run is announced). A run is good if no error exceeds half the limit.
Any fault in a good run is a false alarm, except `law_in_doubt`, which reports the compensator's status.
"""

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from c99_cases import (
    NEXT_CONTACT,
    RESULT,
    ROW,
    Batch,
    assert_same,
    compiled,
    controller_in_python,
    packed,
    write_sources,
)

from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import digest
from jaxhil.rig.faults import CONTACT_TOO_LONG, ENERGY_BALANCE, LAW_IN_DOUBT, RESTITUTION, fault_names
from jaxhil.rig.gain_file import GainFile, check_gain_document
from jaxhil.simulation.gain_file import LoadedGains, check_document
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.metrics import OK
from tuning.bundle.bundle import build_limits_section
from tuning.gain_file import build_document
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.calibration import DEFAULT_DRAWS, calibrate
from tuning.watchdog.recording import RecordedRuns, ScenarioSelection, record_selection

FRESH = 20_000  # seed of new scenarios; limits are calibrated on draws of seed 0
SEEN, CAUSE, TRIPPED = (RESULT.index(name) for name in ("seen", "cause", "tripped"))


class Exported(NamedTuple):
    """Controller with the limits for a restitution error: compiled C code and gain file."""

    name: str
    limit: float
    batch: Batch
    parameters: np.ndarray
    gain_file: GainFile


class Record(NamedTuple):
    """Controller inputs of one lane and the errors of its contacts.

    `rows` are the inputs row by row. Restitution errors are NaN for a contact that did not end. `begins` are
    the rows on which contacts begin.
    """

    rows: np.ndarray
    error: np.ndarray
    begins: np.ndarray


class Verdict(NamedTuple):
    """Trip and faults of the controller in one lane.

    Row on which the controller tripped, or None; first row with a fault; bits of the faults that tripped, and
    of all raised faults.
    """

    row: int | None
    faulty: int | None
    cause: int
    seen: int


WATCHDOG = RESTITUTION | ENERGY_BALANCE | CONTACT_TOO_LONG


class Counts:
    """Numbers of good and bad runs, and the wrong decisions: (lane, row, names of faults).

    `guarded` bad runs were stopped by another guard before the watchdog.
    """

    def __init__(self) -> None:
        self.lanes = self.good = self.bad = self.between = self.between_stopped = 0
        self.missed: list[tuple[int, int, str]] = []
        self.false: list[tuple[int, int, str]] = []
        self.causes: Counter[str] = Counter()
        self.early = self.guarded = 0

    def add(self, record: Record, verdict: Verdict, limit: float) -> None:
        lane, error = self.lanes, np.abs(record.error)
        self.lanes += 1
        beyond = ~(error <= limit)
        if beyond.any():
            self.bad += 1
            first = int(np.argmax(beyond))
            assert first < len(record.begins), "a contact that was judged but not made"
            due = record.begins[first + 1] if first + 1 < len(record.begins) else len(record.rows)
            if verdict.row is None or verdict.row >= due:
                self.missed.append((lane, -1 if verdict.row is None else verdict.row, _text(verdict.seen)))
            else:
                self.early += verdict.row < record.begins[first]
                self.guarded += not verdict.cause & WATCHDOG
                self.causes[_text(verdict.cause)] += 1
        elif np.all(error <= 0.5 * limit):
            self.good += 1
            if verdict.seen & ~LAW_IN_DOUBT or verdict.row is not None:
                row = verdict.faulty if verdict.faulty is not None else verdict.row
                self.false.append((lane, -1 if row is None else row, _text(verdict.seen)))
        else:
            self.between += 1
            self.between_stopped += verdict.row is not None

    def __str__(self) -> str:
        lines = [
            f"  bad {self.bad}, missed {_share(len(self.missed), self.bad)}; stopped by {dict(self.causes)}",
            f"  bad and not stopped before the first bad contact {self.bad - self.early}, "
            f"missed {_share(len(self.missed), self.bad - self.early)}",
            f"  good {self.good}, false alarms {_share(len(self.false), self.good)}",
            f"  between {self.between}, stopped {self.between_stopped}",
            *(f"  missed: lane {lane}, row {row}, {text}" for lane, row, text in self.missed[:10]),
            *(f"  false alarm: lane {lane}, row {row}, {text}" for lane, row, text in self.false[:10]),
        ]
        return "\n".join(lines)


def _text(bits: int) -> str:
    return ", ".join(fault_names(bits)) or "nothing"


def _share(count: int, number: int) -> str:
    _, low, high = binomial_interval(count, number)
    return f"{count} ({low:.2g} to {high:.2g})"


def gains(parsed: Mechanism, values: dict[str, float], compensator: str = "response_error") -> LoadedGains:
    return check_document(build_document(compensator, values, parsed, "0" * 64, {}, {}, 0, {}))


def export(
    loaded: LoadedGains, limit: float, folder: Path, scenarios: int = DEFAULT_DRAWS, lanes: int = 1024
) -> tuple[Exported, dict[str, Any]]:
    """Return the compiled gains with limits calibrated on `scenarios` draws, and the stated alarm rates."""
    limits, rates = calibrate(loaded, scenarios=scenarios, limit=limit, lanes=lanes)
    document = {**loaded.document, "limits": build_limits_section(limits)}
    document["sha256"] = digest(document)
    gain_file = check_gain_document(document)
    sources = write_sources(folder / f"{limit}-{scenarios}", document)
    library = compiled(sources, "c99_driver.c", "driver.so", "-O2", "-shared", "-fPIC")
    batch = Batch(library, gain_file.compensator)
    parameters = batch.exported()
    assert parameters.tolist() == packed(gain_file.compensator, gain_file).tolist()
    return Exported(f"limit {limit}, calibrated on {scenarios}", limit, batch, parameters, gain_file), rates


def records(chunk: RecordedRuns, parsed: Mechanism):
    """Yield a `Record` for every lane of a chunk."""
    signals, period = chunk.signals, parsed.rig.control_period
    lengths = signals.live.sum(axis=0)
    assert all(signals.live[:length, lane].all() for lane, length in enumerate(lengths))
    ticks, lanes = signals.force.shape
    time = np.broadcast_to(period * np.arange(ticks)[:, None], (ticks, lanes))
    mass = np.broadcast_to(chunk.scenarios.equivalent_mass, (lanes,))
    planes = np.broadcast_to(chunk.scenarios.contact_plane, (lanes,))
    acceleration = -signals.command / mass
    motion = (jnp.asarray(leaf) for leaf in (signals.position, signals.velocity, acceleration))
    moved = INTEGRATORS[parsed.rig.integrator](*motion, jnp.asarray(period))
    columns = (
        *(np.where(signals.begins, NEXT_CONTACT, 0.0), signals.force, signals.position, signals.velocity),
        *(signals.measured, time, np.ones_like(time), *map(np.asarray, moved), acceleration),
    )
    for lane, length in enumerate(lengths):
        rows = np.empty((length + 1, len(ROW)))
        for place, column in enumerate(columns):
            rows[:-1, place] = column[:length, lane]
        # A further run is announced, which audits the last contact, and begins as the first run did.
        rows[-1] = rows[0]
        rows[-1, 5] = length * period
        rows[0, 0] = 0.0
        begins = _contact_rows(rows, parsed.contact.clearance, planes[lane])
        yield Record(rows, chunk.contacts.error[:, lane], begins)


def _contact_rows(rows: np.ndarray, clearance: float, plane: float) -> np.ndarray:
    """Return the rows on which contacts begin.

    In each run, a contact begins on the first row beyond a surface, by the model's or the measured position,
    and then on the first row beyond the other surface. The hardware's surfaces lie `plane` deeper.
    """
    position, measured = rows[:-1, 2], rows[:-1, 4]
    near = (position > min(plane, 0.0)) | (measured > plane)
    far = (position < -clearance) | (measured < plane - clearance)
    run = np.cumsum(rows[:-1, 0] == NEXT_CONTACT)
    touching = np.flatnonzero(near | far)
    place = 2 * run[touching] + far[touching]
    return touching[np.diff(place, prepend=-1) != 0]


def verdict_of(results: np.ndarray) -> Verdict:
    """Return the verdict of either controller from the results of a lane."""
    tripped, faulty = (np.flatnonzero(results[:, column]) for column in (TRIPPED, SEEN))
    return Verdict(
        int(tripped[0]) if len(tripped) else None,
        int(faulty[0]) if len(faulty) else None,
        *(int(results[-1, column]) for column in (CAUSE, SEEN)),
    )


def counted(
    loaded: LoadedGains, exported: list[Exported], number: int, lanes: int, in_python: int
) -> list[Counts]:
    """Count the decisions of each controller on new scenarios; check some lanes in Python."""
    counts = [Counts() for _ in exported]
    for chunk in record_selection(loaded, ScenarioSelection("random", FRESH, number), lanes):
        assert np.all(np.isfinite(chunk.contacts.error) == (chunk.contacts.status == OK))
        for lane, record in enumerate(records(chunk, loaded.mechanism)):
            for one, count in zip(exported, counts, strict=True):
                # Each lane uses a new controller, as if the rig's program had just started.
                assert one.batch.begin(one.parameters)
                results = one.batch.run(record.rows, guarded=True)
                count.add(record, verdict_of(results), one.limit)
                if chunk.first + lane < in_python:
                    with np.errstate(all="ignore"):
                        other = controller_in_python(one.gain_file, record.rows)
                    assert_same(results, other, record.rows)
                    assert verdict_of(other) == verdict_of(results)
    return counts
