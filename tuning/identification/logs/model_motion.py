"""Check that the logged commands are what the logged force command makes of the numerical model.

The numerical model moves by M x_d'' = -F_c, exactly but for the digits that a log keeps, for stamps that
scatter where samples do, and for rows that were lost. Second differences over one row show all of a log with
full digits. Where rounding or jitter hides them, differences over more rows are used: what hides them stays
the same, and the motion grows with the square of the rows.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.rows import Stretch, integrator_of
from tuning.identification.logs.scale_fit import Scale, scale
from tuning.identification.logs.scales import CERTAIN, likely_units, triangle

WIDTHS = 1, 2, 4, 8, 16, 32  # rows, over which second differences are taken
FEWEST = 50  # rows
BESIDE = 40  # rows before and after a contact that are looked at
SAMPLE = 20_000  # rows in contact that say as much as all
EXPLAINED = 0.1  # of the motion, which the force command may leave unexplained
SAME_MASS = 0.01  # relative error of the mass that changes no result
OTHER_ROW = 1.2  # times the error of the better row convention, from which the other one is wrong
LIKELIER = 10.0  # logarithm of the likelihood ratio from which it is
EXACT = 1e-12  # m, of rounding in a log with all digits
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
        stretch: Rows without a longer gap.
        contacts: First row, and row after the last one, of each contact: elsewhere a rig may be driven.
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
        row: Convention by which rows are written, as the mapping has it.
        integrator: That of the numerical model, where the logged velocities do not tell it.

    Returns:
        Whether force_command can be what moved the model, else it is to be ignored; and a note or None.

    Raises:
        InputError: If it moves the model with another mass, sign or row convention.
    """
    x, v, force = (stretch.channels[one] for one in ("position_desired", "velocity_desired", "force_command"))
    assert x is not None and force is not None
    parts = _parts(len(x), contacts)
    together = np.concatenate([force[one] for one in parts]) if parts else np.empty(0)
    if np.count_nonzero(np.isfinite(together)) < FEWEST:
        return True, None
    if not np.any(together[np.isfinite(together)]):
        return False, f"{label}: force_command: ignored, since it is 0 N in every contact"
    integrator = integrator_of(x, v, period) or integrator
    ways = [(written, integrator) for written in ROWS]
    moves = [(x[one], _without_gaps(-(period**2) / mass * force[one]), stretch.valid[one]) for one in parts]
    fits = {width: _fits(moves, width, ways) for width in WIDTHS}
    fits = {width: found for width, found in fits.items() if found}
    if not fits:
        return True, None
    least = min(_best(found)[1].left for found in fits.values())
    if least > EXPLAINED:
        return False, (
            f"{label}: force_command: ignored, since M x_d'' = -F_c leaves {100 * least:.2g} % of the motion "
            f"in contact unexplained, expected at most {100 * EXPLAINED:g} %"
        )
    fits = {width: found for width, found in fits.items() if _best(found)[1].left <= EXPLAINED}
    _check_mass(label, fits, mass)
    return True, _check_row(label, fits, mass, row)


def _check_mass(label: str, fits: dict[int, Fits], mass: float) -> None:
    """Raise `InputError` if the model moves by the force command as another mass, or the other way round."""
    fit = min((_best(found)[1] for found in fits.values()), key=lambda one: one.error)
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
    """Raise `InputError` if rows are written by another convention; return a note if nothing tells it."""
    written, clear = "sent" if row == "sent" else "tick", False
    for found in fits.values():
        (best_row, integrator), best = _best(found)
        other = max(fit.rms for fit in found.values()) + EXACT
        # Rows by which both conventions err alike say nothing.
        likelier = best.rows * np.log(other / (best.rms + EXACT))
        if likelier <= LIKELIER or other < OTHER_ROW * (best.rms + EXACT):
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
    return min(fits.items(), key=lambda one: one[1].rms)


def _parts(rows: int, contacts: list[tuple[int, int]]) -> list[slice]:
    """Return the rows of contacts and next to them, of so many contacts as say enough."""
    parts, count = [], 0
    for begin, end in contacts:
        parts.append(slice(max(0, begin - BESIDE), min(rows, end + BESIDE, begin + SAMPLE)))
        count += end - begin
        if count > SAMPLE:
            break
    return parts


def _without_gaps(values: np.ndarray) -> np.ndarray:
    """Return the values with those of lost rows on the line between their neighbours."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return np.nan_to_num(values)
    rows = np.arange(len(values))
    return np.interp(rows, rows[known], values[known])


def _fits(
    moves: list[tuple[np.ndarray, np.ndarray, np.ndarray]], width: int, ways: list[tuple[str, str]]
) -> Fits:
    """Fit second differences over `width` rows by the forces, for each way in which rows may be written.

    `moves`: of each contact the commands, second differences by the force of one row, and which rows are
    valid."""
    moved, made = [], {way: [] for way in ways}
    for x, unit, valid in moves:
        middle = np.arange(width + 1, len(x) - width - 1)
        # Rows that were put back follow from the model itself.
        middle = middle[valid[middle] & valid[middle - width] & valid[middle + width]]
        moved.append(x[middle + width] - 2.0 * x[middle] + x[middle - width])
        for written, integrator in ways:
            pull = np.zeros(len(x))
            pull[1:-1] = pull_of(unit, integrator, written == "sent")
            made[written, integrator].append(np.convolve(pull, triangle(width))[middle + width - 1])
    second = np.concatenate(moved)
    if len(second) < FEWEST:
        return {}
    found = {way: scale(second, np.concatenate(one), width) for way, one in made.items()}
    return {way: fit for way, fit in found.items() if fit is not None}


def pull_of(unit: np.ndarray, integrator: str, sent: bool) -> np.ndarray:
    """Return x(n+1) - 2 x(n) + x(n-1) that forces make, about rows n = 1, 2, ... that hold x(n) or x(n+1)."""
    old, new = unit[:-1], unit[1:]
    made = {"semi_implicit_euler": new, "explicit_euler": old, "zoh": (old + new) / 2}[integrator]
    return made[1:] if sent else made[: len(unit) - 2]
