"""Design of two runs that identify a rig best: a multisine in free motion and a pressed multisine.

The criterion is the error e - e* of a compensation that wrong parameters cause; its derivatives come from the
simulated loop. The powers of both runs are optimized together (`powers`): free motion determines the motion
simulator, and a press then determines stiffness, damping and force delay. A share of the power is spread
evenly over all lines, which reveals a wrong model order or a nonlinearity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize

import jaxhil
from jaxhil.contact.laws import find_contact_law
from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from jaxhil.mechanism.structs import Mechanism
from tuning.identification import hold, mechanism_models
from tuning.identification.design import powers, waveform
from tuning.identification.mechanism_file import set_value

MULTISINE_PERIOD, MULTISINE_PERIODS = 5.0, 12  # s, and number of periods; the first one is dropped
FADE_TIME, APPROACH_TIME, START_CLEARANCE = (
    1.0,
    2.0,
    0.001,
)  # s, s, and m: distance to the surface at the start of a press
MIN_TOP_FREQUENCY = 45.0  # Hz, highest line; 3 bandwidths if that is more
FLAT_POWER_SHARE = 0.2  # share of the power that lies evenly over the lines
ASSUMED_CREST_FACTOR = 1.6  # crest factor that the limits assume
PRELOAD_SHARE, SWING_SHARE = 0.45, 0.4  # mean force, and amplitude about it, over the greatest force
RELATIVE_ERROR_WEIGHT = 0.01  # weight of the parameters' relative errors in addition to their effect on e
CONTACT_PHASES = (0.0, 0.25, 0.5, 0.75)  # phases of the contacts at which e is evaluated
ASSUMED_NOISE_STD = 5e-6, 0.5  # m and N, noise if the mechanism states none
LIMIT_SHARE = 0.9  # share of the limits of speed, acceleration and force
SIMULATOR_KEYS = {
    "ideal": (),
    "first_order": ("time_constant",),
    "second_order": ("natural_frequency", "damping_ratio"),
    "third_order": ("coefficients.0", "coefficients.1", "coefficients.2"),
}


@dataclass(frozen=True)
class Excitation:
    """Command of one run, and its multisine."""

    position: np.ndarray  # m, command relative to its start, or, for a press, to the nominal surface
    frequency: np.ndarray  # Hz, lines of the multisine
    amplitude: np.ndarray  # m, at each line
    crest: float  # peak over rms of the signal that is closest to its limit


@dataclass(frozen=True)
class ExcitationDesign:
    """Both runs and the accuracy that they are expected to give."""

    free: Excitation
    press: Excitation
    keys: tuple[str, ...]  # identified parameters
    values: np.ndarray  # of the parameters in the mechanism
    std: np.ndarray  # predicted standard deviations
    slopes: np.ndarray  # derivatives of e - e* by the parameters, (contacts and phases, keys)
    covariance: np.ndarray
    flat: float  # ratio of the error of e with flat spectra to that of this design

    @property
    def error(self) -> float:
        """Return the rms of e - e* for parameter errors with this covariance."""
        return float(np.sqrt(np.mean(np.sum(self.slopes @ self.covariance * self.slopes, axis=1))))


SlopeFunction = Callable[[Sequence[str]], np.ndarray]


def design_excitation(
    mechanism: Mechanism, stroke: float, slopes_by: SlopeFunction, seed: int = 0
) -> ExcitationDesign:
    """Design both runs for a rig with approximately known parameters.

    Speed and acceleration stay within the limits of `rig.simulator`. The force stays within the sensor's
    range and the force that the approach causes.

    Args:
        mechanism: Mechanism with the approximate parameters.
        stroke: Largest excursion to either side [m].
        slopes_by: Function that returns the derivatives of e - e* by keys of the mechanism, (contacts, keys),
            such as `differentiate_error`.
        seed: Seed of the random phases.

    Raises:
        InputError: If the contact law or the simulator is not supported.
    """
    plan = _MultisinePlan(mechanism, stroke)
    slopes = slopes_by(plan.keys)
    effect = slopes.T @ slopes / len(slopes)
    relative = effect * np.outer(plan.scales, plan.scales)
    weight = effect + RELATIVE_ERROR_WEIGHT * np.trace(relative) / len(relative) * np.diag(plan.scales**-2.0)
    groups = [plan.free, plan.press]
    best = powers.optimise_powers(groups, weight)
    even = [powers.make_flat_powers(group) for group in groups]
    mixed = [
        (1.0 - FLAT_POWER_SHARE) * optimal + FLAT_POWER_SHARE * flat
        for optimal, flat in zip(best, even, strict=True)
    ]
    waves, scaled_powers, crests = [], [], []
    for power, limits in zip(mixed, plan.limits, strict=True):
        amplitude = np.sqrt(2.0 * power)
        angle = waveform.optimise_phases(amplitude, plan.lines, plan.rows, limits, seed)
        signals = waveform.make_limited_signals(amplitude, plan.lines, plan.rows, angle, limits)
        shares = [np.abs(signal).max() for signal in signals]
        waves.append(plan.wave(amplitude, angle) / max(shares))
        crests.append(waveform.crest_factor(signals[int(np.argmax(shares))]))
        scaled_powers.append(power / max(shares) ** 2)
    covariance = powers.invert_scaled(powers.sum_information(groups, scaled_powers))
    errors = [
        np.sqrt(np.trace(weight @ powers.invert_scaled(powers.sum_information(groups, p))))
        for p in (even, mixed)
    ]
    runs = [plan.repeated(waves[0]), plan.pressed(waves[1])]
    free, press = (
        Excitation(position, plan.frequency, np.sqrt(2.0 * power), crest)
        for position, power, crest in zip(runs, scaled_powers, crests, strict=True)
    )
    return ExcitationDesign(
        free,
        press,
        plan.keys,
        plan.values,
        np.sqrt(np.diag(covariance)),
        slopes,
        covariance,
        float(errors[0] / errors[1]),
    )


def differentiate_error(
    mechanism: Mechanism, compensator: str, gains: dict[str, float], keys: Sequence[str]
) -> np.ndarray:
    """Return the derivatives of e - e* by each key, (contacts and phases, keys), without noise."""
    document, rows = to_plain_data(mechanism), []
    for key in ("noise_std", "quantum", "dead_zone", "bias"):
        document["rig"]["force_sensor"][key] = 0.0
    for key in ("noise_std", "quantum"):
        document["rig"]["position_sensor"][key] = 0.0
    for section in ("simulator", "force_sensor"):
        # The derivative by a delay needs a delay above 0.
        document["rig"][section]["delay"] = max(document["rig"][section]["delay"], 1e-6)
    names = [_with_bracketed_indices(key) for key in keys]
    for phase in CONTACT_PHASES:
        document["approach"]["phase"] = phase
        phased = from_plain_data(document, mechanism.name)
        derivatives = jaxhil.jacobian(phased, compensator, gains, of="error", by=names)
        rows.append(np.array([derivatives[name] for name in names]).T)
    slopes = np.concatenate(rows)
    slopes = slopes[np.all(np.isfinite(slopes), axis=1)]
    if not len(slopes):
        raise InputError(
            f"{mechanism.name}: found no contact that ends well under {compensator}, expected one"
        )
    return slopes


def _with_bracketed_indices(key: str) -> str:
    """Return a key in the notation of the mechanism's paths, with entries of lists in brackets."""
    return "".join(f"[{part}]" if part.isdigit() else f".{part}" for part in key.split("."))[1:]


