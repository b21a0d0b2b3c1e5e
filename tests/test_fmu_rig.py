"""FMU of the rig: readings of the plain-Python plant, and the restitution of `simulate` in a closed loop."""

import math
import re

import pytest
from bundles import document
from cases import CASES
from fmus import (
    RunningFmu,
    compile_sources,
    extract,
    fmpy,
    run_loop,
    run_parallel_loop,
    validate_fmu,
    write_fmu,
)
from lanes import validated
from test_plant import AGAINST_THE_ORACLE

import jaxhil
import tuning
from jaxhil.errors import InputError
from jaxhil.mechanism.file import load, to_plain_data
from jaxhil.rig import COMPENSATORS
from tuning.bundle.fmu.controller import controller_fmu
from tuning.bundle.fmu.rig import rig_fmu
from tuning.bundle.writers import describe_fmus, fmi3_files
from tuning.rig.plant import RigHardware

PEDANTIC = ("-pedantic", "-Wall", "-Wextra", "-Werror")
NOISELESS = ("rig.force_sensor.noise_std=0", "rig.position_sensor.noise_std=0")
EVERY_DAY = ("rattling, lag", "velocity limit", "quantum")
PLANTS = [
    name if name in EVERY_DAY else pytest.param(name, marks=pytest.mark.slow) for name in AGAINST_THE_ORACLE
]


def plain(mechanism):
    """Return the part of a gain document that the rig's FMU needs."""
    return {"mechanism": to_plain_data(mechanism)}


@pytest.mark.parametrize("fmi", [3, 2])
def test_rig_fmu_is_valid_and_compiles_without_warning(fmi, tmp_path):
    archive = rig_fmu(document(), fmi)
    path = write_fmu(tmp_path / "rig.fmu", archive, with_library=False)
    assert validate_fmu(str(path)) == []
    # Outputs must not depend on commands before the first step: a loop of equations would follow.
    unknowns = fmpy.read_model_description(str(path)).initialUnknowns
    assert {known.causality for unknown in unknowns for known in unknown.dependencies} == {"parameter"}
    folder = extract(path)
    assert compile_sources(folder, "gcc", "-std=c99", *PEDANTIC) == ""
    assert compile_sources(folder, "g++", "-std=c++11", "-x", "c++", *PEDANTIC) == ""


@pytest.mark.parametrize("name", PLANTS)
def test_rig_fmu_has_the_same_readings_as_python_plant(name, tmp_path):
    mechanism = validated(CASES[name].mechanism)
    rig = RunningFmu(extract(write_fmu(tmp_path / "rig.fmu", rig_fmu(plain(mechanism), 3))))
    velocity, period = mechanism.approach.velocity, mechanism.rig.control_period
    start = rig.get("position")["position"]
    plant = RigHardware(mechanism)
    plant.begin(start, velocity, start - period * velocity, 0)
    touched, depth = 0, 2e-3 + 0.5 * min(mechanism.contact.clearance, 1e-2)
    for tick in range(round(1.2 / period)):
        names = ("force_measured", "position_measured", "contact_force", "position_shortfall")
        outputs = rig.get(*names)
        force, position = plant.read()
        expected = dict(zip(names, (force, position, plant.force, plant.shortfall), strict=True))
        assert outputs == pytest.approx(expected, rel=1e-9, abs=1e-12), tick
        touched += plant.force != 0.0
        command = start + depth * math.sin(5.0 * tick * period)
        rig.set({"position_command": command, "force_command": force})
        rig.step()
        plant.move(command)
    assert touched > 50
    rig.close()


def test_rig_fmu_draws_noise_with_specified_deviation_and_seed(tmp_path):
    rig = RunningFmu(extract(write_fmu(tmp_path / "rig.fmu", rig_fmu(document(), 3))))

    def readings(seed):
        rig.reset(force_noise=2.0, position_noise=1e-6, seed=seed)
        forces = []
        for _ in range(2000):
            rig.set({"position_command": -0.1})
            rig.step()
            forces.append(rig.get("force_measured")["force_measured"])
        return forces

    first = readings(1)
    assert first == readings(1) and first != readings(2)
    assert math.sqrt(sum(value**2 for value in first) / len(first)) == pytest.approx(2.0, rel=0.1)
    rig.close()


def both(name, compensator, fmi, tmp_path, overrides=NOISELESS):
    """Return controller and rig as running FMUs."""
    made = document(name, compensator, overrides)
    return [
        RunningFmu(extract(write_fmu(tmp_path / f"{part}{fmi}.fmu", build(made, fmi))))
        for part, build in (("controller", controller_fmu), ("rig", rig_fmu))
    ]


def simulated(name, compensator, extra, overrides=NOISELESS):
    """Return the contacts of `simulate` with `extra` more periods of command latency."""
    latency = load(name, overrides).mechanism.rig.command_latency + extra
    mechanism = load(name, (*overrides, f"rig.command_latency={latency}")).mechanism
    gains = {name: entry["value"] for name, entry in document(name, compensator, overrides)["gains"].items()}
    return jaxhil.simulate(mechanism, compensator, gains).contacts


def run_both(name, compensator, fmi, tmp_path):
    """Return the contacts of controller and rig as FMUs, and of `simulate` with one more period."""
    running = both(name, compensator, fmi, tmp_path)
    contacts = run_loop(*running, load(name, NOISELESS).mechanism)
    for fmu in running:
        fmu.close()
    return contacts, simulated(name, compensator, 1)


