"""Checks of the scales of forces, positions and velocities, from the momentum of the numerical model.

The numerical model is a free body during a contact, so its change of momentum is exactly the impulse of the
force command. The impulse of the measured force differs by the action of the compensator, which is much less
than the factor between two units. A velocity is the difference of positions.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.rows import Stretch
from tuning.identification.logs.scale_fit import scale

SMOOTH = 10  # ticks, span of a difference that gives a speed
IMPULSE = 0.5, 2.0  # measured impulse over change of momentum; jaxhil's compensators reach 0.97 to 1.45
NEAR = 0.25  # relative tolerance of a unit's factor, since compensators change the impulse
WIDE = 0.2, 5.0  # as `IMPULSE`, for clipped readings or a model that may not be a free body
CERTAIN = 5.0  # standard errors added to the tolerances
SPEED_ERROR = 0.02  # relative tolerance of the velocity against the difference of positions
EXPLAINED = 0.3  # largest relative residual of a usable velocity channel or position fit
GAIN = 0.5, 2.0  # allowed ratio of measured to desired position in slow motion
SAMPLE, FEW = 50_000, 10_000  # rows that are sufficient
MANY = 500  # contacts that are sufficient
MOST_LAG = 100  # rows, largest delay of a slow motion behind its command
BESIDE = 60  # rows before and after a contact that give the force at rest

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


def likely_units(factors: tuple[float, ...], tolerance: float, momentum: bool = True) -> str:
    """Return a question that names the wrong units that may explain a factor of the force.

    Args:
        factors: Estimates of the ratio of the force to its expected value, the best one first.
        tolerance: Relative tolerance of a unit's factor.
        momentum: Whether positions or the mass may be in a wrong unit instead.

    Returns:
        Text such as " (force in lbf, read as N?)", the nearest factors first; "" if none is near.
    """
    factors_of_units = [*_FORCE_FACTORS.items(), *(_MOMENTUM_FACTORS.items() if momentum else ())]
    return _question(factors_of_units, factors, tolerance)


def likely_lengths(factor: float, tolerance: float) -> str:
    """Return a question that names the wrong units that may explain a factor of a length."""
    return _question(list(_LENGTH_FACTORS.items()), (factor,), tolerance)


def _question(units: list[tuple[float, str]], factors: tuple[float, ...], tolerance: float) -> str:
    """Return the texts of the nearest factors as a question, or ""."""
    near: list[str] = []
    for factor in factors:
        off = sorted((abs(np.log(factor / unit_factor)), text) for unit_factor, text in units if factor > 0.0)
        near += [text for distance, text in off if distance <= np.log1p(tolerance)]
    return f" ({', or '.join(list(dict.fromkeys(near))[:3])}?)" if near else ""


def check_impulse(
    label: str,
    kind: str,
    stretch: Stretch,
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
    contacts = contacts[:: len(contacts) // MANY + 1]
    needed, made = _impulses(force, x, contacts, period, mass)
    if not np.any(needed):
        return
    ratio = float(np.dot(made, needed) / np.dot(needed, needed))
    error = _error_of(force, period, contacts) / float(np.linalg.norm(needed))
    if ratio < -WIDE[0] - CERTAIN * error:
        raise InputError(
            f"{label}: force_measured: found one that pulls where the numerical model is pushed back, "
            "allowed the other sign: F > 0 pushes back"
        )
    low, high = IMPULSE if kind == "contact" else WIDE
    low = WIDE[0] if clipped else low
    low, high = low - CERTAIN * error, high + CERTAIN * error
    if low <= ratio <= high:
        return
    # Damping by the compensator and a dead zone change the impulse, but not the slope of the force.
    slope = _slope_of(force, x, contacts, period, mass) or ratio
    if kind == "contact" and low <= slope <= high:
        return
    units = likely_units((ratio, slope), NEAR, momentum=not command_holds)
    units = units or " (is its unit right?)"
    raise InputError(
        f"{label}: force_measured: found {ratio:.4g} times the impulse that there was, "
        f"expected {low:.2g} to {high:.2g} times what turns {mass:g} kg round{units}"
    )


def _impulses(
    force: np.ndarray, x: np.ndarray, contacts: list[tuple[int, int]], period: float, mass: float
) -> tuple[list[float], list[float]]:
    """Return the change of momentum and the impulse of the measured force in each contact [N s]."""
    rest = at_rest(force, contacts)
    needed, made = [], []
    for begin, end in contacts:
        begin, end = begin - SMOOTH, end + SMOOTH  # There is some force below the threshold, too.
        if begin < SMOOTH or end + SMOOTH > len(x):
            begin, end = begin + SMOOTH, end - SMOOTH
        if begin < SMOOTH or end + SMOOTH > len(x):
            continue
        before = (x[begin] - x[begin - SMOOTH]) / (SMOOTH * period)
        after = (x[end + SMOOTH - 1] - x[end - 1]) / (SMOOTH * period)
        needed.append(mass * (before - after))
        made.append(period * float(np.nanmean(force[begin:end]) - rest) * (end - begin))
    return needed, made


def at_rest(force: np.ndarray, contacts: list[tuple[int, int]]) -> float:
    """Return the median reading near, but outside, the contacts [N]; a log may begin in contact."""
    beside = [force[max(0, begin - BESIDE) : max(0, begin - SMOOTH)] for begin, _ in contacts]
    beside += [force[end + SMOOTH : end + BESIDE] for _, end in contacts]
    values = np.concatenate(beside) if beside else force[:0]
    return float(np.nanmedian(values)) if np.any(np.isfinite(values)) else 0.0


def _error_of(force: np.ndarray, period: float, contacts: list[tuple[int, int]]) -> float:
    """Return the standard deviation [N s] of the impulse of all contacts due to noise."""
    steps = np.abs(np.diff(force[:SAMPLE]))
    std = 1.4826 * float(np.nanmedian(steps)) / np.sqrt(2.0)
    rows = sum(end - begin + 2 * SMOOTH for begin, end in contacts)
    return std * period * float(np.sqrt(rows))


def _slope_of(
    force: np.ndarray, x: np.ndarray, contacts: list[tuple[int, int]], period: float, mass: float
) -> float | None:
    """Return the measured force over -M x_d'' in contact, without constant and rate-dependent parts.

    Returns None if the contacts do not determine it.
    """
    rows = [np.arange(max(begin, SMOOTH), min(end, len(x) - SMOOTH)) for begin, end in contacts]
    inside = np.concatenate(rows)[:SAMPLE] if rows else np.empty(0, int)
    if len(inside) < 2 * SMOOTH:
        return None
    second = x[inside + SMOOTH] - 2.0 * x[inside] + x[inside - SMOOTH]
    needed = -mass * second / (SMOOTH * period) ** 2
    force = np.nan_to_num(force[: inside[-1] + SMOOTH])
    made = np.convolve(force, triangle(SMOOTH) / SMOOTH**2)[inside + SMOOTH - 1]
    columns = np.stack([made, np.ones(len(inside)), x[inside + SMOOTH] - x[inside - SMOOTH]], axis=1)
    size = np.linalg.norm(columns, axis=0)
    solution = np.linalg.lstsq(columns / np.where(size > 0.0, size, 1.0), needed, rcond=None)[0]
    return float(size[0] / solution[0]) if solution[0] else None


def triangle(width: int) -> np.ndarray:
    """Return the weights with which second differences over one row add up to one over `width` rows."""
    return width - np.abs(np.arange(1.0 - width, width))


def check_velocity(label: str, stretch: Stretch, period: float) -> str | None:
    """Check that velocity_desired is the rate of position_desired.

    Returns:
        None, or a note if the channel does not follow the positions and is ignored.

    Raises:
        InputError: If it follows them with another scale or sign.
    """
    x, v = stretch.channels["position_desired"], stretch.channels["velocity_desired"]
    if x is None or v is None or len(x) <= 2 * SMOOTH:
        return None
    x, v = x[:SAMPLE], v[:SAMPLE]
    moved, integrated = x[SMOOTH:] - x[:-SMOOTH], _window_sums(period * v)
    good = np.isfinite(integrated) & np.isfinite(moved)
    fit = scale(moved[good], integrated[good], SMOOTH)
    if not np.any(good) or not np.any(moved[good]):
        return None
    if fit is None or fit.left > EXPLAINED or fit.slope == 0.0:
        return f"{label}: velocity_desired: ignored, since position_desired does not move by it"
    if abs(fit.slope - 1.0) <= SPEED_ERROR + CERTAIN * fit.error:
        return None
    ratio = 1.0 / fit.slope
    raise InputError(
        f"{label}: velocity_desired: found {ratio:.4g} times the rate of position_desired, "
        f"expected 1{likely_lengths(ratio, SPEED_ERROR)}"
    )


def _window_sums(values: np.ndarray) -> np.ndarray:
    """Return sums over `SMOOTH` rows up to each row, NaN if one of the values is NaN."""
    finite = np.isfinite(values)
    summed = np.concatenate([[0.0], np.cumsum(np.where(finite, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(finite)])
    whole = summed[1 + SMOOTH :] - summed[1:-SMOOTH]
    return np.where(count[1 + SMOOTH :] - count[1:-SMOOTH] == SMOOTH, whole, np.nan)


def check_gain(label: str, kind: str, x: np.ndarray, measured: np.ndarray) -> None:
    """Raise `InputError` if the measured amplitude of a slow motion differs much from the commanded one."""
    if kind not in ("contact", "tap"):
        return
    x, measured = x[:FEW] - np.mean(x[:FEW]), measured[:FEW] - np.mean(measured[:FEW])
    shifted = [scale(measured[lag:], x[: len(x) - lag]) for lag in range(0, MOST_LAG, 8) if lag < len(x) // 2]
    fit = min(
        (candidate for candidate in shifted if candidate is not None),
        key=lambda candidate: candidate.left,
        default=None,
    )
    if fit is None or fit.left > EXPLAINED or GAIN[0] <= fit.slope <= GAIN[1]:
        return
    raise InputError(
        f"{label}: position_measured: found {fit.slope:.4g} times the motion of position_desired, "
        f"expected {GAIN[0]:g} to {GAIN[1]:g}{likely_lengths(fit.slope, 0.2) or ' (is its unit right?)'}"
    )
