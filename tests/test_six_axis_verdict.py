"""Six-axis verdicts depend on the twist error; precomputed ideal contacts change no metric."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import QUICK
from six_axis_ranges import OFFSETS, WIDE, load_wide

from jaxhil.errors import InputError
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any, six_axis_names
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.one_axis import ONE_AXIS
from jaxhil.simulation.outcome import Outcome
from jaxhil.sixdof.metrics import evaluate
from jaxhil.sixdof.six_axes import SIX_AXES
from tuning.api.arguments import choose_limit
from tuning.api.sweep_options import SweepOptions
from tuning.api.tune_options import TuneOptions
from tuning.sweeps.columns import list_contact_columns, list_verdict_columns


def outcome(errors):
    """Return an outcome whose rows differ in their errors (rows, lanes)."""
    rows = np.asarray(errors, float)
    metrics = Metrics(*[rows] * len(Metrics._fields))
    return Outcome(metrics, *[rows] * (len(Outcome._fields) - 1))


def test_twist_error_is_the_verdict_error_on_six_axes():
    energy, twist = [[0.3, -0.4], [0.1, 0.0]], [[0.01, 0.02], [0.03, 0.04]]
    rows = outcome(energy + twist)
    np.testing.assert_array_equal(SIX_AXES.select_verdict_error(rows).error, twist)
    np.testing.assert_array_equal(ONE_AXIS.select_verdict_error(rows).error, energy + twist)
    columns = list_verdict_columns(load_any("petals").mechanism)
    assert [slot.error for slot in columns] == ["twist_error_1"]
    assert [slot.error for slot in list_contact_columns(load_any("petals").mechanism)] == [
        "energy_error_1",
        "twist_error_1",
    ]
    assert [slot.error for slot in list_verdict_columns(load_any("rig-300kg").mechanism)] == ["error_1"]


def test_default_error_limit_depends_on_number_of_axes():
    one, six = (load_any(name).mechanism for name in ("rig-300kg", "petals"))
    assert (choose_limit(None, one), choose_limit(None, six)) == (0.01, 0.05)
    assert choose_limit(0.3, six) == choose_limit(0.3, one) == 0.3
    assert TuneOptions(compensator="phase_lead").settings(6).objective.limit == 0.05
    assert TuneOptions(compensator="phase_lead").settings(1).objective.limit == 0.01
    assert SweepOptions(scenarios=64).with_limit(six).limit == 0.05
    with pytest.raises(InputError, match=r"rare: found 0.02, expected a finite error, at least --limit"):
        SweepOptions(scenarios=64, rare=0.02).with_limit(six)
    assert SweepOptions(scenarios=64, rare=0.02).with_limit(one).rare == 0.02


def test_six_axis_pareto_accepts_only_the_command_peak_as_cost():
    mechanism = load_any("petals").mechanism
    TuneOptions(compensator="phase_lead", pareto=3).check_mechanism(mechanism)
    for against in ("noise", "transparency"):
        with pytest.raises(InputError, match=f"pareto_against: found {against}, expected peak, the only"):
            options = TuneOptions(compensator="phase_lead", pareto=3, pareto_against=against)
            options.check_mechanism(mechanism)


def test_wide_range_files_equal_builtin_mechanisms_with_added_noise_and_ranges():
    assert sorted(path.stem for path in WIDE.glob("*.toml")) == sorted(six_axis_names())
    for name in six_axis_names():
        wide, own = load_wide(name), load_any(name).mechanism
        assert (wide.target, wide.chaser, wide.contact, wide.approach) == (
            own.target,
            own.chaser,
            own.contact,
            own.approach,
        )
        assert wide.rig.force_sensor.noise_std == [0.5] * 3 + [0.05] * 3
        assert wide.rig.position_sensor.noise_std == [5e-6] * 3 + [1e-5] * 3
        offset = wide.uncertainty["approach.offset"]
        assert (offset.low, offset.high) == (-OFFSETS.get(name, 0.05), OFFSETS.get(name, 0.05))


@pytest.mark.slow
def test_precomputed_ideal_contacts_change_no_metric():
    mechanism = load_any("probe-drogue").mechanism
    with jax_context():
        scenarios = SIX_AXES.scenarios(mechanism, draw(mechanism, 5, 1), 1)
        first, second = (jax.tree.map(lambda leaf, k=k: leaf[..., k], scenarios) for k in
                         (slice(3), slice(3, 5)))  # fmt: skip
        complete = SIX_AXES.with_ideal_contacts([first, second])
        together = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *complete)
        loop = SIX_AXES.loop(mechanism, "phase_lead", scenarios)
        gains = {
            name: jnp.asarray(value) for name, value in literature_gains(mechanism, "phase_lead").items()
        }
        program = jax.jit(evaluate, static_argnums=0, compiler_options=QUICK)
        expected, found = (program(loop, gains, lanes).metrics for lanes in (scenarios, together))
    assert np.all(np.isfinite(expected.twist_error))
    for name in expected._fields:
        values, others = np.asarray(getattr(expected, name), float), np.asarray(getattr(found, name), float)
        np.testing.assert_allclose(others, values, rtol=1e-7, atol=1e-9, err_msg=name)
