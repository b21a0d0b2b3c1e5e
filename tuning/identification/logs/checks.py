"""Checks of the mapping of each channel: unit, sign and row convention.

With a wrong sign, unit or row convention (the ticks that a row's command and readings belong to), the model
may fit the logs well but describe another rig. The numerical model is known exactly and reveals such errors.
According to Newton's law, the force command determines the position commands, and the measured force
determines the change of speed in a contact.
"""

from __future__ import annotations

import numpy as np

from jaxhil.errors import InputError
from tuning.identification.logs import contact_detection
from tuning.identification.logs.lost_rows import LogSegment
from tuning.identification.logs.scales import (
    SPEED_SPAN_TICKS,
    check_gain,
    check_impulse,
    estimate_force_beside_contacts,
)
from tuning.identification.noise import detect_resolution

MIN_LOG_ROWS = 200  # minimum number of rows in a log
MIN_FAR_SIDE_CONTACT_GAP = 0.01  # minimum time between two contacts at the second surface of a clearance [s]
MIN_FAR_SIDE_IMPULSE_SHARE = 0.3  # minimum ratio of impulse to change of momentum at the second surface
MIN_CLIPPED_READINGS = 10  # minimum number of successive readings at the maximum that shows clipping
MAX_ABSOLUTE_VALUE = 1e30  # largest valid number; time stamps in nanoseconds are about 1e18
USUAL_STROKE = 1.0  # largest range of positions without a note [m]; for press runs, largest plausible range
MAX_STROKE = 20.0  # largest plausible range of positions [m]
MIN_STROKE = 1e-5  # smallest plausible range of positions [m]
MAX_SPEED = 5.0  # largest plausible speed [m/s]
FIRST_PEAK_SHARE = 0.8  # minimum ratio of the first large peak of a correlation to the largest peak
MAX_POSITION_LAG = 400  # longest delay between position command and reading in the search [ticks]
MAX_REPEATED_SHARE = 0.4  # maximum share of repeated readings without a note
MAX_HOLD_ROWS = 20  # maximum number of rows for which a reading is held
MIN_REGULAR_SHARE = 0.9  # minimum share of equal intervals between changes that shows held readings
MIN_SPEED_CORRELATION = 0.3  # minimum correlation of desired and measured speed without a note
MAX_EVALUATED_ROWS = 200_000  # maximum number of evaluated rows; more are not needed


def check_values(label: str, name: str, values: np.ndarray) -> None:
    """Raise `InputError` if a value is not finite, or too large for a sensor reading or a time stamp."""
    bad = np.flatnonzero(~(np.abs(values) <= MAX_ABSOLUTE_VALUE))
    if len(bad):
        row, value = int(bad[0]) + 1, float(values[bad[0]])
        allowed = f"a finite number of at most {MAX_ABSOLUTE_VALUE:g}"
        raise InputError(f"{label}: row {row}: {name}: found {value:g}, expected {allowed}")


def check_motion(label: str, kind: str, segment: LogSegment, period: float, hold: str) -> list[str]:
    """Check the desired and measured positions of a segment; return notes.

    The positions must have plausible strokes and speeds, and the measured position must follow the desired
    position. With the command hold "linear", the desired position must change in every row.

    Args:
        label: Name of the log in messages.
        kind: Kind of experiment.
        segment: Segment of the log.
        period: Control period [s].
        hold: Command hold, "linear" or "zoh".

    Raises:
        InputError: If the positions are not plausible, for example because of a wrong unit or sign.
    """
    x, measured = (
        _get_channel(segment, name)[segment.valid] for name in ("position_desired", "position_measured")
    )
    if kind == "rest":
        return []
    if np.ptp(x) == 0.0:
        raise InputError(
            f'{label}: position_desired: found {x[0]:g} m in every row, expected a motion (or kind = "rest")'
        )
    if np.ptp(measured) == 0.0:
        raise InputError(
            f"{label}: position_measured: found {measured[0]:g} m in every row, expected readings that change"
        )
    notes = _check_size(label, kind, x, measured, period)
    if hold == "linear" and (rows := find_change_interval(x)) > 1:
        expected = 'one in every row, or command_hold = "zoh" if the drives hold each command so long'
        raise InputError(
            f"{label}: position_desired: found a new command every {rows} rows, expected {expected}"
        )
    return [*notes, *_note_held_readings(label, x, measured), *_check_following(label, kind, x, measured)]


