"""Six-axis mechanisms tuned and swept: gain file, store and report; errors for unsupported features."""

import json

import jax
import numpy as np
import pytest

import jaxhil as package
import tuning
from jaxhil.errors import InputError
from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.gain_file import load_gain_file
from tuning.api import arguments
from tuning.api.tune_options import TuneOptions

SMALL = {"scenarios": 8, "starts": 2, "steps": 4, "validation": 15}


def test_public_interface_lists_six_axis_compensators():
    assert tuple(SIX_AXIS_COMPENSATORS) == arguments.SIX_AXIS_COMPENSATOR_NAMES


def test_six_axis_lead_per_axis_applies_separate_lead_to_each_channel():
    mechanism = load_any("petals").mechanism
    law = SIX_AXIS_COMPENSATORS["phase_lead_per_axis"]
    gains = literature_gains(mechanism, law.name)
    assert len(gains) == 13 and set(gains.values()) == {0.0037, 0.001, 0.0}
    gains["phase_lead_rx"] = 0.02
    leads = [law.channel(gains, name)["phase_lead"] for name in ("x", "y", "z", "rx", "ry", "rz")]
    assert leads == [0.0037] * 3 + [0.02] + [0.0037] * 2


def test_public_functions_accept_six_axis_mechanisms():
    mechanism = package.load("petals", {"target.mass": 2000.0})
    assert (
        mechanism.target.mass == 2000.0 and mechanism == load_any("petals", {"target.mass": 2000.0}).mechanism
    )
    for call, reason in (
        (lambda: package.simulate(mechanism, "passivity"), "found 'passivity', expected one of none, "
                                                           "impulse_ledger"),
        (lambda: tuning.tune(mechanism, "passivity"), "'passivity', expected one of none, impulse_ledger"),
        (lambda: tuning.tune(mechanism, "phase_lead", chatter_weight=1.0), "chatter_weight: found 1.0"),
        (lambda: tuning.tune("rig-300kg", "phase_lead_per_axis"), "'phase_lead_per_axis', expected none"),
        (lambda: tuning.compare(mechanism, ["passivity"]), "found 'passivity', expected one of none, imp"),
        (lambda: package.jacobian(mechanism, by=("target.mass",)), "found jaxhil/mechanism/2 (six axes)"),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            call()
        assert reason in str(caught.value) and str(caught.value).isprintable()


def test_unsupported_six_axis_features_are_rejected_with_one_line_message(jaxhil, tmp_path):
    path = tmp_path / "gains.json"
    for given, reason in (
        (
            ["tune", "petals", "--compensator", "passivity", "-o", tmp_path],
            "--compensator: found 'passivity', expected one of none, impulse_ledger",
        ),
        (
            ["tune", "petals", "--compensator", "phase_lead", "--noise-weight", 1, "-o", tmp_path],
            "--noise-weight: found 1.0",
        ),
        (
            ["compare", "petals", "--compensators", "passivity", "-o", tmp_path],
            "--compensators: found 'passivity', expected one of none, impulse_ledger",
        ),
        (
            ["compare", "petals", "rig-300kg", "-o", tmp_path],
            "rig-300kg: found a mechanism with one axis, expected one with six axes, as petals",
        ),
        (
            ["compare", "petals", "--suites", "-o", tmp_path],
            "--suites: found the six-axis mechanism petals, expected no --suites: there are no suites",
        ),
        (
            ["map", "petals", "--x", "contact.edges.stiffness=1:2", "--y", "target.mass", "-o", tmp_path],
            "--x: found 'contact.edges.stiffness', expected the key of a number",
        ),
        (
            ["map", "petals", "--x", "target.mass=-1:1", "--y", "chaser.mass", "-o", tmp_path],
            "target.mass: found -1.0",
        ),
        (
            ["map", "petals", "--x", "target.mass", "--y", "chaser.mass", "--setting", "x", "-o", tmp_path],
            "--setting: found 'x', expected none: none has no settings",
        ),
    ):
        ran = jaxhil(*given)
        assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1 and reason in ran.err, ran.err
    assert not path.exists()


def test_six_axis_lead_per_axis_is_tuned_like_any_compensator():
    options = TuneOptions(compensator="phase_lead_per_axis", scenarios=4)
    assert (
        options.settings().objective
        == TuneOptions(compensator="phase_lead", scenarios=4).settings().objective
    )
    with pytest.raises(InputError, match="setting: found 'x', expected none: phase_lead_per_axis has no"):
        arguments.check_setting_name("phase_lead_per_axis", "x")


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    result = tuning.tune("probe-drogue", "phase_lead", **SMALL)
    path = tmp_path_factory.mktemp("six") / "gains.json"
    result.save(path)
    return result, path


@pytest.mark.slow
def test_six_axis_tuning_lowers_both_errors(tuned):
    result, path = tuned
    for error in ("energy_error", "twist_error"):
        figures = result.parts[error]
        assert figures["tuned"].rms < figures["literature"].rms / 4 < figures["before"].rms / 4
        assert figures["tuned"].failed == 0
    assert 0.02 < result.gains["phase_lead"] < 0.03
    loaded = load_gain_file(path, any_axes=True)
    assert loaded.document["axes"] == 6 and loaded.gains == result.gains
    assert loaded.mechanism == load_any("probe-drogue").mechanism
    [episode] = package.simulate("probe-drogue", "none", path).episodes
    [literature] = package.simulate("probe-drogue", "phase_lead").episodes
    assert abs(episode.energy_error) < abs(literature.energy_error) / 4


@pytest.mark.slow
def test_equal_leads_per_axis_give_the_result_of_a_common_lead():
    lead, filter_ = 0.02, 0.001
    each = {f"phase_lead_{axis}": lead for axis in ("x", "y", "z", "rx", "ry", "rz")}
    [one], [six] = (
        package.simulate("probe-drogue", law, {**leads, "lead_filter": filter_}).episodes
        for law, leads in (("phase_lead", {"phase_lead": lead}), ("phase_lead_per_axis", each))
    )
    np.testing.assert_allclose(six.energy_error, one.energy_error, rtol=1e-9)
    np.testing.assert_allclose(six.twist_error, one.twist_error, rtol=1e-9)


@pytest.mark.slow
def test_six_axis_gain_file_is_rejected_by_one_axis_controller(tuned, jaxhil, tmp_path):
    from jaxhil.rig import Controller, GainFileError

    _, path = tuned
    with pytest.raises(GainFileError, match="axes: found 6, expected 1"):
        Controller.from_file(path)
    for command_line in (["rig", path], ["simulate", "rig-300kg", "--gains", path]):
        ran = jaxhil(*command_line)
        assert ran.code == 2 and ran.err.count("\n") == 1 and "axes: found" in ran.err


@pytest.mark.slow
def test_six_axis_sweep_and_report_run_end_to_end(tuned, jaxhil, tmp_path):
    _, path = tuned
    store, page = tmp_path / "store", tmp_path / "page.html"
    ran = jaxhil("sweep", path, "--scenarios", 64, "--chunk", 32, "--limit", 0.3, "-o", store, "--json")
    assert ran.code in (0, 1), ran.err
    document = json.loads(ran.out)
    assert document["axes"] == 6 and sum(document["outcomes"].values()) == 64
    study = tuning.sweep(path, scenarios=48, limit=0.3)
    rows = {name: study.table[name].to_numpy() for name in ("twist_error_1", "worst_error")}
    np.testing.assert_array_equal(rows["worst_error"], rows["twist_error_1"])
    failed = rows["worst_error"] > 0.3
    np.testing.assert_array_equal(study.table["failed"].to_numpy(), failed)
    ran = jaxhil("report", path, store, "-o", page)
    assert ran.code in (0, 1), ran.err
    text = page.read_text(encoding="utf-8")
    assert "energy error on fresh scenarios" in text and "twist error on fresh scenarios" in text
    assert "|error|" in text and "|e - e*|" not in text
    assert f"replay {store} {document['worst'][0]['index']} --plot worst.png" in text


@pytest.mark.slow
def test_six_axis_tuning_objective_derivatives_match_finite_differences():
    from jaxhil.mechanism.uncertainty import draw_quasi_random
    from jaxhil.simulation.jax_environment import jax_context
    from jaxhil.sixdof.six_axes import SIX_AXES
    from tuning.gains.objective import RMS_OBJECTIVE, SolverProblem, compute_residuals, join_terms

    mechanism = load_any("probe-drogue").mechanism
    with jax_context():
        scenarios = SIX_AXES.scenarios(mechanism, draw_quasi_random(mechanism, 8, 0))
        loop = SIX_AXES.loop(mechanism, "phase_lead", scenarios)
        rig, weights = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (scenarios, RMS_OBJECTIVE.weights))
        static = SIX_AXES, loop, ("phase_lead", "lead_filter"), join_terms([RMS_OBJECTIVE], contacts=2)

        @jax.jit
        def loss(gains):
            return compute_residuals(static, gains[None], SolverProblem(rig, {}, weights))[0]

        at = np.array([0.015, 0.001])
        slopes = jax.jit(jax.jacfwd(loss))(at)
        for index, step in enumerate((1e-6, 1e-7)):
            either = [loss(at + sign * step * np.eye(2)[index]) for sign in (1, -1)]
            expected = (either[0] - either[1]) / (2 * step)
            np.testing.assert_allclose(
                slopes[:, index], expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max()
            )
