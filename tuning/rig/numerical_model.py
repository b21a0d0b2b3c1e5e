"""Numerical model of the docking with one axis, coupled with the controller."""

import math
from collections.abc import Sequence
from typing import Any

# Keys of the force sensor with which it reads a force without contact.
NOISE_AND_BIAS_KEYS = ("noise_std", "bias", "bias_random_walk")
APPROACH_TIME = 0.02  # time from the start of a run to the contact [s]


class NumericalModel:
    """Numerical model M x'' = -F_c of the relative motion of two free bodies.

    Mass, control period and integrator come from the gain file's mechanism. The model advances by one step in
    each control period.

    Attributes:
        start: default position [m] and velocity [m/s] at the start of a run. At this velocity, the position
            reaches the lower of 0 and `rig.contact_plane` after 0.02 s + `approach.phase` control periods.
        mass: equivalent mass of the bodies [kg].
        position: relative position of the bodies [m].
        velocity: relative velocity [m/s].
        acceleration: relative acceleration in the last period [m/s^2].
    """

    __slots__ = ("_integrator", "_period", "acceleration", "mass", "position", "start", "velocity")

    def __init__(self, mechanism: dict[str, Any]) -> None:
        bodies, rig, approach = mechanism["bodies"], mechanism["rig"], mechanism["approach"]
        mass = bodies.get("equivalent_mass")
        if mass is None:
            chaser, target = bodies["chaser_mass"], bodies["target_mass"]
            mass = chaser * (target / (chaser + target))
        self.mass, self._period = float(mass), float(rig["control_period"])
        self._integrator = rig.get("integrator", "semi_implicit_euler")
        velocity = float(approach["velocity"])
        phase = float(approach.get("phase", 1.0 / 3.0))
        nearer = min(float(rig.get("contact_plane", 0.0)), 0.0)
        self.start = nearer - velocity * (APPROACH_TIME + phase * self._period), velocity
        self.place(*self.start)

    def place(self, position: float, velocity: float) -> None:
        """Set position [m] and velocity [m/s]; the acceleration becomes 0."""
        self.position, self.velocity, self.acceleration = position, velocity, 0.0

    def integrate(self, force: float) -> None:
        """Integrate the motion for one control period, with the force command F_c [N]."""
        period, velocity = self._period, self.velocity
        acceleration = -force / self.mass
        self.velocity = velocity + period * acceleration
        self.acceleration = acceleration
        if self._integrator == "zoh":
            self.position += period * velocity + period * period * acceleration / 2.0
        elif self._integrator == "explicit_euler":
            self.position += period * velocity
        else:
            self.position += period * self.velocity


class OneAxisModelInLoop:
    """Controller and numerical model with one axis; every vector is a tuple with one number.

    Args:
        controller: controller of the gain file.
        mechanism: mechanism of the gain file.

    Attributes:
        axes: number of axes.
        command: position command [m].
        force: force command of the last tick [N].
        bodies: empty, because position and velocity describe the motion of both bodies.
    """

    __slots__ = ("_controller", "_has_noise_or_bias", "_model", "command", "force")
    axes = 1
    bodies: tuple[float, ...] = ()

    def __init__(self, controller: Any, mechanism: dict[str, Any]) -> None:
        self._controller, self._model = controller, NumericalModel(mechanism)
        sensor = mechanism["rig"].get("force_sensor", {})
        # At tick 0 the mechanism is free. Noise or bias of the sensor must not act on the numerical model.
        self._has_noise_or_bias = any(sensor.get(key, 0.0) != 0.0 for key in NOISE_AND_BIAS_KEYS)
        self.command = self.force = (0.0,)

    @property
    def motion(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return position [m] and velocity [m/s] of the numerical model."""
        return (self._model.position,), (self._model.velocity,)

    @property
    def rate(self) -> tuple[float, ...]:
        """Return the rate of the numerical model's position [m/s]."""
        return (self._model.velocity,)

    def place(self, start: Sequence[float]) -> bool:
        """Set position [m] and velocity [m/s]; use the default start if they are not finite. Return True."""
        self._model.place(*(start if all(map(math.isfinite, start)) else self._model.start))
        return True

    def begin(self) -> None:
        """Compute the position command of tick 0."""
        self.force = (0.0,)
        self._update_command()

    def tare(self, force: Sequence[float]) -> bool:
        """Add a reading without contact to the controller's tare (bias estimate); return True at its end."""
        return self._controller.tare(*force)

    def tick(self, tick: int, force: Sequence[float], position: Sequence[float], time: float) -> None:
        """Advance controller and numerical model by one period."""
        model, controller = self._model, self._controller
        command = controller.step(force[0], model.position, model.velocity, position[0], time)
        if self._has_noise_or_bias and tick == 0:
            command = 0.0
        self.force = (command,)
        model.integrate(command)
        self._update_command()

    def coast(self) -> None:
        """Advance the numerical model by one period under the last force command."""
        self._model.integrate(self.force[0])

    def _update_command(self) -> None:
        model = self._model
        command = self._controller.position_command(model.position, model.velocity, model.acceleration)
        self.command = (command,)
