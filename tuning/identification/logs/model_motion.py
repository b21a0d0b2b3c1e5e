"""Check that the logged force command explains the logged commands of the numerical model.

The numerical model moves by M x_d'' = -F_c, exactly except for rounding, jitter of the stamps, and lost rows.
Second differences over one row suffice for a log with full digits. If rounding or jitter hide the motion,
differences over more rows are used: the disturbance stays the same, and the motion grows with the square of
the number of rows.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.rows import Stretch, integrator_of
from tuning.identification.logs.scale_fit import Scale, scale
from tuning.identification.logs.scales import CERTAIN, likely_units, triangle

WIDTHS = 1, 2, 4, 8, 16, 32  # rows, spans of the second differences
FEWEST = 50  # rows that a fit needs
BESIDE = 40  # rows before and after a contact that are included
SAMPLE = 20_000  # rows in contact that are sufficient
EXPLAINED = 0.1  # largest share of the motion that the force command leaves unexplained
SAME_MASS = 0.01  # relative error of the mass that is tolerated
OTHER_ROW = 1.2  # ratio of the errors of two row conventions, above which one is wrong
LIKELIER = 10.0  # log likelihood ratio, above which one is wrong
EXACT = 1e-12  # m, rounding error of a log with full digits
ROWS = "tick", "sent"

Fits = dict[tuple[str, str], Scale]  # by row convention and integrator


def check_command(
    label: str,
    stretch: Stretch,
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
    parts = _parts(len(x), contacts)
    together = np.concatenate([force[part] for part in parts]) if parts else np.empty(0)
    if np.count_nonzero(np.isfinite(together)) < FEWEST:
        return True, None
    if not np.any(together[np.isfinite(together)]):
        return False, f"{label}: force_command: ignored, since it is 0 N in every contact"
    integrator = integrator_of(x, v, period) or integrator
    ways = [(written, integrator) for written in ROWS]
    moves = [(x[p], _without_gaps(-(period**2) / mass * force[p]), stretch.valid[p]) for p in parts]
    fits = {width: _fits(moves, width, ways) for width in WIDTHS}
    fits = {width: by_way for width, by_way in fits.items() if by_way}
    if not fits:
        return True, None
    least = min(_best(by_way)[1].left for by_way in fits.values())
    if least > EXPLAINED:
        return False, (
            f"{label}: force_command: ignored, since M x_d'' = -F_c leaves {100 * least:.2g} % of the motion "
            f"in contact unexplained, expected at most {100 * EXPLAINED:g} %"
        )
    fits = {width: by_way for width, by_way in fits.items() if _best(by_way)[1].left <= EXPLAINED}
    _check_mass(label, fits, mass)
    return True, _check_row(label, fits, mass, row)


def _check_mass(label: str, fits: dict[int, Fits], mass: float) -> None:
    """Raise `InputError` if the force command moves the model with another mass or with the wrong sign."""
    fit = min((_best(by_way)[1] for by_way in fits.values()), key=lambda candidate: candidate.error)
    if fit.slope < 0.0:
        raise InputError(
            f"{label}: force_command: found one that pulls the model forward, allowed the other sign"
        )
    factor = 1.0 / fit.slope
    tolerance = max(SAME_MASS, CERTAIN * fit.error * factor)
    if abs(factor - 1.0) > tolerance:
        units = likely_units((factor,), tolerance)
        raise InputError(
            f"{label}: position_desired: found commands that force_command does not make of {mass:g} kg "
            f"(nearest: {mass * factor:.4g} kg), {factor:.4g} times the force that there was, "
            f"expected M x_d'' = -F_c within {100 * tolerance:.2g} %{units}; or leave force_command out"
        )


def _check_row(label: str, fits: dict[int, Fits], mass: float, row: str) -> str | None:
    """Raise `InputError` for another row convention; return a note if the log does not determine it."""
    written, clear = "sent" if row == "sent" else "tick", False
    for by_way in fits.values():
        (best_row, integrator), best = _best(by_way)
        other_rms = max(fit.rms for fit in by_way.values()) + EXACT
        # Equal errors of both conventions carry no information.
        likelier = best.rows * np.log(other_rms / (best.rms + EXACT))
        if likelier <= LIKELIER or other_rms < OTHER_ROW * (best.rms + EXACT):
            continue
        clear = True
        if best_row != written:
            raise InputError(
                f'{label}: timing.row: found "{row}", but position_desired is what force_command makes of '
                f'{mass:g} kg ({integrator}) in rows that are "{best_row}"'
            )
    if clear:
        return None
    return f"{label}: timing.row: force_command is too coarse, or its stamps scatter too much, to tell it"


def _best(fits: Fits) -> tuple[tuple[str, str], Scale]:
    """Return the fit with the least residual and its row convention and integrator."""
    return min(fits.items(), key=lambda item: item[1].rms)


def _parts(rows: int, contacts: list[tuple[int, int]]) -> list[slice]:
    """Return the rows in and near contacts, for as many contacts as are sufficient."""
    parts, count = [], 0
    for begin, end in contacts:
        parts.append(slice(max(0, begin - BESIDE), min(rows, end + BESIDE, begin + SAMPLE)))
        count += end - begin
        if count > SAMPLE:
            break
    return parts


def _without_gaps(values: np.ndarray) -> np.ndarray:
    """Return the values with those of lost rows interpolated linearly."""
    finite = np.isfinite(values)
    if finite.all() or not finite.any():
        return np.nan_to_num(values)
    rows = np.arange(len(values))
    return np.interp(rows, rows[finite], values[finite])


def _fits(
    moves: list[tuple[np.ndarray, np.ndarray, np.ndarray]], width: int, ways: list[tuple[str, str]]
) -> Fits:
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
            pull[1:-1] = pull_of(unit, integrator, written == "sent")
            made[written, integrator].append(np.convolve(pull, triangle(width))[middle + width - 1])
    second = np.concatenate(moved)
    if len(second) < FEWEST:
        return {}
    results = {way: scale(second, np.concatenate(columns), width) for way, columns in made.items()}
    return {way: fit for way, fit in results.items() if fit is not None}


def pull_of(unit: np.ndarray, integrator: str, sent: bool) -> np.ndarray:
    """Return x(n+1) - 2 x(n) + x(n-1) due to the forces, for rows n = 1, 2, ... that hold x(n) or x(n+1)."""
    old, new = unit[:-1], unit[1:]
    made = {"semi_implicit_euler": new, "explicit_euler": old, "zoh": (old + new) / 2}[integrator]
    return made[1:] if sent else made[: len(unit) - 2]
