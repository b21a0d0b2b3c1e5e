"""From logs to gains: what gains tuned on the identified file lose on the rig as it is.

Print the figures with `pytest -m slow -s tests/test_identify_tuning.py`.
"""

import campaign_rigs
import campaigns
import numpy as np
import pytest

import tuning
from jaxhil.mechanism.file import from_builtins
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.evaluation import evaluate
from jaxhil.simulation.scenario import build_scenarios
from tuning.identification.estimate import Options, identify

pytestmark = [pytest.mark.slow, pytest.mark.users_options]
PHASES = 511


def error(mechanism, compensator, gains):
    """rms of e - e* on the true rig over phases of its contacts."""
    scenarios = build_scenarios(mechanism, {"approach.phase": np.arange(PHASES) / PHASES}, 0)
    found = evaluate(build_loop(mechanism, compensator, scenarios), gains, scenarios)
    assert np.array_equal(found.good, found.wanted)
    return float(np.sqrt(np.mean(found.error[found.wanted] ** 2)))


@pytest.mark.parametrize("name", ("clean", "third_order", "stiffnesses"))
def test_gains_tuned_on_the_identified_file_lose_little_on_the_true_rig(name):
    truth, compensator = campaign_rigs.mechanism(name), "response_error"
    found = identify(campaigns.campaign(name, 70_000), options=Options(law="kelvin_voigt"))
    identified = from_builtins({**found.mechanism, "uncertainty": {}, "correlation": None}, "identified")
    best, own = (
        error(truth, compensator, tuning.tune(one, compensator, validation=32).gains)
        for one in (truth, identified)
    )
    print(f"{name}, {compensator}: rms e - e* {own:.5f}, of gains tuned on the truth {best:.5f}")
    assert own <= 1.10 * best + 0.0005
