"""Dead zone that replaces small forces by 0 and leaves larger forces unchanged."""

import math

import jax
import numpy as np
import pytest
from lanes import IDEAL, first_contact, mechanism, spread, validated
from oracle import simulate

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.rollout import rollout

CUT, MASS, PERIOD = {"dead_zone": 8.0, "dead_zone_kind": "cut"}, 300.0, 2.5e-4
CONTACT = {"law": "linear", "stiffness": [MASS * (2 * math.pi * 3.0) ** 2]}
RAW = mechanism(CONTACT, IDEAL, 0.003, period=PERIOD, force_sensor=CUT)
RAW["bodies"] = {"equivalent_mass": MASS}
MECHANISM = validated(RAW)
# Restitution of the first contact at 5 mm/s for T -> 0, by half-width of the dead zone [N].
RESTITUTION = {4.0: 1.0945, 8.0: 1.0989, 12.0: 1.1058}


def test_cut_dead_zone_increases_restitution_by_the_work_that_it_removes():
    """Average over four phases to cancel the jumps of the readings; compare each phase with the oracle."""
    phases, widths = np.tile(np.arange(4) / 4, len(RESTITUTION)), np.repeat([*RESTITUTION], 4)
    scenario = spread(MECHANISM, len(phases), phase=phases, force_sensor__dead_zone=widths)
    result = first_contact(MECHANISM, scenario)["restitution"]
    means = result.reshape(-1, 4).mean(axis=1)
    np.testing.assert_allclose(means, [*RESTITUTION.values()], rtol=0, atol=2e-4)
    for lane in (0, 7):
        raw = {**RAW, "approach": RAW["approach"] | {"phase": phases[lane]}}
        raw["rig"] = RAW["rig"] | {"force_sensor": {"delay": 0.003, **CUT, "dead_zone": widths[lane]}}
        assert result[lane] == pytest.approx(simulate(raw)[0]["restitution"], abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "step", "tolerance"), [("dead_zone", 2.0, 0.01), ("delay", 4e-4, 0.01)])
def test_derivative_with_cut_dead_zone_equals_derivative_of_mean_over_phases(name, step, tolerance):
    lanes = 512
    scenario = spread(MECHANISM, lanes, phase=(np.arange(lanes) + 0.5) / lanes)
    loop = build_loop(MECHANISM, "none", scenario)
    gains: Gains = {}

    def restitution(shift):
        sensor = scenario.force_sensor
        sensor = sensor._replace(**{name: getattr(sensor, name) + shift})
        return rollout(loop, gains, scenario._replace(force_sensor=sensor)).restitution[0]

    run = jax.jit(restitution)
    central = float((np.mean(run(step)) - np.mean(run(-step))) / (2 * step))
    slope = jax.jit(lambda shift: jax.jvp(restitution, (shift,), (1.0,))[1])(0.0)
    print(float(np.mean(slope)), central)
    assert float(np.mean(slope)) == pytest.approx(central, rel=tolerance)
