"""Independent simulation of a six-axis rig and its contact in plain NumPy, one case at a time.

It uses rotation matrices, the matrix exponential and a Runge-Kutta method of order 8. A case is a dict:
`masses`, `inertias` and `interfaces` of target and chaser; `start`: position, velocity, rotation matrix and
angular velocity (body axes) of each; `spheres` (centre, radius), `shape` ("plane" or "drogue", with its
numbers in `numbers`), `stiffness`, `exponent`, `damping`, `friction`, `slip`; for the rig `period`,
`frequency`, `ratio` and `delays` of the six axes, `force_delay`, `position_delay`; for a sensor on the moving
side `tool` (mass, centre, inertia), `assumed` (mass, centre) and `gravity`,else None. Frame T is fixed to
the target, frame C to the chaser; `interfaces` are their origins in body axes.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation


def skew(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def jacobian(theta):
    """Return the left Jacobian of rotations by its power series."""
    total, term = np.eye(3), np.eye(3)
    for order in range(2, 30):
        term = term @ skew(theta) / order
        total = total + term
    return total


def drogue(x, half_angle, radius, bottom):
    """Return signed distance and normal of the drogue profile: a circle and a tangent line."""
    rho, z = np.hypot(x[0], x[1]), x[2] - bottom
    outward = np.array([x[0], x[1], 0.0]) / rho if rho > 0 else np.zeros(3)
    touching = radius * np.array([np.cos(half_angle), -np.sin(half_angle)])
    along = np.array([np.sin(half_angle), np.cos(half_angle)])
    if (np.array([rho, z]) - touching) @ along > 0:
        inward = np.array([-along[1], along[0]])
        return (np.array([rho, z]) - touching) @ inward, inward[0] * outward + np.array([0, 0, inward[1]])
    apart = np.hypot(rho, z)
    return radius - apart, -(rho * outward + np.array([0, 0, z])) / apart


def plane(x):
    return x[2], np.array([0.0, 0.0, 1.0])


def wrench(case, p, rotation, v, w):
    """Return the force on the chaser and the torque about T's origin."""
    force, moment = np.zeros(3), np.zeros(3)
    for centre, radius in case["spheres"]:
        x = p + rotation @ np.asarray(centre)
        distance, n = {"plane": plane, "drogue": drogue}[case["shape"]](x, *case["numbers"])
        depth, point = radius - distance, x - distance * n
        if depth <= 0:
            continue
        speed = v + np.cross(w, point - p)
        slip = speed - (n @ speed) * n
        pressed = case["stiffness"] * depth ** case["exponent"] * (1 - 1.5 * case["damping"] * (n @ speed))
        pressed = max(pressed, 0.0)
        one = pressed * (n - case["friction"] * slip / np.sqrt(slip @ slip + case["slip"] ** 2))
        force, moment = force + one, moment + np.cross(point, one)
    return force, moment


def relative(case, bodies):
    """Return pose and motion of C relative to T, and pose of T in the world.

    The first four are position, rotation matrix, velocity and angular velocity in T axes; the last two are
    the position of T's origin and the rotation matrix of T.
    """
    (r1, v1, a1, w1), (r2, v2, a2, w2) = bodies
    o1, o2 = (np.asarray(o) for o in case["interfaces"])
    world1, world2 = a1 @ w1, a2 @ w2
    apart = r2 + a2 @ o2 - r1 - a1 @ o1
    speed = v2 + np.cross(world2, a2 @ o2) - v1 - np.cross(world1, a1 @ o1) - np.cross(world1, apart)
    return a1.T @ apart, a1.T @ a2, a1.T @ speed, a1.T @ (world2 - world1), r1 + a1 @ o1, a1


def loads(case, bodies, force, moment):
    """Return force and torque on each body, in world axes."""
    *_, place, axes = relative(case, bodies)
    f, m = axes @ force, axes @ moment
    (r1, *_), (r2, *_) = bodies
    return [(-f, -m - np.cross(place - r1, f)), (f, m + np.cross(place - r2, f))]


def ideal_motion(case, time):
    """Return the bodies' states after a time, with the undelayed ideal contact."""
    return integrated(case, time, wrench)[1]


