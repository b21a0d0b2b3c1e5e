"""Public interface of `jaxhil`: names, results, unchanged JAX settings, and one-line errors."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np
import pytest

import jaxhil
from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.number_ranges import value_at
from tuning.gain_file import build_document

OFFERED = (
    "load simulate jacobian register Mechanism Compensator Gain ContactLaw InputError __version__".split()
)
TWO = {"approach.contacts": 2, "contact.stiffness": [124355.0, 90000.0], "contact.damping": [0.0]}


def refusal(function, *arguments, **named):
    """Return the one-line error message of a rejected call."""
    with pytest.raises(jaxhil.InputError) as refused:
        function(*arguments, **named)
    message = str(refused.value)
    assert isinstance(refused.value, ValueError)
    assert "\n" not in message and message.isprintable()
    return message


def plain_process(script, **environment):
    """Return the output of a script in a separate process with JAX's default configuration."""
    outside = {name: value for name, value in os.environ.items() if not name.startswith(("XLA", "JAX_"))}
    outside["PYTHONPATH"] = str(Path(__file__).parent.parent)
    command = [sys.executable, "-W", "error", "-c", script]
    ran = subprocess.run(command, env=outside | environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0 and not ran.stderr, ran.stderr
    return ran.stdout


@pytest.fixture
def command(request):
    """Run `jaxhil ARGUMENTS` in this process."""
    return request.getfixturevalue("jaxhil")


def test_jaxhil_package_exports_and_lists_public_names():
    assert set(jaxhil.__all__) == {*OFFERED, "__version__"} <= set(dir(jaxhil))
    for name in OFFERED:
        assert getattr(jaxhil, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        _ = jaxhil.simulat
    assert Path(jaxhil.__file__).with_name("py.typed").exists()


def test_controller_import_needs_neither_jax_nor_numpy():
    imports = "import sys; sys.modules['jax'] = None; import jaxhil, jaxhil.rig"
    assert plain_process(f"{imports}\nprint(jaxhil.rig.Controller.__name__)") == "Controller\n"
    loaded = "print([name for name in ('jax', 'numpy', 'scipy', 'msgspec') if name in sys.modules])"
    assert plain_process(f"import sys, jaxhil\n{loaded}") == "[]\n"


# Loading.


def test_overrides_of_load_function_equal_set_options_of_commands(command):
    mechanism = jaxhil.load("varying", {"rig.force_sensor.delay": np.float32(0.0035), **TWO})
    assert mechanism.contact.stiffness == [124355.0, 90000.0] and mechanism.approach.contacts == 2
    assert mechanism.rig.force_sensor.delay == float(np.float32(0.0035))
    assert jaxhil.load() == jaxhil.load("varying")
    for path, value, text in (
        ("rig.force_sensor.delay", -1.0, "-1.0"),
        ("rig.force_sensr.delay", 0.1, "0.1"),
        ("contact.stiffness[4]", 1.0, "1.0"),
        ("contact.law", "hertz", '"hertz"'),
    ):
        message = refusal(jaxhil.load, "varying", {path: value}).removeprefix(f"varying: overrides {path}: ")
        assert command("simulate", "--set", f"{path}={text}").err.endswith(f": {message}\n")


# Values of any kind that are not a mechanism, path, value, compensator or gain.
ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers().filter(bool),
    st.floats(),
    st.text("abc.\0/[=", max_size=20),
    st.binary(max_size=20),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(st.text(max_size=5), st.integers(), max_size=2),
    st.just(np.array([1.0, np.nan])),
    st.just(object),
)


@hypothesis.settings(max_examples=60)
@hypothesis.given(
    path=st.one_of(st.sampled_from(["approach.velocity", "contact.law", "rig"]), ANYTHING), value=ANYTHING
)
def test_load_applies_any_override_or_raises_one_line_error(path, value):
    try:
        overrides = {path: value}
    except TypeError:
        overrides = value
    try:
        assert isinstance(jaxhil.load("varying", overrides), jaxhil.Mechanism)
    except jaxhil.InputError as refused:
        assert str(refused).isprintable()


@hypothesis.settings(max_examples=60)
@hypothesis.given(value=ANYTHING)
def test_simulate_rejects_any_invalid_argument_with_one_line_message(value):
    refusal(jaxhil.simulate, value)
    refusal(jaxhil.simulate, "varying", value)
    if not isinstance(value, float) or not -1e-9 <= value <= 0.03:
        refusal(jaxhil.simulate, "varying", "phase_lead", {"phase_lead": value})
    if value is not None and not (isinstance(value, dict) and not value):
        refusal(jaxhil.simulate, "varying", "phase_lead", value)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        refusal(jaxhil.simulate, "varying", seed=value)
    refusal(jaxhil.jacobian, "varying", of=value, by="approach.velocity")
    refusal(jaxhil.jacobian, "varying", by=value)


@pytest.fixture(scope="module")
def run():
    return jaxhil.simulate(jaxhil.load("varying", TWO), "phase_lead")


def test_simulate_function_gives_the_results_of_simulate_command(run, command, tmp_path):
    options = [f"--set={path}={value}" for path, value in TWO.items()]
    document = command("simulate", "--compensator", "phase_lead", "--json", *options).document
    assert [
        {name: value for name, value in contact._asdict().items() if value is not None}
        for contact in run.contacts
    ] == document["contacts"]
    assert (run.gains, run.status, run.compensator) == (document["gains"], "ok", "phase_lead")
    run.plot(tmp_path / "new" / "run.svg")
    command("simulate", "--compensator", "phase_lead", "--plot", tmp_path / "command.svg", *options)
    assert (tmp_path / "new" / "run.svg").read_bytes() == (tmp_path / "command.svg").read_bytes()


def test_recorded_ticks_of_a_run_agree_with_its_contacts(run):
    period = run.mechanism.rig.control_period
    ticks = len(run.time)
    for name in run.ticks._fields[:-1]:
        array = getattr(run, name)
        assert isinstance(array, np.ndarray) and array.dtype == np.float64 and array.shape == (ticks,)
    np.testing.assert_allclose(run.time, period * np.arange(ticks), rtol=1e-12)
    assert np.all(np.diff(run.contact) >= 0) and set(run.contact) == {0, 1}
    for index, contact in enumerate(run.contacts):
        in_contact = run.contact == index
        assert run.velocity_desired[in_contact][0] == pytest.approx(contact.approach_velocity, rel=1e-12)
        rebound = contact.restitution * contact.approach_velocity
        # The contact ends a tick later, after the command has decayed.
        assert -run.velocity_desired[in_contact][-1] == pytest.approx(rebound, rel=1e-6)
        assert np.max(np.abs(run.force_command[in_contact])) == pytest.approx(contact.peak_command, rel=1e-12)
        # In every tick, M dv = -F_c T.
        kicks = -run.force_command[in_contact][:-1] * period / run.mechanism.bodies.mass
        np.testing.assert_allclose(np.diff(run.velocity_desired[in_contact]), kicks, rtol=1e-9, atol=1e-18)
    with pytest.raises(AttributeError):
        run.status = "good"


def test_csv_file_of_a_run_contains_exact_tick_values(run, tmp_path):
    run.to_csv(tmp_path / "run.csv")
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert table.dtype.names == run.ticks._fields
    for name in table.dtype.names:
        np.testing.assert_array_equal(table[name], getattr(run, name))
    assert "cannot be written" in refusal(run.to_csv, tmp_path / "missing" / "run.csv")
    assert "expected a path" in refusal(run.to_csv, 3)
    assert "ends in .png" in refusal(run.plot, tmp_path / "run.gif")


def test_simulated_run_lists_contacts_that_are_not_reached():
    diverging = {**TWO, "rig.force_sensor.delay": 0.9, "contact.stiffness": [1e7]}
    run = jaxhil.simulate(jaxhil.load("varying", diverging), "none")
    first, second = run.contacts
    assert run.status == first.status == "diverged" and second.status == "not reached"
    assert math.isnan(first.error) and not math.isnan(first.peak_force) and math.isnan(second.peak_force)


def test_simulate_accepts_gains_as_dict_and_file(tmp_path):
    mechanism = jaxhil.load("varying", TWO)
    literature = jaxhil.simulate(mechanism, "phase_lead")
    changed = jaxhil.simulate(mechanism, "phase_lead", {"phase_lead": np.float64(0.003)})
    assert changed.gains == literature.gains | {"phase_lead": 0.003}
    assert changed.contacts[0].error != literature.contacts[0].error
    document = build_document("phase_lead", changed.gains, mechanism, 64 * "0", {}, {}, 0, {})
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(document))
    for law in ("phase_lead", "none"):
        run = jaxhil.simulate(mechanism, law, path)
        assert (run.gains, run.compensator, run.contacts) == (changed.gains, "phase_lead", changed.contacts)
    other = jaxhil.load("varying", {"rig.control_period": 0.00037})
    assert "control_period" in refusal(jaxhil.simulate, other, "phase_lead", str(path))
    assert "expected phase_lead" in refusal(jaxhil.simulate, mechanism, "response_error", path)
    path.write_text(json.dumps(document | {"control_period": 0.002}))
    assert "was it edited?" in refusal(jaxhil.simulate, mechanism, "phase_lead", path)


