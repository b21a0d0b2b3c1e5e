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


@pytest.mark.parametrize(("name", "compensator", "press"), (
    ("clean", "response_error", False), ("third_order", "response_error", False),
    ("stiffnesses", "response_error", False), ("lagging", "response_error", False),
    ("lagging", "response_error", True), ("clean", "retrospective_reference", False),
))  # fmt: skip
def test_gains_tuned_on_the_identified_file_lose_little_on_the_true_rig(name, compensator, press):
    truth = campaign_rigs.mechanism(name)
    found = identify(campaigns.campaign(name, 70_000, press=press), options=Options(law="kelvin_voigt"))
    identified = from_builtins({**found.mechanism, "uncertainty": {}, "correlation": None}, "identified")
    best, own = (
        error(truth, compensator, tuning.tune(one, compensator, validation=32).gains)
        for one in (truth, identified)
    )
    with_press = " with a press" if press else ""
    print(f"{name}{with_press}, {compensator}: rms e - e* {own:.5f}, of gains tuned on the truth {best:.5f}")
    assert own <= 1.10 * best + 0.0005
