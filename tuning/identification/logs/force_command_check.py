"""Check that the logged force command explains the logged commands of the numerical model.

The numerical model moves by M x_d'' = -F_c, exactly except for rounding, jitter of the stamps, and lost rows.
Second differences over one row suffice for a log with full digits. If rounding or jitter hide the motion,
differences over more rows are used: the disturbance stays the same, and the motion grows with the square of
the number of rows.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.lost_rows import LogSegment, detect_integrator
from tuning.identification.logs.scale_fit import ScaleFit, fit_scale
from tuning.identification.logs.scales import TOLERANCE_SIGMAS, ask_for_unit, make_triangular_weights

DIFFERENCE_SPANS = 1, 2, 4, 8, 16, 32  # rows, spans of the second differences
MIN_FIT_ROWS = 50  # rows that a fit needs
ROWS_BESIDE_CONTACT = 40  # rows before and after a contact that are included
MAX_CONTACT_ROWS = 20_000  # rows in contact that are sufficient
MAX_UNEXPLAINED_SHARE = 0.1  # largest share of the motion that the force command leaves unexplained
MASS_TOLERANCE = 0.01  # relative error of the mass that is tolerated
MIN_ROW_ERROR_RATIO = 1.2  # ratio of the errors of two row conventions, above which one is wrong
MIN_LOG_LIKELIHOOD_RATIO = 10.0  # log likelihood ratio, above which one is wrong
ROUNDING_ERROR = 1e-12  # m, rounding error of a log with full digits
ROW_CONVENTIONS = "tick", "sent"

FitsByConvention = dict[tuple[str, str], ScaleFit]  # by row convention and integrator


def check_command(
    label: str,
    stretch: LogSegment,
    contacts: list[tuple[int, int]],
    period: float,
    mass: float,
    row: str,
    integrator: str,
) -> tuple[bool, str | None]:
    """Check that force_command moves the numerical model as position_desired does.

    Args:
        label: Name of the log in messages.
        stretch: Segment without a longer gap.
        contacts: First row, and row after the last one, of each contact; outside, something else may drive
            the rig.
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
        row: Row convention of the mapping.
        integrator: Integrator of the numerical model if the logged velocities do not determine it.

    Returns:
        Whether force_command can be used (else it is ignored), and a note or None.

    Raises:
        InputError: If it moves the model with another mass, sign or row convention.
    """
    x, v, force = (stretch.channels[key] for key in ("position_desired", "velocity_desired", "force_command"))
    assert x is not None and force is not None
    parts = _select_contact_rows(len(x), contacts)
    together = np.concatenate([force[part] for part in parts]) if parts else np.empty(0)
    if np.count_nonzero(np.isfinite(together)) < MIN_FIT_ROWS:
        return True, None
    if not np.any(together[np.isfinite(together)]):
        return False, f"{label}: force_command: ignored, since it is 0 N in every contact"
    integrator = detect_integrator(x, v, period) or integrator
    ways = [(written, integrator) for written in ROW_CONVENTIONS]
    moves = [(x[p], _interpolate_gaps(-(period**2) / mass * force[p]), stretch.valid[p]) for p in parts]
    fits = {width: _fit_conventions(moves, width, ways) for width in DIFFERENCE_SPANS}
    fits = {width: by_way for width, by_way in fits.items() if by_way}
    if not fits:
        return True, None
    least = min(_select_best_fit(by_way)[1].left for by_way in fits.values())
    if least > MAX_UNEXPLAINED_SHARE:
        return False, (
            f"{label}: force_command: ignored, since M x_d'' = -F_c leaves {100 * least:.2g} % of the motion "
            f"in contact unexplained, expected at most {100 * MAX_UNEXPLAINED_SHARE:g} %"
        )
    fits = {
        width: by_way
        for width, by_way in fits.items()
        if _select_best_fit(by_way)[1].left <= MAX_UNEXPLAINED_SHARE
    }
    _check_mass(label, fits, mass)
    return True, _check_row(label, fits, mass, row)


def _check_mass(label: str, fits: dict[int, FitsByConvention], mass: float) -> None:
    """Raise `InputError` if the force command moves the model with another mass or with the wrong sign."""
    fit = min(
        (_select_best_fit(by_way)[1] for by_way in fits.values()), key=lambda candidate: candidate.error
    )
    if fit.slope < 0.0:
        raise InputError(
            f"{label}: force_command: found one that pulls the model forward, expected the other sign"
        )
    factor = 1.0 / fit.slope
    tolerance = max(MASS_TOLERANCE, TOLERANCE_SIGMAS * fit.error * factor)
    if abs(factor - 1.0) > tolerance:
        units = ask_for_unit((factor,), tolerance)
        raise InputError(
            f"{label}: position_desired: found commands that force_command does not make of {mass:g} kg "
            f"(nearest: {mass * factor:.4g} kg), {factor:.4g} times the force that there was, "
            f"expected M x_d'' = -F_c within {100 * tolerance:.2g} %{units}; or leave force_command out"
        )


def _check_row(label: str, fits: dict[int, FitsByConvention], mass: float, row: str) -> str | None:
    """Raise `InputError` for another row convention; return a note if the log does not determine it."""
    clearest, choice = 0.0, None
    for by_way in fits.values():
        way, best = _select_best_fit(by_way)
        other_rms = max(fit.rms for fit in by_way.values()) + ROUNDING_ERROR
        likelihood_ratio = best.rows * np.log(other_rms / (best.rms + ROUNDING_ERROR))
        # Nearly equal errors of both conventions come from rounding, and carry no information.
        if other_rms >= MIN_ROW_ERROR_RATIO * (best.rms + ROUNDING_ERROR) and likelihood_ratio > clearest:
            clearest, choice = likelihood_ratio, way
    if choice is not None and clearest > MIN_LOG_LIKELIHOOD_RATIO:
        best_row, integrator = choice
        if best_row != ("sent" if row == "sent" else "tick"):
            raise InputError(
                f'{label}: timing.row: found "{row}", but position_desired is what force_command makes of '
                f'{mass:g} kg ({integrator}) in rows that are "{best_row}"'
            )
        return None
    return f"{label}: timing.row: force_command is too coarse, or its stamps scatter too much, to tell it"


def _select_best_fit(fits: FitsByConvention) -> tuple[tuple[str, str], ScaleFit]:
    """Return the fit with the least residual and its row convention and integrator."""
    return min(fits.items(), key=lambda item: item[1].rms)


def _select_contact_rows(rows: int, contacts: list[tuple[int, int]]) -> list[slice]:
    """Return the rows in and near contacts, for as many contacts as are sufficient."""
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
    """Return the values with those of lost rows interpolated linearly."""
    finite = np.isfinite(values)
    if finite.all() or not finite.any():
        return np.nan_to_num(values)
    rows = np.arange(len(values))
    return np.interp(rows, rows[finite], values[finite])


def _fit_conventions(
    moves: list[tuple[np.ndarray, np.ndarray, np.ndarray]], width: int, ways: list[tuple[str, str]]
) -> FitsByConvention:
    """Fit second differences over `width` rows by the forces, for each row convention and integrator.

    `moves` holds for each contact the commands, the second differences that the force of one row causes, and
    which rows are valid.
    """
    moved, made = [], {way: [] for way in ways}
    for x, unit, valid in moves:
        middle = np.arange(width + 1, len(x) - width - 1)
        # Reconstructed rows follow from the model itself.
        middle = middle[valid[middle] & valid[middle - width] & valid[middle + width]]
        moved.append(x[middle + width] - 2.0 * x[middle] + x[middle - width])
        for written, integrator in ways:
            pull = np.zeros(len(x))
            pull[1:-1] = compute_force_displacement(unit, integrator, written == "sent")
            made[written, integrator].append(
                np.convolve(pull, make_triangular_weights(width))[middle + width - 1]
            )
    second = np.concatenate(moved)
    if len(second) < MIN_FIT_ROWS:
        return {}
    results = {way: fit_scale(second, np.concatenate(columns), width) for way, columns in made.items()}
    return {way: fit for way, fit in results.items() if fit is not None}


def compute_force_displacement(unit: np.ndarray, integrator: str, sent: bool) -> np.ndarray:
    """Return x(n+1) - 2 x(n) + x(n-1) due to the forces, for rows n = 1, 2, ... that hold x(n) or x(n+1)."""
    old, new = unit[:-1], unit[1:]
    made = {"semi_implicit_euler": new, "explicit_euler": old, "zoh": (old + new) / 2}[integrator]
    return made[1:] if sent else made[: len(unit) - 2]