@pytest.mark.parametrize(
    ("compensator", "gains", "message"),
    [
        ("phase_led", None, "compensator: found 'phase_led', expected one of none, dead_zone_observer"),
        ("phase_led", None, "did you mean phase_lead"),
        (
            "phase_lead",
            {"phase_led": 1.0},
            "gains: found 'phase_led', expected phase_lead, lead_filter (did you",
        ),
        ("phase_lead", {"phase_lead": 5.0}, "gains.phase_lead: found 5.0, expected 0 to 0.028 s"),
        ("phase_lead", {"phase_lead": "5"}, "gains.phase_lead: found '5', expected 0 to 0.028 s"),
        ("none", {"phase_lead": 5.0}, "gains: found 'phase_lead', expected none: none has no gains"),
        ("phase_lead", "gains.json", "gains.json: cannot be read"),
        ("phase_lead", "sharp", "no setting's name (phase_lead has none)"),
    ],
)
def test_simulate_rejects_wrong_gain_names_and_lists_expected_names(
    compensator, gains, message, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(jaxhil.simulate, "varying", compensator, gains)


def test_simulate_rejects_unknown_setting_and_lists_available_settings(monkeypatch):
    settings = {"gentle": {"velocity_gain": 50.0}, "firm": {}}
    monkeypatch.setattr(type(COMPENSATORS["impulse_ledger"]), "settings", settings)
    message = refusal(jaxhil.simulate, "varying", "impulse_ledger", "gentl")
    assert "'gentle', 'firm' (did you mean gentle?)" in message


GUEST = """
import jax, jax.numpy as jnp, json
{flags}
import jaxhil
before = dict(jax.config.values)
run = jaxhil.simulate("varying", "phase_lead")
slope = jaxhil.jacobian("varying", "phase_lead", by="gains.phase_lead")["gains.phase_lead"]
ticks = run.force_measured
assert dict(jax.config.values) == before
assert ticks.dtype == slope.dtype == "float64" and jnp.ones(2).dtype == {dtype}
print(json.dumps([[c.restitution, c.error, c.peak_force] for c in run.contacts] + [slope.tolist()]))
"""


@pytest.fixture(scope="module")
def as_by_default():
    return plain_process(GUEST.format(flags="", dtype="'float32'"))


@pytest.mark.slow
def test_simulate_function_in_float32_process_gives_the_results_of_command(as_by_default, command):
    *contacts, slope = json.loads(as_by_default)
    document = command("simulate", "varying", "--compensator", "phase_lead", "--json").document
    wanted = [
        [contact[name] for name in ("restitution", "error", "peak_force")] for contact in document["contacts"]
    ]
    np.testing.assert_allclose(contacts, wanted, rtol=1e-13, atol=1e-14)
    here = jaxhil.jacobian("varying", "phase_lead", by="gains.phase_lead")["gains.phase_lead"]
    np.testing.assert_allclose(slope, here, rtol=1e-10)


def test_simulate_leaves_jax_config_unchanged(run):
    before = dict(jax.config.values)
    assert jaxhil.simulate(run.mechanism, "phase_lead").contacts == run.contacts
    assert dict(jax.config.values) == before


@pytest.mark.slow
def test_simulate_does_not_depend_on_jax_config(as_by_default):
    flags = "\n".join(
        f"jax.config.update({name!r}, {value!r})"
        for name, value in {
            "jax_enable_x64": True,
            "jax_numpy_dtype_promotion": "strict",
            "jax_numpy_rank_promotion": "raise",
            "jax_debug_nans": True,
        }.items()
    )
    assert plain_process(GUEST.format(flags=flags, dtype="'float64'")) == as_by_default


KEYS = {
    "rig.force_sensor.delay": 1e-7,
    "contact.stiffness[0]": 1.0,
    "contact.stiffness": 1.0,
    "rig.simulator.natural_frequency": 1e-4,
    "rig.simulator.damping_ratio": 1e-6,
    "bodies.equivalent_mass": 1e-3,
    "approach.phase": 1e-5,
    "gains.phase_lead": 1e-7,
}


def central_difference(law, of, key, step):
    """Return the central difference of a metric, divided by twice the step."""
    base = jaxhil.load("varying", TWO)
    gains = jaxhil.simulate(base, law).gains
    figures = []
    for sign in (1, -1):
        changed, changed_gains = dict(TWO), dict(gains)
        if key.startswith("gains."):
            changed_gains[key[6:]] += sign * step
        elif key == "contact.stiffness":
            changed[key] = [value + sign * step for value in base.contact.stiffness]
        else:
            value = base.contact.stiffness[0] if key.endswith("[0]") else value_at(base, key)
            changed[key] = value + sign * step
        run = jaxhil.simulate(jaxhil.load("varying", changed), law, changed_gains)
        figures.append(np.array([getattr(contact, of) for contact in run.contacts]))
    return (figures[0] - figures[1]) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "of"),
    [
        ("phase_lead", "restitution"),
        ("response_error", "peak_force"),
    ],
)
def test_jacobian_matches_finite_differences(law, of):
    slopes = jaxhil.jacobian(jaxhil.load("varying", TWO), law, of=of, by=list(KEYS))
    assert list(slopes) == list(KEYS)
    for key, step in KEYS.items():
        assert slopes[key].shape == (2,) and slopes[key].dtype == np.float64
        wanted = central_difference(law, of, key, step)
        np.testing.assert_allclose(
            slopes[key], wanted, rtol=2e-4, atol=1e-4 * np.max(np.abs(wanted)), err_msg=key
        )


