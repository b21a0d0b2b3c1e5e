"""Forms: a mechanism does the same in a common form as alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import IDEAL, SECOND_ORDER, as_arrays, mechanism, run_rollout, validated

from jaxhil.contact.laws import LAWS
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.outcome import compare_with_reference
from jaxhil.simulation.scenario import build_scenarios
from tuning.batches import join
from tuning.gains.common_program import common_programs

SPREAD = {"contact.stiffness": {"distribution": "uniform", "factor": [0.5, 2.0]}}
CONTACTS = {
    "linear": {"law": "linear"},
    "kelvin_voigt": {"damping": [900.0, 300.0]},
    "tension": {"damping": [900.0], "tension": True},
    "hunt_crossley": {"law": "hunt_crossley", "stiffness": [3e6], "damping": [2.0]},
    "piecewise_linear": {
        "law": "piecewise_linear", "stiffness": [[1e5, 3e5, 1e5]], "depths": [1e-4, 2e-4], "damping": [100.0],
    },
    "hardening": {"law": "hardening", "reference_depth": 2e-4, "damping": [200.0]},
    "depth_damped": {
        "law": "depth_damped", "stiffness": [3e6], "damping": [900.0], "reference_depth": 2e-4,
    },
    "elastoplastic": {"law": "elastoplastic", "unloading_ratio": 1.5},
    "preloaded": {"law": "preloaded", "preload": 6.0, "friction": 3.0},
}  # fmt: skip


def members():
    found = {}
    for name, contact in CONTACTS.items():
        several = 3 if "depth" not in str(contact) and name != "hardening" else 1
        raw = mechanism(contact, contacts=several)
        found[name] = validated({**raw, "uncertainty": SPREAD})
    noisy = mechanism({}, force_sensor={"noise_std": 0.1, "dead_zone": 0.3, "time_constant": 0.001})
    return {**found, "noisy": validated({**noisy, "name": "noisy", "uncertainty": SPREAD})}


MEMBERS = members()
ALONE = ("piecewise_linear", "hardening", "noisy")
GAINS, LANES = {"phase_lead": 0.005, "lead_filter": 0.001}, 4


def test_one_form_has_every_contact_law():
    groups = common_programs(list(MEMBERS.values()))
    assert [len(group) for group, _ in groups] == [len(MEMBERS)]
    assert set(groups[0][1].laws) == set(LAWS)


def test_two_surfaces_and_other_orders_stay_apart():
    others = [
        mechanism({}),
        mechanism({"clearance": 0.02}),
        mechanism({}, IDEAL),
        mechanism({}, SECOND_ORDER, command_hold="zoh"),
        mechanism(CONTACTS["hardening"], contacts=2),
    ]
    groups = [group for group, _ in common_programs([validated(raw) for raw in others])]
    assert groups == [[0], [1], [2], [3], [4]]


@pytest.mark.slow
def test_the_same_as_alone():
    some = [MEMBERS[name] for name in ALONE]
    [(_, common)] = common_programs(some)
    scenarios = [build_scenarios(one, draw(one, LANES, 1), 1) for one in some]
    in_form = [common.scenarios(one, batch) for one, batch in zip(some, scenarios, strict=True)]
    joined = join(in_form)
    together = evaluate(common.loop(build_loop(MEMBERS["noisy"], "phase_lead", joined)), GAINS, joined)
    for place, (name, one, batch) in enumerate(zip(ALONE, some, scenarios, strict=True)):
        loop = build_loop(one, "phase_lead", batch)
        batch = jax.tree.map(jnp.asarray, batch)
        metrics = run_rollout(loop, as_arrays(GAINS), batch)
        expected = compare_with_reference(loop, batch, metrics)
        own = slice(place * LANES, (place + 1) * LANES)
        good = np.asarray(expected.good)
        assert np.all(good == expected.wanted) and np.any(good)
        np.testing.assert_array_equal(together.good[:, own], good, err_msg=name)
        for figure in ("error", "reference_restitution", "peak_ratio"):
            found, wanted = getattr(together, figure)[:, own], np.asarray(getattr(expected, figure))
            np.testing.assert_allclose(
                found[good], wanted[good], rtol=0, atol=1e-9, err_msg=f"{name}: {figure}"
            )


@pytest.mark.parametrize("exact", [True, False])
def test_lags_beside_none_in_cells(exact):
    """Contact along the exact motion, because it is asked for or because one of the mechanisms is stiff."""
    lagging = mechanism(
        {"law": "kelvin_voigt"}, SECOND_ORDER, period=1e-3, force_sensor={"time_constant": 2e-4}
    )
    yielding = mechanism({"law": "elastoplastic", "unloading_ratio": 1.5}, SECOND_ORDER, period=1e-3)
    stiff = mechanism({"law": "kelvin_voigt", "stiffness": [5e6]}, SECOND_ORDER, period=1e-3)
    parsed = [validated(one) for one in (lagging, yielding, *([] if exact else [stiff]))]
    ((_, common),) = common_programs(parsed)
    assert "has_lag" in common.parts
    for one in parsed[:2]:
        scenarios = build_scenarios(one, {"approach.phase": np.arange(4) / 4}, 0)
        alone = run_rollout(build_loop(one, "none", scenarios, exact=True), {}, scenarios)
        loop = common.loop(build_loop(one, "none", scenarios, exact=exact))
        shared = run_rollout(loop, {}, common.scenarios(one, scenarios))
        assert loop.has_cells
        np.testing.assert_allclose(shared.restitution, alone.restitution, rtol=1e-9)
