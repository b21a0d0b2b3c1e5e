"""Log files of a rig as a test engineer would record them, following only the user guide.

`write_campaign` draws a rig, simulates it and writes logs, mapping file and prior. The same seed draws the
same rig for every kind, except for the property that defines the kind.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from independent_mixtures import draw_mixture
from independent_prior import mechanism_file
from independent_rig import LOGGER, POINTS, Rig, drive, touch
from pyarrow import csv, parquet
from scipy.signal import lfilter

RATES = (1000, 500, 2000)  # Hz
DECIMALS = (3, 2, 1)  # decimals of forces in N; positions in m have six more
REST, PRESS = 5.0, 40.0  # s
CLEARANCE = 0.03  # m between the surface and the middle of the free motion
STROKE = 1.5e-3  # peak of the free motion [m]
JITTER = 50e-6  # standard deviation of stamps [s]


@dataclass(frozen=True)
class Kind:
    """Kind of campaign: a change of the rig or of its log settings."""

    rig: Callable[[np.random.Generator, Rig], dict[str, Any]] = lambda rng, rig: {}
    unknown: tuple[str, ...] = ()  # keys that the prior lacks
    defect: tuple[str, ...] = ()  # a message must contain one of these words; empty for a kind without defect
    states_filter: bool = False  # the prior states kind and order of the filter, and a cutoff
    states_cut: bool = False  # the prior states that the dead zone is cut
    states_walk: bool = False  # the prior states a random walk of the bias
    states_window: bool = False  # the prior states a moving average, and a window
    noiseless: bool = False  # only rounding disturbs the readings
    sweep: bool = False  # the free motion is a swept sine in place of a multisine
    colour: float = 0.0  # standard deviation of low-frequency noise of the force [N]
    walk: float = 0.0  # N/sqrt(s), random walk of the force bias
    lost: float = 0.0  # share of lost rows; if positive, the time stamps also jitter
    force_clock: bool = False  # the force has its own time stamps and begins later
    # linear interpolation of force readings to these time stamps before logging
    resampled: bool = False
    repeats: int = 5  # contacts at each of three speeds
    free: float = 60.0  # duration of the free motion [s]
    noise: tuple[float, float] | None = None  # noise of force [N] and position [m]; drawn if None
    late: int = 0  # rows by which the measured position begins later; logs are Parquet with time stamps


def _lag(rng, rig):
    return {"filter_order": 1, "cutoff": 1 / (2 * np.pi * rng.uniform(0.0005, 0.002))}


def _dead_zone(rng, rig):
    return {"dead_zone": rng.uniform(0.5, 3.0)}


def _moving_average(rng, rig):
    return {"window": rng.uniform(0.034, 0.050)}


def _butterworth(order):
    return lambda rng, rig: {"filter_order": order, "cutoff": rng.uniform(60, 250)}


MIXTURE = "mixture"
FILTER = ("lag", "filter", "delay", "contact law")
KINDS = {
    "plain": Kind(),
    "sweep": Kind(sweep=True),
    "noiseless": Kind(noiseless=True),
    "lag": Kind(_lag),
    "dead_zone": Kind(_dead_zone),
    "damping_unknown": Kind(unknown=("contact.damping",)),
    "lag_unknown": Kind(_lag, unknown=("rig.force_sensor.time_constant",)),
    "dead_zone_unknown": Kind(_dead_zone, unknown=("rig.force_sensor.dead_zone",)),
    "delays_unknown": Kind(unknown=("rig.force_sensor.delay", "rig.simulator.delay")),
    "coloured": Kind(colour=2.0),
    "lost_rows": Kind(lost=0.0075),
    "force_clock": Kind(force_clock=True),
    "late_position": Kind(late=20),
    "butterworth_2": Kind(_butterworth(2), defect=FILTER),
    "butterworth_4": Kind(_butterworth(4), defect=FILTER),
    "butterworth_2_and_dead_zone": Kind(
        lambda rng, rig: {**_butterworth(2)(rng, rig), **_dead_zone(rng, rig)}, defect=(*FILTER, "dead zone")
    ),
    "butterworth_2_and_low_damping": Kind(
        lambda rng, rig: {**_butterworth(2)(rng, rig), "damping": 0.15 * rig.damping}, defect=FILTER
    ),
    "butterworth_2_stated": Kind(_butterworth(2), states_filter=True),
    "butterworth_4_stated": Kind(_butterworth(4), states_filter=True),
    "cut_dead_zone": Kind(
        lambda rng, rig: {"dead_zone": rng.uniform(1.0, 6.0), "cut": True}, defect=("dead zone",)
    ),
    "cut_dead_zone_stated": Kind(
        lambda rng, rig: {"dead_zone": rng.uniform(1.0, 6.0), "cut": True}, states_cut=True
    ),
    "lag_and_dead_zone": Kind(lambda rng, rig: {**_lag(rng, rig), **_dead_zone(rng, rig)}),
    "lag_and_dead_zone_unknown": Kind(
        lambda rng, rig: {**_lag(rng, rig), **_dead_zone(rng, rig)},
        unknown=("rig.force_sensor.time_constant", "rig.force_sensor.dead_zone"),
    ),
    "bias_walk": Kind(walk=0.7, defect=("bias", "drift", "noise")),
    "bias_walk_stated": Kind(walk=0.7, states_walk=True),
    "mode": Kind(
        lambda rng, rig: {"mode": 40.0, "mode_ratio": rng.uniform(0.01, 0.03)},
        defect=("contact law", "resonance", "mode"),
    ),
    "friction": Kind(
        lambda rng, rig: {"friction": rng.uniform(1.0, 4.0)}, defect=("friction", "contact law")
    ),
    "resampled_force": Kind(
        force_clock=True, resampled=True, defect=("noise", "contact law", "interpolated", "lag")
    ),
    "moving_average": Kind(_moving_average, defect=("motion", "order")),
    "moving_average_stated": Kind(_moving_average, states_window=True),
}


def get_kind(name, seed):
    """Return the kind of a name; each seed draws its own mixture."""
    return Kind(**draw_mixture(seed)) if name == MIXTURE else KINDS[name]


@dataclass(frozen=True)
class Campaign:
    """Campaign on disk, and the true rig."""

    kind: str
    seed: int
    rig: Rig
    speed: float  # speed of the slowest contacts [m/s]
    logs: list[Path]
    mapping: Path
    prior: Path

    @property
    def arguments(self):
        """Return the arguments of `jaxhil identify`, without an output folder."""
        return ["identify", *self.logs, "--map", self.mapping, "--prior", self.prior]


def draw_rig(rng):
    """Draw a rig with values of published orders of magnitude, without lag, dead zone or defect."""
    mass, omega = rng.uniform(200, 500), 2 * np.pi * rng.uniform(1.5, 4.0)
    return Rig(
        period=1 / rng.choice(RATES),
        mass=mass,
        stiffness=mass * omega**2,
        damping=2 * rng.uniform(0.005, 0.08) * mass * omega,
        plane=rng.uniform(-50e-6, 50e-6),
        frequency=rng.uniform(10, 30),
        ratio=rng.uniform(0.6, 1.0),
        drive_delay=rng.uniform(0.5e-3, 6e-3),
        force_delay=rng.uniform(1.5e-3, 5e-3),
        integrator=str(rng.choice(["semi_implicit_euler", "zoh"])),
    )


class Noise:
    """Noise of both sensors."""

    def __init__(self, rng, kind, period):
        self.rng, self.kind, self.period = rng, kind, period
        self.force_noise, self.position_noise = rng.uniform(0.1, 0.5), rng.uniform(1e-6, 5e-6)
        if kind.noise:
            self.force_noise, self.position_noise = kind.noise
        if kind.noiseless:
            self.force_noise = self.position_noise = 0.0
        self.bias = rng.uniform(-0.4, 0.4)

    def draw(self, ticks, runs=1):
        """Return new noise of force and position, one row per tick and one column per run."""
        rng, kind, shape = self.rng, self.kind, (ticks, runs)
        force = self.bias + rng.normal(0, self.force_noise, shape)
        if kind.walk:
            force += kind.walk * np.sqrt(self.period) * np.cumsum(rng.normal(size=shape), axis=0)
        if kind.colour:
            # Add noise that a first-order low-pass filter limits to 30 Hz.
            keep = np.exp(-2 * np.pi * 30.0 * self.period)
            noise = np.asarray(lfilter([1], [1, -keep], rng.normal(size=(ticks + 2000, runs)), axis=0))
            force += kind.colour * np.sqrt(1 - keep**2) * noise[2000:]
        return force, rng.normal(0, self.position_noise, shape)


def free_motion(rng, kind, period):
    """Return the commands of a free motion around 0 that starts and ends smoothly within a second."""
    time = np.arange(round(kind.free / period)) * period
    if kind.sweep:
        low, high = 0.2, 30.0
        rate = np.log(high / low) / kind.free
        motion = np.sin(2 * np.pi * low * np.expm1(rate * time) / rate)
        motion /= np.maximum(low * np.exp(rate * time) / 3.0, 1.0)
    else:
        motion = multisine(rng, time, 30.0)
    return STROKE * motion / np.abs(motion).max() * _ends(time, kind.free, 1.0)


def multisine(rng, time, highest):
    """Return a multisine of 5 s period; its amplitude is constant up to 3 Hz and falls as 1/f above."""
    frequencies = np.arange(0.2, highest, 0.2)
    size = 1 / np.maximum(frequencies / 3.0, 1.0)
    phases = rng.uniform(0, 2 * np.pi, len(frequencies))
    return sum(
        s * np.sin(2 * np.pi * f * time + p) for s, f, p in zip(size, frequencies, phases, strict=True)
    )


def _ends(time, duration, rise):
    inside = np.clip(np.minimum(time, duration - time) / rise, 0, 1)
    return (1 - np.cos(np.pi * inside)) / 2


def press_motion(rng, rig):
    """Return commands from 1 mm before the surface to a force of about 50 N, plus a multisine."""
    time = np.arange(round(PRESS / rig.period)) * rig.period
    depth = 50.0 / rig.stiffness
    motion = multisine(rng, time, 20.0)
    motion *= 0.5 * depth / np.abs(motion).max()
    inside = np.clip((np.minimum(time, PRESS - time) - 2.0) / 1.0, 0, 1)
    return rig.plane - 1e-3 + (1e-3 + depth) * _ends(time, PRESS, 2.0) + inside * motion


def _lead(rig, rng, lanes):
    """Return the campaign's compensator: a phase lead for part of the force delay."""
    lead, pole = rig.force_delay * rng.uniform(0.3, 1.0), 2 * rig.period
    state = np.zeros(lanes)

    def controller(force, position, velocity, measured):
        nonlocal state
        slope = (force - state) / (pole + rig.period)
        state = state + rig.period * slope
        return force + lead * slope

    return controller


