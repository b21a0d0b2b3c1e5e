"""Simulated campaigns with known true parameters: 60 s of multisine and 15 contacts, without JAX.

All contacts are simulated together, one lane each. The motion simulator's output is exact at any time (matrix
exponentials of the oracle's state space). The contact force is the oracle's law at the sampling time of the
sensor; the sensor lag is computed by numerical integration. `test_campaigns.py` compares lanes with
`oracle.simulate`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from campaign_kinds import KINDS
from oracle_contact import Law
from oracle_motion import simulator_matrices
from scipy.linalg import expm
from scipy.signal import lfilter

from tuning.identification.records import Campaign, CampaignTiming, LoggedRun

SPEEDS = tuple(np.repeat([0.003, 0.006, 0.012], 5))
NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)
NODES, WEIGHTS = (NODES + 1.0) / 2.0, WEIGHTS / 2.0


def multisine(period=0.001, length=5.0, highest=45.0, rms=0.0008, seed=0):
    """Return one period [m] of odd harmonics up to `highest` [Hz], every fourth omitted, random phases."""
    rows = round(length / period)
    odd = np.arange(1, int(highest * length) + 1, 2)
    lines = odd[(np.arange(len(odd)) + 1) % 4 != 0]
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(lines))
    spectrum = np.zeros(rows // 2 + 1, complex)
    spectrum[lines] = np.exp(1j * phases)
    wave = np.fft.irfft(spectrum, rows)
    return wave * rms / np.sqrt(np.mean(wave**2))


class Plant:
    """Motion simulator in discrete time, with output rows for any time within a period."""

    def __init__(self, rig):
        self.T, self.hold = rig["control_period"], rig.get("command_hold", "linear")
        self.latency = rig.get("command_latency", 0)
        self.A, self.B, self.C = simulator_matrices(rig["simulator"])
        self.state, self.start, self.end = self.after(1.0)

    def after(self, part):
        """Return the state after part of a period from the state and the inputs at both ends of this part."""
        n = len(self.B)
        system = np.zeros((n + 2, n + 2))
        system[:n, :n], system[:n, n], system[n, n + 1] = self.A * self.T, self.B * self.T, 1.0
        full = expm(system * part)[:n]
        return full[:, :n], full[:, n] - full[:, n + 1], full[:, n + 1]

    def rows(self, part):
        """Return output rows of position and velocity for (state, input at start, input at end)."""
        state, start, end = self.after(part)
        position = np.array([*(self.C @ state), self.C @ start, self.C @ end])
        rate = self.C @ self.A
        velocity = np.array([*(rate @ state), rate @ start, rate @ end])
        through = self.C @ self.B
        velocity[-2] += through * (1.0 - part)
        velocity[-1] += through * part
        return position, velocity

    def uniform(self, position, velocity):
        """Return the state in uniform motion: input `position` now, with `velocity` per period."""
        closed = np.eye(len(self.B)) - self.state
        both = self.start + self.end
        ahead = both if self.hold == "zoh" else self.end
        slope = np.linalg.solve(closed, np.outer(both, velocity))
        return np.linalg.solve(closed, np.outer(both, position) + np.outer(ahead, velocity) - slope)


def free(kind, seed, seconds=60.0):
    """Return command and position reading [m] of the multisine, starting from rest."""
    rig, rng = kind.rig, np.random.default_rng(seed)
    T = rig["control_period"]
    one = multisine(T, rms=kind.amplitude, seed=int(rng.integers(1 << 30)))
    command = np.tile(one, round(seconds / T / len(one)))
    return command, _position(Plant(rig), command, _total_delay(rig) / T)


def _total_delay(rig):
    return rig["simulator"].get("delay", 0.0) + rig.get("position_sensor", {}).get("delay", 0.0)


def _position(plant, command, lag):
    """Return the motion simulator's position at the ticks, delayed by `lag` ticks.

    The command was constant before the first tick.
    """
    history = int(np.ceil(lag)) + plant.latency + 3
    c = np.concatenate([np.full(history, command[0]), command])
    # Inputs at the ends of interval `latency` of `c` and of the following intervals.
    end = c[1 : len(c) - plant.latency]
    start = end if plant.hold == "zoh" else c[: len(c) - 1 - plant.latency]
    poles, vectors = np.linalg.eig(plant.state)
    drive = np.linalg.solve(vectors, np.outer(plant.start, start) + np.outer(plant.end, end))
    first = np.linalg.solve(vectors, plant.uniform(c[:1], np.zeros(1))[:, 0])
    states = np.empty((len(poles), len(end) + 1), complex)
    states[:, 0] = first
    for i, pole in enumerate(poles):
        states[i, 1:], _ = lfilter([1.0], [1.0, -pole], drive[i], zi=[pole * first[i]])
    state = (vectors @ states).real
    whole = np.floor(lag + 1e-9)
    row, _ = plant.rows(1.0 - (lag - whole) if lag - whole > 1e-9 else 1.0)
    k = np.arange(len(command)) - 1 - int(whole) + history - plant.latency
    return row[:-2] @ state[:, k] + row[-2] * start[k] + row[-1] * end[k]


def touches(kind, speeds, indices, phases, rng, seconds=0.42, lead=0.05, damping=0.35, noise=True):
    """Return the signals of contacts at every tick, each (ticks, lanes).

    The compensation during the contacts is a filtered force with additional damping of the numerical model,
    which limits the rebound. The estimators do not use it.
    """
    rig, T, mass = kind.rig, kind.rig["control_period"], kind.mass
    plant, law = Plant(rig), Law(kind.contact, rig.get("contact_plane", 0.0))
    sensor, lanes = rig["force_sensor"], len(speeds)
    v = np.array(speeds, float)
    x = -v * (lead + np.asarray(phases) * T)
    position_lag = _total_delay(rig) / T
    force_lag = (rig["simulator"].get("delay", 0.0) + sensor.get("delay", 0.0)) / T
    time_constant = sensor.get("time_constant", 0.0) / T
    history = int(np.ceil(max(position_lag, force_lag))) + plant.latency + 4
    ticks = round(seconds / T)
    c = np.empty((history + ticks + 1, lanes))
    c[: history + 1] = x + v * T * np.arange(-history, 1)[:, None]
    states = np.empty((history + ticks + 1, len(plant.B), lanes))
    first = plant.latency + 2

    def ends(k):
        """Return the motion simulator's inputs at both ends of interval k of the rows of `c`."""
        end = c[k + 1 - plant.latency]
        return (end if plant.hold == "zoh" else c[k - plant.latency]), end

    states[first] = plant.uniform(ends(first - 1)[1], v * T)

    def advance(k):
        start, end = ends(k)
        states[k + 1] = plant.state @ states[k] + np.outer(plant.start, start) + np.outer(plant.end, end)

    for k in range(first, history):
        advance(k)

    def reader(lag):
        whole = np.floor(lag + 1e-9)
        part = 1.0 - (lag - whole) if lag - whole > 1e-9 else 1.0
        rows = plant.rows(part)

        def read(k):
            k = k - 1 - int(whole)
            start, end = ends(k)
            return [row[:-2] @ states[k] + row[-2] * start + row[-1] * end for row in rows]

        return read

    read_position = reader(position_lag)
    back = [force_lag] if time_constant == 0.0 else [force_lag + 1.0 - node for node in NODES]
    kernels = (
        None if time_constant == 0.0 else WEIGHTS * np.exp((NODES - 1.0) / time_constant) / time_constant
    )
    read_force = [reader(lag) for lag in back]
    groups = [(index, np.flatnonzero(np.asarray(indices) == index)) for index in np.unique(indices)]
    grown = 1.0 + kind.drift * np.arange(lanes) / max(lanes - 1, 1)

    def force_of(position, velocity):
        depth, total = position - law.plane, np.zeros(lanes)
        for index, members in groups:
            raw = law.raw(depth[members], velocity[members], int(index))
            raw = np.maximum(raw, 0.0) if law.clamped(int(index)) else raw
            total[members] = np.where(depth[members] > 0.0, raw, 0.0)
        return total * grown

    colour, std = kind.colour, sensor.get("noise_std", 0.0) * noise
    force_noise = _coloured(rng, (ticks, lanes), std, colour)
    std = rig["position_sensor"].get("noise_std", 0.0) * noise
    position_noise = _coloured(rng, (ticks, lanes), std, colour)
    names = ("position_desired", "velocity_desired", "position_measured", "force_measured", "force_command")
    log = {name: np.empty((ticks, lanes)) for name in names}
    lagged, filtered = np.zeros(lanes), np.zeros(lanes)
    viscous = 2.0 * damping * np.sqrt(mass * np.max(np.asarray(kind.contact["stiffness"]).clip(max=4e5)))
    for n in range(ticks):
        k = n + history
        actual, _ = read_position(k)
        forces = [force_of(*read(k)) for read in read_force]
        if kernels is None:
            force = forces[0]
        else:
            lagged = np.exp(-1.0 / time_constant) * lagged + kernels @ np.array(forces)
            force = lagged
        measured = sense(force + force_noise[n], sensor)
        position = _rounded(actual + position_noise[n], rig["position_sensor"].get("quantum", 0.0))
        filtered = filtered + (measured - filtered) * min(1.0, T / 0.002)
        command = filtered + viscous * v * (x > law.plane) if damping else measured
        if n == 0:
            command = np.zeros(lanes)
        for name, value in zip(names, (x, v, position, measured, command), strict=True):
            log[name][n] = value
        v = v - T * command / mass
        x = x + T * v
        c[k + 1] = x
        advance(k)
    return log


