"""Checks of the scales of forces, positions and velocities, from the momentum of the numerical model.

The numerical model is a free body during a contact, so its change of momentum is exactly the impulse of the
force command. The impulse of the measured force differs by the action of the compensator, which is much less
than the factor between two units. A velocity is the difference of positions.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.lost_rows import LogSegment
from tuning.identification.logs.scale_fit import fit_scale

SPEED_SPAN_TICKS = 10  # ticks, span of a difference that gives a speed
IMPULSE_RATIO_RANGE = (
    0.5,
    2.0,
)  # measured impulse over change of momentum; jaxhil's compensators reach 0.97 to 1.45
UNIT_FACTOR_TOLERANCE = 0.25  # relative tolerance of a unit's factor, since compensators change the impulse
WIDE_IMPULSE_RATIO_RANGE = (
    0.2,
    5.0,
)  # as `IMPULSE_RATIO_RANGE`, for clipped readings or a model that may not be a free body
TOLERANCE_SIGMAS = 5.0  # standard errors added to the tolerances
VELOCITY_TOLERANCE = 0.02  # relative tolerance of the velocity against the difference of positions
MAX_RELATIVE_RESIDUAL = 0.3  # largest relative residual of a usable velocity channel or position fit
POSITION_GAIN_RANGE = 0.5, 2.0  # allowed ratio of measured to desired position in slow motion
MAX_EVALUATED_ROWS, MAX_GAIN_ROWS = 50_000, 10_000  # rows that are sufficient
MAX_EVALUATED_CONTACTS = 500  # contacts that are sufficient
MAX_SLOW_MOTION_LAG = 100  # rows, largest delay of a slow motion behind its command
ROWS_BESIDE_CONTACT = 60  # rows before and after a contact that give the force at rest

# Factors by which a wrong unit of the force multiplies it.
_FORCE_FACTORS = {
    1.0 / 4.4482216152605: "force in lbf, read as N",
    4.4482216152605: "force in N, read as lbf",
    1.0 / 9.80665: "force in kgf, read as N",
    9.80665: "force in N, read as kgf",
    1e-3: "force in kN, read as N",
    1e3: "force in N, read as kN (or mN as N)",
    1e6: "force in mN, read as kN",
}
# Factors by which a wrong unit of positions or mass multiplies the impulse over the momentum.
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
_LENGTH_FACTORS = {
    1.0 / f: what.replace("positions ", "") for f, what in _MOMENTUM_FACTORS.items() if "pos" in what
}


def ask_for_unit(factors: tuple[float, ...], tolerance: float, momentum: bool = True) -> str:
    """Return a question that names the wrong units that may explain a factor of the force.

    Args:
        factors: Estimates of the ratio of the force to its expected value, the best one first.
        tolerance: Relative tolerance of a unit's factor.
        momentum: Whether positions or the mass may be in a wrong unit instead.

    Returns:
        Text such as " (force in lbf, read as N?)", the nearest factors first; "" if none is near.
    """
    factors_of_units = [*_FORCE_FACTORS.items(), *(_MOMENTUM_FACTORS.items() if momentum else ())]
    return _ask_for_units(factors_of_units, factors, tolerance)


def ask_for_length_unit(factor: float, tolerance: float) -> str:
    """Return a question that names the wrong units that may explain a factor of a length."""
    return _ask_for_units(list(_LENGTH_FACTORS.items()), (factor,), tolerance)


def _ask_for_units(units: list[tuple[float, str]], factors: tuple[float, ...], tolerance: float) -> str:
    """Return the texts of the nearest factors as a question, or ""."""
    near: list[str] = []
    for factor in factors:
        off = sorted((abs(np.log(factor / unit_factor)), text) for unit_factor, text in units if factor > 0.0)
        near += [text for distance, text in off if distance <= np.log1p(tolerance)]
    return f" ({', or '.join(list(dict.fromkeys(near))[:3])}?)" if near else ""


def check_impulse(
    label: str,
    kind: str,
    stretch: LogSegment,
    contacts: list[tuple[int, int]],
    period: float,
    mass: float,
    command_holds: bool,
    clipped: bool,
) -> None:
    """Raise `InputError` if the impulse of the measured force is not about the model's change of momentum.

    Args:
        label: Name of the log in messages.
        kind: "contact", or "tap", whose commands need not be those of a free body.
        stretch: Rows without a gap.
        contacts: First row, and row after the last one, of each contact.
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
        command_holds: Whether force_command was found to move the model with this mass.
        clipped: Whether readings end at a limit, beyond which some of the force is missing.
    """
    force, x = stretch.channels["force_measured"], stretch.channels["position_desired"]
    assert force is not None and x is not None
    contacts = contacts[:: len(contacts) // MAX_EVALUATED_CONTACTS + 1]
    needed, made = _compute_impulses(force, x, contacts, period, mass)
    if not np.any(needed):
        return
    ratio = float(np.dot(made, needed) / np.dot(needed, needed))
    error = _estimate_impulse_error(force, period, contacts) / float(np.linalg.norm(needed))
    if ratio < -WIDE_IMPULSE_RATIO_RANGE[0] - TOLERANCE_SIGMAS * error:
        raise InputError(
            f"{label}: force_measured: found one that pulls where the numerical model is pushed back, "
            "expected the other sign: F > 0 pushes back"
        )
    low, high = IMPULSE_RATIO_RANGE if kind == "contact" else WIDE_IMPULSE_RATIO_RANGE
    low = WIDE_IMPULSE_RATIO_RANGE[0] if clipped else low
    low, high = low - TOLERANCE_SIGMAS * error, high + TOLERANCE_SIGMAS * error
    if low <= ratio <= high:
        return
    # Damping by the compensator and a dead zone change the impulse, but not the slope of the force.
    slope = _estimate_force_ratio(force, x, contacts, period, mass) or ratio
    if kind == "contact" and low <= slope <= high:
        return
    units = ask_for_unit((ratio, slope), UNIT_FACTOR_TOLERANCE, momentum=not command_holds)
    units = units or " (is its unit right?)"
    raise InputError(
        f"{label}: force_measured: found {ratio:.4g} times the impulse that there was, "
        f"expected {low:.2g} to {high:.2g} times what turns {mass:g} kg round{units}"
    )


def _compute_impulses(
    force: np.ndarray, x: np.ndarray, contacts: list[tuple[int, int]], period: float, mass: float
) -> tuple[list[float], list[float]]:
    """Return the change of momentum and the impulse of the measured force in each contact [N s]."""
    rest = estimate_force_beside_contacts(force, contacts)
    needed, made = [], []
    for begin, end in contacts:
        begin, end = (
            begin - SPEED_SPAN_TICKS,
            end + SPEED_SPAN_TICKS,
        )  # There is some force below the threshold, too.
        if begin < SPEED_SPAN_TICKS or end + SPEED_SPAN_TICKS > len(x):
            begin, end = begin + SPEED_SPAN_TICKS, end - SPEED_SPAN_TICKS
        if begin < SPEED_SPAN_TICKS or end + SPEED_SPAN_TICKS > len(x):
            continue
        before = (x[begin] - x[begin - SPEED_SPAN_TICKS]) / (SPEED_SPAN_TICKS * period)
        after = (x[end + SPEED_SPAN_TICKS - 1] - x[end - 1]) / (SPEED_SPAN_TICKS * period)
        needed.append(mass * (before - after))
        made.append(period * float(np.nanmean(force[begin:end]) - rest) * (end - begin))
    return needed, made


def estimate_force_beside_contacts(force: np.ndarray, contacts: list[tuple[int, int]]) -> float:
    """Return the median reading near, but outside, the contacts [N]; a log may begin in contact."""
    beside = [
        force[max(0, begin - ROWS_BESIDE_CONTACT) : max(0, begin - SPEED_SPAN_TICKS)] for begin, _ in contacts
    ]
    beside += [force[end + SPEED_SPAN_TICKS : end + ROWS_BESIDE_CONTACT] for _, end in contacts]
    values = np.concatenate(beside) if beside else force[:0]
    return float(np.nanmedian(values)) if np.any(np.isfinite(values)) else 0.0


def _estimate_impulse_error(force: np.ndarray, period: float, contacts: list[tuple[int, int]]) -> float:
    """Return the standard deviation [N s] of the impulse of all contacts due to noise."""
    steps = np.abs(np.diff(force[:MAX_EVALUATED_ROWS]))
    std = 1.4826 * float(np.nanmedian(steps)) / np.sqrt(2.0)
    rows = sum(end - begin + 2 * SPEED_SPAN_TICKS for begin, end in contacts)
    return std * period * float(np.sqrt(rows))


def _estimate_force_ratio(
    force: np.ndarray, x: np.ndarray, contacts: list[tuple[int, int]], period: float, mass: float
) -> float | None:
    """Return the measured force over -M x_d'' in contact, without constant and rate-dependent parts.

    Returns None if the contacts do not determine it.
    """
    rows = [
        np.arange(max(begin, SPEED_SPAN_TICKS), min(end, len(x) - SPEED_SPAN_TICKS))
        for begin, end in contacts
    ]
    inside = np.concatenate(rows)[:MAX_EVALUATED_ROWS] if rows else np.empty(0, int)
    if len(inside) < 2 * SPEED_SPAN_TICKS:
        return None
    second = x[inside + SPEED_SPAN_TICKS] - 2.0 * x[inside] + x[inside - SPEED_SPAN_TICKS]
    needed = -mass * second / (SPEED_SPAN_TICKS * period) ** 2
    force = np.nan_to_num(force[: inside[-1] + SPEED_SPAN_TICKS])
    made = np.convolve(force, make_triangular_weights(SPEED_SPAN_TICKS) / SPEED_SPAN_TICKS**2)[
        inside + SPEED_SPAN_TICKS - 1
    ]
    columns = np.stack(
        [made, np.ones(len(inside)), x[inside + SPEED_SPAN_TICKS] - x[inside - SPEED_SPAN_TICKS]], axis=1
    )
    size = np.linalg.norm(columns, axis=0)
    solution = np.linalg.lstsq(columns / np.where(size > 0.0, size, 1.0), needed, rcond=None)[0]
    return float(size[0] / solution[0]) if solution[0] else None


def make_triangular_weights(width: int) -> np.ndarray:
    """Return the weights with which second differences over one row add up to one over `width` rows."""
    return width - np.abs(np.arange(1.0 - width, width))


def check_velocity(label: str, stretch: LogSegment, period: float) -> str | None:
    """Check that velocity_desired is the rate of position_desired.

    Returns:
        None, or a note if the channel does not follow the positions and is ignored.

    Raises:
        InputError: If it follows them with another scale or sign.
    """
    x, v = stretch.channels["position_desired"], stretch.channels["velocity_desired"]
    if x is None or v is None or len(x) <= 2 * SPEED_SPAN_TICKS:
        return None
    x, v = x[:MAX_EVALUATED_ROWS], v[:MAX_EVALUATED_ROWS]
    moved, integrated = x[SPEED_SPAN_TICKS:] - x[:-SPEED_SPAN_TICKS], _sum_windows(period * v)
    good = np.isfinite(integrated) & np.isfinite(moved)
    fit = fit_scale(moved[good], integrated[good], SPEED_SPAN_TICKS)
    if not np.any(good) or not np.any(moved[good]):
        return None
    if fit is None or fit.left > MAX_RELATIVE_RESIDUAL or fit.slope == 0.0:
        return f"{label}: velocity_desired: ignored, since position_desired does not move by it"
    if abs(fit.slope - 1.0) <= VELOCITY_TOLERANCE + TOLERANCE_SIGMAS * fit.error:
        return None
    ratio = 1.0 / fit.slope
    raise InputError(
        f"{label}: velocity_desired: found {ratio:.4g} times the rate of position_desired, "
        f"expected 1{ask_for_length_unit(ratio, VELOCITY_TOLERANCE)}"
    )


def _sum_windows(values: np.ndarray) -> np.ndarray:
    """Return sums over `SPEED_SPAN_TICKS` rows up to each row, NaN if one of the values is NaN."""
    finite = np.isfinite(values)
    summed = np.concatenate([[0.0], np.cumsum(np.where(finite, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(finite)])
    whole = summed[1 + SPEED_SPAN_TICKS :] - summed[1:-SPEED_SPAN_TICKS]
    return np.where(
        count[1 + SPEED_SPAN_TICKS :] - count[1:-SPEED_SPAN_TICKS] == SPEED_SPAN_TICKS, whole, np.nan
    )


def check_gain(label: str, kind: str, x: np.ndarray, measured: np.ndarray) -> None:
    """Raise `InputError` if the measured amplitude of a slow motion differs much from the commanded one."""
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
