"""Independent simulation of six-axis rigs with latches, several contacts, legs and robots, in plain NumPy.

It follows the equations of the guide (six_axes.md, sections 1 to 6), shares no code with the package, and
reads the mechanism files itself. Numerical model and axes are those of `six_axis_oracle`. The nearest points
of two segments are the best of all candidates for a minimum; a hexapod's history is a second of real
commands. Forces act on the chaser, in T axes, with moments about T's origin.
"""

import itertools
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from six_axis_oracle import Axis, command, coordinates_and_twist, integrated, jacobian, moved, relative, skew

FILES = Path(__file__).parents[1] / "jaxhil" / "mechanism" / "builtin" / "six_axes"
LEAD_TIME = 0.02  # time from the start of a run to the first touch, without the phase [s]
MAX_STEP = 2e-3  # of the integration of the ideal contact [s]


def read(name, **approach):
    """Return a built-in mechanism's table, with changed values of `[approach]`."""
    table = tomllib.loads((FILES / f"{name}.toml").read_text())
    table["approach"] |= approach
    return table


def six(value):
    """Return six numbers for one number, a pair of translation and rotation, or a list."""
    if isinstance(value, dict):
        return np.repeat([value["translation"], value["rotation"]], 3).astype(float)
    return np.broadcast_to(np.asarray(value, float), 6)


def about_z(angle):
    return Rotation.from_rotvec([0, 0, angle]).as_matrix()


class Pair:
    """One shape of the chaser and one of the target: sphere and plane, or two capsules."""

    def __init__(self, table, turn, target_turn):
        chaser, target = table["chaser"], table["target"]
        self.is_capsule = chaser["shape"] == "capsule"
        names = ("from", "to") if self.is_capsule else ("centre",)
        self.points = [turn @ np.array(chaser[name], float) for name in names]
        self.radius = chaser["radius"]
        names = ("from", "to") if self.is_capsule else ("point", "normal")
        self.target = [target_turn @ np.array(target[name], float) for name in names]
        self.target_radius = target.get("radius", 0.0)
        self.law = table["stiffness"], table.get("exponent", 1.5), table["damping"]
        self.friction = table["friction"]
        self.deflection = np.zeros(3)

    def touch(self, p, rotation):
        """Return depth, outward normal of the target's surface, and point on the target."""
        points = [p + rotation @ point for point in self.points]
        if not self.is_capsule:
            at, normal = self.target
            normal = normal / np.linalg.norm(normal)
            distance = normal @ (points[0] - at)
            return self.radius - distance, normal, points[0] - distance * normal
        on_chaser, on_target = nearest_points(*points, *self.target)
        distance = np.linalg.norm(on_chaser - on_target)
        normal = (on_chaser - on_target) / distance
        depth = self.radius + self.target_radius - distance
        return depth, normal, on_target + self.target_radius * normal

    def force(self, p, rotation, v, w, period):
        """Return depth, force and its point; a bristle bends by one implicit step of `period`."""
        depth, normal, point = self.touch(p, rotation)
        speed = v + np.cross(w, point - p)
        rate = -normal @ speed
        stiffness, exponent, damping = self.law
        pressed = max(stiffness * max(depth, 0.0) ** exponent * (1 + 1.5 * damping * rate), 0.0)
        return depth, pressed * normal + self.rubbing(pressed, speed + rate * normal, period), point

    def rubbing(self, pressed, slip, period):
        """Return the friction for a normal force."""
        limit = self.friction["coefficient"] * pressed
        if self.friction["law"] == "regularised":
            return -limit * slip / np.hypot(np.linalg.norm(slip), self.friction["slip"])
        if limit == 0.0:
            self.deflection = np.zeros(3)
            return np.zeros(3)
        stiffness, damping = self.friction["stiffness"], self.friction["damping"]
        wear = np.linalg.norm(slip) * stiffness / limit
        self.deflection = (self.deflection + period * slip) / (1 + period * wear)
        force = -(stiffness * self.deflection + damping * slip)
        return force * min(1.0, limit / max(np.linalg.norm(force), 1e-300))


