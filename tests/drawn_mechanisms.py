"""Random mechanisms from the whole allowed range, and their results in the oracle.

A form, given by its index, has the properties that determine a compiled program: contact law, motion
simulator, hold, latency, integrator, and ranges of the poles and of the sensor's lag. Mechanisms of one form
are lanes of one batch.
"""

import math
from typing import Any

import numpy as np
from oracle import simulate

LAWS = ("linear", "kelvin_voigt", "hunt_crossley", "piecewise_linear", "hardening", "depth_damped")
LAWS += ("elastoplastic", "preloaded")
MODELS = ("ideal", "first_order", "second_order", "third_order", "transfer_function")
POLES = ((0.02, 1.0), (1.0, 8.0), (8.0, 63.0))  # rad per control period, range of the fastest pole
LAGS = ((), (0.3, 20.0), (1e-7, 0.3))  # range of the force sensor's lag [control periods]
INTEGRATORS = ("semi_implicit_euler", "zoh", "explicit_euler")
PERIODS, MASSES, STIFFNESSES = (1e-4, 2e-2), (0.1, 1e6), (1.0, 1e9)
FREQUENCIES = 5e-3, 2.0  # rad per control period, range of the contact frequency
MAX_DELAY = 0.1  # s
NUDGE = 1e-12  # relative change of an input, to exclude ill-conditioned cases
BAR = 1e-6

FIGURES = ("restitution", "peak_force", "duration", "work_in", "work_out")


