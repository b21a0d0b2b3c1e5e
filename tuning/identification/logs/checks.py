"""Whether channels are what they are said to be: unit, sign, convention, one for the other.

A wrong sign or unit, or a row that holds another tick's command, would make a good fit of a rig that there is
not. The numerical model is known exactly, so that its own motion tells: commands follow from the logged force
command by Newton's law, and the change of speed in a contact from the measured force.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs import segments
from tuning.identification.logs.rows import Stretch
from tuning.identification.logs.scales import SMOOTH, at_rest, check_gain, check_impulse

FEWEST_ROWS = 200
APART = 0.01  # s, between two contacts on one side
PULLED = 0.3  # share of a change of momentum that readings must explain
CLIPPED = 10  # repeats of the largest reading, from which it is a limit
LARGEST_NUMBER = 1e30  # nanoseconds since an epoch are 1e18
LARGEST_STROKE = 1.0  # m
SMALLEST_STROKE = 1e-5  # m
FASTEST = 5.0  # m/s
MOST_LAG = 400  # ticks, of a reading behind its command
HELD = 0.4  # share of rows that repeat a reading, beyond which it is one that is held
LONGEST_HELD = 20  # rows
ALWAYS = 0.9  # share of the changes that come as far apart as most
FOLLOWS = 0.3  # correlation of speeds, below which a reading does not follow its command
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
    return [*_held(label, x, measured), *_check_following(label, kind, x, measured)]


def check_force(
    label: str,
    kind: str,
    stretch: Stretch,
    touched: list[tuple[int, int]],
    period: float,
    mass: float,
    command_holds: bool = False,
) -> list[str]:
    """Check sign and unit of the measured force: of contacts by the change of speed, of a press by motion.

    `command_holds`: whether force_command was found to move the model.

    Returns notes, such as that not every row has a reading of its own."""
    force = _of(stretch, "force_measured")
    found = force[stretch.valid]
    if np.ptp(found) == 0.0:
        raise InputError(f"{label}: force_measured: found {found[0]:g} N in every row, allowed a reading")
    if kind == "press":
        measured = _of(stretch, "position_measured")[stretch.valid]
        if np.corrcoef(found, measured)[0, 1] < -0.5:
            raise _wrong_sign(label, "falls where the hardware is pushed deeper")
        return _late(label, found)
    top = np.abs(found) >= np.max(np.abs(found))
    clipped = bool(np.count_nonzero(top[1:] & top[:-1]) >= CLIPPED)
    if kind == "contact":
        pull = np.minimum(force - at_rest(force, touched), 0.0)
        _check_one_side(label, pull, _of(stretch, "position_desired"), period, mass)
    check_impulse(label, kind, stretch, touched, period, mass, command_holds, clipped)
    notes = _late(label, found)
    if clipped:
        notes.append(
            f"{label}: force_measured: {np.count_nonzero(top)} rows at the largest reading, as if clipped"
        )
    return notes


def _check_one_side(label: str, pull: np.ndarray, x: np.ndarray, period: float, mass: float) -> None:
    """Raise `InputError` if a contact turns falling positions round, as the far side of a clearance does."""
    for begin, end in segments.contacts(pull, period, 0.0, apart=APART):
        begin, end = begin - SMOOTH, end + SMOOTH
        if begin < SMOOTH or end + SMOOTH >= len(x):
            continue
        before, after = ((x[row] - x[row - SMOOTH]) / (SMOOTH * period) for row in (begin, end + SMOOTH))
        impulse = -period * float(np.nansum(pull[begin:end]))
        if before < 0.0 < after and impulse > PULLED * mass * (after - before):
            raise InputError(
                f"{label}: row {begin + SMOOTH + 1}: found a contact on the far side (F < 0 that turns "
                "falling positions round), allowed contacts on the side that rising positions press (F > 0)"
            )


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


def _check_following(label: str, kind: str, x: np.ndarray, measured: np.ndarray) -> list[str]:
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
    check_gain(label, kind, x, measured)
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
