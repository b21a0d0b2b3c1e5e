"""Checks of the units of forces, positions and velocities, from the momentum of the numerical model.

During a contact, the numerical model is a free body. Its change of momentum therefore equals the impulse of
the force command. The impulse of the measured force differs from this change because of the compensator, but
by a much smaller factor than a wrong unit causes. Velocities are compared with the differences of positions.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.lost_rows import LogSegment
from tuning.identification.logs.scale_fit import fit_scale

SPEED_SPAN_TICKS = 10  # number of ticks between the two positions that give a speed
# Allowed ratio of the measured force's impulse to the change of momentum; jaxhil's compensators cause 0.97 to
# 1.45.
IMPULSE_RATIO_RANGE = 0.5, 2.0
UNIT_FACTOR_TOLERANCE = 0.25  # relative tolerance of a unit's factor, because compensators change the impulse
# Allowed impulse ratio if readings are clipped, or if the numerical model may not be a free body.
WIDE_IMPULSE_RATIO_RANGE = 0.2, 5.0
TOLERANCE_SIGMAS = 5.0  # this number of standard errors is added to a tolerance
VELOCITY_TOLERANCE = 0.02  # maximum relative deviation of the velocity from the differences of positions
MAX_RELATIVE_RESIDUAL = 0.3  # relative residual above which a fit is ignored
POSITION_GAIN_RANGE = 0.5, 2.0  # allowed ratio of measured to desired position in slow motion
MAX_EVALUATED_ROWS, MAX_GAIN_ROWS = 50_000, 10_000  # maximum numbers of evaluated rows; more are not needed
MAX_EVALUATED_CONTACTS = 500  # maximum number of evaluated contacts; more are not needed
MAX_SLOW_MOTION_LAG = 100  # longest delay that the search tries for a slow motion [rows]
ROWS_BESIDE_CONTACT = 60  # number of rows before and after a contact that determine the force without contact

# Factors by which a wrong unit multiplies the force.
_FORCE_FACTORS = {
    1.0 / 4.4482216152605: "force in lbf, read as N",
    4.4482216152605: "force in N, read as lbf",
    1.0 / 9.80665: "force in kgf, read as N",
    9.80665: "force in N, read as kgf",
    1e-3: "force in kN, read as N",
    1e3: "force in N, read as kN (or mN as N)",
    1e6: "force in mN, read as kN",
}
# Factors by which a wrong unit of positions or mass multiplies the ratio of impulse to momentum.
_MOMENTUM_FACTORS = {
    2.54: "positions in in, read as cm",
    1.0 / 2.54: "positions in cm, read as in",
    25.4: "positions in in, read as mm",
    1.0 / 25.4: "positions in mm, read as in",
    1.0 / 0.0254: "positions in in, read as m",
    0.0254: "positions in m, read as in",
    10.0: "positions in cm, read as mm",
    0.1: "positions in mm, read as cm",
    100.0: "positions in m, read as cm",
    0.01: "positions in cm, read as m",
    1e3: "positions in m, read as mm",
    1e-3: "positions in mm, read as m",
    0.45359237: "equivalent_mass in lb, read as kg",
    1.0 / 0.45359237: "equivalent_mass in kg, read as lb",
}
# Factors by which a wrong unit multiplies a length.
_LENGTH_FACTORS = {
    1.0 / f: what.replace("positions ", "") for f, what in _MOMENTUM_FACTORS.items() if "pos" in what
}


def ask_for_unit(factors: tuple[float, ...], tolerance: float, momentum: bool = True) -> str:
    """Return a question that names wrong units as possible causes of a wrong magnitude of the force.

    Args:
        factors: Estimates of the ratio of the force to its expected value; the best estimate comes first.
        tolerance: Relative tolerance between an estimate and the factor that a wrong unit causes.
        momentum: Whether the question may also name units of positions and mass.

    Returns:
        Text such as " (force in lbf, read as N?)", with the most similar factors first; "" if none fits.
    """
    factors_of_units = [*_FORCE_FACTORS.items(), *(_MOMENTUM_FACTORS.items() if momentum else ())]
    return _ask_for_units(factors_of_units, factors, tolerance)


def ask_for_length_unit(factor: float, tolerance: float) -> str:
    """Return a question that names wrong length units (such as mm for m) that may explain `factor`."""
    return _ask_for_units(list(_LENGTH_FACTORS.items()), (factor,), tolerance)


def _ask_for_units(units: list[tuple[float, str]], factors: tuple[float, ...], tolerance: float) -> str:
    """Return the question whether the log has units that explain `factors`; empty if no units match."""
    texts: list[str] = []
    for factor in factors:
        distances = sorted(
            (abs(np.log(factor / unit_factor)), text) for unit_factor, text in units if factor > 0.0
        )
        texts += [text for distance, text in distances if distance <= np.log1p(tolerance)]
    return f" ({', or '.join(list(dict.fromkeys(texts))[:3])}?)" if texts else ""


def check_impulse(
    label: str,
    kind: str,
    segment: LogSegment,
    contacts: list[tuple[int, int]],
    period: float,
    mass: float,
    mass_is_verified: bool,
    clipped: bool,
) -> None:
    """Check that the measured impulse roughly equals the numerical model's change of momentum.

    Args:
        label: Name of the log in messages.
        kind: Kind of experiment: "contact", or "tap" (contacts in which the model is not a free body).
        segment: Segment of the log.
        contacts: For each contact, its first row and the row after its last row.
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
        mass_is_verified: Whether the force command is known to move this mass, so that the units of positions
            and mass are right.
        clipped: Whether force readings are clipped, so that part of the impulse is missing.

    Raises:
        InputError: If the impulse has the wrong sign or magnitude.
    """
    force, x = segment.channels["force_measured"], segment.channels["position_desired"]
    assert force is not None and x is not None
    contacts = contacts[:: len(contacts) // MAX_EVALUATED_CONTACTS + 1]
    momentum_changes, impulses = _compute_impulses(force, x, contacts, period, mass)
    if not np.any(momentum_changes):
        return
    ratio = float(np.dot(impulses, momentum_changes) / np.dot(momentum_changes, momentum_changes))
    error = _estimate_impulse_error(force, period, contacts) / float(np.linalg.norm(momentum_changes))
    if ratio < -WIDE_IMPULSE_RATIO_RANGE[0] - TOLERANCE_SIGMAS * error:
        raise InputError(
            f"{label}: force_measured: found F < 0 in contacts that push the numerical model back, "
            "expected the other sign: F > 0 pushes back"
        )
    low, high = IMPULSE_RATIO_RANGE if kind == "contact" else WIDE_IMPULSE_RATIO_RANGE
    low = WIDE_IMPULSE_RATIO_RANGE[0] if clipped else low
    low, high = low - TOLERANCE_SIGMAS * error, high + TOLERANCE_SIGMAS * error
    if low <= ratio <= high:
        return
    # Damping compensation and a dead zone change the impulse, but hardly the slope of the force.
    slope = _estimate_force_ratio(force, x, contacts, period, mass) or ratio
    if kind == "contact" and low <= slope <= high:
        return
    units = ask_for_unit((ratio, slope), UNIT_FACTOR_TOLERANCE, momentum=not mass_is_verified)
    units = units or " (is its unit right?)"
    raise InputError(
        f"{label}: force_measured: found {ratio:.4g} times the impulse that reverses {mass:g} kg, "
        f"expected {low:.2g} to {high:.2g} times{units}"
    )


def _compute_impulses(
    force: np.ndarray, x: np.ndarray, contacts: list[tuple[int, int]], period: float, mass: float
) -> tuple[list[float], list[float]]:
    """Return the numerical model's changes of momentum and the measured impulses [N s], one per contact."""
    rest = estimate_force_beside_contacts(force, contacts)
    momentum_changes, impulses = [], []
    for begin, end in contacts:
        # Include rows in which the force is below the detection threshold.
        begin, end = begin - SPEED_SPAN_TICKS, end + SPEED_SPAN_TICKS
        if begin < SPEED_SPAN_TICKS or end + SPEED_SPAN_TICKS > len(x):
            begin, end = begin + SPEED_SPAN_TICKS, end - SPEED_SPAN_TICKS
        if begin < SPEED_SPAN_TICKS or end + SPEED_SPAN_TICKS > len(x):
            continue
        before = (x[begin] - x[begin - SPEED_SPAN_TICKS]) / (SPEED_SPAN_TICKS * period)
        after = (x[end + SPEED_SPAN_TICKS - 1] - x[end - 1]) / (SPEED_SPAN_TICKS * period)
        momentum_changes.append(mass * (before - after))
        impulses.append(period * float(np.nanmean(force[begin:end]) - rest) * (end - begin))
    return momentum_changes, impulses


