"""Conditions of Li et al. 2026 (dead zone of 8 N, force 3 ms late), for the evidence page.

The paper's hybrid Smith predictor is `smith_hybrid`. With an ideal motion simulator its lag T_s is 0, and the
law is `phase_lead`. With the observer in addition, it is `dead_zone_observer`.
"""

import math
from statistics import fmean

import pytest
from lanes import IDEAL, mechanism, nominal_gains, validated
from oracle import simulate

from jaxhil.rig import COMPENSATORS

MASS, DELAY, FREQUENCY, SPEED, CONTACTS = 300.0, 0.003, 3.0, 0.005, 4
STIFFNESS = MASS * (2 * math.pi * FREQUENCY) ** 2
PERIOD, PHASES = 2.5e-4, (0.0, 0.25, 0.5, 0.75)
LAWS = "none", "smith_hybrid", "dead_zone_observer"
# By case: arguments of `restitution`; published restitution by law; restitution of four contacts by law.
ROWS = {
    "undamped": (
        (0.0, STIFFNESS, SPEED),
        (None, None, 0.9989),
        [(1.0989, 1.0978, 1.0972, 1.0966), (1.0003, 1.0, 1.0, 1.0), (1.0001, 1.0001, 1.0001, 1.0001)],
    ),
    "damping ratio 0.1": (
        (0.1, STIFFNESS, SPEED),
        (None, None, 0.7294),
        [(0.782, 0.7737, 0.7603, 0.7369), (0.7067, 0.6867, 0.6478, 0.561), (0.731, 0.7346, 0.7482, 0.7852)],
    ),
    "rod": (
        (0.0, 1e5, 0.01),
        (1.0892, 1.0218, 0.9987),
        [(1.0914, 1.0912, 1.091, 1.0908), (1.0, 1.0, 1.0, 1.0), (1.0001, 1.0001, 1.0001, 1.0001)],
    ),
}


def restitution(law: str, ratio: float, stiffness: float, speed: float) -> list[float]:
    """Return the restitution of each successive contact with damping ratio `ratio`, averaged over contact
    phases.
    """
    damping = 2 * ratio * math.sqrt(stiffness * MASS)
    contact = {"law": "kelvin_voigt", "stiffness": [stiffness], "damping": [damping], "tension": ratio > 0}
    sensor = {"dead_zone": 8.0, "dead_zone_kind": "cut"}
    runs = []
    for phase in PHASES:
        raw = mechanism(
            contact, IDEAL, DELAY, CONTACTS, period=PERIOD, velocity=speed, phase=phase, force_sensor=sensor
        )
        raw["bodies"] = {"equivalent_mass": MASS}
        parsed = validated(raw)
        gains = nominal_gains(parsed, law)
        runs.append(simulate(raw, COMPENSATORS[law](gains, PERIOD, math.inf)))
    return [fmean(run[index]["restitution"] for run in runs) for index in range(CONTACTS)]


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_restitution_behind_cut_dead_zone_is_close_to_published_values(row):
    arguments, published, expected = ROWS[row]
    for law, there, ours in zip(LAWS, published, expected, strict=True):
        result = restitution(law, *arguments)
        print(f"\n{row}, {law}: published {there}, {' '.join(f'{e:.4f}' for e in result)}", end="")
        assert result == pytest.approx(ours, abs=6e-5)
        # Measurements on a rig scatter by more than the difference of laws with exact knowledge.
        if law != "smith_hybrid" and there is not None:
            assert abs(result[0] - there) < 2.5e-3