class _MultisinePlan:
    """Lines of both runs, with their information and their limits."""

    def __init__(self, mechanism: Mechanism, stroke: float):
        rig = mechanism.rig
        if rig.simulator.model not in SIMULATOR_KEYS:
            raise InputError(
                f"rig.simulator.model: found {format_value(rig.simulator.model)}, expected "
                f"{', '.join(SIMULATOR_KEYS)}"
            )
        self.period, self.rows = rig.control_period, round(MULTISINE_PERIOD / rig.control_period)
        model = mechanism_models.make_motion_model(mechanism)
        highest = min(max(MIN_TOP_FREQUENCY, 3.0 * min(model.bandwidth(), 1e6)), 0.4 / self.period)
        odd = np.arange(1, int(highest * MULTISINE_PERIOD) + 1, 2)
        self.lines = odd[(np.arange(len(odd)) + 1) % 4 != 0]
        self.frequency = self.lines / (self.rows * self.period)
        self.s = 2j * np.pi * self.frequency
        self.hold = hold.compute_hold_response(
            self.frequency, self.period, rig.command_hold, rig.command_latency
        )
        self.depth, greatest = _find_preload(mechanism)
        self.plane = rig.contact_plane
        sensors = zip((rig.position_sensor, rig.force_sensor), ASSUMED_NOISE_STD, strict=True)
        stds = [
            np.hypot(sensor.noise_std, sensor.quantum / np.sqrt(12.0)) or usual for sensor, usual in sensors
        ]
        parameters = self._told(mechanism)
        self.keys, self.values = tuple(parameters), np.array(list(parameters.values()))
        # Parameters that are 0 need a scale for their relative errors.
        small = [self.period if key.endswith("delay") else 10.0 for key in parameters]
        self.scales = np.maximum(np.abs(self.values), small)
        motion, force = self._responses(mechanism)
        self.free, self.press = (
            self._group(mechanism, index, response, std, response_limits, periods)
            for index, response, std, response_limits, periods in (
                (0, motion, stds[0], self._limits(rig, stroke), MULTISINE_PERIODS - 1),
                (
                    1,
                    force,
                    stds[1],
                    [*self._limits(rig, stroke), (force, SWING_SHARE * greatest)],
                    MULTISINE_PERIODS,
                ),
            )
        )
        self.limits = (
            self._limits(rig, stroke),
            [*self._limits(rig, stroke), (force, SWING_SHARE * greatest)],
        )

    def _told(self, mechanism: Mechanism) -> dict[str, float]:
        """Return the parameters that the runs identify, by key."""
        document, simulator = to_plain_data(mechanism), mechanism.rig.simulator.model
        keys = [*(f"rig.simulator.{name}" for name in SIMULATOR_KEYS[simulator]), "rig.simulator.delay"]
        keys += ["rig.force_sensor.delay", *_find_stiffness_key(mechanism, self.depth)]
        if find_contact_law(mechanism.contact.law).damped:
            keys.append("contact.damping.0")
        return {key: _get_value(document, key) for key in keys}

    def _responses(self, mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray]:
        """Return the responses of the position and of the pressed force to the command, at the lines."""
        sensor, position = mechanism.rig.force_sensor, mechanism.rig.position_sensor
        motion = mechanism_models.make_motion_model(mechanism).response(self.s) * self.hold
        late = self.s * (sensor.delay - position.delay)
        slope, rate = _differentiate_force(mechanism, self.depth)
        return motion, (slope + rate * self.s) * motion * np.exp(-late) / (
            1.0 + self.s * sensor.time_constant
        )

    def _group(self, mechanism, index, response, std, limits, periods) -> powers.RunLines:
        """Return the information of unit power at each line, and the share of each limit that it uses."""
        slopes = []
        for key, scale in zip(self.keys, self.scales, strict=True):
            document, step = to_plain_data(mechanism), 1e-6 * scale
            set_value(document, key, _get_value(document, key) + step)
            slopes.append((self._responses(from_plain_data(document, key))[index] - response) / step)
        jacobian = np.array(slopes)
        fisher = np.einsum("il,jl->lij", jacobian.conj(), jacobian).real * periods * self.rows / std**2
        use = np.array(
            [np.abs(factor) ** 2 * (ASSUMED_CREST_FACTOR / limit) ** 2 for factor, limit in limits]
        )
        return powers.RunLines(fisher, use)

    def _limits(self, rig, stroke: float) -> list[tuple[np.ndarray, float]]:
        """Return the response from the command to each limited signal, and its limit."""
        limits = [(np.ones_like(self.s), stroke)]
        for power, limit in ((1, rig.simulator.velocity_limit), (2, rig.simulator.acceleration_limit)):
            if np.isfinite(limit):
                limits.append((self.s**power, LIMIT_SHARE * limit))
        return limits

    def wave(self, amplitude: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return one period of the multisine."""
        return waveform.synthesise_multisine(amplitude, self.lines, self.rows, angle)

    def repeated(self, wave: np.ndarray) -> np.ndarray:
        """Return all periods, with a smooth start and end."""
        return waveform.repeat_with_fades(wave, MULTISINE_PERIODS, round(FADE_TIME / self.period))

    def pressed(self, wave: np.ndarray) -> np.ndarray:
        """Return the approach from clear of the surface to the preload, all periods, and the way back."""
        low, high = self.plane - START_CLEARANCE, self.plane + self.depth
        rows = round(APPROACH_TIME / self.period)
        approach = waveform.ramp(low, high, rows)
        return np.concatenate([approach, high + self.repeated(wave), waveform.ramp(high, low, rows)])


def _get_value(document: dict, key: str) -> float:
    value: object = document
    for part in key.split("."):
        value = value[int(part) if part.isdigit() else part]  # type: ignore[index]
    return float(value)  # type: ignore[arg-type]


def _find_stiffness_key(mechanism: Mechanism, depth: float) -> list[str]:
    """Return the key of the stiffness that is effective in a press at this depth."""
    contact = mechanism.contact
    if not find_contact_law(contact.law).segmented:
        return ["contact.stiffness.0"]
    return [f"contact.stiffness.0.{np.searchsorted(contact.depths, depth)}"]


def _compute_force(mechanism: Mechanism, depth: np.ndarray, rate: float = 0.0) -> np.ndarray:
    law, numbers = (
        mechanism_models.make_regression_law(mechanism.contact),
        mechanism_models.get_regression_coefficients(mechanism.contact, 0),
    )
    return np.array(numbers) @ np.array(law.entry_functions(depth, np.full_like(depth, rate)))


def _differentiate_force(mechanism: Mechanism, depth: float) -> tuple[float, float]:
    """Return the slope of the force by depth [N/m] and by rate [N s/m] at a depth [m]."""
    step = 1e-3 * depth
    low, high = _compute_force(mechanism, np.array([depth - step, depth + step]))
    back, forth = (float(_compute_force(mechanism, np.array([depth]), rate)[0]) for rate in (-step, step))
    return float(high - low) / (2.0 * step), (forth - back) / (2.0 * step)


def _find_preload(mechanism: Mechanism) -> tuple[float, float]:
    """Return the preload's depth [m] and the greatest force [N], limited by the sensor or the approach."""
    energy = 0.5 * mechanism.bodies.mass * mechanism.approach.velocity**2

    def left(depth: float) -> float:
        grid = np.linspace(0.0, depth, 400)
        return float(np.trapezoid(_compute_force(mechanism, grid), grid)) - energy

    far = 1e-6
    while left(far) < 0.0:
        far *= 2.0
    deepest: Any = optimize.brentq(left, 0.0, far)
    greatest = min(
        float(_compute_force(mechanism, np.array([deepest]))[0]),
        LIMIT_SHARE * mechanism.rig.force_sensor.range,
    )
    pressed: Any = optimize.brentq(
        lambda depth: float(_compute_force(mechanism, np.array([depth]))[0]) - PRELOAD_SHARE * greatest,
        0.0,
        deepest,
    )
    return float(pressed), greatest
