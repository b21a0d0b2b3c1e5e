"""What one contact says of the rig, as seven numbers that are 0 where the mechanism file is right.

All but the noise are sums of the readings less what the file's rig would have read, each reading with a
weight: so their noise is known, and so is what a change of any number of the file makes of them. The first
readings of a touch do not count: damped contact begins with a jump, and a row on its other side says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tuning.identification.monitor.readings import Readings
from tuning.identification.noise import at_rest, autoregression, whitened_share
from tuning.identification.records import Run

# Name, unit it is shown in, and that over the SI unit.
FIGURES = (
    ("stiffness", "%", 100.0),  # the force's part in phase with the depth, over the file's
    ("apparent damping", "N s/m", 1.0),  # the part in phase with the rate: damping and force delay in one
    ("mean force", "N", 1.0),  # in contact
    ("restitution", "1", 1.0),  # of the log less that of the file's rig under the same command
    ("bias", "N", 1.0),  # out of contact
    ("noise", "%", 100.0),  # of the force, over the file's
    ("lag of motion", "ms", 1e3),  # of the measured position behind that of the file's rig
)
NAMES = tuple(name for name, _, _ in FIGURES)
BIAS, NOISE, LAG = (NAMES.index(name) for name in ("bias", "noise", "lag of motion"))
FORCE = slice(0, NOISE)  # those that are sums of forces
FEWEST = 20  # rows, from which a figure is taken
POOL = 2000  # rows at rest that the noise's colour is taken of
EXACT = 1e-3  # of the largest force and depth: no model is nearer to its rig
REACH = 3.0  # standard deviations of delays and plane, by which the touch may be off
DEEP = 0.1  # of the greatest depth: rows deeper than this count at any rate


@dataclass(frozen=True)
class Weights:
    """Of one contact's readings: what its figures are made of."""

    force: np.ndarray  # (figures but noise and lag, rows); a row of NaN where the log does not tell
    position: np.ndarray  # (rows,)
    rest: np.ndarray  # bool, rows out of contact

    def shift(self, force: np.ndarray, position: np.ndarray) -> np.ndarray:
        """What readings that are higher by these make of the figures."""
        found = np.zeros(len(NAMES))
        found[FORCE] = self.force @ force
        found[LAG] = self.position @ position
        return found


@dataclass(frozen=True)
class Sensors:
    """The noise that the file states."""

    std: float  # N
    quantum: float  # N
    dead_zone: float  # N
    range: float  # N
    time_constant: float  # s


def weights(
    run: Run, expected: Readings, lane: int, sensors: Sensors, slack: tuple[float, float], mass: float,
    period: float,
) -> Weights:  # fmt: skip
    """The weights of a run's readings. `slack`: standard deviations of the delays [s] and the plane [m]."""
    rows = len(run.tick)
    parts = (expected.depth, expected.touching, expected.rate, expected.elastic, expected.force)
    depth, touching, rate, elastic, force = (part[:rows, lane] for part in parts)
    measured = np.asarray(run.force_measured, float)
    read = run.valid & np.isfinite(measured)
    speed = np.max(np.abs(np.gradient(depth, period)))
    # Through a lag the touch shows for some of its time constants.
    margin = (REACH * (slack[0] + sensors.time_constant) + period) * speed + REACH * slack[1]
    margin = min(margin, DEEP * max(float(depth.max()), 0.0))
    used = read & (depth > margin) & (touching > 0.5) & (np.abs(measured) < sensors.range)
    if sensors.dead_zone:
        used &= np.abs(force) > 4.0 * sensors.std
    rest = read & (depth < -margin) & (touching < 1e-6) & (sensors.dead_zone == 0.0)
    table = np.full((NOISE, rows), np.nan)
    tare = rest / max(rest.sum(), 1)
    if rest.sum() >= FEWEST:
        table[BIAS] = tare
    if used.sum() >= FEWEST:
        columns = np.stack([elastic, rate])[:, used]
        size = np.linalg.norm(columns, axis=1)
        table[:BIAS] = 0.0
        table[:2, used] = np.linalg.pinv((columns / size[:, None]).T) / size[:, None]
        table[2, used] = 1.0 / used.sum()
        table[3] = _restitution(run, used, mass, period)
        # The contact's own bias is taken off.
        table[:BIAS] -= table[:BIAS].sum(axis=1, keepdims=True) * tare
    return Weights(table, _lag(run, expected, lane), rest)


