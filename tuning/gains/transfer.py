"""Gains tuned for one mechanism as a start for its neighbours.

`distance` says how alike two mechanisms are, `nearest` picks the most alike of those already tuned, and
`carry_over` makes its gains those of another mechanism.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxhil.contact.laws import contact_law
from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.scenario import build_scenarios
from tuning.gain_file import validity_envelope


class Traits(NamedTuple):
    """What a mechanism's restitution without compensation depends on, nominally."""

    slowest: float  # omega of the slowest contact [rad/s]
    fastest: float  # of the fastest [rad/s]
    force_delay: float  # delay and lag of the force sensor [s]
    simulator_delay: float  # those of the motion simulator with its command [s]
    control_period: float  # [s]
    damping_ratio: float  # [1]
    law: str  # contact law
    two_sided: bool  # whether there are two surfaces


@dataclass(frozen=True)
class Tuned:
    """Gains that were tuned before."""

    mechanism: Mechanism  # that they were tuned for
    gains: Mapping[str, float]  # [SI units]
    source: str  # where they come from, as a user would say

    @functools.cached_property
    def traits(self) -> Traits:
        """Those of the mechanism."""
        return traits(self.mechanism)


def distance(a: Mechanism, b: Mechanism) -> float:
    """How unlike two mechanisms are [1]: 0 for equal ones, the same both ways.

    The root of the sum of squares of

        ln(omega_a / omega_b)       of the slowest and of the fastest contact, half of each square
        (pi/2) omega (tau_a - tau_b)    of the force's delay, the motion simulator's, the control period,
                                    omega the geometric mean of all four frequencies
        pi (xi_a - xi_b)            of the damping ratio
        1                           for another contact law or number of surfaces

    so that each counts by what it does to ln e: a delay in the loop multiplies the restitution by about
    exp(pi omega tau / 2), damping by about exp(-pi xi).
    """
    return _apart(traits(a), traits(b))


def traits(mechanism: Mechanism) -> Traits:
    """Of the nominal run. The stiffness k of a law that is not linear is that of the linear contact with the
    same peak force (`validity_envelope`); xi = b/(2 sqrt(k M)), of Hunt and Crossley's law chi v/pi, from
    e = 1 - chi v; the largest of all contacts."""
    nominal = build_scenarios(mechanism)
    frequency = validity_envelope(mechanism, nominal)["contact_frequency"]
    slowest, fastest = (2 * math.pi * frequency[end] for end in ("low", "high"))
    simulator, sensor, rig = nominal.simulator, nominal.force_sensor, mechanism.rig
    # The lag of num(s)/den(s) behind a uniform motion: the difference of their slopes at s = 0.
    slopes = [
        float(one[-2, 0] / one[-1, 0]) if len(one) > 1 else 0.0
        for one in (np.asarray(simulator.denominator), np.asarray(simulator.numerator))
    ]
    held = rig.command_latency - (0.5 if rig.command_hold == "zoh" else 0.0)
    damping = float(np.max(nominal.contact.damping))
    mass, velocity = mechanism.bodies.mass, mechanism.approach.velocity
    law = contact_law(mechanism.contact.law)
    return Traits(
        slowest=slowest,
        fastest=fastest,
        force_delay=float(sensor.delay[0] + sensor.time_constant[0]),
        simulator_delay=float(simulator.delay[0]) + slopes[0] - slopes[1] + held * rig.control_period,
        control_period=rig.control_period,
        damping_ratio=law.damping_ratio(damping, mass, velocity, math.sqrt(slowest * fastest)),
        law=law.name,
        two_sided=math.isfinite(mechanism.contact.clearance),
    )


def nearest(mechanism: Mechanism, tuned: Sequence[Tuned]) -> Tuned:
    """The tuned mechanism least distant from `mechanism`, the first of equally distant ones."""
    own = traits(mechanism)
    return min(tuned, key=lambda one: _apart(own, one.traits))


def near_to(mechanism: AnyMechanism, sources: Sequence[Sequence[Tuned]]) -> list[Tuned]:
    """The nearest mechanism of each source; in six axes it is not known what is near."""
    if not isinstance(mechanism, Mechanism):
        return []
    return [nearest(mechanism, known) for known in sources]


def carry_over(
    compensator: str, gains: Mapping[str, float], source: Mechanism, target: Any
) -> dict[str, float]:
    """Gains of `compensator` tuned for `source`, for `target`.

    Bounds and the literature's values follow from the mechanism: from its stiffness and mass, its delays, its
    control period. What tuning found is taken relative to them. A gain on a logarithmic scale keeps its ratio
    to the literature's value, any other its displacement from it as a share of the gain's range; both are
    then clipped into the target's bounds. For equal mechanisms these are the very gains.
    """
    known, wanted = literature_gains(source, compensator), literature_gains(target, compensator)
    carried = {}
    for gain in COMPENSATORS[compensator].gains:
        old, new = known[gain.name], wanted[gain.name]
        lower, upper = float(gain.lower(target)), float(gain.upper(target))
        span = float(gain.upper(source)) - float(gain.lower(source))
        # Written so that a factor of 1 changes no digit.
        if gain.logarithmic and old > 0:
            value = gains[gain.name] * (new / old)
        else:
            factor = (upper - lower) / span if span > 0 else 1.0
            value = gains[gain.name] * factor + (new - old * factor)
        carried[gain.name] = min(max(value, lower), upper)
    return carried


def _apart(ours: Traits, theirs: Traits) -> float:
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