def check_force(
    label: str,
    kind: str,
    segment: LogSegment,
    contacts: list[tuple[int, int]],
    period: float,
    mass: float,
    mass_is_verified: bool = False,
) -> list[str]:
    """Check the sign and unit of the measured force in a segment; return notes.

    In contacts, the force must explain the change of speed of the numerical model. In press runs, which stay
    in contact, the force must increase with the position.

    Args:
        label: Name of the log in messages.
        kind: Kind of experiment.
        segment: Segment of the log.
        contacts: For each contact, its first row and the row after its last row.
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
        mass_is_verified: Whether the logged motion has shown that the force command moves this mass.

    Returns:
        Notes, for example that the log does not have a new force reading in every row.

    Raises:
        InputError: If the force has a wrong sign or unit.
    """
    force = _get_channel(segment, "force_measured")
    readings = force[segment.valid]
    if np.ptp(readings) == 0.0:
        raise InputError(
            f"{label}: force_measured: found {readings[0]:g} N in every row, expected readings that change"
        )
    if kind == "press":
        measured = _get_channel(segment, "position_measured")[segment.valid]
        if np.corrcoef(readings, measured)[0, 1] < -0.5:
            raise InputError(
                f"{label}: force_measured: found a force that decreases when the hardware is pressed deeper, "
                "expected the other sign: F > 0 pushes back"
            )
        return _note_slow_readings(label, readings)
    top = np.abs(readings) >= np.max(np.abs(readings))
    clipped = bool(np.count_nonzero(top[1:] & top[:-1]) >= MIN_CLIPPED_READINGS)
    if kind == "contact":
        pull = np.minimum(force - estimate_force_beside_contacts(force, contacts), 0.0)
        _check_one_side(label, pull, _get_channel(segment, "position_desired"), period, mass)
    check_impulse(label, kind, segment, contacts, period, mass, mass_is_verified, clipped)
    notes = _note_slow_readings(label, readings)
    if clipped:
        notes.append(
            f"{label}: force_measured: {np.count_nonzero(top)} rows have the largest reading, as if clipped"
        )
    return notes


def _check_one_side(label: str, pull: np.ndarray, x: np.ndarray, period: float, mass: float) -> None:
    """Raise `InputError` if the log contains contacts at the second (far) surface of a clearance.

    In such a contact, the force pulls (F < 0) and turns a retraction into an approach.

    Args:
        label: Name of the log in messages.
        pull: Negative part of the force [N].
        x: Desired position [m].
        period: Control period [s].
        mass: Equivalent mass of the numerical model [kg].
    """
    for begin, end in contact_detection.detect_contacts(pull, period, 0.0, apart=MIN_FAR_SIDE_CONTACT_GAP):
        begin, end = begin - SPEED_SPAN_TICKS, end + SPEED_SPAN_TICKS
        if begin < SPEED_SPAN_TICKS or end + SPEED_SPAN_TICKS >= len(x):
            continue
        before, after = (
            (x[row] - x[row - SPEED_SPAN_TICKS]) / (SPEED_SPAN_TICKS * period)
            for row in (begin, end + SPEED_SPAN_TICKS)
        )
        impulse = -period * float(np.nansum(pull[begin:end]))
        if before < 0.0 < after and impulse > MIN_FAR_SIDE_IMPULSE_SHARE * mass * (after - before):
            raise InputError(
                f"{label}: row {begin + SPEED_SPAN_TICKS + 1}: found a contact at the second surface of a "
                "clearance (F < 0 reverses a retraction), expected only contacts that reverse an approach "
                "(F > 0); with one surface: sign = -1 in the channels of force, position and velocity"
            )


def _note_slow_readings(label: str, force: np.ndarray) -> list[str]:
    """Return a note if the log does not have a new force reading in every row."""
    rows = find_change_interval(force)
    if rows == 1:
        return []
    return [f"{label}: force_measured: a new reading only every {rows} rows: no law explains the others"]


def find_change_interval(values: np.ndarray) -> int:
    """Return for how many rows each value is held (repeated); 1 if values are not repeated regularly."""
    steps = np.diff(values[:MAX_EVALUATED_ROWS])
    apart = np.diff(np.flatnonzero(steps))
    if len(apart) < MIN_LOG_ROWS // 10:
        return 1
    usual = int(np.median(apart))
    # Rounded values of a uniform motion also change regularly, by one unit of their last digit.
    coarse = np.median(np.abs(steps[steps != 0.0])) <= 4 * detect_resolution(values)
    is_held = 1 < usual <= MAX_HOLD_ROWS and np.mean(apart == usual) > MIN_REGULAR_SHARE and not coarse
    return usual if is_held else 1


