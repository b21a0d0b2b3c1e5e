"""Tangent model: recursive least squares, and the bridge from the last reading to the present.

Along the contact's direction the force on a unit mass is F = k x + c x|x| + b x' + F_0, with the depth x
since the onset. The estimate is of F over the approach speed, so that its prior does not depend on the speed.
"""

from typing import Annotated

from jaxhil.laws.impulse_ledger.six_axes.constants import (
    BEND,
    BRIDGE_STEPS,
    FEATURES,
    LEAST_ERROR,
    MISFIT,
    MOST_DAMPING,
    MOST_GROWTH,
)
from jaxhil.rig.types import Gains, Positive

SPREADS = "stiffness_spread", "damping_spread", "force_spread", "curvature_spread"
GROWING = FEATURES - 1  # features whose variances are compared with the prior's
Features = Annotated[list[float], FEATURES]
Covariance = Annotated[list[list[float]], FEATURES, FEATURES]


class TangentModel:
    """Estimate of the tangent model, and the model at the depth of the last reading, per unit mass.

    Attributes:
        readings: readings since the estimate began.
        stiffness: k [1/s^2].
        curvature: c over the approach speed [1/s^3].
        damping: b [1/s].
        impulse: impulse of the last bridge.
        force: last force of the last bridge.
    """

    __slots__ = (
        "_covariance", "_growth", "_mean", "_most_damping", "_path", "_prior", "_speed", "curvature",
        "damping", "force", "impulse", "readings", "stiffness",
    )  # fmt: skip
    _covariance: Covariance
    _mean: Features

    def __init__(self, gains: Gains, period: Positive) -> None:
        self._prior = [gains[name] * gains[name] for name in SPREADS]
        self._growth = gains["forgetting"] ** (-period / 1e-3)
        self._most_damping = MOST_DAMPING / period
        self.restart()

    def restart(self) -> None:
        """Return to the prior."""
        self._mean = [0.0] * FEATURES
        self._covariance = [[0.0] * FEATURES for _ in range(FEATURES)]
        for j in range(FEATURES):
            self._covariance[j][j] = self._prior[j]
        self.readings = 0.0
        self._path = 0.0
        self._speed = 1.0
        self.stiffness = 0.0
        self.curvature = 0.0
        self.damping = 0.0
        self.impulse = 0.0
        self.force = 0.0

    def learn(self, path: float, rate: float, force: float, variance: float, speed: float) -> None:
        """Update the estimate with a reading, by recursive least squares with forgetting.

        Args:
            path: depth [m].
            rate: speed into the surface [m/s].
            force: force on a unit mass [m/s^2].
            variance: variance of its noise.
            speed: approach speed [m/s].
        """
        depth = path / speed
        features = [depth, rate / speed, 1.0, depth * abs(depth) / BEND]
        scaled = force / speed
        covariance, mean = self._covariance, self._mean
        column = [
            row[0] * features[0] + row[1] * features[1] + row[2] * features[2] + row[3] * features[3]
            for row in covariance
        ]
        misfit = MISFIT * scaled
        total = variance / (speed * speed) + misfit * misfit + LEAST_ERROR * LEAST_ERROR
        innovation = scaled
        for phi, entry, value in zip(features, column, mean, strict=True):
            total += phi * entry
            innovation -= value * phi
        grown = 0.0
        for i in range(FEATURES):
            share = column[i] / total
            mean[i] += share * innovation
            for j in range(FEATURES):
                covariance[i][j] -= share * column[j]
            if i < GROWING:
                grown += covariance[i][i] / self._prior[i]
        if grown < MOST_GROWTH:
            for i in range(FEATURES):
                for j in range(FEATURES):
                    covariance[i][j] *= self._growth
        self.readings += 1.0

    def settle(self, path: float, speed: float) -> None:
        """Set the model at a depth [m] from the estimate; `speed` is the approach speed [m/s]."""
        self._path = path / speed
        self._speed = speed
        stiffness, damping, _, curvature = self._mean
        self.stiffness = max(stiffness, 0.0)
        self.curvature = curvature / BEND
        self.damping = min(max(damping, 0.0), self._most_damping)

    def restoring(self, change: float) -> float:
        """Return the change of the elastic force for a change of the depth [m]."""
        path, speed = self._path, self._speed
        later = path + change / speed
        bend = later * abs(later) - path * abs(path)
        return self.stiffness * change + self.curvature * speed * bend

    def bridge(self, force: float, least: float, deeper: float, velocity: float, duration: float) -> None:
        """Compute impulse and last force of the reference from the last reading to the present.

        A unit mass moves against the model.

        Args:
            force: force on the reference at the last reading.
            least: least force, 0 or negative.
            deeper: depth of the hardware beyond that of the reference, at the last reading.
            velocity: speed of the reference into the surface.
            duration: time to bridge [s].
        """
        damping = self.damping
        step = duration / BRIDGE_STEPS
        half = 0.5 * step
        start = force - self.restoring(-deeper)
        divisor = 1.0 + half * damping
        depth, speed, impulse = 0.0, velocity, 0.0
        for _ in range(BRIDGE_STEPS):
            push = start + self.restoring(depth + half * speed - deeper) + damping * (speed - velocity)
            push = max(push, least) / divisor
            later = speed - push * step
            depth += half * (speed + later)
            speed = later
            impulse += push * step
        self.impulse = impulse
        push = start + self.restoring(depth - deeper) + damping * (speed - velocity)
        self.force = max(push, least)
