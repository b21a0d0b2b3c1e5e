"""Tangent model: recursive least squares, and prediction from the last reading to the present.

Along the contact's direction, the force per unit mass is F = k x + c x|x| + b x' + F_0, where x is the depth
since the onset. F and x are divided by the approach speed, so that the prior is independent of the speed.
"""

from typing import Annotated

from jaxhil.laws.impulse_ledger.six_axes.constants import (
    BEND,
    BRIDGE_STEPS,
    FEATURES,
    MAX_DAMPING,
    MAX_GROWTH,
    MAX_PUSH,
    MIN_ERROR,
    MISFIT,
)
from jaxhil.rig.types import Gains, Positive

SPREADS = "stiffness_spread", "damping_spread", "force_spread", "curvature_spread"
GROWING = FEATURES - 1  # number of regressors whose variances stop the forgetting
Features = Annotated[list[float], FEATURES]
Covariance = Annotated[list[list[float]], FEATURES, FEATURES]


class TangentModel:
    """Contact force model F = k x + c x|x| + b x' + F_0 at the depth x; forces are per unit mass.

    Attributes:
        readings: number of readings since the last restart.
        stiffness: k [1/s^2].
        curvature: c times the approach speed [1/s^3].
        damping: b [1/s].
        impulse: impulse of the last prediction, per unit mass [m/s].
        force: force at the end of the last prediction [m/s^2].
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
        self._most_damping = MAX_DAMPING / period
        self.restart()

    def restart(self) -> None:
        """Set the estimate to the prior."""
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

    def turn(self, path: float, force: float, speed: float) -> None:
        """Adapt the estimate to a turn of the contact's direction, which restarts the depth at 0.

        The stiffness becomes the slope at the last depth, the damping stays, the offset becomes `force`, and
        the curvature 0. The covariance is that of the prior.

        Args:
            path: depth at the last reading [m].
            force: force per unit mass along the new direction [m/s^2].
            speed: approach speed [m/s].
        """
        stiffness, damping, _, curvature = self._mean
        slope = max(stiffness + 2.0 * curvature * abs(path / speed) / BEND, 0.0)
        self.restart()
        self._mean = [slope, damping, force / speed, 0.0]

    def learn(self, path: float, rate: float, force: float, variance: float, speed: float) -> None:
        """Update the estimate with a reading, by recursive least squares with forgetting.

        Args:
            path: depth since the onset [m].
            rate: speed into the surface [m/s].
            force: force per unit mass [m/s^2].
            variance: variance of the noise of `force` [m^2/s^4].
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
        total = variance / (speed * speed) + misfit * misfit + MIN_ERROR * MIN_ERROR
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
        if grown < MAX_GROWTH:
            for i in range(FEATURES):
                for j in range(FEATURES):
                    covariance[i][j] *= self._growth
        self.readings += 1.0

    def settle(self, path: float, speed: float) -> None:
        """Set the model to the estimate, within bounds, at depth `path` [m] for approach `speed` [m/s]."""
        self._path = path / speed
        self._speed = speed
        stiffness, damping, _, curvature = self._mean
        self.stiffness = max(stiffness, 0.0)
        self.curvature = curvature / BEND
        self.damping = min(max(damping, 0.0), self._most_damping)

    def compute_force_change(self, change: float) -> float:
        """Return the change of the elastic force per mass [m/s^2] for a `change` of the depth [m].

        The result is 0 if force and depth would change with opposite signs.
        """
        path, speed = self._path, self._speed
        later = path + change / speed
        bend = later * abs(later) - path * abs(path)
        force = self.stiffness * change + self.curvature * speed * bend
        return max(force, 0.0) if change > 0.0 else min(force, 0.0)

    def bridge(self, force: float, least: float, deeper: float, velocity: float, duration: float) -> None:
        """Integrate the reference trajectory of a unit mass in this model; set `impulse` and `force`.

        Args:
            force: force on the reference trajectory at the last reading [m/s^2].
            least: lower bound of the force, 0 or negative [m/s^2].
            deeper: depth of the hardware minus depth of the reference trajectory, at the last reading [m].
            velocity: speed of the reference trajectory into the surface at the last reading [m/s].
            duration: time from the last reading to the end of the prediction [s].
        """
        damping = self.damping
        step = duration / BRIDGE_STEPS
        half = 0.5 * step
        start = force - self.compute_force_change(-deeper)
        divisor = 1.0 + half * damping
        depth, speed, impulse = 0.0, velocity, 0.0
        for _ in range(BRIDGE_STEPS):
            push = (
                start
                + self.compute_force_change(depth + half * speed - deeper)
                + damping * (speed - velocity)
            )
            push = min(max(push, least), MAX_PUSH) / divisor
            later = speed - push * step
            depth += half * (speed + later)
            speed = later
            impulse += push * step
        self.impulse = impulse
        push = start + self.compute_force_change(depth - deeper) + damping * (speed - velocity)
        self.force = min(max(push, least), MAX_PUSH)