def _check_size(label: str, kind: str, x: np.ndarray, measured: np.ndarray, period: float) -> list[str]:
    """Raise `InputError` if a stroke or speed indicates a wrong unit; return notes on large strokes."""
    largest, notes = USUAL_STROKE if kind == "press" else MAX_STROKE, []
    for name, values in (("position_desired", x), ("position_measured", measured)):
        stroke = float(np.ptp(values))
        if not MIN_STROKE <= stroke <= largest:
            allowed = f"{MIN_STROKE:g} to {largest:g} m (is its unit right?)"
            raise InputError(f"{label}: {name}: found a stroke of {stroke:.3g} m, expected {allowed}")
        if stroke > USUAL_STROKE:
            notes.append(f"{label}: {name}: a stroke of {stroke:.3g} m: is its unit right?")
        speed = float(np.percentile(np.abs(values[SPEED_SPAN_TICKS:] - values[:-SPEED_SPAN_TICKS]), 95)) / (
            SPEED_SPAN_TICKS * period
        )
        if speed > MAX_SPEED:
            allowed = f"at most {MAX_SPEED:g} m/s (is its unit right?)"
            raise InputError(f"{label}: {name}: found speeds of {speed:.3g} m/s, expected {allowed}")
    ratio = float(np.ptp(measured) / np.ptp(x))
    if not 0.02 <= ratio <= 50:
        stroke_text = f"{ratio:.3g} times the stroke of position_desired"
        raise InputError(
            f"{label}: position_measured: found {stroke_text}, expected a factor of 0.02 to 50 (wrong unit?)"
        )
    return notes


def _check_following(label: str, kind: str, x: np.ndarray, measured: np.ndarray) -> list[str]:
    """Check that the measured position follows the desired one with the same sign; return notes."""
    command, reading = (
        (values[SPEED_SPAN_TICKS:] - values[:-SPEED_SPAN_TICKS])[:MAX_EVALUATED_ROWS]
        for values in (x, measured)
    )
    command, reading = command - np.mean(command), reading - np.mean(reading)
    scale = float(np.linalg.norm(command) * np.linalg.norm(reading))
    if scale == 0.0:
        return []
    lags = np.arange(-MAX_POSITION_LAG, MAX_POSITION_LAG + 1)
    lags = lags[np.abs(lags) < len(command) // 2]
    size = 2 ** int(np.ceil(np.log2(2 * len(command))))
    spectrum = np.fft.rfft(reading, size) * np.conj(np.fft.rfft(command, size))
    correlation = np.fft.irfft(spectrum, size)[lags] / scale
    best = int(np.argmax(np.abs(correlation)))
    if abs(correlation[best]) < MIN_SPEED_CORRELATION:
        strength = f"{correlation[best]:.2g}"
        return [f"{label}: position_measured: hardly follows position_desired (correlation {strength})"]
    if correlation[best] < 0 and correlation[_find_first_peak(correlation, lags)] < 0:
        raise InputError(
            f"{label}: position_measured: found a motion against position_desired, expected the same sign"
        )
    lag = int(lags[np.argmax(correlation)])
    if lag <= -2:
        finding = f"a motion {-lag} ticks earlier than position_desired"
        raise InputError(
            f"{label}: position_measured: found {finding}, expected a later one (are the two swapped?)"
        )
    check_gain(label, kind, x, measured)
    return []


def _find_first_peak(correlation: np.ndarray, lags: np.ndarray) -> int:
    """Return the index of the first large peak of either sign for which the reading is not early.

    A short run of almost a single frequency has peaks of alternating sign, half a period apart.
    """
    size = np.abs(correlation)
    peaks = 1 + np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:]))
    late = peaks[lags[peaks] >= -1]
    large = late[size[late] >= FIRST_PEAK_SHARE * np.max(size[late], initial=0.0)]
    return int(large[0]) if len(large) else int(np.argmax(size))


def _note_held_readings(label: str, x: np.ndarray, measured: np.ndarray) -> list[str]:
    """Return a note if many position readings equal the previous one although the command changes."""
    moving = np.abs(np.diff(x)) > detect_resolution(measured)
    if np.count_nonzero(moving) < MIN_LOG_ROWS // 2:
        return []
    share = float(np.mean(np.diff(measured)[moving] == 0.0))
    if share < MAX_REPEATED_SHARE:
        return []
    rows_held = 1 / (1 - share) if share < 1 else np.inf
    message = f"repeated in {100 * share:.0f} % of rows, as if each reading was held for {rows_held:.2g} rows"
    return [f"{label}: position_measured: {message}, which adds half of this time to the delay"]


def _get_channel(segment: LogSegment, name: str) -> np.ndarray:
    values = segment.channels[name]
    assert values is not None
    return values
