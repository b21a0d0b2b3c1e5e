"""Common programs: results in a shared program equal those in a separate program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import IDEAL, SECOND_ORDER, as_arrays, mechanism, run_rollout, validated

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.outcome import compare_with_ideal
from jaxhil.simulation.scenario import build_scenarios
from tuning.batches import join_batches
from tuning.gains.common_program import group_by_common_program

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
    result = {}
    for name, contact in CONTACTS.items():
        several = 3 if "depth" not in str(contact) and name != "hardening" else 1
        raw = mechanism(contact, contacts=several)
        result[name] = validated({**raw, "uncertainty": SPREAD})
    noisy = mechanism({}, force_sensor={"noise_std": 0.1, "dead_zone": 0.3, "time_constant": 0.001})
    return {**result, "noisy": validated({**noisy, "name": "noisy", "uncertainty": SPREAD})}


MEMBERS = members()
ALONE = ("piecewise_linear", "hardening", "noisy")
GAINS, LANES = {"phase_lead": 0.005, "lead_filter": 0.001}, 4


def test_common_program_includes_every_contact_law():
    groups = group_by_common_program(list(MEMBERS.values()))
    assert [len(group) for group, _ in groups] == [len(MEMBERS)]
    assert set(groups[0][1].laws) == set(CONTACT_LAWS)


def test_mechanisms_with_different_surfaces_or_model_orders_share_no_program():
    others = [
        mechanism({}),
        mechanism({"clearance": 0.02}),
        mechanism({}, IDEAL),
        mechanism({}, SECOND_ORDER, command_hold="zoh"),
        mechanism(CONTACTS["hardening"], contacts=2),
    ]
    groups = [group for group, _ in group_by_common_program([validated(raw) for raw in others])]
    assert groups == [[0], [1], [2], [3], [4]]


@pytest.mark.slow
def test_common_program_gives_the_same_results_as_separate_programs():
    chosen = [MEMBERS[name] for name in ALONE]
    [(_, common)] = group_by_common_program(chosen)
    scenarios = [build_scenarios(member, draw(member, LANES, 1), 1) for member in chosen]
    in_form = [common.scenarios(member, batch) for member, batch in zip(chosen, scenarios, strict=True)]
    joined = join_batches(in_form)
    together = evaluate(common.loop(build_loop(MEMBERS["noisy"], "phase_lead", joined)), GAINS, joined)
    for index, (name, member, batch) in enumerate(zip(ALONE, chosen, scenarios, strict=True)):
        loop = build_loop(member, "phase_lead", batch)
        batch = jax.tree.map(jnp.asarray, batch)
        metrics = run_rollout(loop, as_arrays(GAINS), batch)
        expected = compare_with_ideal(loop, batch, metrics)
        lanes = slice(index * LANES, (index + 1) * LANES)
        good = np.asarray(expected.good)
        assert np.all(good == expected.is_scheduled) and np.any(good)
        np.testing.assert_array_equal(together.good[:, lanes], good, err_msg=name)
        for figure in ("error", "reference_restitution", "peak_ratio"):
            joint, alone = getattr(together, figure)[:, lanes], np.asarray(getattr(expected, figure))
            np.testing.assert_allclose(
                joint[good], alone[good], rtol=0, atol=1e-9, err_msg=f"{name}: {figure}"
            )


@pytest.mark.slow
@pytest.mark.parametrize("exact", [True, False])
def test_common_program_simulates_force_sensors_with_and_without_lag(exact):
    lagging = mechanism(
        {"law": "kelvin_voigt"}, SECOND_ORDER, period=1e-3, force_sensor={"time_constant": 2e-4}
    )
    yielding = mechanism({"law": "elastoplastic", "unloading_ratio": 1.5}, SECOND_ORDER, period=1e-3)
    stiff = mechanism({"law": "kelvin_voigt", "stiffness": [5e6]}, SECOND_ORDER, period=1e-3)
    parsed = [validated(member) for member in (lagging, yielding, *([] if exact else [stiff]))]
    ((_, common),) = group_by_common_program(parsed)
    assert "has_lag" in common.parts
    for member in parsed[:2]:
        scenarios = build_scenarios(member, {"approach.phase": np.arange(4) / 4}, 0)
        alone = run_rollout(build_loop(member, "none", scenarios, exact=True), {}, scenarios)
        loop = common.loop(build_loop(member, "none", scenarios, exact=exact))
        shared = run_rollout(loop, {}, common.scenarios(member, scenarios))
        assert loop.has_cells
        np.testing.assert_allclose(shared.restitution, alone.restitution, rtol=1e-9)