def assert_same_contacts(contacts, expected):
    assert len(contacts) == len(expected) > 0
    for mine, other in zip(contacts, expected, strict=True):
        assert mine.status == other.status == "ok"
        assert mine.restitution == pytest.approx(other.restitution, abs=1e-9)


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
def test_controller_and_rig_fmus_reproduce_simulation_with_one_more_period(fmi, tmp_path):
    contacts, expected = run_both("rig-300kg", "phase_lead", fmi, tmp_path)
    assert_same_contacts(contacts, expected)
    without = jaxhil.simulate(load("rig-300kg", NOISELESS).mechanism, "phase_lead").contacts
    assert abs(contacts[0].restitution - without[0].restitution) > 1e-3


@pytest.mark.parametrize(
    "integrator",
    [pytest.param(name, marks=pytest.mark.slow) for name in ("semi_implicit_euler", "zoh")]
    + ["explicit_euler"],
)
def test_parallel_master_adds_one_period_if_controller_integrates_model(integrator, tmp_path):
    overrides = (*NOISELESS, f"rig.integrator={integrator}")
    running = both("rig-300kg", "phase_lead", 3, tmp_path, overrides)
    contact = run_parallel_loop(*running, load("rig-300kg", overrides).mechanism)
    assert_same_contacts([contact], simulated("rig-300kg", "phase_lead", 1, overrides))


# Two surfaces, sensor effects, layers with several contacts, memory, and an ideal simulator.
LOOPS = ("rattling", "suite-dead-zone", "suite-lag", "layered", "suite-elastoplastic", "suite-repeated")


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("compensator", ["none", "phase_lead", "response_error", "impulse_ledger"])
def test_loop_of_fmus_reproduces_simulation_of_other_mechanisms(name, compensator, tmp_path):
    assert_same_contacts(*run_both(name, compensator, 3, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("compensator", [name for name in COMPENSATORS if name != "position_lead"])
def test_loop_of_fmus_reproduces_simulation_of_every_compensator(compensator, tmp_path):
    assert_same_contacts(*run_both("rig-300kg", compensator, 3, tmp_path))


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("rig.force_sensor.jitter=0.0005", "rig.force_sensor.jitter: found 0.0005, expected 0"),
        (
            "rig.force_sensor.loss_probability=0.01",
            "rig.force_sensor.loss_probability: found 0.01, expected 0",
        ),
        (
            "rig.force_sensor.bias_random_walk=0.5",
            "rig.force_sensor.bias_random_walk: found 0.5, expected 0",
        ),
        ("rig.force_sensor.filter.cutoff=200", "rig.force_sensor.filter: found a filter, expected none"),
    ],
)
def test_export_writes_the_controller_fmu_alone_if_the_rig_has_effects_that_its_fmu_lacks(override, reason):
    others = ("rig.force_sensor.filter.kind=bessel", "rig.force_sensor.filter.order=2")
    made = document("rig-300kg", "none", (*others, override) if "filter" in override else (override,))
    files = fmi3_files(made)
    assert {*files} == {"fmi3/jaxhil_controller.fmu", "fmi3/test_vectors.c"}
    rig, library = describe_fmus(made, files)
    assert rig == f"The rig has no FMU: {reason}."
    assert library.startswith("The FMUs contain no library: found no C compiler, or it failed")
    assert describe_fmus(made, {}) == []


def test_rig_fmu_rejects_user_registered_contact_law(monkeypatch):
    monkeypatch.setattr("tuning.bundle.fmu.rig.LAWS", ("hardening",))
    message = "fmu: contact.law: found 'kelvin_voigt', expected one of hardening"
    with pytest.raises(InputError, match=re.escape(message)):
        rig_fmu(document(), 3)


def test_rig_fmu_excludes_extra_periods_of_co_simulation():
    made = document("rig-300kg", overrides=("rig.command_latency=1",))
    with_entry = {**made, "figures": {"co_simulation": {"extra_periods": 1}}}
    assert rig_fmu(with_entry, 3) == rig_fmu(document("rig-300kg"), 3) != rig_fmu(made, 3)
    with pytest.raises(InputError, match=r"extra_periods: found 2, expected 0 to 1"):
        rig_fmu({**made, "figures": {"co_simulation": {"extra_periods": 2}}}, 3)


@pytest.mark.slow
def test_gains_tuned_with_extra_periods_state_their_number_and_work_in_co_simulation(tmp_path):
    tuned = tuning.tune(
        load("rig-300kg", NOISELESS).mechanism,
        "phase_lead",
        extra_periods=1,
        scenarios=4,
        starts=1,
        validation=4,
    )
    assert tuned.mechanism.rig.command_latency == 1
    assert tuned.document["figures"]["co_simulation"] == {"extra_periods": 1}
    running = [
        RunningFmu(extract(write_fmu(tmp_path / f"{part}.fmu", build(tuned.document, 3))))
        for part, build in (("controller", controller_fmu), ("rig", rig_fmu))
    ]
    expected = jaxhil.simulate(tuned.mechanism, "phase_lead", tuned.gains).contacts
    assert_same_contacts(run_loop(*running, tuned.mechanism), expected)
    with pytest.raises(InputError, match="extra_periods: rig-300kg: found 4, expected at most 3"):
        tuning.tune(load("rig-300kg", ("rig.command_latency=1",)).mechanism, "phase_lead", extra_periods=4)
