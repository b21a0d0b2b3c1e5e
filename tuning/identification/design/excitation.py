"""The two runs that tell a rig's numbers best: a multisine clear of the mechanism, and one pushed against it.

What matters is what wrong numbers do to the error e - e* of a compensation; its derivatives are those of the
simulated loop. The runs' powers are chosen together (`powers`): free motion tells the motion simulator, a
press stiffness, damping and force delay given that. A share of the power lies evenly over all lines, so that
a model of the wrong order, or a nonlinearity, shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize

import jaxhil
from jaxhil.contact.laws import contact_law
from jaxhil.errors import InputError, shown
from jaxhil.mechanism.file import from_builtins, to_builtins
from jaxhil.mechanism.structs import Mechanism
from tuning.identification import hold, known
from tuning.identification.design import powers, waveform
from tuning.identification.mechanism_file import put

PERIOD, PERIODS = 5.0, 12  # s, of which the first is dropped
FADE, APPROACH, CLEAR = 1.0, 2.0, 0.001  # s, s, m
HIGHEST = 45.0  # Hz, or 3 bandwidths where that is more
EVEN = 0.2  # share of the power that lies evenly over the lines
CREST = 1.6  # wanted of the waves
PRELOAD, SWING = 0.45, 0.4  # of the greatest force: mean and peak about it while pressed
ALSO = 0.01  # weight of the numbers' own relative errors beside their effect on e
PHASES = (0.0, 0.25, 0.5, 0.75)  # of the contacts that e is taken from
NOISE = 5e-6, 0.5  # m and N, where the mechanism states none
USED = 0.9  # of the limits of speed and acceleration
OWN_KEYS = {
    "ideal": (),
    "first_order": ("time_constant",),
    "second_order": ("natural_frequency", "damping_ratio"),
    "third_order": ("coefficients.0", "coefficients.1", "coefficients.2"),
}


@dataclass(frozen=True)
class Excitation:
    """One run."""

    position: np.ndarray  # m, of the command: from where it starts, or (press) from the nominal plane
    frequency: np.ndarray  # Hz, of the lines
    amplitude: np.ndarray  # m
    crest: float  # peak over rms, of what is nearest to its limit


@dataclass(frozen=True)
class Design:
    """Both runs and what they will tell."""

    free: Excitation
    press: Excitation
    keys: tuple[str, ...]  # of the numbers told
    values: np.ndarray  # of the mechanism
    std: np.ndarray  # predicted
    slopes: np.ndarray  # d(e - e*) by the numbers, (contacts and phases, keys)
    covariance: np.ndarray
    flat: float  # error of e with flat spectra within the same limits, over that with these

    @property
    def error(self) -> float:
        """rms of e - e* that errors of these standard deviations, and their correlations, make."""
        return float(np.sqrt(np.mean(np.sum(self.slopes @ self.covariance * self.slopes, axis=1))))


Slopes = Callable[[Sequence[str]], np.ndarray]


def design(mechanism: Mechanism, stroke: float, slopes_by: Slopes, seed: int = 0) -> Design:
    """For a rig of about these numbers; `stroke`: largest excursion to either side [m]; `slopes_by` gives
    d(e - e*) by keys of the mechanism, (contacts, keys), as `error_slopes` does.

    Speed and acceleration stay within `rig.simulator`'s limits, the force within the sensor's range and what
    the approach makes. Raises `InputError` for a law or a simulator that this cannot be done for."""
    plan = _Plan(mechanism, stroke)
    slopes = slopes_by(plan.keys)
    effect = slopes.T @ slopes / len(slopes)
    relative = effect * np.outer(plan.scales, plan.scales)
    weight = effect + ALSO * np.trace(relative) / len(relative) * np.diag(plan.scales**-2.0)
    groups = [plan.free, plan.press]
    best = powers.best_powers(groups, weight)
    even = [powers.flat_powers(group) for group in groups]
    mixed = [(1.0 - EVEN) * one + EVEN * other for one, other in zip(best, even, strict=True)]
    waves, found, crests = [], [], []
    for power, limits in zip(mixed, plan.limits, strict=True):
        amplitude = np.sqrt(2.0 * power)
        angle = waveform.phases(amplitude, plan.lines, plan.rows, limits, seed)
        signals = waveform.made(amplitude, plan.lines, plan.rows, angle, limits)
        shares = [np.abs(one).max() for one in signals]
        waves.append(plan.wave(amplitude, angle) / max(shares))
        crests.append(waveform.crest_factor(signals[int(np.argmax(shares))]))
        found.append(power / max(shares) ** 2)
    covariance = powers.inverse(powers.information(groups, found))
    errors = [
        np.sqrt(np.trace(weight @ powers.inverse(powers.information(groups, p)))) for p in (even, mixed)
    ]
    runs = [plan.repeated(waves[0]), plan.pressed(waves[1])]
    free, press = (
        Excitation(position, plan.frequency, np.sqrt(2.0 * power), crest)
        for position, power, crest in zip(runs, found, crests, strict=True)
    )
    return Design(
        free,
        press,
        plan.keys,
        plan.values,
        np.sqrt(np.diag(covariance)),
        slopes,
        covariance,
        float(errors[0] / errors[1]),
    )


def error_slopes(
    mechanism: Mechanism, compensator: str, gains: dict[str, float], keys: Sequence[str]
) -> np.ndarray:
    """d(e - e*) by each key, (contacts and phases, keys), of the loop without noise."""
    document, rows = to_builtins(mechanism), []
    for key in ("noise_std", "quantum", "dead_zone", "bias"):
        document["rig"]["force_sensor"][key] = 0.0
    for key in ("noise_std", "quantum"):
        document["rig"]["position_sensor"][key] = 0.0
    for section in ("simulator", "force_sensor"):
        # Derivatives by a delay are those of one that is there.
        document["rig"][section]["delay"] = max(document["rig"][section]["delay"], 1e-6)
    names = [_bracketed(key) for key in keys]
    for phase in PHASES:
        document["approach"]["phase"] = phase
        one = from_builtins(document, mechanism.name)
        found = jaxhil.jacobian(one, compensator, gains, of="error", by=names)
        rows.append(np.array([found[name] for name in names]).T)
    slopes = np.concatenate(rows)
    slopes = slopes[np.all(np.isfinite(slopes), axis=1)]
    if not len(slopes):
        raise InputError(
            f"{mechanism.name}: found no contact that ends well under {compensator}, allowed one"
        )
    return slopes


def _bracketed(key: str) -> str:
    """A key with entries of lists as the mechanism's paths have them."""
    return "".join(f"[{part}]" if part.isdigit() else f".{part}" for part in key.split("."))[1:]