def write_campaign(kind_name, seed, folder):
    """Simulate a campaign of a kind, write it to a folder and return it."""
    kind, rng = get_kind(kind_name, seed), np.random.default_rng([seed, 2026])
    rig, speed = draw_rig(rng), rng.uniform(3e-3, 6e-3)
    form = Form(rng, kind)
    with_press = seed % 2 == 1
    prior_factors = rng.lognormal(0, 0.15, 6)
    rig = replace(rig, **kind.rig(rng, rig))
    sensors = Noise(rng, kind, rig.period)
    folder.mkdir(parents=True, exist_ok=True)
    logs = []

    def log(name, force, command, desired, velocity, measured, logger):
        if kind.resampled:
            rows = np.arange(len(force))
            force = np.interp(rows - LOGGER / POINTS, rows, force)
        elif kind.force_clock:
            force = rig.read_force(logger + sensors.draw(len(logger))[0][:, 0])
        values = {"x_cmd": desired, "x": measured, "F": force, "F_cmd": command, "v_cmd": velocity}
        logs.append(form.write(folder / name, rng, rig.period, values))

    def open_loop(name, commands, plant):
        force, logger, position = drive(plant, commands)
        noise, position_noise = (values[:, 0] for values in sensors.draw(len(commands)))
        reading, velocity = rig.read_force(force + noise), np.gradient(commands, rig.period)
        log(name, reading, np.zeros(len(commands)), commands, velocity, position + position_noise, logger)

    aside = replace(rig, mode=0.0)  # out of contact the structure moves with the drive
    open_loop("rest", np.full(round(REST / rig.period), -CLEARANCE), aside)
    open_loop("free", free_motion(rng, kind, rig.period) - CLEARANCE, aside)
    speeds = speed * np.repeat([1.0, 2.0, 4.0], kind.repeats)
    approach = rng.uniform(0.2, 0.3, len(speeds))
    duration = max(0.7, (210 + kind.late) * rig.period) + np.pi * np.sqrt(rig.mass / rig.stiffness)
    ticks = round(duration / rig.period)
    noise, position_noise = sensors.draw(ticks, len(speeds))
    touches = touch(
        rig,
        rig.plane - speeds * approach,
        speeds,
        _lead(rig, rng, len(speeds)),
        ticks,
        lambda tick, force, position: (force + noise[tick], position + position_noise[tick]),
    )
    for index in rng.permutation(len(speeds)):
        log(f"touch_{len(logs) - 2:02d}", *touches[1:, :, index])
    if with_press:
        open_loop("press", press_motion(rng, rig), rig)
    mapping, prior = folder / "logs.toml", folder / "prior.toml"
    mapping.write_text(form.mapping(rig, with_press))
    prior.write_text(mechanism_file(rig, speed, kind, prior_factors))
    return Campaign(kind_name, seed, rig, speed, logs, mapping, prior)


