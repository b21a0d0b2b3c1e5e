"""Check of the row convention: the tick whose readings a row holds, from the noise of the force sensor.

A compensator responds to the force reading including its noise, and the numerical model to the compensator: M
(x(n+1) - 2 x(n) + x(n-1)) / T^2 = -F_c(n) contains the noise of F(n) and of no later reading. If rows hold
the next tick's command, the commands seem to depend on the noise of the following row; if rows hold the next
tick's readings, the response seems one row late. A regression finds the latest reading on which the second
differences of the commands depend. Differencing all signals leaves little except noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.contact_detection import estimate_contact_threshold, estimate_resting_force
from tuning.identification.logs.lost_rows import detect_integrator
from tuning.identification.records import CampaignTiming, LoggedRun

ROWS_AFTER_COMMAND, ROWS_BEFORE_COMMAND = (
    2,
    6,
)  # rows after and before a command whose readings enter the regression
MIN_COEFFICIENT_SIGMAS = 6.0  # standard deviations of a significant coefficient
MIN_COEFFICIENT_SHARE = 0.3  # share of the largest coefficient, above which a coefficient counts
MAX_PRECEDING_SHARE = 0.12  # the same for the row before; above it a slow filter hides the first coefficient
# Correlation of neighbours in twice differenced noise (-2/3 if white), above which it is no noise.
MAX_NEIGHBOUR_CORRELATION = -0.4
MIN_REGRESSION_ROWS = 100  # rows that a regression needs
OUTLIER_RATIO = 8.0  # times the median residual, above which a row is excluded
MIN_AGREEING_SHARE = 0.7  # share of the conclusive runs that must agree
ROWS_BESIDE_CONTACT = 50  # rows before and after a contact that are included
OUTLIER_ITERATIONS = 6  # iterations of excluding rows
MAX_RUNS = 50  # runs that are evaluated
MAX_COMPUTING_DELAY = 4  # ticks, largest computing delay
ROW_SHIFT = {"sent": 1, "tick": 0, "after": -1}
EXPLICIT_INTEGRATOR = "explicit_euler"  # applies a reading one tick later than the other integrators


def check_row_convention(
    runs: Sequence[LoggedRun], timing: CampaignTiming, integrator: str | None = None
) -> None:
    """Check that the noise in the commands agrees with the row convention `timing.row`.

    A command depends on the reading of its tick, or of `timing.computing_delay` ticks earlier; with the
    explicit integrator, of one more tick.

    Raises:
        InputError: If the noise shows another convention.
    """
    last = detect_reading_offset(runs)
    usual = timing.computing_delay + (integrator == EXPLICIT_INTEGRATOR)
    if last is None or last == ROW_SHIFT[timing.row] - usual:
        return
    meant = [row for row, ahead in ROW_SHIFT.items() if ahead - usual == last]
    late = ROW_SHIFT[timing.row] - last - (integrator == EXPLICIT_INTEGRATOR)
    allowed = [f'row = "{row}"' for row in meant] + [f"computing_delay = {late}"] * (
        0 < late <= MAX_COMPUTING_DELAY
    )
    if late == 1 and integrator is None:
        allowed.append(f'velocity_desired, or a prior whose rig.integrator is "{EXPLICIT_INTEGRATOR}"')
    row_text = "their own row" if last == 0 else f"{abs(last)} rows {'after' if last > 0 else 'before'} them"
    raise InputError(
        f'timing.row: found "{timing.row}", but commands answer the force reading of {row_text}, '
        f"expected {' or '.join(allowed) or 'another row'}"
    )


def detect_common_integrator(runs: Sequence[LoggedRun], period: float) -> str | None:
    """Return the numerical model's integrator according to most of the contacts with a logged velocity."""
    contacts = [run for run in runs if run.kind == "contact"][:MAX_RUNS]
    integrators = [detect_integrator(run.position_desired, run.velocity_desired, period) for run in contacts]
    return max(set(integrators), key=integrators.count, default=None)


