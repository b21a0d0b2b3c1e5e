"""Balance of impulses: detects contact, predicts the reference to the present, computes the command."""

from math import sqrt

from jaxhil.laws.impulse_ledger.six_axes.constants import (
    AHEAD,
    HIGHEST,
    MAX_RECALL,
    MIN_SHARE,
    MIN_SPEED,
    MIN_STIFFNESS,
    MIN_TWIST,
    TURNED,
)
from jaxhil.laws.impulse_ledger.six_axes.reading.rig import ModelRows, SixAxisReader
from jaxhil.laws.impulse_ledger.six_axes.tangent_model.rig import TangentModel
from jaxhil.rig.six_axes.registry import ModelConstants
from jaxhil.rig.six_axes.vectors import AXES, Matrix, Vector, add_multiple, dot, multiply, product, subtract
from jaxhil.rig.types import Gains, Positive


class Ledger:
    """State of one contact, and the impulse that is still missing on the numerical model.

    Attributes:
        delay: delay D of the loop [ticks].
        tangent: model of the contact force along the contact's direction.
        is_limited: whether the last correction of the impulse was limited in norm.
    """

    __slots__ = (
        "_command", "_corrected", "_correction_limit", "_deeper", "_direction", "_drift", "_impulse",
        "_inverse", "_least_delay", "_longest", "_mass", "_mixed", "_modelled", "_path", "_peak", "_period",
        "_pole", "_position_gain", "_speed", "_unpaid", "_velocity_gain", "delay", "is_limited", "tangent",
    )  # fmt: skip
    _period: Positive
    _inverse: Matrix
    _mass: Matrix

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None:
        self._period = period
        self._mass = constants.mass_matrix
        self._inverse = constants.inverse_mass
        self._velocity_gain = gains["velocity_gain"]
        self._position_gain = gains["position_gain"]
        self._correction_limit = gains["correction_limit"]
        self._pole = gains["direction_pole"]
        self._least_delay = gains["identification_delay"] / period
        self._longest = constants.longest_delay / period
        if not self._longest <= MAX_RECALL:
            raise ValueError(f"a delay of {self._longest!r} periods, expected at most {MAX_RECALL!r}")
        self.tangent = TangentModel(gains, period)
        self.reset()

    def reset(self) -> None:
        """Forget all contacts."""
        self.delay = 0.0
        self.is_limited = False
        self._speed = 1.0  # v_0, approach speed along the contact's direction
        self._impulse = [0.0] * AXES  # I_r, impulse of the reference up to t - D
        self._drift = [0.0] * AXES  # eps, pose of the model at t - D minus the reference's pose
        self._mixed = [0.0] * AXES  # filtered wrench, whose sign a pulling force does not reverse
        self._direction = [0.0] * AXES  # w, unit wrench of the contact's direction
        self._modelled = [0.0] * AXES  # direction at the last restart of the tangent model
        self._unpaid = [0.0] * AXES  # L, impulse that the model still owes
        self._command = [0.0] * AXES
        self._corrected = 0.0  # F_r, force on the reference
        self._deeper = 0.0  # depth of the hardware minus depth of the reference
        self._path = 0.0  # X, depth of the hardware along the direction since the onset
        self._peak = 0.0  # largest force so far, per unit mass
        self.tangent.restart()

    def begin(self, reader: SixAxisReader, pose_desired: Vector, twist_desired: Vector) -> None:
        """Begin a contact: set its direction, delay and speed (equation b); `follow` sets the impulse."""
        wrench = list(reader.wrench)
        direction = multiply(1.0 / self._size(wrench), wrench)
        if not reader.is_recent:
            if reader.has_flown:
                self._approach(direction, reader.lag, reader.twist)
            else:
                self._approach(direction, subtract(pose_desired, reader.pose), twist_desired)
            reader.tool = 0.0
        self._mixed = wrench
        self._direction = direction
        self._modelled = list(direction)
        self._drift = [0.0] * AXES
        self._path = 0.0
        self._peak = 0.0

    def _approach(self, direction: Vector, lag: Vector, twist: Vector) -> None:
        """Compute the loop's delay and the approach speed from the hardware's `lag` and model's `twist`."""
        momentum = product(self._mass, twist)
        whole = dot(twist, momentum)
        speed = sqrt(whole) if whole > 0.0 else 0.0
        closing = -dot(direction, twist)
        # If the contact's direction is perpendicular to the motion, use the mean delay of all directions.
        delay = dot(lag, momentum) / (whole + MIN_TWIST * MIN_TWIST)
        if closing > MIN_SHARE * speed + MIN_TWIST:
            delay = -dot(direction, lag) / closing
        self.delay = min(max(delay / self._period, self._least_delay), self._longest)
        self._speed = max(closing, MIN_SPEED * speed + MIN_TWIST)

    def follow(self, reader: SixAxisReader, commanded: Vector, begins: bool) -> Vector:
        """Process one reading of a contact; return the command wrench about the chaser's origin C.

        Args:
            reader: reader with the reading of this tick.
            commanded: I_c, impulse commanded so far [N s, N m s].
            begins: whether the contact begins with this reading.
        """
        recalled = reader.recall_model(self.delay)
        if begins:
            self._impulse = list(recalled[12:18])
        self._turn(reader, begins)
        wrench, direction = reader.wrench, self._direction
        force = dot(wrench, product(self._inverse, direction))
        self._book(reader, recalled, force)
        self._peak = max(self._peak, abs(force))
        stiffness = max(self.tangent.stiffness, MIN_STIFFNESS)
        self._unpaid = subtract(commanded, self._impulse)
        self._command = [0.0] * AXES
        gain = 0.0
        if reader.loud:
            ahead = (self.delay + AHEAD) * self._period
            rest = add_multiple(wrench, -force, direction)
            last = 0.0
            if self._corrected != 0.0:
                gain = self._position_gain
                last = self._bridge(recalled, min(force, 0.0), stiffness, ahead)
            self._unpaid = add_multiple(self._unpaid, -ahead, rest)
            self._command = add_multiple(rest, last, direction)
        reader.weigh_tool()
        # Compute the command wrench (equation e).
        pulled = add_multiple(self._unpaid, gain, product(self._mass, self._drift))
        return add_multiple(self._command, 1.0, self._correction(pulled, stiffness))

    def _book(self, reader: SixAxisReader, recalled: ModelRows, force: float) -> None:
        """Update the tangent model, and advance the reference trajectory to the time t - D (equation c).

        D is the loop's delay: a reading at the time t belongs to the model's motion at t - D.
        """
        period, direction, tangent = self._period, self._direction, self.tangent
        rate = -dot(direction, reader.moved) / period
        if reader.loud:
            tangent.learn(self._path, rate, force, reader.variance, self._speed)
        tangent.settle(self._path, self._speed)
        missing = product(self._inverse, subtract(recalled[12:18], self._impulse))
        self._drift = add_multiple(self._drift, period, missing)
        offset = subtract(reader.pose, recalled[0:6])
        self._deeper = -(dot(direction, offset) + dot(direction, self._drift))
        faster = rate + dot(direction, recalled[6:12]) - dot(direction, missing)
        self._corrected = force
        if reader.loud:
            correction = tangent.compute_force_change(-self._deeper) - tangent.damping * faster
            self._corrected = max(force + correction, min(force, 0.0))
        self._impulse = add_multiple(self._impulse, period, reader.wrench)
        self._impulse = add_multiple(self._impulse, period * (self._corrected - force), direction)

    def _bridge(self, recalled: ModelRows, least: float, stiffness: float, ahead: float) -> float:
        """Predict the reference trajectory from t - D to the middle of the command's period (equation d).

        Return the contact force at the end; subtract the predicted impulse from `_unpaid`.
        """
        direction, tangent = self._direction, self.tangent
        missing = product(self._inverse, subtract(recalled[12:18], self._impulse))
        velocity = dot(direction, missing) - dot(direction, recalled[6:12])
        tangent.bridge(self._corrected, least, self._deeper, velocity, ahead)
        self._unpaid = add_multiple(self._unpaid, -tangent.impulse, direction)
        expected = max(sqrt(stiffness) * self._speed, self._peak)
        return min(tangent.force, HIGHEST * expected)

    def unpaid_share(self) -> float:
        """Return the norm of the missing impulse, divided by that of the reference trajectory's impulse."""
        return self._size(self._unpaid) / self._size(self._impulse)

    def _turn(self, reader: SixAxisReader, begins: bool) -> None:
        """Update the contact's direction and the depth; adapt the tangent model if the direction has turned.

        A pulling force, for example of a latch, does not reverse the direction.
        """
        if reader.loud and not begins:
            old, pole = self._mixed, self._pole
            along = dot(old, product(self._inverse, reader.wrench))
            sign = -1.0 if along < 0.0 else 1.0
            self._mixed = [
                sign * now + pole * (before - sign * now)
                for before, now in zip(old, reader.wrench, strict=True)
            ]
            self._direction = multiply(1.0 / self._size(self._mixed), self._mixed)
        direction = self._direction
        turns = begins
        if begins:
            self.tangent.restart()
        elif reader.loud and dot(self._modelled, product(self._inverse, direction)) < TURNED:
            # If the direction turns, the contact is at a different surface.
            turns = True
            force = dot(reader.wrench, product(self._inverse, direction))
            self.tangent.turn(self._path, force, self._speed)
        if turns:
            self._modelled = list(direction)
            self._path = 0.0
        else:
            self._path -= dot(direction, reader.moved)

    def _correction(self, unpaid: Vector, stiffness: float) -> Vector:
        """Return the wrench, limited in norm, that reduces the impulse error `unpaid` [N s, N m s]."""
        wrench = multiply(-self._velocity_gain, unpaid)
        limit = self._correction_limit * sqrt(stiffness) * self._speed
        square = dot(wrench, product(self._inverse, wrench))
        size = sqrt(square) if square > 0.0 else 0.0
        self.is_limited = size > limit
        if size > limit:
            return multiply(limit / size, wrench)
        return wrench

    def _size(self, wrench: Vector) -> float:
        """Return the norm |W| = sqrt(W . M^-1 W) of a wrench W, with the mass matrix M; 1 if W is 0."""
        square = dot(wrench, product(self._inverse, wrench))
        return sqrt(square) if square > 0.0 else 1.0
