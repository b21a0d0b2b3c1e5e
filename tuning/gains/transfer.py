"""Transfer of gains tuned for one mechanism, as a start for similar mechanisms.

`compute_mechanism_distance` measures how different two mechanisms are, `find_nearest` selects the nearest
mechanism already tuned, and `transfer_gains` converts its gains to another mechanism.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.scenario import build_scenarios
from tuning.gain_file import validity_envelope


class MechanismTraits(NamedTuple):
    """Nominal properties that determine a mechanism's restitution without compensation."""

    slowest: float  # omega of the slowest contact [rad/s]
    fastest: float  # omega of the fastest contact [rad/s]
    force_delay: float  # delay plus lag of the force sensor [s]
    simulator_delay: float  # delay plus lag of the motion simulator and its command [s]
    control_period: float  # [s]
    damping_ratio: float  # [1]
    law: str  # name of the contact law
    two_sided: bool  # whether there are two surfaces


@dataclass(frozen=True)
class EarlierGains:
    """Gains of an earlier tuning."""

    mechanism: Mechanism  # mechanism they were tuned for
    gains: Mapping[str, float]  # [SI units]
    source: str  # origin of the gains, for messages

    @functools.cached_property
    def traits(self) -> MechanismTraits:
        """Return the traits of the mechanism."""
        return compute_traits(self.mechanism)


def compute_mechanism_distance(a: Mechanism, b: Mechanism) -> float:
    """Return the distance of two mechanisms [1], which is symmetric, and 0 for equal ones.

    It is the root of the sum of squares of

        ln(omega_a / omega_b) / sqrt(2)     for the slowest and for the fastest contact
        (pi/2) omega (tau_a - tau_b)        for the delays of force and motion simulator and the control
                                            period, omega the geometric mean of all four frequencies
        pi (xi_a - xi_b)                    for the damping ratio
        1                                   if contact law or number of surfaces differ

    so that each term is about its effect on ln e: a delay in the loop multiplies the restitution by about
    exp(pi omega tau / 2), damping by about exp(-pi xi).
    """
    return _compute_trait_distance(compute_traits(a), compute_traits(b))


def compute_traits(mechanism: Mechanism) -> MechanismTraits:
    """Return the traits of the nominal run.

    The stiffness k of a nonlinear law is that of the linear contact with the same peak force
    (`validity_envelope`). The damping ratio, the largest of all contacts, is b/(2 sqrt(k M)), or chi v/pi for
    Hunt and Crossley's law, from e = 1 - chi v.
    """
    nominal = build_scenarios(mechanism)
    frequency = validity_envelope(mechanism, nominal)["contact_frequency"]
    slowest, fastest = (2 * math.pi * frequency[end] for end in ("low", "high"))
    simulator, sensor, rig = nominal.simulator, nominal.force_sensor, mechanism.rig
    # The lag of num(s)/den(s) behind a uniform motion: the difference of their slopes at s = 0.
    slopes = [
        float(polynomial[-2, 0] / polynomial[-1, 0]) if len(polynomial) > 1 else 0.0
        for polynomial in (np.asarray(simulator.denominator), np.asarray(simulator.numerator))
    ]
    command_delay = rig.command_latency - (0.5 if rig.command_hold == "zoh" else 0.0)
    damping = float(np.max(nominal.contact.damping))
    mass, velocity = mechanism.bodies.mass, mechanism.approach.velocity
    law = find_contact_law(mechanism.contact.law)
    return MechanismTraits(
        slowest=slowest,
        fastest=fastest,
        force_delay=float(sensor.delay[0] + sensor.time_constant[0]),
        simulator_delay=float(simulator.delay[0])
        + slopes[0]
        - slopes[1]
        + command_delay * rig.control_period,
        control_period=rig.control_period,
        damping_ratio=law.damping_ratio(damping, mass, velocity, math.sqrt(slowest * fastest)),
        law=law.name,
        two_sided=math.isfinite(mechanism.contact.clearance),
    )


def find_nearest(mechanism: Mechanism, tuned: Sequence[EarlierGains]) -> EarlierGains:
    """Return the tuned mechanism nearest to `mechanism`, the first of equally distant ones."""
    target = compute_traits(mechanism)
    return min(tuned, key=lambda candidate: _compute_trait_distance(target, candidate.traits))


def find_nearest_of_each(
    mechanism: AnyMechanism, sources: Sequence[Sequence[EarlierGains]]
) -> list[EarlierGains]:
    """Return the nearest mechanism of each source; none in six axes, where no distance is defined."""
    if not isinstance(mechanism, Mechanism):
        return []
    return [find_nearest(mechanism, tuned) for tuned in sources]


def transfer_gains(
    compensator: str, gains: Mapping[str, float], source: Mechanism, target: Any
) -> dict[str, float]:
    """Convert gains of `compensator` tuned for `source` to `target`.

    A gain on a logarithmic scale keeps its ratio to the literature's value. Any other gain keeps its
    difference from the literature's value as a share of the gain's range. Both are then clipped to the
    target's bounds. For equal mechanisms the gains do not change.
    """
    old_literature, new_literature = (
        literature_gains(source, compensator),
        literature_gains(target, compensator),
    )
    converted = {}
    for gain in COMPENSATORS[compensator].gains:
        old, new = old_literature[gain.name], new_literature[gain.name]
        lower, upper = float(gain.lower(target)), float(gain.upper(target))
        span = float(gain.upper(source)) - float(gain.lower(source))
        # In this form a factor of 1 leaves every digit of the gain unchanged.
        if gain.logarithmic and old > 0:
            value = gains[gain.name] * (new / old)
        else:
            factor = (upper - lower) / span if span > 0 else 1.0
            value = gains[gain.name] * factor + (new - old * factor)
        converted[gain.name] = min(max(value, lower), upper)
    return converted


def _compute_trait_distance(ours: MechanismTraits, theirs: MechanismTraits) -> float:
    omega = ((ours.slowest * ours.fastest) * (theirs.slowest * theirs.fastest)) ** 0.25
    squares = [
        (math.log(ours.slowest) - math.log(theirs.slowest)) ** 2 / 2,
        (math.log(ours.fastest) - math.log(theirs.fastest)) ** 2 / 2,
        (math.pi * (ours.damping_ratio - theirs.damping_ratio)) ** 2,
        float((ours.law, ours.two_sided) != (theirs.law, theirs.two_sided)),
    ]
    for name in ("force_delay", "simulator_delay", "control_period"):
        squares.append((math.pi / 2 * omega * (getattr(ours, name) - getattr(theirs, name))) ** 2)
    return math.sqrt(sum(squares))
