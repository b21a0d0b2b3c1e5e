"""Numerical model of the docking with six axes, coupled with the controller.

The model has two free rigid bodies, target and chaser, like `jaxhil.sixdof.relative`, but in plain Python.
The state of a body has 13 numbers, in world axes: position [m] and velocity [m/s] of the centre of mass,
quaternion (w, x, y, z) of the rotation from body axes, and angular momentum about the centre of mass
[kg m^2/s]. The states of both bodies have 26 numbers, those of the target first.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

BODY_NUMBERS = 13  # number of values in the state of a body
MAX_NORM_ERROR = 1e-6  # largest difference of a start's quaternion from norm 1
MAX_ANGLE = 1e6  # largest rotation in a period that is computed [rad], because sin(inf) is an error
# Fraction of a period's velocity change that acts on the position in the same period.
SHARES = {"semi_implicit_euler": 1.0, "zoh": 0.5, "explicit_euler": 0.0}

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class FreeBody(NamedTuple):
    """Rigid body with an interface frame."""

    mass: float  # [kg]
    inverse_inertia: Sequence[Triple]  # rows of the inverse inertia, in body axes [1/(kg m^2)]
    interface: Triple  # origin of the interface frame, in body axes [m]
    interface_attitude: Quaternion  # rotation from interface axes to body axes


class BodyMotion(NamedTuple):
    """Motion of a rigid body, in world axes."""

    position: Triple  # position of the centre of mass [m]
    velocity: Triple  # velocity of the centre of mass [m/s]
    attitude: Quaternion  # rotation from body axes to world axes
    spin: Triple  # angular momentum about the centre of mass [kg m^2/s]


class SixAxisModelInLoop:
    """Controller and numerical model with six axes.

    Args:
        controller: controller of the gain file.
        mechanism: mechanism of the gain file.

    Attributes:
        axes: number of axes.
        command: pose command [m, rad].
        force: wrench command of the last tick, about the origin of the target's interface frame T [N, N m].
        motion: pose [m, rad] and twist [m/s, rad/s] of the chaser's interface frame C relative to T.
    """

    __slots__ = ("_bodies", "_controller", "_period", "_share", "_states", "command", "force", "motion")
    axes = 6

    def __init__(self, controller: Any, mechanism: dict[str, Any]) -> None:
        self._controller, self._period = controller, float(mechanism["rig"]["control_period"])
        self._share = SHARES[mechanism["rig"].get("integrator", "semi_implicit_euler")]
        self._bodies = tuple(build_body(mechanism[name]) for name in ("target", "chaser"))
        self._states: tuple[BodyMotion, ...] = ()
        zero = (0.0,) * self.axes
        self.command: tuple[float, ...] = zero
        self.force: tuple[float, ...] = zero
        self.motion: tuple[tuple[float, ...], tuple[float, ...]] = zero, zero

    @property
    def bodies(self) -> tuple[float, ...]:
        """Return the states of both bodies; zeros before the first run."""
        numbers = tuple(number for state in self._states for part in state for number in part)
        return numbers or (0.0,) * 2 * BODY_NUMBERS

    @property
    def rate(self) -> tuple[float, ...]:
        """Return the time derivatives of position and rotation vector in the model's pose [m/s, rad/s].

        For a rotation by the angle theta, a power series gives the derivative of the rotation vector, with a
        relative error of theta^4/720.
        """
        (_, _, _, *rotation), (*velocity, a, b, c) = self.motion
        angular = a, b, c
        once = _cross(rotation, angular)
        twice = _cross(rotation, once)
        turning = (w - u / 2 + v / 12 for w, u, v in zip(angular, once, twice, strict=True))
        return (*velocity, *turning)

    def place(self, start: Sequence[float]) -> bool:
        """Set the states of both bodies; return False if they are not finite or not rotations."""
        states = tuple(_build_state(start[at : at + BODY_NUMBERS]) for at in (0, BODY_NUMBERS))
        norms = (math.hypot(*state.attitude) for state in states)
        if not all(map(math.isfinite, start)) or any(abs(norm - 1.0) > MAX_NORM_ERROR for norm in norms):
            return False
        self._states = states
        self._observe()
        return True

    def begin(self) -> None:
        """Compute the pose command of tick 0."""
        self.force = (0.0,) * self.axes
        self._update_command()

    def tare(self, force: Sequence[float]) -> bool:
        """Add a reading without contact to the controller's tare (bias estimate); return True at its end."""
        return self._controller.tare(force)

    def tick(self, tick: int, force: Sequence[float], position: Sequence[float], time: float) -> None:
        """Advance controller and numerical model by one period."""
        self.force = tuple(self._controller.step(force, *self.motion, position, time))
        self.coast()
        self._update_command()

    def coast(self) -> None:
        """Advance the numerical model by one period under the last wrench command."""
        (target, chaser), (origin, axes, *_) = self._states, _interface(self._bodies[0], self._states[0])
        force, moment = _rotate(axes, self.force[:3]), _rotate(axes, self.force[3:])
        reaction = tuple(-value for value in force)
        on_target, on_chaser = (
            _add(moment, _cross(_subtract(origin, state.position), force)) for state in (target, chaser)
        )
        self._states = (
            self._move(self._bodies[0], target, reaction, tuple(-value for value in on_target)),
            self._move(self._bodies[1], chaser, force, on_chaser),
        )
        self._observe()

    def _move(
        self, body: FreeBody, state: BodyMotion, force: Sequence[float], torque: Sequence[float]
    ) -> BodyMotion:
        """Integrate the motion of a body for one period under a constant force and torque in world axes."""
        period, share = self._period, self._share
        kick = [period / body.mass * value for value in force]
        spin = [value + share * period * part for value, part in zip(state.spin, torque, strict=True)]

        def turned(attitude: Quaternion, duration: float) -> Quaternion:
            """Rotate the initial attitude for `duration` [s] at the body's angular velocity at `attitude`."""
            angular = _product(body.inverse_inertia, _rotate(_reverse(attitude), spin))
            return _compose(state.attitude, _exponential([duration * value for value in angular]))

        attitude = turned(turned(state.attitude, period / 2), period)
        w, x, y, z = attitude
        # Versions of Python differ in the rounding of `sum`.
        norm = math.sqrt(w * w + x * x + y * y + z * z) or math.nan
        w, x, y, z = (part / norm for part in attitude)
        positions = zip(state.position, state.velocity, kick, strict=True)
        a, b, c = (at + period * (rate + share * more) for at, rate, more in positions)
        momentum = _add(state.spin, [period * part for part in torque])
        return BodyMotion((a, b, c), _add(state.velocity, kick), (w, x, y, z), momentum)

    def _observe(self) -> None:
        """Compute pose and twist of the chaser's interface frame C relative to the target's frame T."""
        (origin, axes, velocity, angular), chaser = map(_interface, self._bodies, self._states)
        apart = _subtract(chaser[0], origin)
        back = _reverse(axes)
        linear = _subtract(_subtract(chaser[2], velocity), _cross(angular, apart))
        pose = (*_rotate(back, apart), *_logarithm(_compose(back, chaser[1])))
        twist = (*_rotate(back, linear), *_rotate(back, _subtract(chaser[3], angular)))
        self.motion = pose, twist

    def _update_command(self) -> None:
        self.command = tuple(self._controller.pose_command(*self.motion))


