"""What a mechanism file of six axes means: its first contact as in space, beside what the rig can do."""

import math
from typing import NamedTuple

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.six_axes_rig import Simulator, TargetRobot
from jaxhil.sixdof.units import unit_warnings

FASTEST = 0.1  # contact frequency over control rate, of files that can be meant


class Meaning(NamedTuple):
    """Of the first touch, nominally; NaN where nothing touches."""

    effective_mass: float  # m_n [kg]
    frequency: float  # of the contact in space, 1/(2 duration) [Hz]; NaN where a latch holds in the end
    peak_force: float  # in space [N]
    restitution: float  # e* in space; NaN unless it is a single touch
    delay: float  # of the loop: the slowest axis with its lag, and the force sensor [s]
    slip_limit: float  # below which regularised friction is an unstable damper on the rig [m/s]; NaN without
    warnings: tuple[str, ...]  # what can hardly be meant: key, what was found, what is expected

    def line(self, name: str) -> str:
        """All of it in one line, the warnings apart."""
        if math.isnan(self.effective_mass):
            return f"{name}: nothing touches; the rig is {1e3 * self.delay:.3g} ms late"
        rebound = "" if math.isnan(self.restitution) else f", e* {self.restitution:.3g}"
        kind = "a latch holds" if math.isnan(self.frequency) else f"a contact of {self.frequency:.3g} Hz"
        text = f"{name}: effective mass {self.effective_mass:.4g} kg at the first touch; in space {kind}, "
        text += f"peak force {self.peak_force:.3g} N{rebound}; the rig is {1e3 * self.delay:.3g} ms late"
        if not math.isnan(self.slip_limit):
            text += f", friction steady there from a slip of {self.slip_limit:.2g} m/s on"
        return text


def meaning(
    mechanism: SixAxisMechanism,
    effective_mass: float,
    tangential_mass: float,
    duration: float,
    peak_force: float,
    restitution: float,
) -> Meaning:
    """The meaning of a mechanism whose first contact in space has these figures, in SI units."""
    rig = mechanism.rig
    delay = rig.force_sensor.delay + rig.force_sensor.time_constant + _lateness(rig.simulator)
    frequency = 1 / (2 * duration) if duration > 0 else math.nan
    found = list(unit_warnings(mechanism))
    rate = 1 / rig.control_period
    if frequency > FASTEST * rate:
        found.append(
            f"contact: found a contact of {frequency:.3g} Hz, expected at most {FASTEST * rate:.4g} Hz, "
            "1/10 of the control rate"
        )
    limit = math.nan
    for name, contact in mechanism.contact.items():
        friction = contact.friction
        if friction is None or friction.slip is None or not peak_force > 0:
            continue
        # Of a delayed damper on a mass: stable below pi/2 of damping times delay over mass.
        own = 2 / math.pi * friction.coefficient * peak_force * delay / tangential_mass
        limit = own if math.isnan(limit) else max(limit, own)
        if friction.slip < own:
            found.append(
                f"contact.{name}.friction.slip: found {friction.slip:.3g} m/s, "
                f"expected more than {own:.2g} m/s: below it the delayed friction chatters"
            )
    return Meaning(effective_mass, frequency, peak_force, restitution, delay, limit, tuple(found))


def _lateness(simulator: Simulator) -> float:
    """By how much [s] the slowest axis follows a uniform motion late; of two robots, both by their shares."""
    own, robot = _lags(simulator, simulator), simulator.target_robot
    if robot is None:
        return max(own)
    other = _lags(simulator, robot)
    return max(
        (1 - share) * chaser + share * target
        for share, chaser, target in zip(robot.share, own, other, strict=True)
    )


def _lags(simulator: Simulator, robot: Simulator | TargetRobot) -> list[float]:
    """By how much [s] each axis of a robot follows a uniform motion late: its delay, and -G'(0)."""

    def of(key: str) -> list[float]:
        return getattr(robot, key) or getattr(simulator, key)

    lag = [0.0] * 6
    if simulator.model == "first_order":
        lag = of("time_constant")
    elif simulator.model == "second_order":
        pairs = zip(of("damping_ratio"), of("natural_frequency"), strict=True)
        lag = [damping / (math.pi * frequency) for damping, frequency in pairs]
    elif simulator.model == "third_order" and simulator.coefficients:
        lag = [simulator.coefficients[0]] * 6
    elif simulator.model == "transfer_function":
        *_, slope, value = simulator.denominator or []
        *_, lead, gain = 0.0, *(simulator.numerator or [])
        lag = [slope / value - lead / gain] * 6
    return [one + delay for one, delay in zip(lag, of("delay"), strict=True)]