def estimate_force_beside_contacts(force: np.ndarray, contacts: list[tuple[int, int]]) -> float:
    """Return the median force reading just before and after the contacts [N]."""
    beside = [
        force[max(0, begin - ROWS_BESIDE_CONTACT) : max(0, begin - SPEED_SPAN_TICKS)] for begin, _ in contacts
    ]
    beside += [force[end + SPEED_SPAN_TICKS : end + ROWS_BESIDE_CONTACT] for _, end in contacts]
    values = np.concatenate(beside) if beside else force[:0]
    return float(np.nanmedian(values)) if np.any(np.isfinite(values)) else 0.0


def _estimate_impulse_error(force: np.ndarray, period: float, contacts: list[tuple[int, int]]) -> float:
    """Return the standard deviation [N s] of the impulses of all contacts together, due to the noise.

    The noise hides the ends of a contact. The force beside the contact, which is subtracted from all of its
    readings, may therefore be wrong by as much as the noise's standard deviation.
    """
    steps = np.abs(np.diff(force[:MAX_EVALUATED_ROWS]))
    std = 1.4826 * float(np.nanmedian(steps)) / np.sqrt(2.0)
    rows = [end - begin + 2 * SPEED_SPAN_TICKS for begin, end in contacts]
    return std * period * float(np.linalg.norm(rows))


