"""Whether channels are what they are said to be: unit, sign, convention, one for the other.

A wrong sign or unit, or a row that holds another tick's command, would make a good fit of a rig that there is
not. The numerical model is known exactly, so that its own motion tells: commands follow from the logged force
command by Newton's law, and the change of speed in a contact from the measured force.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs.rows import Stretch, integrator_of

FEWEST_ROWS = 200
LARGEST_NUMBER = 1e30  # nanoseconds since an epoch are 1e18
LARGEST_STROKE = 1.0  # m
SMALLEST_STROKE = 1e-5  # m
FASTEST = 5.0  # m/s
SMOOTH = 10  # ticks, over which speeds are taken
MOST_LAG = 400  # ticks, of a reading behind its command
HELD = 0.4  # share of rows that repeat a reading, beyond which it is one that is held
LONGEST_HELD = 20  # rows
ALWAYS = 0.9  # share of the changes that come as far apart as most
FOLLOWS = 0.3  # correlation of speeds, below which a reading does not follow its command
IMPULSE = 0.2, 5.0  # measured over what the change of speed needs
SAMPLE = 200_000  # rows looked at, where some say as much as all


def check_rows(label: str, name: str, values: np.ndarray) -> None:
    """All are numbers that can be read from a sensor or a clock."""
    bad = np.flatnonzero(~(np.abs(values) <= LARGEST_NUMBER))
    if len(bad):
        row, found = int(bad[0]) + 1, float(values[bad[0]])
        allowed = f"a finite number of at most {LARGEST_NUMBER:g}"
        raise InputError(f"{label}: row {row}: {name}: found {found:g}, allowed {allowed}")


def check_motion(label: str, kind: str, stretch: Stretch, period: float, hold: str) -> list[str]:
    """Position channels of one stretch: size, excitation, one against the other; drives with the `hold`
    "linear" get a command every row. Returns notes."""
    x, measured = (_of(stretch, name)[stretch.valid] for name in ("position_desired", "position_measured"))
    if kind == "rest":
        return []
    if np.ptp(x) == 0.0:
        raise InputError(
            f"{label}: position_desired: found {x[0]:g} m in every row: nothing excites the motion simulator"
        )
    if np.ptp(measured) == 0.0:
        raise InputError(
            f"{label}: position_measured: found {measured[0]:g} m in every row, allowed a reading"
        )
    _check_size(label, x, measured, period)
    if hold == "linear" and (rows := changes_every(x)) > 1:
        allowed = 'one of every row; or command_hold = "zoh" where the drives hold it so long'
        raise InputError(
            f"{label}: position_desired: found one that changes every {rows} rows, allowed {allowed}"
        )
    return [*_held(label, x, measured), *_check_following(label, x, measured)]


def check_force(
    label: str, kind: str, stretch: Stretch, touched: list[tuple[int, int]], period: float, mass: float
):
    """Sign and unit of the measured force of contacts, by the change of speed that it makes; of a press, by
    the motion that raises it; whether it is one of every row. Returns notes."""
    force, x = _of(stretch, "force_measured"), _of(stretch, "position_desired")
    found = force[stretch.valid]
    if np.ptp(found) == 0.0:
        raise InputError(f"{label}: force_measured: found {found[0]:g} N in every row, allowed a reading")
    if kind == "press":
        measured = _of(stretch, "position_measured")[stretch.valid]
        if np.corrcoef(found, measured)[0, 1] < -0.5:
            raise _wrong_sign(label, "falls where the hardware is pushed deeper")
        return _late(label, found)
    needed, made = [], []
    for begin, end in touched:
        if begin >= SMOOTH and end + SMOOTH <= len(x):
            before = (x[begin] - x[begin - SMOOTH]) / (SMOOTH * period)
            after = (x[end + SMOOTH - 1] - x[end - 1]) / (SMOOTH * period)
            needed.append(mass * (before - after))
            made.append(period * float(np.nansum(force[begin:end])))
    ratio = float(np.dot(made, needed) / np.dot(needed, needed)) if np.any(needed) else np.nan
    if ratio < -IMPULSE[0]:
        raise _wrong_sign(label, "pulls where the numerical model is pushed back")
    if ratio > IMPULSE[1] or 0 <= ratio < IMPULSE[0]:
        allowed = f"about what turns {mass:g} kg round (is its unit right?)"
        raise InputError(
            f"{label}: force_measured: found {ratio:.3g} times the impulse that there was, allowed {allowed}"
        )
    notes = _late(label, found)
    top = np.abs(found) >= np.max(np.abs(found))
    if np.count_nonzero(top[1:] & top[:-1]) >= 10:
        notes.append(
            f"{label}: force_measured: {np.count_nonzero(top)} rows at the largest reading, as if clipped"
        )
    return notes


def _late(label: str, force: np.ndarray) -> list[str]:
    """A note where readings come more seldom than rows."""
    rows = changes_every(force)
    if rows == 1:
        return []
    return [f"{label}: force_measured: a new reading every {rows} rows alone: those between do not fit a law"]


def changes_every(values: np.ndarray) -> int:
    """Every how many rows the values change, where that is always the same; else 1."""
    steps = np.diff(values[:SAMPLE])
    apart = np.diff(np.flatnonzero(steps))
    if len(apart) < FEWEST_ROWS // 10:
        return 1
    usual = int(np.median(apart))
    # Rounded values of a steady motion change as regularly, by one unit of their last digit.
    coarse = np.median(np.abs(steps[steps != 0.0])) <= 4 * _resolution(values)
    held = 1 < usual <= LONGEST_HELD and np.mean(apart == usual) > ALWAYS and not coarse
    return usual if held else 1


def check_command(
    label: str,
    stretch: Stretch,
    period: float,
    mass: float,
    row: str,
    integrator: str = "semi_implicit_euler",
) -> list[str]:
    """That the logged commands are what the force command makes of the numerical model: M x_d'' = -F_c in the
    row convention `row`. `integrator` holds where no logged velocity tells it. Returns notes."""
    x, v, force = (stretch.channels[one] for one in ("position_desired", "velocity_desired", "force_command"))
    assert x is not None and force is not None
    integrator = integrator_of(x, v, period) or integrator
    second = x[2:] - 2 * x[1:-1] + x[:-2]
    fits: dict[tuple[int, str], tuple[float, float, float]] = {}
    for sign, written in product((1, -1), ("tick", "sent")):
        pull = _pull(-sign * period**2 / mass * force, integrator, written == "sent")
        moved = second[: len(pull)]
        known = np.isfinite(moved) & np.isfinite(pull) & (pull != 0.0)
        # A rig that is driven back between contacts moves by other commands.
        known &= np.abs(moved) <= 10 * np.max(np.abs(pull[known]), initial=0.0)
        if np.count_nonzero(known) >= FEWEST_ROWS // 4:
            moved, pull = moved[known], pull[known]
            with np.errstate(all="ignore"):
                nearest = mass * float(np.dot(pull, pull) / np.dot(pull, moved))
            fits[sign, written] = _rms(moved - pull), _rms(moved), nearest
    if not fits:
        return []
    best = min(fits, key=lambda way: fits[way][0])
    scatter, spread, nearest = fits[best]
    resolution = _resolution(x)
    if spread <= 4 * resolution:
        said = f"steps of {resolution:.2g} m are too coarse to check it by force_command"
        return [f"{label}: position_desired: {said}"]
    if scatter > 0.05 * spread:
        raise InputError(
            f"{label}: position_desired: found commands that force_command does not make of {mass:g} kg "
            f"(nearest: {nearest:.4g} kg), allowed M x_d'' = -F_c; or leave force_command out"
        )
    if best[0] < 0:
        raise InputError(
            f"{label}: force_command: found one that pulls the model forward, allowed the other sign"
        )
    told = "sent" if row == "sent" else "tick"
    if fits[1, told][0] > 1.5 * scatter + 1e-12:
        raise InputError(
            f'{label}: timing.row: found "{row}", but position_desired is what force_command makes of '
            f'{mass:g} kg ({integrator}) in rows that are "{best[1]}"'
        )
    return []


def _pull(unit: np.ndarray, integrator: str, sent: bool) -> np.ndarray:
    """x(n+1) - 2 x(n) + x(n-1) that the forces make, about rows n = 1, 2, ... that hold x(n), or x(n+1)."""
    old, new = unit[:-1], unit[1:]
    made = {"semi_implicit_euler": new, "explicit_euler": old, "zoh": (old + new) / 2}[integrator]
    return made[1:] if sent else made[: len(unit) - 2]


def _resolution(values: np.ndarray) -> float:
    """What all steps are multiples of; 0 where there is no such number."""
    steps = np.diff(np.unique(values[np.isfinite(values)][:SAMPLE]))
    least = float(np.min(steps, initial=np.inf))
    return least if np.median(np.abs(steps / least - np.rint(steps / least))) < 0.01 else 0.0


def _check_size(label: str, x: np.ndarray, measured: np.ndarray, period: float) -> None:
    """Strokes and speeds of rigs: metres taken for millimetres, and the other way round, stand out."""
    for name, values in (("position_desired", x), ("position_measured", measured)):
        stroke = float(np.ptp(values))
        if not SMALLEST_STROKE <= stroke <= LARGEST_STROKE:
            allowed = f"{SMALLEST_STROKE:g} to {LARGEST_STROKE:g} m (is its unit right?)"
            raise InputError(f"{label}: {name}: found a stroke of {stroke:.3g} m, allowed {allowed}")
        speed = float(np.percentile(np.abs(values[SMOOTH:] - values[:-SMOOTH]), 95)) / (SMOOTH * period)
        if speed > FASTEST:
            allowed = f"at most {FASTEST:g} m/s (is its unit right?)"
            raise InputError(f"{label}: {name}: found speeds of {speed:.3g} m/s, allowed {allowed}")
    ratio = float(np.ptp(measured) / np.ptp(x))
    if not 0.02 <= ratio <= 50:
        found = f"a stroke {ratio:.3g} times that of position_desired"
        raise InputError(
            f"{label}: position_measured: found {found}, allowed a like one (is its unit right?)"
        )


def _check_following(label: str, x: np.ndarray, measured: np.ndarray) -> list[str]:
    """The reading follows its command, the same way round."""
    command, reading = ((one[SMOOTH:] - one[:-SMOOTH])[:SAMPLE] for one in (x, measured))
    command, reading = command - np.mean(command), reading - np.mean(reading)
    scale = float(np.linalg.norm(command) * np.linalg.norm(reading))
    if scale == 0.0:
        return []
    lags = np.arange(-MOST_LAG, MOST_LAG + 1)
    lags = lags[np.abs(lags) < len(command) // 2]
    size = 2 ** int(np.ceil(np.log2(2 * len(command))))
    spectrum = np.fft.rfft(reading, size) * np.conj(np.fft.rfft(command, size))
    found = np.fft.irfft(spectrum, size)[lags] / scale
    lag, strength = int(lags[np.argmax(np.abs(found))]), float(found[np.argmax(np.abs(found))])
    if abs(strength) < FOLLOWS:
        return [f"{label}: position_measured: hardly follows position_desired (correlation {strength:.2g})"]
    if strength < 0:
        raise InputError(
            f"{label}: position_measured: found one that moves against the command, allowed the other sign"
        )
    if lag <= -2:
        found = f"one that leads position_desired by {-lag} ticks"
        raise InputError(
            f"{label}: position_measured: found {found}, allowed one that follows (are the two swapped?)"
        )
    return []


def _held(label: str, x: np.ndarray, measured: np.ndarray) -> list[str]:
    """A note where readings stay the same while the command moves by more than they are rounded to."""
    moving = np.abs(np.diff(x)) > _resolution(measured)
    if np.count_nonzero(moving) < FEWEST_ROWS // 2:
        return []
    share = float(np.mean(np.diff(measured)[moving] == 0.0))
    if share < HELD:
        return []
    held = 1 / (1 - share) if share < 1 else np.inf
    said = f"the same in {100 * share:.0f} % of rows, as if each reading was held for {held:.2g} of them"
    return [f"{label}: position_measured: {said}: its delay is then longer by half of that"]


def _wrong_sign(label: str, what: str) -> InputError:
    return InputError(
        f"{label}: force_measured: found one that {what}, allowed the other sign: F > 0 pushes back"
    )


def _of(stretch: Stretch, name: str) -> np.ndarray:
    values = stretch.channels[name]
    assert values is not None
    return values


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