def nearest_points(a, b, c, d):
    """Return the nearest points of the segments a to b and c to d.

    The minimum is in the inside of both segments, on an end of one, or on an end of both.
    """
    u, v, apart = b - a, d - c, a - c
    matrix, right = np.array([[u @ u, -u @ v], [-u @ v, v @ v]]), np.array([-u @ apart, v @ apart])
    candidates = [np.linalg.lstsq(matrix, right, rcond=1e-12)[0]]
    for end in (0.0, 1.0):
        candidates += [(end, (right[1] + u @ v * end) / (v @ v)), ((right[0] + u @ v * end) / (u @ u), end)]
    candidates += itertools.product((0.0, 1.0), repeat=2)
    inside = [(s, t) for s, t in candidates if 0 <= s <= 1 and 0 <= t <= 1]
    return min(
        ((a + s * u, c + t * v) for s, t in inside), key=lambda ends: np.linalg.norm(ends[0] - ends[1])
    )


class Latch:
    """Point of the chaser that is caught below T's plane z = 0 and then held by a spring and a damper."""

    def __init__(self, table, turn):
        self.point = turn @ np.array(table["chaser"], float)
        self.depth, self.angle, self.speed = table["depth"], table["angle"], table.get("speed", np.inf)
        self.stiffness, self.damping = six(table["stiffness"]), six(table["damping"])
        self.caught = None

    def margin(self, p, rotation, v, w):
        """Return a number that is positive if all three conditions for catching hold."""
        arm = rotation @ self.point
        receding = (v + np.cross(w, arm))[2]
        angle = np.linalg.norm(Rotation.from_matrix(rotation).as_rotvec())
        return min(-(p + arm)[2] - self.depth, self.angle - angle, self.speed - receding)

    def force(self, p, rotation, v, w):
        """Return force, point, and moment about this point."""
        arm = rotation @ self.point
        if self.caught is None:
            return np.zeros(3), p + arm, np.zeros(3)
        place, attitude = self.caught
        turned = Rotation.from_matrix(rotation @ attitude.T).as_rotvec()
        spring = np.concatenate([p + arm - place, turned]) * self.stiffness
        damper = np.concatenate([v + np.cross(w, arm), w]) * self.damping
        moment = np.linalg.solve(jacobian(turned).T, spring[3:])
        return -spring[:3] - damper[:3], p + arm, -moment - damper[3:]


class Mechanism:
    """All pairs of shapes and latches of a mechanism."""

    def __init__(self, table):
        self.pairs, self.latches = [], []
        for contact in table["contact"].values():
            count, phase = contact.get("pattern", {}).get("count", 1), contact.get("target_pattern", {})
            for angle in 2 * np.pi * np.arange(count) / count:
                turns = about_z(angle), about_z(angle + phase.get("phase", 0.0))
                self.pairs.append(Pair(contact, *turns))
        for latch in table.get("latch", {}).values():
            count = latch.get("pattern", {}).get("count", 1)
            self.latches += [Latch(latch, about_z(2 * np.pi * k / count)) for k in range(count)]

    def gap(self, p, rotation):
        """Return the smallest distance of a pair; negative in contact."""
        return min(-pair.touch(p, rotation)[0] for pair in self.pairs)

    def margin(self, *motion):
        """Return the largest margin of a latch that has not caught, or -1."""
        return max((latch.margin(*motion) for latch in self.latches if latch.caught is None), default=-1.0)

    def catch(self, p, rotation, v, w, tolerance=0.0):
        """Let the latches catch whose margin exceeds minus the tolerance."""
        for latch in self.latches:
            if latch.caught is None and latch.margin(p, rotation, v, w) > -tolerance:
                latch.caught = p + rotation @ latch.point, rotation

    def wrench(self, p, rotation, v, w, period):
        """Return force, moment, and whether each pair touches; bristles bend for a period."""
        force, moment, touches = np.zeros(3), np.zeros(3), []
        for pair in self.pairs:
            depth, push, point = pair.force(p, rotation, v, w, period)
            touches.append(depth > 0)
            force, moment = force + push, moment + np.cross(point, push)
        for latch in self.latches:
            push, point, torque = latch.force(p, rotation, v, w)
            force, moment = force + push, moment + torque + np.cross(point, push)
        return force, moment, touches


