"""Check that the logged force command explains the logged motion of the numerical model.

The numerical model moves by M x_d'' = -F_c. The logs satisfy this equation exactly, except for rounding,
jitter of the time stamps and lost rows. In a log without rounding, the second differences of successive rows
test the equation. If rounding or jitter hides the acceleration, the second differences of rows that are n
rows apart test it: the acceleration increases them by the factor n^2, but the disturbance does not increase.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.lost_rows import LogSegment, detect_integrator
from tuning.identification.logs.scale_fit import ScaleFit, fit_scale
from tuning.identification.logs.scales import TOLERANCE_SIGMAS, ask_for_unit, make_triangular_weights

DIFFERENCE_SPANS = 1, 2, 4, 8, 16, 32  # numbers of rows between the positions in a second difference
MIN_FIT_ROWS = 50  # minimum number of rows for a fit
ROWS_BESIDE_CONTACT = 40  # number of rows before and after a contact that are included
MAX_CONTACT_ROWS = 20_000  # maximum number of evaluated rows; more are not needed
MAX_UNEXPLAINED_SHARE = 0.1  # maximum share of the motion that the force command does not explain
MASS_TOLERANCE = 0.01  # relative tolerance of the mass
MIN_ROW_ERROR_RATIO = 1.2  # minimum ratio of two row conventions' fit errors that rejects one of them
MIN_LOG_LIKELIHOOD_RATIO = 10.0  # minimum log likelihood ratio that rejects one of two row conventions
ROUNDING_ERROR = 1e-12  # rounding error in a log with all digits [m]
ROW_CONVENTIONS = "tick", "sent"  # row conventions that the motion of the model distinguishes

FitsByConvention = dict[tuple[str, str], ScaleFit]  # keys: row convention, integrator


def check_command(
    label: str,
    segment: LogSegment,
    contacts: list[tuple[int, int]],
    period: float,
    mass: float,
    row: str,
    integrator: str,
) -> tuple[bool, str | None]:
    """Check that the force command moves the numerical model in agreement with the desired position.

    Args:
        label: Name of the log in messages.
        segment: Segment of the log without a long gap.
        contacts: For each contact, its first row and the row after its last row. Other rows are not checked,
            because another program may command the rig there.
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
        row: Row convention that the mapping states (`timing.row`).
        integrator: Integrator of the numerical model, for logs whose velocity does not determine it.

    Returns:
        True if the force command can be used, and a note or None.

    Raises:
        InputError: If the mass, the sign of the force or the row convention contradicts the motion.
    """
    x, v, force = (segment.channels[key] for key in ("position_desired", "velocity_desired", "force_command"))
    assert x is not None and force is not None
    parts = _select_contact_rows(len(x), contacts)
    together = np.concatenate([force[part] for part in parts]) if parts else np.empty(0)
    if np.count_nonzero(np.isfinite(together)) < MIN_FIT_ROWS:
        return True, None
    if not np.any(together[np.isfinite(together)]):
        return False, f"{label}: force_command: ignored, because it is 0 N in every contact"
    integrator = detect_integrator(x, v, period) or integrator
    ways = [(convention, integrator) for convention in ROW_CONVENTIONS]
    moves = [(x[p], _interpolate_gaps(-(period**2) / mass * force[p]), segment.valid[p]) for p in parts]
    fits = {width: _fit_conventions(moves, width, ways) for width in DIFFERENCE_SPANS}
    fits = {width: by_way for width, by_way in fits.items() if by_way}
    if not fits:
        return True, None
    smallest_share = min(_select_best_fit(by_way)[1].left for by_way in fits.values())
    if smallest_share > MAX_UNEXPLAINED_SHARE:
        return False, (
            f"{label}: force_command: ignored, because M x_d'' = -F_c leaves {100 * smallest_share:.2g} % of "
            f"the motion in contact unexplained, expected at most {100 * MAX_UNEXPLAINED_SHARE:g} %"
        )
    fits = {
        width: by_way
        for width, by_way in fits.items()
        if _select_best_fit(by_way)[1].left <= MAX_UNEXPLAINED_SHARE
    }
    _check_mass(label, fits, mass)
    return True, _check_row(label, fits, mass, row)


def _check_mass(label: str, fits: dict[int, FitsByConvention], mass: float) -> None:
    """Raise `InputError` if the force command fits the motion only with the opposite sign or another mass."""
    fit = min(
        (_select_best_fit(by_way)[1] for by_way in fits.values()), key=lambda candidate: candidate.error
    )
    if fit.slope < 0.0:
        raise InputError(
            f"{label}: force_command: found forces that accelerate the approach, expected the other sign"
        )
    factor = 1.0 / fit.slope
    tolerance = max(MASS_TOLERANCE, TOLERANCE_SIGMAS * fit.error * factor)
    if abs(factor - 1.0) > tolerance:
        units = ask_for_unit((factor,), tolerance)
        raise InputError(
            f"{label}: force_command: found {factor:.4g} times the force that moves {mass:g} kg like "
            f"position_desired (as if the mass were {mass * factor:.4g} kg), expected M x_d'' = -F_c within "
            f"{100 * tolerance:.2g} %{units}; correct unit or mass, or leave force_command out"
        )


def _check_row(label: str, fits: dict[int, FitsByConvention], mass: float, row: str) -> str | None:
    """Raise `InputError` if the log shows another row convention than `row`.

    Return a note if the log shows no row convention.
    """
    clearest, choice = 0.0, None
    for by_way in fits.values():
        way, best = _select_best_fit(by_way)
        other_rms = max(fit.rms for fit in by_way.values()) + ROUNDING_ERROR
        likelihood_ratio = best.rows * np.log(other_rms / (best.rms + ROUNDING_ERROR))
        # Nearly equal errors of both conventions come from rounding and contain no information.
        if other_rms >= MIN_ROW_ERROR_RATIO * (best.rms + ROUNDING_ERROR) and likelihood_ratio > clearest:
            clearest, choice = likelihood_ratio, way
    if choice is not None and clearest > MIN_LOG_LIKELIHOOD_RATIO:
        best_row, integrator = choice
        if best_row != ("sent" if row == "sent" else "tick"):
            raise InputError(
                f'{label}: timing.row: found "{row}", expected "{best_row}", with which force_command '
                f"moves {mass:g} kg like position_desired (integrator {integrator})"
            )
        return None
    return f"{label}: timing.row: not checked: force_command is too coarse, or its stamps scatter too much"


def _select_best_fit(fits: FitsByConvention) -> tuple[tuple[str, str], ScaleFit]:
    """Return the key (row convention, integrator) of the fit with the smallest residual, and this fit."""
    return min(fits.items(), key=lambda item: item[1].rms)


def _select_contact_rows(rows: int, contacts: list[tuple[int, int]]) -> list[slice]:
    """Return the ranges of rows in and near the contacts, with at most `MAX_CONTACT_ROWS` rows."""
    parts, count = [], 0
    for begin, end in contacts:
        parts.append(
            slice(
                max(0, begin - ROWS_BESIDE_CONTACT),
                min(rows, end + ROWS_BESIDE_CONTACT, begin + MAX_CONTACT_ROWS),
            )
        )
        count += end - begin
        if count > MAX_CONTACT_ROWS:
            break
    return parts


def _interpolate_gaps(values: np.ndarray) -> np.ndarray:
    """Replace NaN in lost rows by linear interpolation."""
    finite = np.isfinite(values)
    if finite.all() or not finite.any():
        return np.nan_to_num(values)
    rows = np.arange(len(values))
    return np.interp(rows, rows[finite], values[finite])


def _fit_conventions(
    moves: list[tuple[np.ndarray, np.ndarray, np.ndarray]], width: int, ways: list[tuple[str, str]]
) -> FitsByConvention:
    """Fit the measured second differences of positions as a multiple of those that the forces cause.

    Args:
        moves: For each contact, three arrays over its rows: positions [m]; -T^2 F_c / M [m], as in
            `compute_force_displacement`; and flags of the valid rows.
        width: Number of rows between the positions of a second difference.
        ways: Pairs of row convention and integrator.

    Returns:
        The fit for each pair; empty if there are too few rows.
    """
    second_differences, displacements = [], {way: [] for way in ways}
    for x, unit, valid in moves:
        middle = np.arange(width + 1, len(x) - width - 1)
        # Omit reconstructed rows, because they were computed from the force command.
        middle = middle[valid[middle] & valid[middle - width] & valid[middle + width]]
        second_differences.append(x[middle + width] - 2.0 * x[middle] + x[middle - width])
        for convention, integrator in ways:
            force_displacement = np.zeros(len(x))
            force_displacement[1:-1] = compute_force_displacement(unit, integrator, convention == "sent")
            displacements[convention, integrator].append(
                np.convolve(force_displacement, make_triangular_weights(width))[middle + width - 1]
            )
    second = np.concatenate(second_differences)
    if len(second) < MIN_FIT_ROWS:
        return {}
    results = {
        way: fit_scale(second, np.concatenate(columns), width) for way, columns in displacements.items()
    }
    return {way: fit for way, fit in results.items() if fit is not None}


def compute_force_displacement(unit: np.ndarray, integrator: str, sent: bool) -> np.ndarray:
    """Return the second differences x(n+1) - 2 x(n) + x(n-1) that the force command causes in positions x.

    Args:
        unit: -T^2 F_c / M in each row, with control period T, force command F_c and equivalent mass M [m].
        integrator: Integrator of the numerical model.
        sent: Whether row n contains the position of tick n + 1, not of tick n.
    """
    previous, current = unit[:-1], unit[1:]
    displacements = {
        "semi_implicit_euler": current,
        "explicit_euler": previous,
        "zoh": (previous + current) / 2,
    }[integrator]
    return displacements[1:] if sent else displacements[: len(unit) - 2]