class Form:
    """Common properties of mechanisms that share a program."""

    def __init__(self, number: int) -> None:
        self.law, self.model = LAWS[number % 8], MODELS[number % 5]
        self.poles, self.lag = POLES[number // 2 % 3], LAGS[number // 3 % 3]
        self.latency, self.integrator = number // 4 % 2, INTEGRATORS[number % 3]
        self.two_sided, self.tension = number % 7 == 3, number % 16 == 1
        self.hold = "zoh" if number % 4 < 2 else "linear"
        # The velocity of an ideal simulator is zero while the command is held, so a damper has no effect.
        self.damped = self.model != "ideal" or self.hold == "linear"

    def draw(self, rng: np.random.Generator, longest: int) -> dict[str, Any]:
        """Draw a mechanism of this form whose contact takes at most about `longest` ticks."""

        def spread(low: float, high: float) -> float:
            return float(low * (high / low) ** rng.random())

        while True:
            period, mass, stiffness = spread(*PERIODS), spread(*MASSES), spread(*STIFFNESSES)
            frequency = math.sqrt(stiffness / mass)
            ticks = math.pi / (frequency * period)
            if (
                FREQUENCIES[0] <= frequency * period <= FREQUENCIES[1]
                and ticks <= longest
                and frequency > 2.0
            ):
                break
        velocity = spread(1e-3, 0.1)
        depth, force = velocity / frequency, velocity * math.sqrt(stiffness * mass)
        contact = self._contact(rng, spread, stiffness, mass, depth, force)
        delays = [self._delay(rng, spread, period, frequency) for _ in range(2)]
        if self.two_sided:
            contact["clearance"] = (
                4 * velocity * (0.02 + 2 * period + delays[0] + 30 * period / self.poles[0])
            )
        sensor: dict[str, float] = {"delay": delays[1]}
        if self.lag:
            sensor["time_constant"] = spread(*self.lag) * period
        if rng.random() < 0.25:
            sensor["quantum"] = force * spread(1e-4, 1e-2)
        if rng.random() < 0.25:
            sensor["dead_zone"] = force * spread(1e-3, 0.1)
        rig: dict[str, Any] = {
            "control_period": period,
            "integrator": self.integrator,
            "command_latency": self.latency,
            "command_hold": self.hold,
            "simulator": {**self._simulator(rng, spread, period), "delay": delays[0]},
            "force_sensor": sensor,
        }
        if rng.random() < 0.2:
            rig["contact_plane"] = depth * float(rng.uniform(-0.5, 0.5))
        return {
            "schema": "jaxhil/mechanism/1",
            "name": "drawn",
            "bodies": {"equivalent_mass": mass},
            "approach": {"velocity": velocity, "phase": float(rng.random()), "contacts": 1},
            "contact": contact,
            "rig": rig,
        }

    def _contact(self, rng, spread, stiffness, mass, depth, force) -> dict[str, Any]:
        contact: dict[str, Any] = {"law": self.law, "stiffness": [stiffness]}
        damping = 2 * math.sqrt(stiffness * mass) * spread(1e-3, 1.0) if self.damped else 0.0
        if self.law in ("kelvin_voigt", "hardening", "depth_damped", "piecewise_linear"):
            contact["damping"] = [damping]
        if self.law == "kelvin_voigt":
            contact["tension"] = self.tension
        if self.law in ("hardening", "depth_damped"):
            contact["reference_depth"] = depth * spread(0.3, 3.0)
        if self.law in ("hunt_crossley", "depth_damped"):
            power = float(rng.choice([1.0, 1.2, 1.5, 2.0]))
            contact |= {"exponent": power, "stiffness": [min(stiffness / depth ** (power - 1), 1e9)]}
        if self.law == "hunt_crossley" and self.damped:
            contact["damping"] = [spread(1e-3, 0.5) * stiffness * depth / (force * 1e-1)]
        if self.law == "piecewise_linear":
            contact["depths"] = sorted(depth * rng.uniform(0.1, 0.9, 2))
            contact["stiffness"] = [[stiffness, stiffness * spread(0.3, 3.0), stiffness * spread(0.3, 3.0)]]
        if self.law == "elastoplastic":
            contact["unloading_ratio"] = spread(1.0, 3.0)
        if self.law == "preloaded":
            contact["preload"] = force * spread(1e-3, 0.3)
            contact["friction"] = force * spread(1e-3, 0.1) if self.damped else 0.0
        return contact

    def _simulator(self, rng, spread, period) -> dict[str, Any]:
        fastest = spread(*self.poles) / period
        slower = fastest / spread(1.0, 3.0)
        ratio = spread(0.3, 1.0)
        pair = [1 / slower**2, 2 * ratio / slower, 1.0]
        if self.model == "first_order":
            return {"model": self.model, "time_constant": 1 / fastest}
        if self.model == "second_order":
            return {
                "model": self.model,
                "natural_frequency": fastest / (2 * math.pi),
                "damping_ratio": ratio,
            }
        if self.model == "third_order":
            *coefficients, _ = np.polymul(pair, [1 / fastest, 1.0])
            return {"model": self.model, "coefficients": coefficients[::-1]}
        if self.model == "transfer_function":
            denominator = np.polymul(pair, [1 / fastest**2, 2 * ratio / fastest, 1.0])
            zero = [spread(0.1, 1.0) / slower, 1.0]
            return {"model": self.model, "numerator": zero, "denominator": denominator.tolist()}
        return {"model": self.model}

    @staticmethod
    def _delay(rng, spread, period, frequency) -> float:
        """Draw a delay: none, whole periods, arbitrary or tiny; usually short compared with the contact."""
        longest = min(MAX_DELAY, 0.5 / frequency)
        choice = rng.integers(5)
        if choice == 0:
            return 0.0
        if choice == 1:
            return min(period * int(rng.integers(1, 4)), MAX_DELAY)
        return spread(1e-9, 1e-6) if choice == 2 else spread(0.01 * longest, longest)


def oracle_figures(parsed: dict[str, Any]) -> dict[str, float] | None:
    """Return the oracle's metrics of the first contact.

    Returns None if the contact does not end, or if a change of an input by `NUDGE` changes a metric by more
    than the tolerance.
    """
    contact = simulate(parsed)[0]
    if contact["status"] != "over":
        return None
    approach, bodies = parsed["approach"], parsed["bodies"]
    nudged = (
        {"approach": {**approach, "phase": approach["phase"] * (1 - NUDGE)}},
        {"bodies": {"equivalent_mass": bodies["equivalent_mass"] * (1 + NUDGE)}},
    )
    for change in nudged:
        moved = simulate(parsed | change)[0]
        if moved["status"] != "over" or max(differences(moved, contact).values()) > BAR:
            return None
    return {name: float(contact[name]) for name in FIGURES}


def differences(result: dict[str, Any], expected: dict[str, Any]) -> dict[str, float]:
    """Return the differences of metrics relative to their scale."""
    scales = {
        "restitution": max(1.0, expected["restitution"]),
        "peak_force": expected["peak_force"],
        "duration": expected["duration"],
        "work_in": expected["work_in"],
        "work_out": expected["work_in"],
    }
    return {name: abs(result[name] - expected[name]) / scales[name] for name in FIGURES}