def _estimate_force_ratio(
    force: np.ndarray, x: np.ndarray, contacts: list[tuple[int, int]], period: float, mass: float
) -> float | None:
    """Return the measured force in contact, divided by -`mass` times the desired acceleration.

    A regression excludes the constant and the rate-dependent part of the force. Returns None if the
    rows do not determine the ratio.
    """
    rows = [
        np.arange(max(begin, SPEED_SPAN_TICKS), min(end, len(x) - SPEED_SPAN_TICKS))
        for begin, end in contacts
    ]
    inside = np.concatenate(rows)[:MAX_EVALUATED_ROWS] if rows else np.empty(0, int)
    if len(inside) < 2 * SPEED_SPAN_TICKS:
        return None
    second = x[inside + SPEED_SPAN_TICKS] - 2.0 * x[inside] + x[inside - SPEED_SPAN_TICKS]
    needed_force = -mass * second / (SPEED_SPAN_TICKS * period) ** 2
    force = np.nan_to_num(force[: inside[-1] + SPEED_SPAN_TICKS])
    mean_force = np.convolve(force, make_triangular_weights(SPEED_SPAN_TICKS) / SPEED_SPAN_TICKS**2)[
        inside + SPEED_SPAN_TICKS - 1
    ]
    columns = np.stack(
        [mean_force, np.ones(len(inside)), x[inside + SPEED_SPAN_TICKS] - x[inside - SPEED_SPAN_TICKS]],
        axis=1,
    )
    size = np.linalg.norm(columns, axis=0)
    solution = np.linalg.lstsq(columns / np.where(size > 0.0, size, 1.0), needed_force, rcond=None)[0]
    return float(size[0] / solution[0]) if solution[0] else None