def test_jacobian_with_respect_to_both_masses_matches_equivalent_mass():
    masses = {"bodies": {"chaser_mass": 500.0, "target_mass": 1000.0}}
    together = jaxhil.load("varying", {**TWO, **masses})
    # The same number of keys as above, so that both tests share one program.
    both = ["bodies.chaser_mass", "bodies.target_mass"] * (len(KEYS) // 2)
    slopes = jaxhil.jacobian(together, "phase_lead", by=both)
    single = jaxhil.load("varying", {**TWO, "bodies": {"equivalent_mass": together.bodies.mass}})
    alone = ["bodies.equivalent_mass"] * len(KEYS)
    whole = jaxhil.jacobian(single, "phase_lead", by=alone)["bodies.equivalent_mass"]
    # d(m1 m2/(m1 + m2))/d(m1) = (m2/(m1 + m2))^2.
    np.testing.assert_allclose(slopes["bodies.chaser_mass"], whole * 4 / 9, rtol=1e-10)
    np.testing.assert_allclose(slopes["bodies.target_mass"], whole / 9, rtol=1e-10)


@pytest.mark.parametrize(
    ("by", "message"),
    [
        (
            "approach.contacts",
            "by approach.contacts: found a path without a derivative, expected the path of a real number",
        ),
        ("rig.force_sensor.dely", "did you mean rig.force_sensor.delay"),
        ("rig.force_sensor.quantum", "found a path without a derivative"),
        ("contact.clearance", "found inf, expected a key with a finite value"),
        ("contact.reference_depth", "found nothing"),
        ("contact.stiffness[7]", "found indices outside the shape (3,) of the value"),
        ("rig.force_sensor.time_constant", "the derivative at 0 is one-sided"),
        ("gains.phase_led", "expected gains.phase_lead, gains.lead_filter (did you mean phase_lead?)"),
        ([], "expected dotted paths"),
    ],
)
def test_jacobian_rejects_key_without_derivative(by, message):
    assert message in refusal(jaxhil.jacobian, "varying", "phase_lead", by=by)


def test_jacobian_rejects_metric_without_derivative():
    message = refusal(jaxhil.jacobian, "varying", "phase_lead", of="duration", by="approach.velocity")
    assert "of: found 'duration', expected one of restitution" in message
    rounded = jaxhil.load("varying", {"rig.force_sensor.quantum": 0.5})
    message = refusal(jaxhil.jacobian, rounded, "phase_lead", by="approach.velocity")
    assert message == "rig.force_sensor.quantum: found 0.5, expected 0: quantised readings have no derivative"