def build_case(table):
    """Return masses, inertias, interfaces, period and initial states, as `six_axis_oracle` uses them."""
    bodies = [table["target"], table["chaser"]]
    case = {
        "masses": [body["mass"] for body in bodies],
        "inertias": [np.diag(body["inertia"]).astype(float) for body in bodies],
        "interfaces": [np.array(body["interface"], float) for body in bodies],
        "period": table["rig"]["control_period"],
    }
    return case | {"start": start(table, case)}


def start(table, case):
    """Return the bodies' states ahead of the first touch, in free flight; the target does not move."""
    approach, mechanism = table["approach"], Mechanism(table)
    offset, rotation = approach["offset"], Rotation.from_rotvec(approach["attitude"]).as_matrix()

    def gap(height):
        return mechanism.gap(np.array([*offset, height]), rotation)

    heights = np.arange(1.0, -1.0, -1e-3)
    below = next(height for height in heights if gap(height) < 0)
    p = np.array([*offset, brentq(gap, below, below + 1e-3, xtol=1e-16, rtol=1e-15)])
    v, w = (np.array(approach[key], float) for key in ("velocity", "angular_velocity"))
    (o1, o2), j = case["interfaces"], case["inertias"][1]
    velocity = v - np.cross(w, rotation @ o2)
    before = LEAD_TIME + approach.get("phase", 1 / 3) * case["period"]

    def slope(_, y):
        attitude, spin = y[:9].reshape(3, 3), y[9:]
        return np.concatenate(
            [(attitude @ skew(spin)).ravel(), np.linalg.solve(j, -np.cross(spin, j @ spin))]
        )

    begin = np.concatenate([rotation.ravel(), rotation.T @ w])
    y = solve_ivp(slope, (0, -before), begin, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    position = o1 + p - rotation @ o2 - before * velocity
    return [
        (np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3)),
        (position, velocity, y[:9].reshape(3, 3), y[9:]),
    ]


class Drives:
    """Motion simulator: six coordinates, six legs, or six coordinates of each of two robots.

    Before the first tick, the commands are those of uniform motion of the coordinates.
    """

    def __init__(self, table, at, rate):
        simulator, self.period = table["rig"]["simulator"], table["rig"]["control_period"]
        self.space, self.pose = simulator.get("space", "task"), at.copy()
        self.simulator = simulator
        keys = "natural_frequency", "damping_ratio", "delay"
        numbers = [[six(simulator[key]) for key in keys]]
        if self.space == "two_robots":
            other = simulator["target_robot"]
            self.share = six(other["share"])
            numbers.append([six(other.get(key, simulator[key])) for key in keys])
        self.delays = np.concatenate([part[2] for part in numbers])
        frequencies, ratios = (np.concatenate([part[k] for part in numbers]) for k in (0, 1))
        self.history = round(1 / self.period) if self.space == "stewart" else 0
        first = at - self.history * self.period * rate
        starts, slopes = self.split(first), self.split(first + rate) - self.split(first)
        self.axes = [
            Axis(frequency, ratio, self.period, start, slope)
            for frequency, ratio, start, slope in zip(frequencies, ratios, starts, slopes, strict=True)
        ]
        for back in range(self.history - 1, -1, -1):
            self.send(at - back * self.period * rate)

    def split(self, coordinates):
        """Return the commands of the axes for six coordinates."""
        if self.space == "task":
            return coordinates
        if self.space == "two_robots":
            return np.concatenate([(1 - self.share) * coordinates, self.share * coordinates])
        return np.linalg.norm(self.legs(coordinates)[0], axis=1)

    def legs(self, coordinates):
        """Return the legs' vectors, and their platform joints, in the axes of T."""
        simulator = self.simulator
        joints = np.array(simulator["platform"]) @ Rotation.from_rotvec(coordinates[3:]).as_matrix().T
        return simulator["height"] + coordinates[:3] + joints - np.array(simulator["base"]), joints

    def send(self, coordinates):
        for axis, value in zip(self.axes, self.split(coordinates), strict=True):
            axis.send(value)

    def motion(self, now):
        """Return position, rotation matrix, velocity, angular velocity and coordinates of the hardware."""
        each = zip(self.axes, self.delays, strict=True)
        values, rates, _ = np.array(
            [axis.response(now + self.history * self.period - own) for axis, own in each]
        ).T
        if self.space == "stewart":
            return self.forward(values, rates)
        x, rate = (part.reshape(-1, 6).sum(axis=0) for part in (values, rates))
        return x[:3], Rotation.from_rotvec(x[3:]).as_matrix(), rate[:3], jacobian(x[3:]) @ rate[3:], x

    def forward(self, lengths, rates):
        """Return the motion of `motion` for the lengths of six legs and their rates, by Newton's method."""
        x = self.pose
        for _ in range(20):
            legs, joints = self.legs(x)
            sizes = np.linalg.norm(legs, axis=1)
            units = legs / sizes[:, None]
            rows = np.hstack([units, np.cross(joints, units)])
            step = np.linalg.solve(rows, lengths - sizes)
            x = x + np.concatenate([step[:3], np.linalg.solve(jacobian(x[3:]), step[3:])])
            if np.max(np.abs(step)) < 1e-13:
                break
        self.pose = x
        twist = np.linalg.solve(rows, rates)
        return x[:3], Rotation.from_rotvec(x[3:]).as_matrix(), twist[:3], twist[3:], x


