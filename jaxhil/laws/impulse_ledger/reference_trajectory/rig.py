"""Reference trajectory: motion that the numerical model should have at the time of the force readings.

    x_r'' = -F_r,    F_r = max(f(x_r, v_r) + y - f(X, V), min(0, y))

y is the force reading, f the contact model with the regressor phi, and (X, V) the motion of the hardware,
delayed like y. The trajectory is integrated once, from the onset on. When the estimate of the contact model's
parameters changes by d theta, the sensitivities s = d x_r/d theta correct the trajectory:

    x_r += s.d theta,   v_r += s'.d theta,   s'' = -[phi(x_r, v_r) - phi(X, V) + k s + b s']

k and b are the slope and the damping of the contact model at x_r. `bridge` continues the trajectory to the
present. All values are scaled as in `contact_model`.

Source: sensitivity equations, Khalil, "Nonlinear Systems" (2002), section 3.3.
"""

from math import sqrt

from jaxhil.laws.impulse_ledger.contact_model.rig import (
    DAMPING,
    DELAY,
    PARAMETERS,
    PRELOAD,
    Matrix,
    Vector,
    damping,
    dot,
    features,
    force,
    slope,
)

STEPS = 12  # number of integration steps from the last reading to the present
MAX_SCALED_SPEED = 2.0  # limit on speed / approach speed, a ratio that exceeds 1 only with added energy [1]
MAX_SCALED_DEPTH = 10.0  # limit on the depth, divided by the approach speed [s]: 3 times the depth at 0.05 Hz


class ReferenceTrajectory:
    """Reference trajectory at the time of the last reading, with its sensitivities.

    Attributes:
        depth: depth x_r, divided by the approach speed [s].
        speed: speed v_r, divided by the approach speed [1].
        force: force F_r, divided by mass and approach speed [1/s].
        deepest: largest depth so far, divided by the approach speed [s].
        released: whether the trajectory has left the surface.
    """

    __slots__ = ("_depths", "_losses", "_speeds", "_theta", "deepest", "depth", "force", "released", "speed")

    def __init__(self) -> None:
        self.begin(0.0, 1.0, [0.0] * PARAMETERS)

    def begin(self, depth: float, speed: float, theta: Vector) -> None:
        """Start the trajectory at `depth` [s] and `speed` [1], both divided by the approach speed."""
        self.depth = depth
        self.speed = speed
        self.force = 0.0
        self.deepest = depth
        self.released = False
        self._theta = theta
        self._depths = [0.0] * PARAMETERS  # s
        self._speeds = [0.0] * PARAMETERS  # s'
        self._losses = [0.0] * PARAMETERS  # work per unit of each dissipative parameter

    def correct(self, theta: Vector) -> None:
        """Correct the trajectory to first order for the contact model's new parameters `theta`."""
        changes = [new - old for new, old in zip(theta, self._theta, strict=True)]
        self._theta = theta
        if not self.released:
            self.depth = within(self.depth + dot(self._depths, changes), MAX_SCALED_DEPTH)
        self.speed = within(self.speed + dot(self._speeds, changes), MAX_SCALED_SPEED)

    def advance(self, period: float, reading: float, measured: Vector) -> None:
        """Advance the trajectory by one control period to the time of the next reading.

        Args:
            period: control period [s].
            reading: force reading y, divided by mass and approach speed [1/s].
            measured: regressor phi(X, V) of the hardware's motion.
        """
        theta = self._theta
        depth = self.depth + period * self.speed - 0.5 * (period * period) * self.force
        speed = self.speed - period * self.force
        self.deepest = max(self.deepest, depth)
        self.released = self.released or (depth <= 0.0 and speed < 0.0)
        undelayed = features(depth, speed, self.deepest, 0.0)
        push = dot(theta, undelayed) + (reading - dot(theta, measured))
        push = 0.0 if self.released else max(min(0.0, reading), push)
        if push != 0.0:
            # With larger stiffness or damping, the integration would be unstable.
            stiffness = min(slope(theta, depth), 1.0 / (period * period))
            resistance = min(damping(theta, depth), 1.0 / period)
            depths, speeds = self._depths, self._speeds
            for j in range(PARAMETERS):
                ahead = depths[j] + period * speeds[j]
                rate = undelayed[j] - measured[j] + stiffness * ahead + resistance * speeds[j]
                speeds[j] -= period * rate
                depths[j] += period * speeds[j]
            for j in range(DAMPING, PRELOAD):
                self._losses[j] += period * speed * undelayed[j]
        self.speed = within(self.speed - 0.5 * period * (self.force + push), MAX_SCALED_SPEED)
        self.depth = depth
        self.force = push

    def spread(self, covariance: Matrix, delay_variance: float) -> float:
        """Return the standard deviation of the speed, divided by the approach speed [1]: sqrt(s' P s').

        Args:
            covariance: covariance P of the contact model's parameters.
            delay_variance: variance of the delay [s^2], which replaces the variance in P.
        """
        columns = [dot(row, self._speeds) for row in covariance]
        total, variance = dot(self._speeds, columns), covariance[DELAY][DELAY]
        if variance > 0.0:
            by_delay = columns[DELAY] / variance
            total += by_delay * by_delay * (delay_variance - variance)
        return sqrt(total) if total > 0.0 else 0.0

    def imbalance(self) -> float:
        """Return the trajectory's energy loss minus the contact model's dissipation, divided by M v^2 [1]."""
        return 0.5 * (1.0 - self.speed * self.speed) - dot(self._losses, self._theta)

    def bridge(self, duration: float) -> tuple[float, float]:
        """Predict scaled force [1/s] and speed [1] at the time `duration` [s] after the last reading."""
        theta = self._theta
        step = duration / STEPS
        depth, speed, push = self.depth, self.speed, self.force
        deepest, released = self.deepest, self.released
        for _ in range(STEPS):
            depth += step * speed - 0.5 * (step * step) * push
            ahead = speed - step * push
            deepest = depth if depth > deepest else deepest
            later = force(theta, depth, ahead, deepest)
            released = released or (ahead < 0.0 and (depth <= 0.0 or later <= 0.0))
            later = 0.0 if released or later < 0.0 else later
            speed -= 0.5 * step * (push + later)
            push = later
        return push, speed


def within(value: float, limit: float) -> float:
    """Clip the value to the range from -limit to limit."""
    return max(min(value, limit), -limit)