def integrated(case, time, wrench, event=None, max_step=5e-4):
    """Integrate the ideal contact under `wrench(case, ...)`; return the time of integration and the states.

    The integration ends when `event(p, rotation, v, w)` becomes positive.
    """
    inertias = [np.asarray(j) for j in case["inertias"]]

    def unpacked(y):
        return [(one[:3], one[3:6], one[6:15].reshape(3, 3), one[15:18]) for one in (y[:18], y[18:])]

    def slope(_, y):
        bodies = unpacked(y)
        loads_on_chaser = wrench(case, *relative(case, bodies)[:4])
        rates = []
        for body, (f, torque), mass, j in zip(
            bodies, loads(case, bodies, *loads_on_chaser), case["masses"], inertias, strict=True
        ):
            _, v, a, w = body
            spun = np.linalg.solve(j, a.T @ torque - np.cross(w, j @ w))
            rates += [v, f / mass, (a @ skew(w)).ravel(), spun]
        return np.concatenate(rates)

    def crossing(_, y):
        return event(*relative(case, unpacked(y))[:4])

    crossing.terminal, crossing.direction = True, 1.0
    begin = np.concatenate([np.ravel(part) for body in case["start"] for part in body])
    solution = solve_ivp(
        slope, (0, time), begin, method="DOP853", rtol=1e-12, atol=1e-14, max_step=max_step,
        events=None if event is None else crossing,
    )  # fmt: skip
    return solution.t[-1], unpacked(solution.y[:, -1])


def moved(case, bodies, force, moment):
    """Advance the numerical model by a period: velocities from the force first, then positions."""
    period, after = case["period"], []
    for (r, v, a, w), (f, torque), mass, j in zip(
        bodies, loads(case, bodies, force, moment), case["masses"], case["inertias"], strict=True
    ):
        v = v + period / mass * f
        spin = a @ np.asarray(j) @ w + period * torque
        inverse = np.linalg.inv(j)
        half = a @ Rotation.from_rotvec(period / 2 * inverse @ a.T @ spin).as_matrix()
        a = a @ Rotation.from_rotvec(period * inverse @ half.T @ spin).as_matrix()
        after.append((r + period * v, v, a, inverse @ a.T @ spin))
    return after


def command(case, bodies):
    p, rotation, v, w, *_ = relative(case, bodies)
    theta = Rotation.from_matrix(rotation).as_rotvec()
    return np.concatenate([p, theta]), np.concatenate([v, np.linalg.solve(jacobian(theta), w)])


class Axis:
    """Motion simulator axis y'' + 2 zeta w y' + w^2 y = w^2 u, which starts in steady motion.

    With the hold "zoh", steady motion is the motion after one second of uniform commands.
    """

    def __init__(self, frequency, ratio, period, at, rate, hold="linear"):
        w = 2 * np.pi * frequency
        self.flow = np.zeros((4, 4))
        self.flow[0, 1] = self.flow[2, 3] = 1
        self.flow[1] = [-(w**2), -2 * ratio * w, w**2, 0]
        self.period, self.late, self.transitions = period, 2 * ratio / w * rate, {}
        self.is_held, self.history = hold == "zoh", 0 if hold == "linear" else round(1 / period)
        self.at, self.rate = at - self.history * period * rate, rate
        self.starts = []
        self.state, self.sent = np.array([self.at - self.late, rate]), self.at
        for back in range(self.history - 1, -1, -1):
            self.send(at - back * period * rate)

    def send(self, value):
        """Set the command at the next tick."""
        slope = (value - self.sent) / self.period
        start = np.array([*self.state, value, 0] if self.is_held else [*self.state, self.sent, slope])
        self.starts.append(start)
        self.state, self.sent = (self.transition(self.period) @ start)[:2], value

    def transition(self, time):
        """Return the transition matrix of a time, rounded to 1e-14 s so that ticks share their matrices."""
        time = round(time, 14)
        if time not in self.transitions:
            self.transitions[time] = expm(self.flow * time)
        return self.transitions[time]

    def response(self, time):
        """Return y, y', y'' at a time after the first tick."""
        time += self.history * self.period
        if time <= 1e-9 * self.period:
            return np.array([self.at - self.late + self.rate * time, self.rate, 0.0])
        index = min(int(np.ceil(time / self.period - 1e-9)) - 1, len(self.starts) - 1)
        state = self.transition(time - index * self.period) @ self.starts[index]
        return np.array([state[0], state[1], (self.flow @ state)[1]])


