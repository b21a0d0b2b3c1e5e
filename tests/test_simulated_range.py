"""Metrics of a contact for the whole range of mechanisms, compared with the event-accurate oracle."""

from typing import Any

import numpy as np
import pytest
from drawn_mechanisms import BAR, FIGURES, Form, differences, oracle_figures
from lanes import join, run_rollout, validated

from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.scenario import build_scenarios

FORMS = 60
LANES = 6


def compare(form: Form, seed: int, lanes: int, longest: int) -> list[tuple[dict[str, Any], dict[str, float]]]:
    """Compare metrics; omit mechanisms whose contact does not end or whose oracle is ill-conditioned."""
    rng = np.random.default_rng(seed)
    drawn = [form.draw(rng, longest) for _ in range(lanes)]
    mechanisms = [validated(one) for one in drawn]
    scenarios = join(build_scenarios(one) for one in mechanisms)
    loop = build_loop(mechanisms[0], "none", scenarios, energies=True, exact=True)
    metrics = run_rollout(loop, {}, scenarios)
    compared = []
    for lane, one in enumerate(drawn):
        expected = oracle_figures(one) if np.asarray(metrics.status)[0, lane] == OK else None
        if expected is not None:
            result = {name: float(np.asarray(getattr(metrics, name))[0, lane]) for name in FIGURES}
            compared.append((one, differences(result, expected)))
    return compared


@pytest.mark.parametrize("number", [33, pytest.param(38, marks=pytest.mark.slow)])
def test_contacts_of_random_mechanisms_agree_with_oracle(number):
    compared = compare(Form(number), seed=number, lanes=3, longest=16)
    assert len(compared) >= 2
    for mechanism, difference in compared:
        assert max(difference.values()) <= BAR, (difference, mechanism)


@pytest.mark.slow
def test_contacts_of_300_random_mechanisms_agree_with_oracle():
    compared = []
    for number in range(FORMS):
        compared += compare(Form(number), seed=number, lanes=LANES, longest=60)
    worst = {name: max(difference[name] for _, difference in compared) for name in FIGURES}
    print(len(compared), worst)
    assert len(compared) >= 300
    for mechanism, difference in compared:
        assert max(difference.values()) <= BAR, (difference, mechanism)
