"""Construction of the static `Loop` for a mechanism, a compensator and a batch of scenarios.

A `Loop` contains only what determines the compiled program. The lengths of delay lines are powers of two, so
that mechanisms with similar delays share a program.
"""

import jax
import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.sensor_filter import find_modes
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.cells import MAX_POLE, NO_CELLS, CellCounts, count_cells, fastest_pole
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.moving_average import DEGREE
from jaxhil.simulation.scenario import Scenario, add_jitter

MIN_RING_LENGTH = 16  # minimum length of a delay line [samples]
# Maximum pole of the motion simulator and maximum contact frequency [rad per control period] for computing a
# contact without cells. Up to these rates, the peak force is accurate to 2e-3.
MAX_SAMPLED_RATES = (1.0, 0.1)
# The same limits for a force sensor with a lag or a contact law with memory: up to these rates, the
# restitution is accurate to 1e-5.
MAX_SAMPLED_RATES_WITH_MEMORY = (0.15, 0.05)
# factor by which the rate b/M of a damper is multiplied for the comparison with contact frequencies [1]. It
# exceeds 1 because a damper's force jumps at the onset of contact.
DAMPER_WEIGHT = 2.0


def build_loop(
    mechanism: Mechanism,
    compensator: str,
    scenarios: Scenario,
    energies: bool = False,
    chatter: bool = False,
    exact: bool = False,
) -> Loop:
    """Build the loop that runs all `scenarios` of a mechanism.

    Args:
        mechanism: Mechanism to be simulated.
        compensator: Name of the compensator.
        scenarios: Scenarios. The loop includes every effect that at least one scenario has.
        energies: Whether to record the mechanical work of the real force.
        chatter: Whether to record the excess variation of the force command.
        exact: Whether to compute the contact from the exact motion between the samples in every case.
            Restitution, peak force, duration and work are then accurate to 1e-6. Otherwise a method that is
            several times faster is used for slow motion, where its accuracy is sufficient.
    """
    rig, force, position = mechanism.rig, scenarios.force_sensor, scenarios.position_sensor
    simulator, sensor_filter = scenarios.simulator, rig.force_sensor.filter
    law = COMPENSATORS[compensator]
    sensed = add_jitter(np.maximum(force.delay, position.delay) + simulator.delay, scenarios.timing)
    aligned = [g.upper(mechanism) for g in law.gains if g.name == "identification_delay"]

    def samples(delay) -> int:
        """Return the length of a delay line for a delay of up to `delay` [s]."""
        periods = float(np.max(delay / scenarios.control_period))
        return max(MIN_RING_LENGTH, 1 << int(np.ceil(np.log2(periods + 4))))

    past = sensed if simulator.window is None else np.maximum(sensed, simulator.window)
    is_two_sided = bool(np.any(np.isfinite(scenarios.clearance)))
    return Loop(
        law=find_contact_law(mechanism.contact.law).simulation_law,
        compensator=law,
        integrator=rig.integrator,
        hold=rig.command_hold,
        latency=rig.command_latency,
        has_lag=bool(np.any(force.time_constant > 0)),
        sensor_filter=None if sensor_filter is None else find_modes(sensor_filter.kind, sensor_filter.order),
        has_force_bias=force.bias_walk is not None or bool(np.any(force.bias != 0)),
        has_force_noise=bool(np.any(force.noise_std > 0)),
        has_position_noise=bool(np.any(position.noise_std > 0)),
        has_sample_effects=bool(
            np.any(force.quantum > 0)
            or np.any(force.dead_zone > 0)
            or np.any(np.isfinite(force.range))
            or np.any(position.quantum > 0)
        ),
        cuts_dead_zone=rig.force_sensor.dead_zone_kind == "cut" and bool(np.any(force.dead_zone > 0)),
        has_limits=bool(
            np.any(np.isfinite(simulator.velocity_limit)) or np.any(np.isfinite(simulator.acceleration_limit))
        ),
        discontinuity_order=_find_discontinuity_order(simulator, rig.command_hold),
        cells=_choose_cell_counts(mechanism, scenarios, exact),
        is_two_sided=is_two_sided,
        ring=samples(past),
        controller_ring=samples(max(aligned, default=0.0)),
        energies=energies,
        probed=scenarios.probe is not None,
        chatter=chatter,
        has_timing=scenarios.timing is not None,
    )


def _choose_cell_counts(mechanism: Mechanism, scenarios: Scenario, exact: bool) -> CellCounts:
    """Return the numbers of cells in a sampling interval; `NO_CELLS` for slow motion unless `exact` is set.

    The numbers suffice for the fastest pole, shortest lag and longest control period of all scenarios.
    """
    period = float(np.max(scenarios.control_period))
    window = scenarios.simulator.window
    fastest = float(np.max(fastest_pole(scenarios.simulator.denominator))) * period
    lags = np.asarray(scenarios.force_sensor.time_constant) / period
    law, lagging = find_contact_law(mechanism.contact.law), bool(np.any(lags > 0))
    has_memory = law.has_memory or lagging
    pole, contact = MAX_SAMPLED_RATES_WITH_MEMORY if has_memory else MAX_SAMPLED_RATES
    if window is not None:
        # The motion has a kink within every interval, where a lag or a law with memory would be inaccurate.
        fastest = np.inf if has_memory else period / float(np.min(window))
    slow = fastest <= pole and _max_contact_frequency(mechanism, scenarios) * period <= contact
    if mechanism.rig.force_sensor.filter is not None:
        exact = True
    if slow and (law.is_locally_parabolic or not lagging) and not exact:
        return NO_CELLS
    if window is not None:
        return count_cells(0.0, lags)._replace(degree=DEGREE)
    return count_cells(min(fastest, MAX_POLE), lags)


def _max_contact_frequency(mechanism: Mechanism, scenarios: Scenario) -> float:
    """Return the largest contact frequency [rad/s] of all scenarios, at the velocity of the first approach.

    The contact frequency is the larger of sqrt(k/M) and 2 b/M. Here M is the equivalent mass, and k is the
    slope of the force over the penetration at the deepest point. b is the derivative of the force with
    respect to the penetration rate at the onset of contact.
    """
    # Convert JAX arrays: only NumPy broadcasts arrays with a contact axis against arrays without one.
    law, contact = find_contact_law(mechanism.contact.law), jax.tree.map(np.asarray, scenarios.contact)
    mass, velocity = np.asarray(scenarios.equivalent_mass), np.asarray(scenarios.velocity)
    if contact.stiffness.ndim > contact.damping.ndim:  # (slots, segments, lanes): the stiffest segment
        contact = contact._replace(stiffness=np.max(contact.stiffness, axis=1))
    with np.errstate(all="ignore"):
        slope, damping = law.tangent_stiffness(contact, mass, velocity), law.onset_damping(contact)
        frequency = np.max(np.sqrt(slope / mass), initial=0.0)
        return float(max(frequency, DAMPER_WEIGHT * np.max(damping / mass)))


def _find_discontinuity_order(simulator, hold: str) -> int:
    """Return the order of the lowest derivative of the position that jumps at the ticks, at most 3.

    The order is the relative degree of the motion simulator, plus 1 if the position command does not jump.
    A moving average has the relative degree 1.
    """
    numerator = simulator.numerator
    if simulator.window is not None:
        return 1 + (hold == "linear")
    proper = [i + 1 for i in range(len(numerator)) if np.any(numerator[i] != 0)]
    return min((proper[0] if proper else 0) + (hold == "linear"), 3)