def build_body(table: Mapping[str, Any]) -> FreeBody:
    """Build a body from a table of the mechanism file."""
    inertia = table["inertia"]
    if not isinstance(inertia[0], (list, tuple)):
        inertia = [[value if i == j else 0.0 for j in range(3)] for i, value in enumerate(inertia)]
    x, y, z = inertia
    columns = _cross(y, z), _cross(z, x), _cross(x, y)
    (a, b, c), (u, v, w) = x, columns[0]
    determinant = a * u + b * v + c * w
    a, b, c = zip(*columns, strict=True)
    inverse = [(row[0] / determinant, row[1] / determinant, row[2] / determinant) for row in (a, b, c)]
    rotation = _exponential(table.get("interface_rotation", (0.0, 0.0, 0.0)))
    interface = _add(table.get("interface", (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0))
    return FreeBody(float(table["mass"]), inverse, interface, rotation)


def _build_state(numbers: Sequence[float]) -> BodyMotion:
    a, b, c, u, v, w, q, x, y, z, r, s, t = numbers
    return BodyMotion((a, b, c), (u, v, w), (q, x, y, z), (r, s, t))


def _interface(body: FreeBody, state: BodyMotion) -> tuple[Triple, Quaternion, Triple, Triple]:
    """Return origin, attitude, velocity and angular velocity of a body's interface frame, in world axes."""
    attitude = state.attitude
    angular = _rotate(attitude, _product(body.inverse_inertia, _rotate(_reverse(attitude), state.spin)))
    offset = _rotate(attitude, body.interface)
    return (
        _add(state.position, offset),
        _compose(attitude, body.interface_attitude),
        _add(state.velocity, _cross(angular, offset)),
        angular,
    )


def _add(left: Sequence[float], right: Sequence[float]) -> Triple:
    return left[0] + right[0], left[1] + right[1], left[2] + right[2]


def _subtract(left: Sequence[float], right: Sequence[float]) -> Triple:
    return left[0] - right[0], left[1] - right[1], left[2] - right[2]


def _cross(left: Sequence[float], right: Sequence[float]) -> Triple:
    (a, b, c), (x, y, z) = left, right
    return b * z - c * y, c * x - a * z, a * y - b * x


def _product(rows: Sequence[Sequence[float]], vector: Sequence[float]) -> Triple:
    """Return the product of a matrix (a tuple of rows) and a vector."""
    x, y, z = vector
    first, second, third = (row[0] * x + row[1] * y + row[2] * z for row in rows)
    return first, second, third


def _reverse(rotation: Quaternion) -> Quaternion:
    w, x, y, z = rotation
    return w, -x, -y, -z


def _compose(second: Quaternion, first: Quaternion) -> Quaternion:
    """Return the product of two rotations: `first`, followed by `second`."""
    (a, x, y, z), (b, u, v, w) = second, first
    return (
        a * b - x * u - y * v - z * w,
        a * u + b * x + y * w - z * v,
        a * v + b * y + z * u - x * w,
        a * w + b * z + x * v - y * u,
    )


def _rotate(rotation: Quaternion, vector: Sequence[float]) -> Triple:
    w, *axis = rotation
    a, b, c = _cross(axis, vector)
    along = 2.0 * a, 2.0 * b, 2.0 * c
    once, twice = [w * value for value in along], _cross(axis, along)
    return vector[0] + once[0] + twice[0], vector[1] + once[1] + twice[1], vector[2] + once[2] + twice[2]


def _exponential(theta: Sequence[float]) -> Quaternion:
    """Convert a rotation vector [rad] to a quaternion; the result is NaN above `MAX_ANGLE`."""
    x, y, z = theta
    angle = math.sqrt(x * x + y * y + z * z)
    if not angle < MAX_ANGLE:
        return math.nan, math.nan, math.nan, math.nan
    scale = math.sin(angle / 2) / angle if angle > 0.0 else 0.5
    return math.cos(angle / 2), scale * x, scale * y, scale * z


def _logarithm(rotation: Quaternion) -> Triple:
    """Convert a quaternion to its rotation vector [rad], with a norm of at most pi."""
    w, x, y, z = rotation if rotation[0] >= 0.0 else tuple(-part for part in rotation)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 0.0 else 2.0
    return scale * x, scale * y, scale * z