def _restitution(run: Run, used: np.ndarray, mass: float, period: float) -> np.ndarray:
    """Of the rebound: by momentum and energy a force r more changes e by -(sum of r v T)/(M v_0 |v_1|)."""
    x = run.position_desired
    speed = np.gradient(x, period) if run.velocity_desired is None else run.velocity_desired
    before, after = float(speed[0]), float(speed[-1])
    if before <= 0.0 or after >= -0.05 * before:
        return np.full(len(x), np.nan)
    return used * -speed * period / (mass * before * abs(after))


def _lag(run: Run, expected: Readings, lane: int) -> np.ndarray:
    """Of the position: the time by which it is behind, whatever its zero is."""
    velocity = expected.velocity[: len(run.tick), lane]
    read = run.valid & np.isfinite(run.position_measured)
    varied = np.where(read, velocity - velocity[read].mean(), 0.0)
    power = float(varied @ varied)
    return -varied / power if read.sum() >= FEWEST and power > 0.0 else np.full(len(read), np.nan)


@dataclass
class Colour:
    """The noise's rows at rest of the contacts so far: how much more of it adds up than of white noise."""

    rows: np.ndarray

    def factor(self, more: np.ndarray) -> float:
        """With more rows: standard deviation of a mean over that of a mean of white noise."""
        self.rows = np.concatenate([self.rows, more - more.mean()])[-POOL:]
        filter_ = autoregression(self.rows)
        return float(np.sqrt(whitened_share(filter_)) / abs(np.sum(filter_)))


def figures(
    run: Run, expected: Readings, lane: int, weights: Weights, sensors: Sensors,
    colours: tuple[Colour, Colour],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The figures of a contact and their covariance by the noise of its readings; NaN where it does not tell.

    `colours`: of force and position, which learn from it."""
    rows = len(run.tick)
    parts = (expected.force, expected.position, expected.velocity, expected.depth)
    force, position, velocity, depth = (part[:rows, lane] for part in parts)
    off = np.nan_to_num(np.asarray(run.force_measured, float) - force)
    late = np.nan_to_num(run.position_measured - position)
    value = weights.shift(off, late)
    value[NOISE], unsure, std = _noise(off[weights.rest], sensors, colours[0])
    left = late - late.mean() + value[LAG] * (velocity - velocity.mean())
    scatter = float(left.std()) * colours[1].factor(left) if np.isfinite(value[LAG]) else np.nan
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[FORCE, FORCE] = max(std, EXACT * np.abs(force).max()) ** 2 * weights.force @ weights.force.T
    covariance[NOISE, NOISE] = unsure**2
    covariance[LAG, LAG] = max(scatter, EXACT * depth.max()) ** 2 * weights.position @ weights.position
    return value, covariance


def _noise(rest: np.ndarray, sensors: Sensors, colour: Colour) -> tuple[float, float, float]:
    """Of the force: by how much it is above the file's, that number's standard deviation, and the standard
    deviation [N] by which readings weigh in sums."""
    stated = float(np.hypot(sensors.std, sensors.quantum / np.sqrt(12.0)))
    if len(rest) < FEWEST:
        return np.nan, np.nan, stated
    found = at_rest(rest)
    if found.silent:
        return np.nan, np.nan, stated
    spread = float(np.hypot(found.std, found.quantum / np.sqrt(12.0))) * colour.factor(rest)
    if sensors.std == 0.0:
        return np.nan, np.nan, spread
    return found.std / sensors.std - 1.0, found.std_std / sensors.std, spread