class Form:
    """Units, signs, rounding and conventions of a campaign's logs."""

    def __init__(self, rng, kind):
        self.kind = kind
        self.small = bool(rng.integers(2))  # mm, kN and ms instead of SI units
        self.decimals = int(rng.choice(DECIMALS))
        self.sent = bool(rng.integers(2))  # a row contains the next tick's command
        velocity, command = rng.random() < 0.3, rng.random() < 0.7
        self.columns = ["x_cmd", "x", "F", *["F_cmd"] * command, *["v_cmd"] * velocity]
        self.sign = int(rng.choice([-1, 1]))  # sign of logged forces
        self.offset = float(rng.choice([0.0, 0.25]))  # offset of logged positions [m]
        rng.random()

    def write(self, path, rng, period, columns):
        """Write a log and return its path."""
        kind, rows = self.kind, np.arange(len(columns["F"]))
        stamps = round(rng.uniform(0, 100), 1) + rows * period
        columns = {"t": stamps, **{name: values for name, values in columns.items() if name in self.columns}}
        keep = np.ones(len(rows), bool)
        if self.sent:
            keep[-1] = False
            columns |= {name: np.roll(columns[name], -1) for name in ("x_cmd", "v_cmd") if name in columns}
        if kind.lost:
            jitter = min(JITTER, 0.1 * period)
            keep[1:] &= rng.random(len(rows) - 1) > kind.lost
            columns["t"] = stamps + np.clip(rng.normal(0, jitter, len(rows)), -4 * jitter, 4 * jitter)
        if kind.late:
            keep[-kind.late :] = False
            columns |= {"x": np.roll(columns["x"], -kind.late), "t_x": stamps + kind.late * period}
        if kind.force_clock:
            keep[-3:] = False
            columns["F"] = np.roll(columns["F"], -3)
            columns["t_F"] = stamps + (3 - LOGGER / POINTS) * period
        table = pa.table({name: self._rounded(name, values[keep]) for name, values in columns.items()})
        path = path.with_suffix(".parquet" if kind.late else ".csv")
        (parquet.write_table if kind.late else csv.write_csv)(table, path)
        return path

    def _rounded(self, name, values):
        scale, decimals = 1.0, {"F": self.decimals, "x": self.decimals + 6, "v": 6, "t": 6}[name[0]]
        if name[0] == "F":
            values = self.sign * values
        if name[0] == "x":
            values = values + self.offset
        if self.small:
            scale, fewer = {"F": (1e-3, -3), "x": (1e3, 3), "v": (1e3, 3), "t": (1e3, 3)}[name[0]]
            decimals -= fewer
        return pa.array(np.round(values * scale, max(decimals, 0)))

    def mapping(self, rig, with_press):
        """Return the mapping file of the logs."""
        length, force, time = ("mm", "kN", "ms") if self.small else ("m", "N", "s")
        place = f'unit = "{length}", offset = {-self.offset * (1e3 if self.small else 1)}'
        push = f'unit = "{force}", sign = {self.sign}'
        clock = ', time = "t_F"' if self.kind.force_clock else ""
        begin = ', time = "t_x"' if self.kind.late else ""
        channels = {
            "t": f'time = {{ column = "t", unit = "{time}" }}',
            "x_cmd": f'position_desired = {{ column = "x_cmd", {place} }}',
            "x": f'position_measured = {{ column = "x", {place}{begin} }}',
            "F": f'force_measured = {{ column = "F", {push}{clock} }}',
            "F_cmd": f'force_command = {{ column = "F_cmd", {push} }}',
            "v_cmd": f'velocity_desired = {{ column = "v_cmd", unit = "{length}/s" }}',
        }
        lines = ['schema = "jaxhil/log/1"', "[channels]", *(channels[name] for name in ["t", *self.columns])]
        lines += ["[timing]", f"control_period = {rig.period}", 'command_hold = "linear"']
        lines += [f'row = "{"sent" if self.sent else "tick"}"', f"[bodies]\nequivalent_mass = {rig.mass}"]
        runs = {
            "rest*": "rest",
            "free*": "free",
            "touch_*": "contact",
            **({"press*": "press"} if with_press else {}),
        }
        return "\n".join(
            lines + [f'[[runs]]\nfiles = "{files}"\nkind = "{run}"' for files, run in runs.items()]
        )
