"""Transfer of tuned gains to a similar mechanism, as starting gains for its tuning.

`compute_mechanism_distance` measures how much two mechanisms differ, `find_nearest` selects the most similar
tuned mechanism, and `transfer_gains` converts gains from one mechanism to another.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.laws.shared.nominal_values import force_delay as nominal_force_delay
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.scenario import build_scenarios
from tuning.gain_file import validity_envelope


class MechanismTraits(NamedTuple):
    """Nominal properties of a mechanism and its rig that determine the restitution without compensation."""

    slowest: float  # angular frequency of the slowest contact [rad/s]
    fastest: float  # angular frequency of the fastest contact [rad/s]
    force_delay: float  # delay plus lag of the force sensor [s]
    simulator_delay: float  # delay plus lag of the motion simulator, including the command's delay [s]
    control_period: float  # [s]
    damping_ratio: float  # largest damping ratio of all contacts [1]
    law: str  # name of the contact law
    two_sided: bool  # whether there are two contact surfaces


@dataclass(frozen=True)
class EarlierGains:
    """Gains that were tuned earlier, for another mechanism."""

    mechanism: Mechanism  # mechanism for which the gains were tuned
    gains: Mapping[str, float]  # [SI units]
    source: str  # file or mechanism from which the gains come, for messages

    @functools.cached_property
    def traits(self) -> MechanismTraits:
        return compute_traits(self.mechanism)


def compute_mechanism_distance(a: Mechanism, b: Mechanism) -> float:
    """Return a dimensionless distance between two mechanisms, symmetric and 0 for equal mechanisms.

    The distance is the root of the sum of squares of

        ln(omega_a / omega_b) / sqrt(2)     for the slowest and for the fastest contact
        (pi/2) omega (tau_a - tau_b)        for force delay, motion simulator delay and control period; omega
                                            is the geometric mean of the four contact frequencies
        pi (xi_a - xi_b)                    for the damping ratio
        1                                   if contact law or number of surfaces differs

    Each term approximates the effect of its property on ln e: a delay in the loop multiplies the restitution
    e by about exp(pi omega tau / 2), and damping by about exp(-pi xi).
    """
    return _compute_trait_distance(compute_traits(a), compute_traits(b))


def compute_traits(mechanism: Mechanism) -> MechanismTraits:
    """Compute the nominal properties by which a mechanism is compared with others.

    The contact frequencies of a nonlinear law are those of the linear contact with the same peak force
    (`validity_envelope`). With damping b, stiffness k and mass M, the damping ratio is b/(2 sqrt(k M)). For
    the law of Hunt and Crossley, it is chi v/pi with the law's damping parameter chi and the approach speed
    v, since e is about 1 - chi v.
    """
    nominal = build_scenarios(mechanism)
    frequency = validity_envelope(mechanism, nominal)["contact_frequency"]
    slowest, fastest = (2 * math.pi * frequency[end] for end in ("low", "high"))
    simulator, rig = nominal.simulator, mechanism.rig
    # In uniform motion, the output of num(s)/den(s) lags by den'(0)/den(0) - num'(0)/num(0).
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
        force_delay=nominal_force_delay(mechanism),
        simulator_delay=float(simulator.delay[0])
        + slopes[0]
        - slopes[1]
        + (0.0 if simulator.window is None else float(simulator.window[0]) / 2)
        + command_delay * rig.control_period,
        control_period=rig.control_period,
        damping_ratio=law.damping_ratio(damping, mass, velocity, math.sqrt(slowest * fastest)),
        law=law.name,
        two_sided=math.isfinite(mechanism.contact.clearance),
    )


def find_nearest(mechanism: Mechanism, tuned: Sequence[EarlierGains]) -> EarlierGains:
    """Return the tuned gains whose mechanism has the smallest distance from `mechanism`."""
    target = compute_traits(mechanism)
    return min(tuned, key=lambda candidate: _compute_trait_distance(target, candidate.traits))


def find_nearest_of_each(
    mechanism: AnyMechanism, sources: Sequence[Sequence[EarlierGains]]
) -> list[EarlierGains]:
    """Return, from each list in `sources`, the gains tuned for the nearest mechanism; for six axes, none."""
    if not isinstance(mechanism, Mechanism):
        return []
    return [find_nearest(mechanism, tuned) for tuned in sources]


def transfer_gains(
    compensator: str, gains: Mapping[str, float], source: Mechanism, target: Any
) -> dict[str, float]:
    """Convert gains that were tuned for the mechanism `source` to the mechanism `target`.

    A gain on a logarithmic scale keeps its ratio to the literature's value. Any other gain keeps its
    difference from the literature's value, as a fraction of the gain's range. All gains are clipped to the
    bounds for `target`. If the two mechanisms are equal, the gains do not change.
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
        # These formulas leave a gain unchanged to the last digit if the mechanisms are equal.
        if gain.logarithmic and old > 0:
            value = gains[gain.name] * (new / old)
        else:
            factor = (upper - lower) / span if span > 0 else 1.0
            value = gains[gain.name] * factor + (new - old * factor)
        converted[gain.name] = min(max(value, lower), upper)
    return converted


def _compute_trait_distance(a: MechanismTraits, b: MechanismTraits) -> float:
    omega = ((a.slowest * a.fastest) * (b.slowest * b.fastest)) ** 0.25
    squares = [
        (math.log(a.slowest) - math.log(b.slowest)) ** 2 / 2,
        (math.log(a.fastest) - math.log(b.fastest)) ** 2 / 2,
        (math.pi * (a.damping_ratio - b.damping_ratio)) ** 2,
        float((a.law, a.two_sided) != (b.law, b.two_sided)),
    ]
    for name in ("force_delay", "simulator_delay", "control_period"):
        squares.append((math.pi / 2 * omega * (getattr(a, name) - getattr(b, name))) ** 2)
    return math.sqrt(sum(squares))
