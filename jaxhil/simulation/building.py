"""From a mechanism and a compensator's name to the static `Loop` that serves a batch of scenarios.

Only what shapes the program is decided here; delay lines are sized in powers of two, so that mechanisms with
like delays share one compiled program.
"""

import numpy as np

from jaxhil.compensators import COMPENSATORS
from jaxhil.contact.laws import LAWS
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.scenario import Scenario

SHORTEST_RING = 16


def build_loop(
    mechanism: Mechanism, compensator: str, scenarios: Scenario, energies: bool = False, chatter: bool = False
) -> Loop:
    """The loop of `mechanism` under the compensator called `compensator`, for all `scenarios` at once.

    `energies` asks for the works of the real force, `chatter` for the command's excess variation.
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
        law=LAWS[mechanism.contact.law],
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
        is_two_sided=is_two_sided,
        ring=samples(sensed),
        controller_ring=samples(max(aligned, default=0.0)),
        energies=energies,
        probed=scenarios.probe is not None,
        chatter=chatter,
    )


def _first_break(numerator, hold: str) -> int:
    """The relative degree of the motion simulator, and one more where the command itself has no jumps."""
    proper = [i + 1 for i in range(len(numerator)) if np.any(numerator[i] != 0)]
    return min((proper[0] if proper else 0) + (hold == "linear"), 3)