class _Plan:
    """Lines, what they tell, and their limits, of both runs."""

    def __init__(self, mechanism: Mechanism, stroke: float):
        rig = mechanism.rig
        if rig.simulator.model not in OWN_KEYS:
            raise InputError(
                f"rig.simulator.model: found {shown(rig.simulator.model)}, allowed {', '.join(OWN_KEYS)}"
            )
        self.period, self.rows = rig.control_period, round(PERIOD / rig.control_period)
        model = known.motion_model(mechanism)
        highest = min(max(HIGHEST, 3.0 * min(model.bandwidth(), 1e6)), 0.4 / self.period)
        odd = np.arange(1, int(highest * PERIOD) + 1, 2)
        self.lines = odd[(np.arange(len(odd)) + 1) % 4 != 0]
        self.frequency = self.lines / (self.rows * self.period)
        self.s = 2j * np.pi * self.frequency
        self.hold = hold.response(self.frequency, self.period, rig.command_hold, rig.command_latency)
        self.depth, greatest = _press_depth(mechanism)
        self.plane = rig.contact_plane
        sensors = zip((rig.position_sensor, rig.force_sensor), NOISE, strict=True)
        stds = [np.hypot(one.noise_std, one.quantum / np.sqrt(12.0)) or usual for one, usual in sensors]
        told = self._told(mechanism)
        self.keys, self.values = tuple(told), np.array(list(told.values()))
        # A number that is 0 counts by what would matter.
        small = [self.period if key.endswith("delay") else 10.0 for key in told]
        self.scales = np.maximum(np.abs(self.values), small)
        motion, force = self._responses(mechanism)
        self.free, self.press = (
            self._group(mechanism, place, response, std, response_limits, periods)
            for place, response, std, response_limits, periods in (
                (0, motion, stds[0], self._limits(rig, stroke), PERIODS - 1),
                (1, force, stds[1], [*self._limits(rig, stroke), (force, SWING * greatest)], PERIODS),
            )
        )
        self.limits = (self._limits(rig, stroke), [*self._limits(rig, stroke), (force, SWING * greatest)])

    def _told(self, mechanism: Mechanism) -> dict[str, float]:
        """The numbers that the runs tell, by key."""
        document, simulator = to_builtins(mechanism), mechanism.rig.simulator.model
        keys = [*(f"rig.simulator.{name}" for name in OWN_KEYS[simulator]), "rig.simulator.delay"]
        keys += ["rig.force_sensor.delay", *_slope_keys(mechanism, self.depth)]
        if contact_law(mechanism.contact.law).damped:
            keys.append("contact.damping.0")
        return {key: _get(document, key) for key in keys}

    def _responses(self, mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray]:
        """Of the position and of the pressed force reading to the command, at the lines."""
        sensor, position = mechanism.rig.force_sensor, mechanism.rig.position_sensor
        motion = known.motion_model(mechanism).response(self.s) * self.hold
        late = self.s * (sensor.delay - position.delay)
        slope, rate = _tangent(mechanism, self.depth)
        return motion, (slope + rate * self.s) * motion * np.exp(-late) / (
            1.0 + self.s * sensor.time_constant
        )

    def _group(self, mechanism, place, response, std, limits, periods) -> powers.Group:
        """What unit power at each line tells, and the share of each limit that it takes."""
        slopes = []
        for key, scale in zip(self.keys, self.scales, strict=True):
            document, step = to_builtins(mechanism), 1e-6 * scale
            put(document, key, _get(document, key) + step)
            slopes.append((self._responses(from_builtins(document, key))[place] - response) / step)
        whole = np.array(slopes)
        told = np.einsum("il,jl->lij", whole.conj(), whole).real * periods * self.rows / std**2
        use = np.array([np.abs(factor) ** 2 * (CREST / limit) ** 2 for factor, limit in limits])
        return powers.Group(told, use)

    def _limits(self, rig, stroke: float) -> list[tuple[np.ndarray, float]]:
        """Response to the command of what is limited, and its largest value."""
        found = [(np.ones_like(self.s), stroke)]
        for power, limit in ((1, rig.simulator.velocity_limit), (2, rig.simulator.acceleration_limit)):
            if np.isfinite(limit):
                found.append((self.s**power, USED * limit))
        return found

    def wave(self, amplitude: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """One period of the lines."""
        return waveform.wave(amplitude, self.lines, self.rows, angle)

    def repeated(self, wave: np.ndarray) -> np.ndarray:
        """All periods, coming and going."""
        return waveform.repeated(wave, PERIODS, round(FADE / self.period))

    def pressed(self, wave: np.ndarray) -> np.ndarray:
        """From clear of the mechanism to the preload, all periods, and back."""
        low, high = self.plane - CLEAR, self.plane + self.depth
        rows = round(APPROACH / self.period)
        there = waveform.ramp(low, high, rows)
        return np.concatenate([there, high + self.repeated(wave), waveform.ramp(high, low, rows)])


def _get(document: dict, key: str) -> float:
    place: object = document
    for part in key.split("."):
        place = place[int(part) if part.isdigit() else part]  # type: ignore[index]
    return float(place)  # type: ignore[arg-type]


def _slope_keys(mechanism: Mechanism, depth: float) -> list[str]:
    """The stiffness that a press at this depth feels."""
    contact = mechanism.contact
    if not contact_law(contact.law).segmented:
        return ["contact.stiffness.0"]
    return [f"contact.stiffness.0.{np.searchsorted(contact.depths, depth)}"]


def _force(mechanism: Mechanism, depth: np.ndarray, rate: float = 0.0) -> np.ndarray:
    law, numbers = known.contact_law(mechanism.contact), known.coefficients(mechanism.contact, 0)
    return np.array(numbers) @ np.array(law.own(depth, np.full_like(depth, rate)))


def _tangent(mechanism: Mechanism, depth: float) -> tuple[float, float]:
    """Slope of the force by depth [N/m] and by rate [N s/m] there."""
    step = 1e-3 * depth
    low, high = _force(mechanism, np.array([depth - step, depth + step]))
    back, forth = (float(_force(mechanism, np.array([depth]), rate)[0]) for rate in (-step, step))
    return float(high - low) / (2.0 * step), (forth - back) / (2.0 * step)


def _press_depth(mechanism: Mechanism) -> tuple[float, float]:
    """Depth of the preload [m], and the greatest force [N]: the sensor's, or that of the approach."""
    energy = 0.5 * mechanism.bodies.mass * mechanism.approach.velocity**2

    def left(depth: float) -> float:
        grid = np.linspace(0.0, depth, 400)
        return float(np.trapezoid(_force(mechanism, grid), grid)) - energy

    far = 1e-6
    while left(far) < 0.0:
        far *= 2.0
    deepest: Any = optimize.brentq(left, 0.0, far)
    greatest = min(float(_force(mechanism, np.array([deepest]))[0]), USED * mechanism.rig.force_sensor.range)
    pressed: Any = optimize.brentq(
        lambda depth: float(_force(mechanism, np.array([depth]))[0]) - PRELOAD * greatest, 0.0, deepest
    )
    return float(pressed), greatest
