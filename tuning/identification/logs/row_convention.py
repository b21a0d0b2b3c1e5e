"""Check of the row convention (ticks of a row's command and readings) by means of the force sensor's noise.

The force command depends on the force reading, including its noise, and moves the numerical model:

    M (x(n+1) - 2 x(n) + x(n-1)) / T^2 = -F_c(n).

The right-hand side depends on the noise of the reading F(n), but not on that of later readings. If a row
contains the next tick's command, the commands seem to depend on the noise of the following row. If a row
contains the next tick's readings, the response seems to be one row late. A regression finds the latest
reading on which the commands depend. Before the regression, all signals are differenced twice, so that mainly
noise remains.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.contact_detection import estimate_contact_threshold, estimate_resting_force
from tuning.identification.logs.lost_rows import detect_integrator
from tuning.identification.records import CampaignTiming, LoggedRun

# Numbers of rows after and before a command whose force readings are regressors of this command.
ROWS_AFTER_COMMAND, ROWS_BEFORE_COMMAND = 2, 6
MIN_COEFFICIENT_SIGMAS = 6.0  # minimum size of a significant coefficient in standard deviations
MIN_COEFFICIENT_SHARE = 0.3  # minimum size of a significant coefficient as a share of the largest coefficient
# Maximum size of the coefficient before the first significant one, as a share of the largest coefficient. If
# it is larger, a slow filter hides the latest reading.
MAX_PRECEDING_SHARE = 0.12
# Maximum correlation of successive second differences of readings that noise dominates (white noise: -2/3).
MAX_NEIGHBOUR_CORRELATION = -0.4
MIN_REGRESSION_ROWS = 100  # minimum number of rows for a regression
OUTLIER_RATIO = 8.0  # maximum ratio of a residual to the median residual; other rows are excluded
MIN_AGREEING_SHARE = 0.7  # minimum share of the conclusive runs that must agree
ROWS_BESIDE_CONTACT = 50  # number of rows before and after a contact that are included
OUTLIER_ITERATIONS = 6  # maximum number of iterations that exclude rows
MAX_RUNS = 50  # maximum number of evaluated runs
MAX_COMPUTING_DELAY = 4  # longest computing delay [ticks]
# Number of ticks by which the readings of a row are older than its command.
ROW_SHIFT = {"sent": 1, "tick": 0, "after": -1}
EXPLICIT_INTEGRATOR = "explicit_euler"  # integrator that responds to a reading one tick later than the others


def check_row_convention(
    runs: Sequence[LoggedRun], timing: CampaignTiming, integrator: str | None = None
) -> None:
    """Check the row convention `timing.row` by means of the sensor noise in the commands.

    A command depends on the force reading `timing.computing_delay` ticks earlier (0: same tick). With the
    explicit Euler integrator, the reading is one tick older.

    Args:
        runs: Runs of the campaign.
        timing: Timing of commands and readings.
        integrator: Integrator of the numerical model, or None if it is unknown.

    Raises:
        InputError: If the noise indicates another row convention.
    """
    offset = detect_reading_offset(runs)
    delay = timing.computing_delay + (integrator == EXPLICIT_INTEGRATOR)
    if offset is None or offset == ROW_SHIFT[timing.row] - delay:
        return
    rows = [row for row, shift in ROW_SHIFT.items() if shift - delay == offset]
    computing_delay = ROW_SHIFT[timing.row] - offset - (integrator == EXPLICIT_INTEGRATOR)
    expected = [f'row = "{row}"' for row in rows] + [f"computing_delay = {computing_delay}"] * (
        0 < computing_delay <= MAX_COMPUTING_DELAY
    )
    if computing_delay == 1 and integrator is None:
        expected.append(f'velocity_desired, or a prior whose rig.integrator is "{EXPLICIT_INTEGRATOR}"')
    count = f"{abs(offset)} row{'s' * (abs(offset) != 1)}"
    row_text = "of the same row" if offset == 0 else f"{count} {'later' if offset > 0 else 'earlier'}"
    raise InputError(
        f'timing.row: found "{timing.row}", but commands depend on the force reading {row_text}, '
        f"expected {' or '.join(expected) or 'another row convention'}"
    )


def detect_common_integrator(runs: Sequence[LoggedRun], period: float) -> str | None:
    """Return the integrator that most runs in contact indicate for the numerical model; None if unclear."""
    contacts = [run for run in runs if run.kind == "contact"][:MAX_RUNS]
    integrators = [detect_integrator(run.position_desired, run.velocity_desired, period) for run in contacts]
    return max(set(integrators), key=integrators.count, default=None)


def detect_reading_offset(runs: Sequence[LoggedRun]) -> int | None:
    """Return the row offset from a command to the latest force reading that affects it.

    The offset is positive if the reading is in a later row than the command. The result is None if the runs
    disagree, or if fewer than two runs are conclusive.
    """
    contacts = [run for run in runs if run.kind == "contact"]
    contacts = contacts[:: -(-len(contacts) // MAX_RUNS) or 1]
    parts = [part for run in contacts for part in [_make_regression_columns(run)] if part is not None]
    if not parts:
        return None
    first = _find_latest_reading(*(np.concatenate([part[index] for part in parts]) for index in (0, 1)))
    offsets = [offset for part in parts for offset in [_find_latest_reading(*part)] if offset is not None]
    if first is None or len(offsets) < 2 or offsets.count(first) < MIN_AGREEING_SHARE * len(offsets):
        return None
    return first


def _find_latest_reading(commands: np.ndarray, columns: np.ndarray) -> int | None:
    """Return the row offset from a command to the latest reading that affects the command; None if unclear.

    Args:
        commands: Fourth differences of the commands, shape (rows,).
        columns: Second differences of the regressors, shape (rows, regressors). The first regressor is the
            reading `ROWS_AFTER_COMMAND` rows after the command; the next ones are those of earlier rows.
    """
    if len(commands) < MIN_REGRESSION_ROWS or _correlate_neighbours(columns) > MAX_NEIGHBOUR_CORRELATION:
        return None
    scale = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(scale > 0, scale, 1.0)
    solution, error = np.zeros(columns.shape[1]), commands
    for _ in range(OUTLIER_ITERATIONS):
        # Exclude rows with large residuals: at onsets and limits, the response is not linear.
        used = np.abs(error) <= OUTLIER_RATIO * np.median(np.abs(error))
        solution, _, rank, _ = np.linalg.lstsq(columns[used], commands[used], rcond=1e-10)
        if rank < columns.shape[1]:
            return None
        error = commands - columns @ solution
    degrees_of_freedom = np.count_nonzero(used) - columns.shape[1]
    inverse = np.linalg.inv(columns[used].T @ columns[used])
    variance = float(error[used] @ error[used]) / degrees_of_freedom * np.diag(inverse)
    lags = slice(0, ROWS_AFTER_COMMAND + ROWS_BEFORE_COMMAND + 1)
    size = np.abs(solution[lags])
    is_significant = (size > MIN_COEFFICIENT_SIGMAS * np.sqrt(np.maximum(variance[lags], 0.0))) & (
        size > MIN_COEFFICIENT_SHARE * np.max(size)
    )
    first = int(np.argmax(is_significant))
    if not np.any(is_significant) or (first > 0 and size[first - 1] > MAX_PRECEDING_SHARE * np.max(size)):
        return None
    return ROWS_AFTER_COMMAND - first


def _make_regression_columns(run: LoggedRun) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the columns of the regression for one run, or None if it has too few usable rows.

    The first array contains the fourth differences of the commands. The second array contains the second
    differences of the regressors: force readings of nearby rows, and the position and velocity of the
    numerical model. Only rows in and near contact are included, because commands in other rows may not
    depend on the force.

    Returns:
        Arrays of shape (rows,) and (rows, regressors).
    """
    x, force = run.position_desired, run.force_measured
    assert force is not None
    if len(x) < ROWS_AFTER_COMMAND + ROWS_BEFORE_COMMAND + MIN_REGRESSION_ROWS // 2:
        return None
    exceeds_threshold = np.abs(force - estimate_resting_force(force)) > estimate_contact_threshold(force)
    touched = np.flatnonzero(exceeds_threshold[:-2] & exceeds_threshold[1:-1] & exceeds_threshold[2:])
    if not len(touched):
        return None
    second = x[2:] - 2 * x[1:-1] + x[:-2]
    first, last = touched[0] - ROWS_BESIDE_CONTACT, touched[-1] + 2 + ROWS_BESIDE_CONTACT
    rows = np.arange(max(ROWS_BEFORE_COMMAND + 1, first), min(len(x) - ROWS_AFTER_COMMAND - 1, last))
    readings = [force[rows + ahead] for ahead in range(ROWS_AFTER_COMMAND, -ROWS_BEFORE_COMMAND - 1, -1)]
    table = np.stack([second[rows - 1], *readings, x[rows], x[rows] - x[rows - 1]], axis=1)
    table = np.diff(table, n=2, axis=0)
    # Exclude rows without acceleration, and velocity jumps that a reset of the rig causes.
    acceleration = np.abs(second[rows - 1])
    median_acceleration = np.median(acceleration[acceleration > 0]) if np.any(acceleration > 0) else 0.0
    usable = (acceleration > 0) & (acceleration < 20 * median_acceleration) & run.valid[rows]
    usable = usable[2:] & usable[1:-1] & usable[:-2] & np.all(np.isfinite(table), axis=1)
    return (
        (table[usable, 0], table[usable, 1:])
        if np.count_nonzero(usable) > ROWS_AFTER_COMMAND + ROWS_BEFORE_COMMAND + 5
        else None
    )


def _correlate_neighbours(columns: np.ndarray) -> float:
    """Return the correlation of force readings (second differences) in adjacent rows; 1 if undefined."""
    reading, next_reading = columns[:, ROWS_AFTER_COMMAND], columns[:, ROWS_AFTER_COMMAND + 1]
    size = float(np.sqrt(np.dot(reading, reading) * np.dot(next_reading, next_reading)))
    return float(np.dot(reading, next_reading)) / size if size else 1.0
