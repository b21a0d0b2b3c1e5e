"""From a mechanism and a compensator's name to the static `Loop` that serves a batch of scenarios.

Only what shapes the program is decided here; delay lines are sized in powers of two, so that mechanisms with
like delays share one compiled program.
"""

import jax
import numpy as np

from jaxhil.contact.laws import contact_law
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.cells import FASTEST_POLE, NO_CELLS, CellCounts, count_cells, fastest_pole
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.scenario import Scenario

SHORTEST_RING = 16
# Greatest pole and contact frequency [rad per control period] at which samples say enough of what is between
# them: peak force to 2e-3 and, where a lag or a dent lets the loop feel it, the restitution to 1e-5.
SLOW, SLOW_BETWEEN = (1.0, 0.1), (0.15, 0.05)
DAMPED = 2.0  # a damper's rate b/M counts as so many times a frequency: its force jumps at the touch


def build_loop(
    mechanism: Mechanism,
    compensator: str,
    scenarios: Scenario,
    energies: bool = False,
    chatter: bool = False,
    exact: bool = False,
) -> Loop:
    """The loop of `mechanism` under the compensator called `compensator`, for all `scenarios` at once.

    `energies` asks for the works of the real force, `chatter` for the command's excess variation, `exact` for
    restitution, peak force, duration and works to 1e-6 by the motion between samples, where others take what
    samples say as long as that is enough, in a small part of the time.
    """
    rig, force, position = mechanism.rig, scenarios.force_sensor, scenarios.position_sensor
    simulator = scenarios.simulator
    law = COMPENSATORS[compensator]
    sensed = np.maximum(force.delay, position.delay) + simulator.delay
    aligned = [g.upper(mechanism) for g in law.gains if g.name == "identification_delay"]

    def samples(delay) -> int:
        """Read are samples up to the delay back, plus the interval under way and its start."""
        periods = float(np.max(delay / scenarios.control_period))
        return max(SHORTEST_RING, 1 << int(np.ceil(np.log2(periods + 4))))

    is_two_sided = bool(np.any(np.isfinite(scenarios.clearance)))
    return Loop(
        law=contact_law(mechanism.contact.law).simulated,
        compensator=law,
        integrator=rig.integrator,
        hold=rig.command_hold,
        latency=rig.command_latency,
        has_lag=bool(np.any(force.time_constant > 0)),
        has_force_bias=bool(np.any(force.bias != 0)),
        has_force_noise=bool(np.any(force.noise_std > 0)),
        has_position_noise=bool(np.any(position.noise_std > 0)),
        has_sample_effects=bool(
            np.any(force.quantum > 0)
            or np.any(force.dead_zone > 0)
            or np.any(np.isfinite(force.range))
            or np.any(position.quantum > 0)
        ),
        has_limits=bool(
            np.any(np.isfinite(simulator.velocity_limit)) or np.any(np.isfinite(simulator.acceleration_limit))
        ),
        first_break=_first_break(simulator.numerator, rig.command_hold),
        cells=_cells(mechanism, scenarios, exact),
        is_two_sided=is_two_sided,
        ring=samples(sensed),
        controller_ring=samples(max(aligned, default=0.0)),
        energies=energies,
        probed=scenarios.probe is not None,
        chatter=chatter,
    )


def _cells(mechanism: Mechanism, scenarios: Scenario, exact: bool) -> CellCounts:
    """Cells for the fastest pole and the shortest lag of any lane, at the longest period; none where what
    samples say is enough."""
    period = float(np.max(scenarios.control_period))
    fastest = float(np.max(fastest_pole(scenarios.simulator.denominator))) * period
    lags = np.asarray(scenarios.force_sensor.time_constant) / period
    law, lagging = contact_law(mechanism.contact.law), bool(np.any(lags > 0))
    pole, contact = SLOW_BETWEEN if law.remembers or lagging else SLOW
    slow = fastest <= pole and _fastest_contact(mechanism, scenarios) * period <= contact
    if slow and (law.arcs or not lagging) and not exact:
        return NO_CELLS
    return count_cells(min(fastest, FASTEST_POLE), lags)


def _fastest_contact(mechanism: Mechanism, scenarios: Scenario) -> float:
    """The largest frequency sqrt(F'/M) [rad/s] of a contact at its deepest, or rate F_d/(2 M) of its damping,
    F_d the slope of the force against the rate at the touch; of any lane, entered at its first speed."""
    # Whatever arrays the scenarios are of: slots and lanes meet here.
    law, contact = contact_law(mechanism.contact.law), jax.tree.map(np.asarray, scenarios.contact)
    mass, velocity = np.asarray(scenarios.equivalent_mass), np.asarray(scenarios.velocity)
    if contact.stiffness.ndim > contact.damping.ndim:  # segments between slots and lanes
        contact = contact._replace(stiffness=np.max(contact.stiffness, axis=1))
    with np.errstate(all="ignore"):
        slope, damping = law.tangent_stiffness(contact, mass, velocity), law.onset_damping(contact)
        frequency = np.max(np.sqrt(slope / mass), initial=0.0)
        return float(max(frequency, DAMPED * np.max(damping / mass)))


def _first_break(numerator, hold: str) -> int:
    """The relative degree of the motion simulator, and one more where the command itself has no jumps."""
    proper = [i + 1 for i in range(len(numerator)) if np.any(numerator[i] != 0)]
    return min((proper[0] if proper else 0) + (hold == "linear"), 3)