class PlantRun(NamedTuple):
    """Motion of the numerical model and real wrench at every tick, and coordinates and twist at the end."""

    coordinates: np.ndarray  # (ticks, 6)
    twist: np.ndarray  # (ticks, 6)
    wrench: np.ndarray  # (ticks, 6)
    touches: np.ndarray  # whether each pair touches, (ticks, pairs)
    final: tuple[list[float], list[float]]


def run_on_rig(table, ticks, controller, leads=0.0):
    """Simulate the rig with an exported controller; `leads` are those of `six_axis_oracle.on_the_rig`."""
    case, mechanism = build_case(table), Mechanism(table)
    bodies, period = case["start"], case["period"]
    delay = table["rig"]["force_sensor"]["delay"]
    at, rates = command(case, bodies)
    drives, rows = Drives(table, at + leads * rates, rates), []
    for tick in range(ticks):
        *motion, _ = drives.motion(tick * period - delay)
        mechanism.catch(*motion)
        *wrench, touches = mechanism.wrench(*motion, period)
        measured = drives.motion(tick * period)[4].tolist()
        desired = coordinates_and_twist(case, bodies)
        rows.append((*desired, np.concatenate(wrench), touches))
        reading = (-rows[-1][2]).tolist()  # the sensor is on the target's side and reads the reaction
        wrench_command = controller.step(controller.from_sensor(reading, measured), *desired, measured)
        bodies = moved(case, bodies, np.array(wrench_command[:3]), np.array(wrench_command[3:]))
        drives.send(np.array(controller.pose_command(*coordinates_and_twist(case, bodies))))
    return PlantRun(*map(np.array, zip(*rows, strict=True)), coordinates_and_twist(case, bodies))


def ideal_motion(table, time):
    """Return coordinates and twist after a time in the ideal contact, without bristles."""
    case, mechanism, elapsed = build_case(table), Mechanism(table), 0.0
    while True:
        step, case["start"] = integrated(
            case,
            time - elapsed,
            lambda _, *motion: mechanism.wrench(*motion, 0.0)[:2],
            mechanism.margin,
            MAX_STEP,
        )
        elapsed += step
        if elapsed > time - 1e-12:
            return coordinates_and_twist(case, case["start"])
        mechanism.catch(*relative(case, case["start"])[:4], 1e-12)