def on_the_rig(case, ticks, controller=None, leads=0.0, jitter=None, lost=(), missed=(), bias=None):
    """Return the states of the numerical model's bodies after the given number of ticks.

    A controller's `from_sensor(reading, measured)` converts the sensor's reading, its
    `step(wrench, pose, twist, measured)` changes the wrench, and its `pose_command(pose, twist)` changes the
    command. `leads` are the times by which the controller leads the coordinates before
    the first tick. `jitter` is the deviation of the force's delay [s] at every tick; `lost` and `missed` are
    the ticks whose frame is lost, and at which the controller does not run. `bias` is the bias of the tool's
    sensor at every tick, (ticks, 6).
    """
    bodies, period = case["start"], case["period"]
    at, rates = command(case, bodies)
    if controller is not None:
        at = at + leads * rates
    axes = [
        Axis(*numbers, period, x, rate, case["hold"])
        for *numbers, x, rate in zip(case["frequency"], case["ratio"], at, rates, strict=True)
    ]

    def seen(now, delay):
        each = zip(axes, case["delays"], strict=True)
        return np.array([axis.response(now - delay - own) for axis, own in each]).T

    reading = np.zeros(3), np.zeros(3)
    for tick in range(ticks):
        late = case["force_delay"] + (0.0 if jitter is None else jitter[tick])
        x, rate, bend = seen(tick * period, late)
        theta, slopes = x[3:], jacobian(x[3:])
        rotation, w = Rotation.from_rotvec(theta).as_matrix(), slopes @ rate[3:]
        force, moment = wrench(case, x[:3], rotation, rate[:3], w)
        measured, *_ = seen(tick * period, case["position_delay"])
        frame = force, moment
        if case["tool"] is not None:
            frame = sensor_reading(case, x, rotation, w, rate, bend, force, moment)
            if bias is not None:
                frame = frame[0] + bias[tick, :3], frame[1] + bias[tick, 3:]
        reading = reading if tick in lost else frame
        if tick in missed:
            for axis in axes:
                axis.send(axis.sent)
            continue
        force, moment = reading
        if case["tool"] is not None:
            if controller is None:
                force, moment = without_tool(case, reading, measured)
            else:
                converted = controller.from_sensor(np.concatenate(reading).tolist(), measured.tolist())
                force, moment = converted[:3], converted[3:]
        if controller is not None:
            result = controller.step(
                [*force, *moment], *coordinates_and_twist(case, bodies), measured.tolist()
            )
            force, moment = np.array(result[:3]), np.array(result[3:])
        bodies = moved(case, bodies, force, moment)
        sent = command(case, bodies)[0]
        if controller is not None:
            sent = controller.pose_command(*coordinates_and_twist(case, bodies))
        for axis, value in zip(axes, sent, strict=True):
            axis.send(value)
    return bodies


def coordinates_and_twist(case, bodies):
    """Return the coordinates of frame C in frame T, and the twist, six numbers each."""
    _, _, v, w, *_ = relative(case, bodies)
    return command(case, bodies)[0].tolist(), [*v.tolist(), *w.tolist()]


def sensor_reading(case, x, rotation, w, rate, bend, force, moment):
    """Return the reading of a sensor that carries the tool, in C axes and about C's origin."""
    mass, centre, inertia = case["tool"]
    step = 1e-6
    ahead, behind = (
        jacobian(x[3:] + s * step * rate[3:]) @ (rate[3:] + s * step * bend[3:]) for s in (1, -1)
    )
    alpha = (ahead - behind) / (2 * step)
    arm = rotation @ centre
    acceleration = bend[:3] + np.cross(alpha, arm) + np.cross(w, np.cross(w, arm))
    pull = mass * (case["gravity"] - acceleration)
    j = rotation @ inertia @ rotation.T
    at_flange = moment - np.cross(x[:3], force) + np.cross(arm, pull) - j @ alpha - np.cross(w, j @ w)
    return rotation.T @ (force + pull), rotation.T @ at_flange


def without_tool(case, reading, measured):
    """Return the wrench of a reading after tool compensation, about T's origin and in T axes."""
    attitude = Rotation.from_rotvec(measured[3:]).as_matrix()
    mass, centre = case["assumed"]
    weight = mass * case["gravity"]
    force = attitude @ reading[0] - weight
    moment = attitude @ reading[1] - np.cross(attitude @ centre, weight) + np.cross(measured[:3], force)
    return force, moment
