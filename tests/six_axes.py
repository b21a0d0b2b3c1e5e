"""Common parts of six-axis rigs for tests."""

import jax.numpy as jnp
import numpy as np

from jaxhil.contact.laws import CONTACT_KEYS, CONTACT_LAWS, ContactParameters
from jaxhil.simulation.scenario import MotionSimulatorBatch
from jaxhil.simulation.sensors import BIAS_WALK_STREAM, white_noise
from jaxhil.simulation.timing import draw_timing
from jaxhil.sixdof.approach import begin
from jaxhil.sixdof.bodies import build_body
from jaxhil.sixdof.candidates import ChaserSpheres
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.friction import Frictionless
from jaxhil.sixdof.relative import Pose, Twist
from jaxhil.sixdof.rotations import exponential, identity
from jaxhil.sixdof.sensor import SampleErrors, Sensor, Tool
from jaxhil.sixdof.vectors import Matrix, Vector, matrix, vector

# Full inertias of a target and a chaser, in body axes [kg m^2].
FULL = (
    np.array([[1400.0, 30, -20], [30, 1100, 15], [-20, 15, 800]]),
    np.array([[150.0, 10, 5], [10, 180, -8], [5, -8, 110]]),
)


def zeros(like):
    """Return a zero vector for a batch."""
    return Vector(*(jnp.zeros_like(like) for _ in range(3)))


def lanes(values, batch=()):
    """Repeat numbers over a trailing batch axis."""
    values = np.asarray(values, float)
    spread = values.reshape(*values.shape, *[1] * len(batch))
    return jnp.asarray(np.broadcast_to(spread, (*values.shape, *batch)))


def no_tool(like):
    """Return a tool without mass."""
    return Tool(jnp.zeros_like(like), zeros(like), Matrix(zeros(like), zeros(like), zeros(like)))


def ideal_sensor(delay, **changes):
    """Return a sensor on the target side, in frame T, with a delay [s] (*batch) and no errors."""
    batch, none = delay.shape, jnp.zeros((6, *delay.shape))
    errors = SampleErrors(lanes(np.eye(6), batch), none, none, none, none + jnp.inf)
    mounting = Pose(zeros(delay), identity(delay))
    sensor = Sensor(
        delay, 0 * delay, errors, none, mounting, no_tool(delay), zeros(delay), no_tool(delay), zeros(delay),
        none, 0 * delay, none, none,
    )  # fmt: skip
    return sensor._replace(**changes)


def second_order(frequencies, dampings, delays):
    """Return a simulator with natural frequencies [Hz], damping ratios and delays [s], (axes, *batch)."""
    frequency, same = 2 * np.pi * frequencies, jnp.ones_like(delays)
    return MotionSimulatorBatch(
        jnp.stack([0 * same, frequency**2]),
        jnp.stack([same, 2 * dampings * frequency, frequency**2]),
        delays, jnp.inf * same, jnp.inf * same,
    )  # fmt: skip


def springs(stiffness, damping, exponent):
    """Return parameters of a contact law, each (candidates, *batch)."""
    zero = jnp.zeros_like(stiffness)
    parameters = {key.name: zero for key in CONTACT_KEYS.values()}
    parameters |= {"exponent": exponent, "depths": zero[:1], "tension": zero > 1}
    return ContactParameters(stiffness, damping, **parameters)


def place(values, batch=()):
    """Return a constant vector of three numbers over a batch."""
    return vector(lanes(values, batch))


def plain_body(mass, inertia, interface, batch=()):
    """Return a body with mass, inertia (3, 3) and interface, whose frame is parallel to the body frame."""
    number = lanes(mass, batch)
    return build_body(number, matrix(lanes(inertia, batch)), place(interface, batch), identity(number))


def meeting(bodies, pose, twist, before):
    """Return the bodies' states `before` [s] ahead of the given pose (p, theta) with twist (v, w).

    Pose and twist are (6, *batch).
    """
    at = Pose(vector(pose[:3]), exponential(vector(pose[3:])))
    return begin(bodies, at, Twist(vector(twist[:3]), vector(twist[3:])), before)


def spheres(centres, radii, shape, law, parameters, friction=None):
    """Return a group of spheres of the chaser, centres (3, candidates, *batch)."""
    candidates = ChaserSpheres(vector(centres), radii, shape)
    return ContactGroup(candidates, CONTACT_LAWS[law], parameters, friction or Frictionless())


def drawn_timing(scenario, ticks):
    """Return jitter [s], lost ticks and missed ticks of a scenario, as arguments of `on_the_rig`."""
    age = jnp.arange(ticks, dtype=jnp.int32)[:, None]
    draws = draw_timing(scenario.timing, scenario.key, jnp.zeros(1, jnp.int32), age)
    jitter, lost, missed = (None if effect is None else np.asarray(effect)[:, 0] for effect in draws)
    sets = {"lost": lost, "missed": missed}
    return {"jitter": jitter} | {
        name: set() if ticks is None else set(np.flatnonzero(ticks).tolist()) for name, ticks in sets.items()
    }


def drawn_bias_walk(scenario, ticks):
    """Return the change of the force sensor's bias at each tick of a scenario, (ticks, 6)."""
    count = jnp.arange(6 * ticks, dtype=jnp.int32)[:, None]
    noise = white_noise(scenario.key, jnp.full(1, BIAS_WALK_STREAM, jnp.int32), count, float)
    steps = np.asarray(noise).reshape(ticks, 6) * np.asarray(scenario.sensor.bias_walk)[:, 0]
    steps[0] = 0.0
    return np.cumsum(steps, axis=0) * float(scenario.control_period[0]) ** 0.5