def make_triangular_weights(width: int) -> np.ndarray:
    """Return the weights with which second differences of adjacent rows sum to one of rows `width` apart."""
    return width - np.abs(np.arange(1.0 - width, width))


def check_velocity(label: str, segment: LogSegment, period: float) -> str | None:
    """Check that the desired velocity is the derivative of the desired position.

    Returns:
        A note if the velocity must be ignored, because it is not proportional to the derivative; or None.

    Raises:
        InputError: If the velocity is proportional to the derivative, with a factor other than 1.
    """
    x, v = segment.channels["position_desired"], segment.channels["velocity_desired"]
    if x is None or v is None or len(x) <= 2 * SPEED_SPAN_TICKS:
        return None
    x, v = x[:MAX_EVALUATED_ROWS], v[:MAX_EVALUATED_ROWS]
    steps, integrated = x[SPEED_SPAN_TICKS:] - x[:-SPEED_SPAN_TICKS], _sum_windows(period * v)
    usable = np.isfinite(integrated) & np.isfinite(steps)
    fit = fit_scale(steps[usable], integrated[usable], SPEED_SPAN_TICKS)
    if not np.any(usable) or not np.any(steps[usable]):
        return None
    if fit is None or fit.left > MAX_RELATIVE_RESIDUAL or fit.slope == 0.0:
        return f"{label}: velocity_desired: ignored, because it is not the rate of position_desired"
    if abs(fit.slope - 1.0) <= VELOCITY_TOLERANCE + TOLERANCE_SIGMAS * fit.error:
        return None
    ratio = 1.0 / fit.slope
    raise InputError(
        f"{label}: velocity_desired: found {ratio:.4g} times the rate of position_desired, "
        f"expected 1{ask_for_length_unit(ratio, VELOCITY_TOLERANCE)}"
    )


def _sum_windows(values: np.ndarray) -> np.ndarray:
    """Return, for each row, the sum of the last `SPEED_SPAN_TICKS` values; NaN if one of them is NaN."""
    finite = np.isfinite(values)
    summed = np.concatenate([[0.0], np.cumsum(np.where(finite, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(finite)])
    whole = summed[1 + SPEED_SPAN_TICKS :] - summed[1:-SPEED_SPAN_TICKS]
    return np.where(
        count[1 + SPEED_SPAN_TICKS :] - count[1:-SPEED_SPAN_TICKS] == SPEED_SPAN_TICKS, whole, np.nan
    )


def check_gain(label: str, kind: str, x: np.ndarray, measured: np.ndarray) -> None:
    """Raise `InputError` if the static gain from desired to measured position is far from 1."""
    if kind not in ("contact", "tap"):
        return
    x, measured = (
        x[:MAX_GAIN_ROWS] - np.mean(x[:MAX_GAIN_ROWS]),
        measured[:MAX_GAIN_ROWS] - np.mean(measured[:MAX_GAIN_ROWS]),
    )
    shifted = [
        fit_scale(measured[lag:], x[: len(x) - lag])
        for lag in range(0, MAX_SLOW_MOTION_LAG, 8)
        if lag < len(x) // 2
    ]
    fit = min(
        (candidate for candidate in shifted if candidate is not None),
        key=lambda candidate: candidate.left,
        default=None,
    )
    if (
        fit is None
        or fit.left > MAX_RELATIVE_RESIDUAL
        or POSITION_GAIN_RANGE[0] <= fit.slope <= POSITION_GAIN_RANGE[1]
    ):
        return
    raise InputError(
        f"{label}: position_measured: found {fit.slope:.4g} times the motion of position_desired, "
        f"expected {POSITION_GAIN_RANGE[0]:g} to "
        f"{POSITION_GAIN_RANGE[1]:g}{ask_for_length_unit(fit.slope, 0.2) or ' (is its unit right?)'}"
    )
