"""Optimal design of two identification runs: a multisine in free motion, and one in contact (press run).

The design minimises the error e - e* of the restitution that wrong parameters cause in a compensated contact
(e on the rig, e* in the ideal contact). The derivatives of this error come from the simulated loop. A press
run keeps the mechanism pressed against the surface. The free run determines the motion simulator, and the
press run then determines stiffness, damping and force delay. The power spectra of both runs are therefore
optimised together (`powers`). A share of the power is distributed evenly among all frequency lines, so that
the runs also reveal a wrong model order or a nonlinearity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

import jaxhil
from jaxhil.contact.laws import find_contact_law
from jaxhil.errors import InputError, format_value
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from jaxhil.mechanism.structs import Mechanism
from tuning.identification import hold, mechanism_models
from tuning.identification.design import powers, waveform
from tuning.identification.design.press_force import LIMIT_SHARE, differentiate_force, find_preload
from tuning.identification.mechanism_file import set_value
from tuning.terminal import format_key

MULTISINE_PERIOD = 5.0  # s
MULTISINE_PERIODS = 12  # number of periods; the first period of the free run is not evaluated
FADE_TIME = 1.0  # duration of the fade-in and of the fade-out [s]
APPROACH_TIME = 2.0  # duration of the approach to the preload of a press run, and of the retraction [s]
START_CLEARANCE = 0.001  # distance to the surface at the start of a press run [m]
MIN_TOP_FREQUENCY = 45.0  # minimum of the highest frequency line, which is usually 3 times the bandwidth [Hz]
FLAT_POWER_SHARE = 0.2  # share of the power that is distributed evenly among the frequency lines
ASSUMED_CREST_FACTOR = 1.6  # assumed crest factor for the comparison of powers with limits
SWING_SHARE = 0.4  # amplitude of the force about its mean, as a share of the largest allowed force
# Weight of the parameters' relative errors, which is added to the weight of their effect on e - e*.
RELATIVE_ERROR_WEIGHT = 0.01
CONTACT_PHASES = (0.0, 0.25, 0.5, 0.75)  # evaluated phases of the contact within a control period
ASSUMED_NOISE_STD = 5e-6, 0.5  # m and N, noise of position and force if the mechanism specifies none
DAMPING_KEY = "contact.damping.0"
TRIAL_DAMPING_RATIO = 0.01  # damping ratio of the contact at which the resolution of damping is computed
SIMULATOR_KEYS = {
    "ideal": (),
    "first_order": ("time_constant",),
    "second_order": ("natural_frequency", "damping_ratio"),
    "moving_average": ("window",),
    "third_order": ("coefficients.0", "coefficients.1", "coefficients.2"),
}


@dataclass(frozen=True)
class Excitation:
    """Position command of one run, and the multisine that it contains.

    Attributes:
        position: Position command in each control period [m]; relative to the start position in a free run,
            absolute in a press run.
        frequency: Frequency lines of the multisine [Hz].
        amplitude: Amplitude at each line [m].
        crest: Crest factor (ratio of peak to rms) of the signal that is closest to its limit.
    """

    position: np.ndarray
    frequency: np.ndarray
    amplitude: np.ndarray
    crest: float


@dataclass(frozen=True)
class ExcitationDesign:
    """Commands of a free run and a press run, and the predicted accuracy of the identification.

    Attributes:
        free: Run in free motion.
        press: Run in contact (pressed against the surface).
        keys: Keys of the identified parameters.
        values: Values of the parameters in the mechanism, in SI units.
        std: Predicted standard deviation of each parameter.
        slopes: Derivatives of e - e* with respect to the parameters. One row per contact and per phase of the
            contact within a control period.
        covariance: Predicted covariance of the parameters.
        flat: Predicted error e - e* with equal powers at all lines, divided by that with this design.
    """

    free: Excitation
    press: Excitation
    keys: tuple[str, ...]
    values: np.ndarray
    std: np.ndarray
    slopes: np.ndarray
    covariance: np.ndarray
    flat: float

    @property
    def error(self) -> float:
        """Return the rms of e - e* that the predicted parameter errors (`covariance`) would cause."""
        return float(np.sqrt(np.mean(np.sum(self.slopes @ self.covariance * self.slopes, axis=1))))


SlopeFunction = Callable[[Sequence[str]], np.ndarray]


def design_excitation(
    mechanism: Mechanism, stroke: float, slopes_by: SlopeFunction, seed: int = 0
) -> ExcitationDesign:
    """Design a free run and a press run (in contact) for a rig with approximately known parameters.

    Speed and acceleration stay within the limits of `rig.simulator`. The force stays within the range of the
    sensor and below the peak force of a contact at the nominal approach speed.

    Args:
        mechanism: Mechanism with the approximate parameters.
        stroke: Largest excursion of the multisine in either direction [m].
        slopes_by: Function from keys to the derivatives of e - e* with respect to these parameters, shape
            (contacts, keys); for example, a call of `differentiate_error`.
        seed: Seed of the random phases.

    Raises:
        InputError: If the contact law or the simulator is not supported.
    """
    plan = _MultisinePlan(mechanism, stroke)
    slopes, values = slopes_by(plan.keys), plan.values
    effect = slopes.T @ slopes / len(slopes)
    relative = effect * np.outer(plan.scales, plan.scales)
    weight = effect + RELATIVE_ERROR_WEIGHT * np.trace(relative) / len(relative) * np.diag(plan.scales**-2.0)
    if DAMPING_KEY in plan.keys and values[plan.keys.index(DAMPING_KEY)] == 0.0:
        plan = _plan_with_detectable_damping(mechanism, stroke, plan, weight)
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
        values,
        np.sqrt(np.diag(covariance)),
        slopes,
        covariance,
        float(errors[0] / errors[1]),
    )


def differentiate_error(
    mechanism: Mechanism, compensator: str, gains: dict[str, float], keys: Sequence[str]
) -> np.ndarray:
    """Differentiate the restitution error e - e* with respect to parameters, in simulations without noise.

    Args:
        mechanism: Mechanism with the approximate parameters.
        compensator: Name of the compensator.
        gains: Gains of the compensator.
        keys: Keys of the parameters.

    Returns:
        Derivatives; one row per contact and per phase within a control period, one column per key.

    Raises:
        InputError: If no simulated contact ends and has finite derivatives.
    """
    document, rows = to_plain_data(mechanism), []
    for key in ("noise_std", "quantum", "dead_zone", "bias", "bias_random_walk"):
        document["rig"]["force_sensor"][key] = 0.0
    for key in ("noise_std", "quantum"):
        document["rig"]["position_sensor"][key] = 0.0
    for section in ("simulator", "force_sensor"):
        # The derivative with respect to a delay exists only for a delay above 0.
        document["rig"][section]["delay"] = max(document["rig"][section]["delay"], 1e-6)
    names = [format_key(key) for key in keys]
    for phase in CONTACT_PHASES:
        document["approach"]["phase"] = phase
        phased = from_plain_data(document, mechanism.name)
        derivatives = jaxhil.jacobian(phased, compensator, gains, of="error", by=names)
        rows.append(np.array([derivatives[name] for name in names]).T)
    slopes = np.concatenate(rows)
    slopes = slopes[np.all(np.isfinite(slopes), axis=1)]
    if not len(slopes):
        raise InputError(
            f"{mechanism.name}: found no simulated contact that ends with compensator {compensator}, "
            "expected at least one"
        )
    return slopes


def _plan_with_detectable_damping(
    mechanism: Mechanism, stroke: float, undamped: _MultisinePlan, weight: np.ndarray
) -> _MultisinePlan:
    """Plan runs for an undamped mechanism as if it had the lowest damping that the runs can detect.

    Without damping, the derivatives of the force with respect to damping and force delay are proportional, so
    a linear prediction of their uncertainty would be infinite. The standard deviation of a low damping is
    inversely proportional to the damping. The lowest detectable damping is equal to its standard deviation.
    """
    stiffness, _ = differentiate_force(mechanism, undamped.depth)
    _, rate = differentiate_force(_replace_damping(mechanism, 1.0), undamped.depth)
    trial = 2.0 * TRIAL_DAMPING_RATIO * np.sqrt(stiffness * mechanism.bodies.mass) / rate
    plan = _MultisinePlan(_replace_damping(mechanism, trial), stroke)
    groups, index = [plan.free, plan.press], plan.keys.index(DAMPING_KEY)
    information = powers.sum_information(groups, powers.optimise_powers(groups, weight))
    std = np.sqrt(powers.invert_scaled(information)[index, index])
    return _MultisinePlan(_replace_damping(mechanism, float(np.sqrt(trial * std))), stroke)


def _replace_damping(mechanism: Mechanism, damping: float) -> Mechanism:
    document = to_plain_data(mechanism)
    set_value(document, DAMPING_KEY, damping)
    return from_plain_data(document, mechanism.name)


class _MultisinePlan:
    """Plan of the multisines in free motion and in contact: frequency lines, Fisher information, limits."""

    def __init__(self, mechanism: Mechanism, stroke: float):
        rig = mechanism.rig
        if rig.simulator.model not in SIMULATOR_KEYS:
            raise InputError(
                f"rig.simulator.model: found {format_value(rig.simulator.model)}, expected "
                f"one of {', '.join(SIMULATOR_KEYS)}"
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
        self.depth, greatest = find_preload(mechanism)
        self.plane = rig.contact_plane
        sensors = zip((rig.position_sensor, rig.force_sensor), ASSUMED_NOISE_STD, strict=True)
        stds = [
            np.hypot(sensor.noise_std, sensor.quantum / np.sqrt(12.0)) or usual for sensor, usual in sensors
        ]
        parameters = self._list_parameters(mechanism)
        self.keys, self.values = tuple(parameters), np.array(list(parameters.values()))
        # The relative error of a parameter that is 0 refers to these values.
        small = [self.period if key.endswith("delay") else 10.0 for key in parameters]
        self.scales = np.maximum(np.abs(self.values), small)
        motion, force = self._compute_responses(mechanism)
        self.free, self.press = (
            self._compute_run_lines(mechanism, index, response, std, response_limits, periods)
            for index, response, std, response_limits, periods in (
                (0, motion, stds[0], self._list_limits(rig, stroke), MULTISINE_PERIODS - 1),
                (
                    1,
                    force,
                    stds[1],
                    [*self._list_limits(rig, stroke), (force, SWING_SHARE * greatest)],
                    MULTISINE_PERIODS,
                ),
            )
        )
        self.limits = (
            self._list_limits(rig, stroke),
            [*self._list_limits(rig, stroke), (force, SWING_SHARE * greatest)],
        )

    def _list_parameters(self, mechanism: Mechanism) -> dict[str, float]:
        """Return the parameters that the runs identify: a dictionary from key to value."""
        document, simulator = to_plain_data(mechanism), mechanism.rig.simulator.model
        keys = [*(f"rig.simulator.{name}" for name in SIMULATOR_KEYS[simulator]), "rig.simulator.delay"]
        keys += ["rig.force_sensor.delay", *_find_stiffness_key(mechanism, self.depth)]
        if find_contact_law(mechanism.contact.law).is_damped:
            keys.append(DAMPING_KEY)
        return {key: _get_value(document, key) for key in keys}

    def _compute_responses(self, mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray]:
        """Return the frequency responses, in contact, from the command to position and force readings."""
        sensor, position = mechanism.rig.force_sensor, mechanism.rig.position_sensor
        motion = mechanism_models.make_motion_model(mechanism).response(self.s) * self.hold
        delay_exponent = self.s * (sensor.delay - position.delay)
        slope, rate = differentiate_force(mechanism, self.depth)
        return motion, (slope + rate * self.s) * motion * np.exp(-delay_exponent) / (
            1.0 + self.s * sensor.time_constant
        )

    def _compute_run_lines(self, mechanism, index, response, std, limits, periods) -> powers.RunLines:
        """Compute each line's Fisher information and used share of each limit, both per unit power.

        Args:
            mechanism: Mechanism with the approximate parameters.
            index: 0 for the position reading, 1 for the force reading.
            response: Frequency response from the command to this reading.
            std: Noise of the reading.
            limits: Frequency response and limit of each limited signal.
            periods: Number of evaluated periods.
        """
        slopes = []
        for key, scale in zip(self.keys, self.scales, strict=True):
            document, step = to_plain_data(mechanism), 1e-6 * scale
            set_value(document, key, _get_value(document, key) + step)
            slopes.append((self._compute_responses(from_plain_data(document, key))[index] - response) / step)
        jacobian = np.array(slopes)
        fisher = np.einsum("il,jl->lij", jacobian.conj(), jacobian).real * periods * self.rows / std**2
        use = np.array(
            [np.abs(factor) ** 2 * (ASSUMED_CREST_FACTOR / limit) ** 2 for factor, limit in limits]
        )
        return powers.RunLines(fisher, use)

    def _list_limits(self, rig, stroke: float) -> list[tuple[np.ndarray, float]]:
        """List the limits of stroke, speed and acceleration, each with the response from the command."""
        limits = [(np.ones_like(self.s), stroke)]
        for power, limit in ((1, rig.simulator.velocity_limit), (2, rig.simulator.acceleration_limit)):
            if np.isfinite(limit):
                limits.append((self.s**power, LIMIT_SHARE * limit))
        return limits

    def wave(self, amplitude: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return one period of the multisine."""
        return waveform.synthesise_multisine(amplitude, self.lines, self.rows, angle)

    def repeated(self, wave: np.ndarray) -> np.ndarray:
        """Return the command of all periods of the multisine, with fade-in and fade-out."""
        return waveform.repeat_with_fades(wave, MULTISINE_PERIODS, round(FADE_TIME / self.period))

    def pressed(self, wave: np.ndarray) -> np.ndarray:
        """Return the command of a press run: approach to the preload, multisine, and retraction."""
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
    """Return the key of the stiffness at a depth [m], as a list with one element."""
    contact = mechanism.contact
    if not find_contact_law(contact.law).is_segmented:
        return ["contact.stiffness.0"]
    return [f"contact.stiffness.0.{np.searchsorted(contact.depths, depth)}"]