def sense(force, sensor):
    """Apply bias, quantisation, dead zone and range, in this order; `force` already contains noise."""
    force = _rounded(force + sensor.get("bias", 0.0), sensor.get("quantum", 0.0))
    force = np.sign(force) * np.maximum(0.0, np.abs(force) - sensor.get("dead_zone", 0.0))
    limit = sensor.get("range", np.inf)
    return np.clip(force, -limit, limit)


def _rounded(value, quantum):
    return quantum * np.round(value / quantum) if quantum > 0.0 else value


def _coloured(rng, shape, std, pole):
    """Return noise of this standard deviation along axis 0: white, or filtered by one pole."""
    white = rng.standard_normal(shape)
    if pole == 0.0:
        return std * white
    drive = white * np.sqrt(1.0 - pole**2)
    drive[0] = white[0]
    return std * lfilter([1.0], [1.0, -pole], drive, axis=0)


def campaign(name, seed, speeds=SPEEDS, seconds=60.0, rest=5.0, press=False) -> Campaign:
    """Return a campaign of this kind: rest, free motion, contacts, and a press run if requested."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, len(name)])
    runs = []
    if rest:
        runs.append(_rest_run(kind, rng, rest))
    if seconds:
        runs.append(_free_run(kind, rng, seconds))
    if len(speeds):
        runs += _touch_runs(kind, rng, speeds)
    if press:
        runs.append(_press_run(kind, rng))
    timing = CampaignTiming(
        kind.rig["control_period"],
        kind.rig.get("command_hold", "linear"),
        kind.rig.get("command_latency", 0),
        "tick",
        None,
    )
    return Campaign(tuple(runs), timing, kind.mass, {})


def _rest_run(kind, rng, seconds):
    rig, rows = kind.rig, round(seconds / kind.rig["control_period"])
    command = np.full(rows, -0.02)
    force = sense(_coloured(rng, rows, rig["force_sensor"]["noise_std"], kind.colour), rig["force_sensor"])
    return _run(kind, "rest", command, _measured(kind, rng, command), force)


def _free_run(kind, rng, seconds):
    command, actual = free(kind, int(rng.integers(1 << 30)), seconds)
    rig = kind.rig
    offset = -0.05  # out of contact [m]
    force = _coloured(rng, len(command), rig["force_sensor"]["noise_std"], kind.colour)
    force = sense(force, rig["force_sensor"])
    run = _run(kind, "free", command + offset, _measured(kind, rng, actual + offset), force)
    return _lose(kind, run, rng)


def _touch_runs(kind, rng, speeds):
    count = len(kind.contact["stiffness"])
    indices = np.arange(len(speeds)) % count
    log = touches(kind, speeds, indices, rng.uniform(size=len(speeds)), rng)
    runs = []
    for lane, speed in enumerate(speeds):
        signals = {name: value[:, lane] for name, value in log.items()}
        rows = len(signals["force_measured"])
        run = _run(kind, "contact", signals["position_desired"], signals["position_measured"],
                   signals["force_measured"])  # fmt: skip
        run = replace(
            run,
            source=f"touch_{lane}.csv",
            velocity_desired=signals["velocity_desired"],
            force_command=signals["force_command"],
            contact_index=np.full(rows, indices[lane]),
            speed=float(speed),
        )
        runs.append(_lose(replace(kind, block=0), run, rng))
    return runs


def _press_run(kind, rng, seconds=30.0, depth=0.0008, rms=5e-5):
    rig, T = kind.rig, kind.rig["control_period"]
    one = multisine(T, rms=rms, seed=int(rng.integers(1 << 30)))
    command = depth + np.tile(one, round(seconds / T / len(one)))
    plant = Plant(rig)
    sensor = rig["force_sensor"]
    actual = _position(plant, command, _total_delay(rig) / T)
    lag = (rig["simulator"].get("delay", 0.0) + sensor.get("delay", 0.0)) / T
    # The time step limits the velocity, so that the press run never leaves the contact.
    near = 1e-3
    law = Law(kind.contact, rig.get("contact_plane", 0.0))

    def force_at(lag):
        at = [_position(plant, command, lag + shift) for shift in (near, 0.0, -near)]
        return law.raw(at[1] - law.plane, (at[2] - at[0]) / (2.0 * near * T), 0)

    force = _lagged(force_at, lag, sensor.get("time_constant", 0.0) / T)
    force = force + _coloured(rng, len(command), sensor["noise_std"], kind.colour)
    return _run(kind, "press", command, _measured(kind, rng, actual), sense(force, sensor))


def _lagged(force_at, lag, time_constant):
    """Return the force after the sensor's lag `time_constant` [ticks], delayed by `lag` ticks."""
    if time_constant == 0.0:
        return force_at(lag)
    drive = sum(
        weight * np.exp((node - 1.0) / time_constant) / time_constant * force_at(lag + 1.0 - node)
        for node, weight in zip(NODES, WEIGHTS, strict=True)
    )
    pole = np.exp(-1.0 / time_constant)
    return lfilter([1.0], [1.0, -pole], drive, zi=[pole * force_at(lag)[0]])[0]


def _measured(kind, rng, actual):
    sensor = kind.rig["position_sensor"]
    noisy = actual + _coloured(rng, len(actual), sensor["noise_std"], kind.colour)
    return _rounded(noisy, sensor.get("quantum", 0.0))


def _run(kind, what, command, measured, force):
    rows = len(command)
    return LoggedRun(what, f"{what}.csv", np.arange(rows), kind.jitter, command, measured, force, None, None,
               np.ones(rows, bool), None, None)  # fmt: skip


def _lose(kind, run, rng):
    """Remove single rows and a block of rows; the commands of contacts are restored, as by the log reader."""
    rows = len(run.tick)
    valid = rng.uniform(size=rows) >= kind.lost
    valid[:3] = True
    if kind.block:
        middle = int(rng.integers(rows // 4, rows // 2))
        valid[middle : middle + kind.block] = False
    if valid.all():
        return run
    position = np.where(valid, run.position_measured, np.nan)
    force = None if run.force_measured is None else np.where(valid, run.force_measured, np.nan)
    return replace(run, valid=valid, position_measured=position, force_measured=force)
