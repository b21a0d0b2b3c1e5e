"""Nominal values of mechanism and rig, which are all that a compensator knows before a run.

The values come from the mechanism file, not from a scenario. If the file states an uncertainty, the value
that is drawn for a scenario therefore differs from the nominal value. `Compensator.knows` lists the nominal
values that a compensator needs.
"""

import math

from jaxhil.contact.laws import find_contact_law
from jaxhil.mechanism.sensor_filter import low_frequency_delay
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

BIAS_WALK_TIME = 1.0  # s; typical duration of an approach and a contact, in which the bias changes


def force_delay(mechanism: Mechanism | SixAxisMechanism) -> float:
    """Return the nominal delay [s] of the force measurement: transport delay plus lag or filter."""
    sensor = mechanism.rig.force_sensor
    return sensor.delay + sensor.time_constant + low_frequency_delay(sensor.filter)


def simulator_inverse(mechanism: Mechanism) -> tuple[float, float]:
    """Return the coefficients a_1 [s] and a_2 [s^2] of the series e^(s tau)/G(s) = 1 + a_1 s + a_2 s^2 + ...

    G is the motion simulator's transfer function without transport delay. tau is this transport delay plus
    the mean delay of the command. For the control period T and a latency of L periods, the delay of the
    command is L T with linear interpolation, and L T - T/2 with zero-order hold (notebooks/guide/model.md
    section 6, item 7).
    """
    rig = mechanism.rig
    first, second = _inverse_series(rig.simulator)
    delay = rig.simulator.delay
    delay += (rig.command_latency - (0.0 if rig.command_hold == "linear" else 0.5)) * rig.control_period
    return first + delay, second + first * delay + delay**2 / 2


def simulator_lag(mechanism: Mechanism) -> float:
    """Return the motion simulator's lag [s] in uniform motion: a_1 of `simulator_inverse`."""
    return simulator_inverse(mechanism)[0]


def axis_lags(mechanism: SixAxisMechanism) -> list[float]:
    """Return the motion simulator's lag [s] of each coordinate in uniform motion.

    With two robots, the lag is the mean of both robots' lags, weighted by their shares of the motion. In a
    hexapod every leg affects all coordinates, so that the lag is the mean of the legs' lags.
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
    return find_contact_law(mechanism.contact.law).is_damped and any(b > 0 for b in mechanism.contact.damping)


def peak_force(mechanism: Mechanism) -> float:
    """Return an estimate of the peak contact force [N], for the largest stiffness in the file."""
    contact = mechanism.contact
    stiffness = [max(k) if isinstance(k, list | tuple) else k for k in contact.stiffness]
    mass, velocity = mechanism.bodies.mass, mechanism.approach.velocity
    return find_contact_law(contact.law).nominal_peak_force(contact, stiffness, mass, velocity)


def typical_stiffness(mechanism: Mechanism) -> float:
    """Return an estimate of the contact stiffness [N/m] from `peak_force`, mass and approach speed."""
    return (peak_force(mechanism) / mechanism.approach.velocity) ** 2 / mechanism.bodies.mass


def contact_frequency(mechanism: Mechanism) -> float:
    """Return an estimate of the contact's angular frequency [rad/s], from `typical_stiffness`."""
    return math.sqrt(typical_stiffness(mechanism) / mechanism.bodies.mass)


def critical_damping(mechanism: Mechanism) -> float:
    """Return the critical damping 2 sqrt(k M) [N s/m]: k is `typical_stiffness`, M the equivalent mass."""
    return 2 * math.sqrt(typical_stiffness(mechanism) * mechanism.bodies.mass)


def noise_bound(mechanism: Mechanism) -> float:
    """Return a force [N] above the noise: 4 standard deviations plus bias and quantum of the force sensor.

    A random walk of the bias counts with its change in `BIAS_WALK_TIME`.
    """
    sensor = mechanism.rig.force_sensor
    # With 3 standard deviations, noise at a small depth sometimes causes a wrong identified stiffness.
    drift = sensor.bias_random_walk * math.sqrt(BIAS_WALK_TIME)
    return 4 * (sensor.noise_std + drift) + abs(sensor.bias) + sensor.quantum


def _lags(simulator: Simulator, robot: Simulator | TargetRobot) -> list[float]:
    """Return a robot's lag [s] on each axis in uniform motion: lag of its dynamics plus transport delay."""

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
    elif simulator.model == "moving_average":
        lag = [window / 2 for window in of("window")]
    return [axis_lag + delay for axis_lag, delay in zip(lag, of("delay"), strict=True)]


def _inverse_series(simulator) -> tuple[float, float]:
    """Return a_1 [s] and a_2 [s^2] of 1/G(s) = 1 + a_1 s + a_2 s^2 + ... for the simulator's dynamics G."""
    if simulator.model == "first_order":
        return simulator.time_constant, 0.0
    if simulator.model == "second_order":
        frequency = 2 * math.pi * simulator.natural_frequency
        return 2 * simulator.damping_ratio / frequency, 1 / frequency**2
    if simulator.model == "third_order":
        return simulator.coefficients[0], simulator.coefficients[1]
    if simulator.model == "transfer_function":
        # Divide the denominator by the numerator as power series, in ascending powers.
        low = [*reversed(simulator.denominator), 0.0, 0.0][:3]
        num = [*reversed(simulator.numerator), 0.0, 0.0][:3]
        first = (low[1] - low[0] / num[0] * num[1]) / num[0]
        second = (low[2] - low[0] / num[0] * num[2] - first * num[1]) / num[0]
        return first, second
    if simulator.model == "moving_average":
        return simulator.window / 2, simulator.window**2 / 12
    return 0.0, 0.0
