"""Estimates of mechanism and rig that a compensator has before a run: nominal values of the file.

They are never the values of a scenario: where the file states an uncertainty, the drawn value differs from
the estimate. `Compensator.knows` lists the estimates that a compensator needs.
"""

import math

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.six_axes_rig import Simulator, TargetRobot
from jaxhil.mechanism.structs import Mechanism

FORCE_DELAY = "force delay"
STIFFNESS = "contact stiffness"
CONTACT_FREQUENCY = "contact frequency"
SIMULATOR_LAG = "simulator lag"
SIMULATOR_DYNAMICS = "simulator dynamics"
DEAD_ZONE = "dead zone"
FORCE_NOISE = "force noise"
EQUIVALENT_MASS = "equivalent mass"


def force_delay(mechanism: Mechanism | SixAxisMechanism) -> float:
    """Return the nominal delay [s] of the force measurement: transport delay plus first-order lag."""
    sensor = mechanism.rig.force_sensor
    return sensor.delay + sensor.time_constant


def simulator_inverse(mechanism: Mechanism) -> tuple[float, float]:
    """Return a_1 [s] and a_2 [s^2] of 1 + a_1 s + a_2 s^2 + ..., the series of e^(s tau)/G(s).

    tau is the transport delay of the motion simulator plus the average delay of the command: L T with linear
    interpolation, (L - 1/2) T with zero-order hold (notebooks/guide/model.md section 6, item 7).
    """
    rig = mechanism.rig
    first, second = _inverse_series(rig.simulator)
    delay = rig.simulator.delay
    delay += (rig.command_latency - (0.0 if rig.command_hold == "linear" else 0.5)) * rig.control_period
    return first + delay, second + first * delay + delay**2 / 2


def simulator_lag(mechanism: Mechanism) -> float:
    """Return the time [s] by which the motion simulator lags in uniform motion: a_1 of the inverse."""
    return simulator_inverse(mechanism)[0]


def axis_lags(mechanism: SixAxisMechanism) -> list[float]:
    """Return the delay [s] of each coordinate in uniform motion.

    With two robots it is the mean of both delays, weighted by their shares. A hexapod's legs have six delays,
    each of which affects all coordinates: the result is their mean.
    """
    simulator = mechanism.rig.simulator
    lags, robot = _lags(simulator, simulator), simulator.target_robot
    if simulator.space == "stewart":
        return [sum(lags) / 6] * 6
    if robot is None:
        return lags
    return [
        (1 - share) * chaser + share * target
        for share, chaser, target in zip(robot.share, lags, _lags(simulator, robot), strict=True)
    ]


def is_damped(mechanism: Mechanism) -> bool:
    """Return whether the mechanism's contact law dissipates energy."""
    return find_contact_law(mechanism.contact.law).damped and any(b > 0 for b in mechanism.contact.damping)


def peak_force(mechanism: Mechanism) -> float:
    """Return the order of the peak contact force [N], for the stiffest stiffness in the file."""
    contact = mechanism.contact
    stiffness = [max(k) if isinstance(k, list | tuple) else k for k in contact.stiffness]
    mass, velocity = mechanism.bodies.mass, mechanism.approach.velocity
    return find_contact_law(contact.law).nominal_peak_force(contact, stiffness, mass, velocity)


def typical_stiffness(mechanism: Mechanism) -> float:
    """Return the order of the contact stiffness [N/m], M omega^2 for the stiffest stiffness in the file."""
    return (peak_force(mechanism) / mechanism.approach.velocity) ** 2 / mechanism.bodies.mass


def contact_frequency(mechanism: Mechanism) -> float:
    """Return the order of the contact's angular frequency [rad/s], with the typical stiffness."""
    return math.sqrt(typical_stiffness(mechanism) / mechanism.bodies.mass)


def critical_damping(mechanism: Mechanism) -> float:
    """Return the critical damping 2 sqrt(k M) [N s/m], with the typical stiffness."""
    return 2 * math.sqrt(typical_stiffness(mechanism) * mechanism.bodies.mass)


def noise_bound(mechanism: Mechanism) -> float:
    """Return a force [N] that noise hardly ever exceeds."""
    sensor = mechanism.rig.force_sensor
    # 3 standard deviations are not enough: one reading above, at a small depth, identifies a wrong stiffness.
    return 4 * sensor.noise_std + abs(sensor.bias) + sensor.quantum


def _lags(simulator: Simulator, robot: Simulator | TargetRobot) -> list[float]:
    """Return the delay [s] of each axis of a robot in uniform motion: transport delay plus -G'(0)."""

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
    return [axis_lag + delay for axis_lag, delay in zip(lag, of("delay"), strict=True)]


def _inverse_series(simulator) -> tuple[float, float]:
    """Return the coefficients of s [s] and s^2 [s^2] in the series of 1/G."""
    if simulator.model == "first_order":
        return simulator.time_constant, 0.0
    if simulator.model == "second_order":
        frequency = 2 * math.pi * simulator.natural_frequency
        return 2 * simulator.damping_ratio / frequency, 1 / frequency**2
    if simulator.model == "third_order":
        return simulator.coefficients[0], simulator.coefficients[1]
    if simulator.model == "transfer_function":
        # Series division of denominator by numerator, with low powers first.
        low = [*reversed(simulator.denominator), 0.0, 0.0][:3]
        num = [*reversed(simulator.numerator), 0.0, 0.0][:3]
        first = (low[1] - low[0] / num[0] * num[1]) / num[0]
        second = (low[2] - low[0] / num[0] * num[2] - first * num[1]) / num[0]
        return first, second
    return 0.0, 0.0
