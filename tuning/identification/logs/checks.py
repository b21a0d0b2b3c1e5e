"""Checks that channels agree with their mapping: unit, sign and row convention.

A wrong sign, a wrong unit or a row with another tick's command would give a good fit of a rig that does not
exist. The numerical model is known exactly, so its motion reveals such errors: the commands follow from the
logged force command by Newton's law, and the change of speed in a contact from the measured force.
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

MIN_LOG_ROWS = 200  # rows, shortest log
MIN_FAR_SIDE_CONTACT_GAP = 0.01  # s, least time between two contacts on the far side
MIN_FAR_SIDE_IMPULSE_SHARE = 0.3  # share of the change of momentum that shows a contact on the far side
MIN_CLIPPED_READINGS = 10  # repetitions of the largest reading that show clipping
MAX_ABSOLUTE_VALUE = 1e30  # largest valid number; nanoseconds since an epoch are 1e18
MAX_STROKE = 1.0  # m
MIN_STROKE = 1e-5  # m
MAX_SPEED = 5.0  # m/s
MAX_POSITION_LAG = 400  # ticks, largest delay of a reading behind its command
MAX_REPEATED_SHARE = 0.4  # share of repeated readings, above which a note warns of held readings
MAX_HOLD_ROWS = 20  # rows, longest regular repetition
MIN_REGULAR_SHARE = 0.9  # share of changes at the most common distance that shows regular repetition
MIN_SPEED_CORRELATION = 0.3  # correlation of speeds, below which a note says that the reading does not follow
MAX_EVALUATED_ROWS = 200_000  # rows that are sufficient


def check_values(label: str, name: str, values: np.ndarray) -> None:
    """Raise `InputError` if a value cannot be a reading of a sensor or a clock."""
    bad = np.flatnonzero(~(np.abs(values) <= MAX_ABSOLUTE_VALUE))
    if len(bad):
        row, value = int(bad[0]) + 1, float(values[bad[0]])
        allowed = f"a finite number of at most {MAX_ABSOLUTE_VALUE:g}"
        raise InputError(f"{label}: row {row}: {name}: found {value:g}, expected {allowed}")


def check_motion(label: str, kind: str, stretch: LogSegment, period: float, hold: str) -> list[str]:
    """Check the position channels of a segment: size, excitation, and agreement; return notes.

    With the `hold` "linear" the command must change in every row.
    """
    x, measured = (
        _get_channel(stretch, name)[stretch.valid] for name in ("position_desired", "position_measured")
    )
    if kind == "rest":
        return []
    if np.ptp(x) == 0.0:
        raise InputError(
            f"{label}: position_desired: found {x[0]:g} m in every row: nothing excites the motion simulator"
        )
    if np.ptp(measured) == 0.0:
        raise InputError(
            f"{label}: position_measured: found {measured[0]:g} m in every row, expected a reading"
        )
    _check_size(label, x, measured, period)
    if hold == "linear" and (rows := find_change_interval(x)) > 1:
        allowed = 'one of every row; or command_hold = "zoh" where the drives hold it so long'
        raise InputError(
            f"{label}: position_desired: found one that changes every {rows} rows, expected {allowed}"
        )
    return [*_note_held_readings(label, x, measured), *_check_following(label, kind, x, measured)]


def check_force(
    label: str,
    kind: str,
    stretch: LogSegment,
    touched: list[tuple[int, int]],
    period: float,
    mass: float,
    command_holds: bool = False,
) -> list[str]:
    """Check the sign and unit of the measured force by the change of speed, or of a press by the motion.

    `command_holds` says whether force_command moves the model.

    Returns:
        Notes, for example that the force does not have a new reading in every row.
    """
    force = _get_channel(stretch, "force_measured")
    readings = force[stretch.valid]
    if np.ptp(readings) == 0.0:
        raise InputError(f"{label}: force_measured: found {readings[0]:g} N in every row, expected a reading")
    if kind == "press":
        measured = _get_channel(stretch, "position_measured")[stretch.valid]
        if np.corrcoef(readings, measured)[0, 1] < -0.5:
            raise _make_sign_error(label, "falls where the hardware is pushed deeper")
        return _note_slow_readings(label, readings)
    top = np.abs(readings) >= np.max(np.abs(readings))
    clipped = bool(np.count_nonzero(top[1:] & top[:-1]) >= MIN_CLIPPED_READINGS)
    if kind == "contact":
        pull = np.minimum(force - estimate_force_beside_contacts(force, touched), 0.0)
        _check_one_side(label, pull, _get_channel(stretch, "position_desired"), period, mass)
    check_impulse(label, kind, stretch, touched, period, mass, command_holds, clipped)
    notes = _note_slow_readings(label, readings)
    if clipped:
        notes.append(
            f"{label}: force_measured: {np.count_nonzero(top)} rows at the largest reading, as if clipped"
        )
    return notes


def _check_one_side(label: str, pull: np.ndarray, x: np.ndarray, period: float, mass: float) -> None:
    """Raise `InputError` if a contact reverses a retracting motion, like the far surface of a clearance."""
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
                f"{label}: row {begin + SPEED_SPAN_TICKS + 1}: found a contact on the far side (F < 0 "
                "that turns "
                "falling positions round), expected contacts on the side that rising positions press (F > 0)"
            )


def _note_slow_readings(label: str, force: np.ndarray) -> list[str]:
    """Return a note if there are fewer readings than rows."""
    rows = find_change_interval(force)
    if rows == 1:
        return []
    return [f"{label}: force_measured: a new reading every {rows} rows alone: those between do not fit a law"]


def find_change_interval(values: np.ndarray) -> int:
    """Return the regular number of rows between changes of the values, or 1."""
    steps = np.diff(values[:MAX_EVALUATED_ROWS])
    apart = np.diff(np.flatnonzero(steps))
    if len(apart) < MIN_LOG_ROWS // 10:
        return 1
    usual = int(np.median(apart))
    # Rounded values of a steady motion also change regularly, by one unit of their last digit.
    coarse = np.median(np.abs(steps[steps != 0.0])) <= 4 * _detect_resolution(values)
    is_held = 1 < usual <= MAX_HOLD_ROWS and np.mean(apart == usual) > MIN_REGULAR_SHARE and not coarse
    return usual if is_held else 1


def _detect_resolution(values: np.ndarray) -> float:
    """Return the step of which all differences are multiples, or 0."""
    steps = np.diff(np.unique(values[np.isfinite(values)][:MAX_EVALUATED_ROWS]))
    least = float(np.min(steps, initial=np.inf))
    return least if np.median(np.abs(steps / least - np.rint(steps / least))) < 0.01 else 0.0


def _check_size(label: str, x: np.ndarray, measured: np.ndarray, period: float) -> None:
    """Raise `InputError` for strokes or speeds that indicate a wrong unit."""
    for name, values in (("position_desired", x), ("position_measured", measured)):
        stroke = float(np.ptp(values))
        if not MIN_STROKE <= stroke <= MAX_STROKE:
            allowed = f"{MIN_STROKE:g} to {MAX_STROKE:g} m (is its unit right?)"
            raise InputError(f"{label}: {name}: found a stroke of {stroke:.3g} m, expected {allowed}")
        speed = float(np.percentile(np.abs(values[SPEED_SPAN_TICKS:] - values[:-SPEED_SPAN_TICKS]), 95)) / (
            SPEED_SPAN_TICKS * period
        )
        if speed > MAX_SPEED:
            allowed = f"at most {MAX_SPEED:g} m/s (is its unit right?)"
            raise InputError(f"{label}: {name}: found speeds of {speed:.3g} m/s, expected {allowed}")
    ratio = float(np.ptp(measured) / np.ptp(x))
    if not 0.02 <= ratio <= 50:
        stroke_text = f"a stroke {ratio:.3g} times that of position_desired"
        raise InputError(
            f"{label}: position_measured: found {stroke_text}, expected a like one (is its unit right?)"
        )


def _check_following(label: str, kind: str, x: np.ndarray, measured: np.ndarray) -> list[str]:
    """Check that the reading follows its command with the same sign; return notes."""
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
    best = np.argmax(np.abs(correlation))
    lag, strength = int(lags[best]), float(correlation[best])
    if abs(strength) < MIN_SPEED_CORRELATION:
        return [f"{label}: position_measured: hardly follows position_desired (correlation {strength:.2g})"]
    if strength < 0:
        raise InputError(
            f"{label}: position_measured: found one that moves against the command, expected the other sign"
        )
    if lag <= -2:
        finding = f"one that leads position_desired by {-lag} ticks"
        raise InputError(
            f"{label}: position_measured: found {finding}, expected one that follows (are the two swapped?)"
        )
    check_gain(label, kind, x, measured)
    return []


def _note_held_readings(label: str, x: np.ndarray, measured: np.ndarray) -> list[str]:
    """Return a note if readings are constant while the command moves by more than their resolution."""
    moving = np.abs(np.diff(x)) > _detect_resolution(measured)
    if np.count_nonzero(moving) < MIN_LOG_ROWS // 2:
        return []
    share = float(np.mean(np.diff(measured)[moving] == 0.0))
    if share < MAX_REPEATED_SHARE:
        return []
    rows_held = 1 / (1 - share) if share < 1 else np.inf
    message = (
        f"the same in {100 * share:.0f} % of rows, as if each reading was held for {rows_held:.2g} of them"
    )
    return [f"{label}: position_measured: {message}: its delay is then longer by half of that"]


def _make_sign_error(label: str, problem: str) -> InputError:
    return InputError(
        f"{label}: force_measured: found one that {problem}, expected the other sign: F > 0 pushes back"
    )


def _get_channel(stretch: LogSegment, name: str) -> np.ndarray:
    values = stretch.channels[name]
    assert values is not None
    return values