def detect_reading_offset(runs: Sequence[LoggedRun]) -> int | None:
    """Return the number of rows by which the last reading that affects a command follows it.

    Returns None if the noise is not conclusive, if only one run is conclusive, or if the runs disagree.
    """
    contacts = [run for run in runs if run.kind == "contact"]
    contacts = contacts[:: -(-len(contacts) // MAX_RUNS) or 1]
    parts = [part for run in contacts for part in [_make_regression_columns(run)] if part is not None]
    if not parts:
        return None
    first = _find_latest_reading(*(np.concatenate([part[index] for part in parts]) for index in (0, 1)))
    votes = [vote for part in parts for vote in [_find_latest_reading(*part)] if vote is not None]
    if first is None or len(votes) < 2 or votes.count(first) < MIN_AGREEING_SHARE * len(votes):
        return None
    return first


def _find_latest_reading(moved: np.ndarray, columns: np.ndarray) -> int | None:
    """Return the row offset of the latest reading that affects the commands, or None.

    The columns begin with the reading `ROWS_AFTER_COMMAND` rows after the command.
    """
    if len(moved) < MIN_REGRESSION_ROWS or _correlate_neighbours(columns) > MAX_NEIGHBOUR_CORRELATION:
        return None
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    solution, error = np.zeros(columns.shape[1]), moved
    for _ in range(OUTLIER_ITERATIONS):
        # Exclude rows with large residuals: onsets and limits are not linear.
        used = np.abs(error) <= OUTLIER_RATIO * np.median(np.abs(error))
        solution, _, rank, _ = np.linalg.lstsq(columns[used], moved[used], rcond=1e-10)
        if rank < columns.shape[1]:
            return None
        error = moved - columns @ solution
    free = np.count_nonzero(used) - columns.shape[1]
    inverse = np.linalg.inv(columns[used].T @ columns[used])
    variance = float(error[used] @ error[used]) / free * np.diag(inverse)
    lags = slice(0, ROWS_AFTER_COMMAND + ROWS_BEFORE_COMMAND + 1)
    size = np.abs(solution[lags])
    clear = (size > MIN_COEFFICIENT_SIGMAS * np.sqrt(variance[lags])) & (
        size > MIN_COEFFICIENT_SHARE * np.max(size)
    )
    first = int(np.argmax(clear))
    if not np.any(clear) or (first > 0 and size[first - 1] > MAX_PRECEDING_SHARE * np.max(size)):
        return None
    return ROWS_AFTER_COMMAND - first


def _make_regression_columns(run: LoggedRun) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the second differences of the commands and the regressors, all differenced twice.

    Regressors are the neighbouring readings and the model's position and velocity. Only rows in and near
    contact are included, because elsewhere another source may drive the rig.
    """
    x, force = run.position_desired, run.force_measured
    assert force is not None
    if len(x) < ROWS_AFTER_COMMAND + ROWS_BEFORE_COMMAND + MIN_REGRESSION_ROWS // 2:
        return None
    loud = np.abs(force - estimate_resting_force(force)) > estimate_contact_threshold(force)
    touched = np.flatnonzero(loud[:-2] & loud[1:-1] & loud[2:])
    if not len(touched):
        return None
    second = x[2:] - 2 * x[1:-1] + x[:-2]
    first, last = touched[0] - ROWS_BESIDE_CONTACT, touched[-1] + 2 + ROWS_BESIDE_CONTACT
    rows = np.arange(max(ROWS_BEFORE_COMMAND + 1, first), min(len(x) - ROWS_AFTER_COMMAND - 1, last))
    readings = [force[rows + ahead] for ahead in range(ROWS_AFTER_COMMAND, -ROWS_BEFORE_COMMAND - 1, -1)]
    table = np.stack([second[rows - 1], *readings, x[rows], x[rows] - x[rows - 1]], axis=1)
    table = np.diff(table, n=2, axis=0)
    # Rows without acceleration carry no information, and jumps come from a reset of the rig.
    pulled = np.abs(second[rows - 1])
    usual = np.median(pulled[pulled > 0]) if np.any(pulled > 0) else 0.0
    good = (pulled > 0) & (pulled < 20 * usual) & run.valid[rows]
    good = good[2:] & good[1:-1] & good[:-2] & np.all(np.isfinite(table), axis=1)
    return (
        (table[good, 0], table[good, 1:])
        if np.count_nonzero(good) > ROWS_AFTER_COMMAND + ROWS_BEFORE_COMMAND + 5
        else None
    )


def _correlate_neighbours(columns: np.ndarray) -> float:
    """Return the correlation of each reading's difference with the next one's; 1 if it is undefined."""
    reading, next_reading = columns[:, ROWS_AFTER_COMMAND], columns[:, ROWS_AFTER_COMMAND + 1]
    size = float(np.sqrt(np.dot(reading, reading) * np.dot(next_reading, next_reading)))
    return float(np.dot(reading, next_reading)) / size if size else 1.0
