"""Which tick's readings a row holds, told by the sensor's own noise.

A compensator acts on what the force sensor read, noise and all, and the numerical model on what the
compensator says: M (x(n+1) - 2 x(n) + x(n-1)) / T^2 = -F_c(n) has in it the noise of F(n), and of no later
reading. Rows that hold the next tick's command seem to know the noise of the row after them; rows with the
next tick's readings answer a row late. The first reading that the second differences of the commands depend
on is found by regression; differences of all of it leave little but noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.rows import integrator_of
from tuning.identification.logs.segments import resting, threshold
from tuning.identification.records import Run, Timing

AHEAD, BEHIND = 2, 6  # rows after and before a command whose readings are tried
SIGNIFICANT = 6.0  # standard deviations
LARGE = 0.3  # of the largest coefficient
SMALL = 0.12  # of the largest coefficient: a filter whose answer rises over more rows does not tell its first
ALTERNATES = (
    -0.4
)  # correlation of neighbours in differences of noise (-2/3 if white), above which they are none
FEWEST = 100  # rows
FAR = 8.0  # times the median residual, beyond which a row is left out
AGREE = 0.7  # of the runs that tell
NEAR = 50  # rows before and after a contact
ROUNDS = 6  # of leaving rows out
MOST_RUNS = 50  # looked at, of any number
MOST_DELAY = 4  # ticks
ROWS_AHEAD = {"sent": 1, "tick": 0, "after": -1}
EXPLICIT = "explicit_euler"  # moves the model by a reading a tick later than the others


def check_rows_of(runs: Sequence[Run], timing: Timing, integrator: str | None = None) -> None:
    """Contacts' rows are as `timing.row` says, as far as noise tells: a command answers the reading of its
    own tick, or of `timing.computing_delay` ticks before; under the explicit integrator of a tick more.
    Raises `InputError`."""
    found = rows_ahead(runs)
    usual = timing.computing_delay + (integrator == EXPLICIT)
    if found is None or found == ROWS_AHEAD[timing.row] - usual:
        return
    meant = [row for row, ahead in ROWS_AHEAD.items() if ahead - usual == found]
    late = ROWS_AHEAD[timing.row] - found - (integrator == EXPLICIT)
    allowed = [f'row = "{row}"' for row in meant] + [f"computing_delay = {late}"] * (0 < late <= MOST_DELAY)
    if late == 1 and integrator is None:
        allowed.append(f'velocity_desired, or a prior whose rig.integrator is "{EXPLICIT}"')
    place = "their own row" if found == 0 else f"{abs(found)} rows {'after' if found > 0 else 'before'} them"
    raise InputError(
        f'timing.row: found "{timing.row}", but commands answer the force reading of {place}, '
        f"allowed {' or '.join(allowed) or 'another row'}"
    )


def integrator_of_all(runs: Sequence[Run], period: float) -> str | None:
    """How the numerical model moves by its velocity, by most of the contacts that log it."""
    contacts = [run for run in runs if run.kind == "contact"][:MOST_RUNS]
    told = [integrator_of(run.position_desired, run.velocity_desired, period) for run in contacts]
    return max(set(told), key=told.count, default=None)


def rows_ahead(runs: Sequence[Run]) -> int | None:
    """By how many rows the last reading that a command depends on is after it; None where nothing tells,
    one run alone does, or runs by themselves tell otherwise."""
    contacts = [run for run in runs if run.kind == "contact"]
    contacts = contacts[:: -(-len(contacts) // MOST_RUNS) or 1]
    parts = [part for run in contacts for part in [_columns(run)] if part is not None]
    if not parts:
        return None
    found = _first(*(np.concatenate([part[place] for part in parts]) for place in (0, 1)))
    votes = [vote for part in parts for vote in [_first(*part)] if vote is not None]
    if found is None or len(votes) < 2 or votes.count(found) < AGREE * len(votes):
        return None
    return found


def _first(moved: np.ndarray, columns: np.ndarray) -> int | None:
    """The first of the readings, from that `AHEAD` rows after on, that commands depend on."""
    if len(moved) < FEWEST or _neighbours(columns) > ALTERNATES:
        return None
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    solution, error = np.zeros(columns.shape[1]), moved
    for _ in range(ROUNDS):
        # Onsets and limits are no part of a linear law: rows that are off by far are left out.
        kept = np.abs(error) <= FAR * np.median(np.abs(error))
        solution, _, rank, _ = np.linalg.lstsq(columns[kept], moved[kept], rcond=1e-10)
        if rank < columns.shape[1]:
            return None
        error = moved - columns @ solution
    free = np.count_nonzero(kept) - columns.shape[1]
    inverse = np.linalg.inv(columns[kept].T @ columns[kept])
    variance = float(error[kept] @ error[kept]) / free * np.diag(inverse)
    lags = slice(0, AHEAD + BEHIND + 1)
    size = np.abs(solution[lags])
    clear = (size > SIGNIFICANT * np.sqrt(variance[lags])) & (size > LARGE * np.max(size))
    first = int(np.argmax(clear))
    if not np.any(clear) or (first > 0 and size[first - 1] > SMALL * np.max(size)):
        return None
    return AHEAD - first


def _columns(run: Run) -> tuple[np.ndarray, np.ndarray] | None:
    """Second differences of the commands, and what they may depend on: readings about them, where the model
    is and how fast; all differenced twice more. Rows in contact and next to it alone: before and after that a
    rig may be driven by something else."""
    x, force = run.position_desired, run.force_measured
    assert force is not None
    if len(x) < AHEAD + BEHIND + FEWEST // 2:
        return None
    loud = np.abs(force - resting(force)) > threshold(force)
    touched = np.flatnonzero(loud[:-2] & loud[1:-1] & loud[2:])
    if not len(touched):
        return None
    second = x[2:] - 2 * x[1:-1] + x[:-2]
    first, last = touched[0] - NEAR, touched[-1] + 2 + NEAR
    rows = np.arange(max(BEHIND + 1, first), min(len(x) - AHEAD - 1, last))
    readings = [force[rows + ahead] for ahead in range(AHEAD, -BEHIND - 1, -1)]
    whole = np.stack([second[rows - 1], *readings, x[rows], x[rows] - x[rows - 1]], axis=1)
    whole = np.diff(whole, n=2, axis=0)
    # Where the model is not pulled it tells nothing; jumps, where a rig is driven back, tell something else.
    pulled = np.abs(second[rows - 1])
    usual = np.median(pulled[pulled > 0]) if np.any(pulled > 0) else 0.0
    good = (pulled > 0) & (pulled < 20 * usual) & run.valid[rows]
    good = good[2:] & good[1:-1] & good[:-2] & np.all(np.isfinite(whole), axis=1)
    return (whole[good, 0], whole[good, 1:]) if np.count_nonzero(good) > AHEAD + BEHIND + 5 else None


def _neighbours(columns: np.ndarray) -> float:
    """Correlation of each reading's difference with the next one's; 1 where there are none."""
    one, other = columns[:, AHEAD], columns[:, AHEAD + 1]
    size = float(np.sqrt(np.dot(one, one) * np.dot(other, other)))
    return float(np.dot(one, other)) / size if size else 1.0
