"""Runs of six-axis mechanism files: construction, output of `jaxhil simulate`, comparison with one axis."""

import copy
import json

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxhil as package
from jaxhil.errors import InputError
from jaxhil.mechanism.file import any_from_plain_data, builtin_names, load_any, six_axis_names, to_plain_data
from jaxhil.mechanism.uncertainty import draw
from jaxhil.sixdof.building import build_scenarios
from jaxhil.sixdof.building_contacts import candidate_names
from jaxhil.sixdof.mechanism_summary import summarise_six_axes
from jaxhil.sixdof.run import simulate_six_axes

STILL = {"velocity": [0, 0, 0], "angular_velocity": [0, 0, 0], "attitude": [1, 0, 0, 0]}
APART = {"approach": None, "uncertainty": {}, "start.duration": 0.05}
APART |= {"start.target": {**STILL, "position": [0, 0, 0]}, "start.chaser": {**STILL, "position": [0, 0, 3]}}


def test_pattern_of_six_axis_shapes_consists_of_rotated_copies():
    mechanism = load_any("petals", APART).mechanism
    scenario = build_scenarios(mechanism)
    edges, rings = jax.tree.map(np.asarray, scenario.groups)
    assert candidate_names(mechanism)[:3] == ("edge_left[0]", "edge_left[1]", "edge_left[2]")
    turned = np.exp(2j * np.pi / 3 * np.arange(3))
    chaser, target = edges.candidates.chaser.start, edges.candidates.target.start
    np.testing.assert_allclose((chaser.x + 1j * chaser.y)[:3, 0], (0.527 - 0.286j) * turned)
    further = turned * np.exp(-1.0472j)
    np.testing.assert_allclose((target.x + 1j * target.y)[:3, 0], (0.527 + 0.286j) * further)
    centre = rings.candidates.centre
    np.testing.assert_allclose((centre.x + 1j * centre.y)[:, 0], 0.6 * np.exp(1j * np.pi / 3 * np.arange(6)))
    np.testing.assert_allclose(rings.candidates.shape.normal.z, np.ones((6, 1)))


def test_six_axis_parameter_draws_are_stored_along_last_array_axis():
    factor = {"distribution": "uniform", "factor": [0.9, 1.1]}
    uncertain = {
        key: factor for key in ("target.inertia", "contact.edge_left.chaser.from", "rig.simulator.delay")
    }
    mechanism = load_any("petals", {**APART, "uncertainty": uncertain}).mechanism
    drawn = draw(mechanism, 5, 0)
    scenario = build_scenarios(mechanism, drawn)
    np.testing.assert_array_equal(scenario.bodies.target.inertia.y.y, drawn["target.inertia"][:, 1])
    np.testing.assert_allclose(
        scenario.groups[0].candidates.chaser.start.x[0], drawn["contact.edge_left.chaser.from"][:, 0]
    )
    np.testing.assert_array_equal(scenario.simulator.delay, drawn["rig.simulator.delay"].T)
    assert np.all(scenario.bodies.chaser.mass == 420.0) and scenario.sensor.errors.bias.shape == (6, 5)


def test_six_axis_latches_and_robots_are_built_as_specified():
    hooks = {"latch.hooks.chaser": [0.6, 0.1, 0.02], "latch.hooks.pattern": {"count": 3, "phase": 0.5}}
    hooks |= {
        "latch.nose": {"chaser": [0, 0, 0], "latched": True, "stiffness_matrix": np.diag([6.0] * 6).tolist()}
    }
    latches = build_scenarios(load_any("ring-capture", APART | hooks).mechanism).latches
    ring, nose = jax.tree.map(np.asarray, latches)
    turned = np.exp(0.5j + 2j * np.pi / 3 * np.arange(3))
    np.testing.assert_allclose((ring.point.x + 1j * ring.point.y)[:, 0], (0.6 + 0.1j) * turned)
    assert not ring.from_start.any() and ring.depth.shape == (3, 1) and np.all(ring.depth == 2e-4)
    assert ring.stiffness[:, :, 1, 0].diagonal().tolist() == [8e3] * 3 + [0.0] * 3
    assert nose.from_start.all() and np.array_equal(nose.stiffness[:, :, 0, 0], 6 * np.eye(6))

    mechanism = load_any("claw-two-arms", APART | {"rig.simulator.target_robot.delay": 0.016}).mechanism
    scenario = build_scenarios(mechanism)
    assert scenario.kinematics.share[:, 0].tolist() == [0.3] * 3 + [0.0] * 3
    assert scenario.simulator.delay[:, 0].tolist() == [0.008] * 6 + [0.016] * 6
    own = load_any("claw-two-arms", APART).mechanism
    assert build_scenarios(own).simulator.delay[:, 0].tolist() == [0.008] * 12
    # The delay of each robot counts by its share.
    lag = 0.9 / (np.pi * np.array([14.0, 12.0]))
    delay = 0.004 + 0.7 * (lag[0] + 0.008) + 0.3 * (lag[1] + 0.016)
    late = summarise_six_axes(mechanism, 1.0, 1.0, 1.0, 1.0, 1.0).delay
    np.testing.assert_allclose(late, max(delay, 0.004 + lag[1] + 0.008))
    latched = summarise_six_axes(mechanism, 1.0, 1.0, np.nan, 1.0, np.nan)
    assert "; ideal contact: held by a latch, peak force 1 N; rig: delay" in latched.line("claw")


def central_contact(name):
    """Return a six-axis mechanism with the central impact of a one-axis mechanism's contact."""
    one = load_any(name, {"approach.contacts": 1}).mechanism
    raw = to_plain_data(one)
    body = {"mass": 2 * one.bodies.mass, "inertia": [3.0, 4.0, 5.0]}
    contact = {key: value for key, value in raw["contact"].items() if key != "clearance"}
    contact |= {key: contact[key][0] for key in ("stiffness", "damping") if key in contact}
    if "friction" in contact:
        contact["dry_friction"] = contact.pop("friction")
    contact |= {
        "chaser": {"shape": "sphere", "centre": [0, 0, 0], "radius": 0},
        "target": {"shape": "plane", "point": [0, 0, 0], "normal": [0, 0, 1]},
    }
    rig = copy.deepcopy(raw["rig"])
    for key in ("contact_plane", "position_sensor"):
        rig.pop(key, None)
    for key in ("velocity_limit", "acceleration_limit"):
        rig["simulator"].pop(key, None)
    rig["force_sensor"].pop("noise_std", None)
    return one, {
        "schema": "jaxhil/mechanism/2",
        "name": name,
        "target": {**body, "interface": [0, 0, 1]},
        "chaser": {**body, "interface": [0, 0, -1]},
        "approach": {"velocity": [0, 0, -one.approach.velocity], "phase": one.approach.phase},
        "contact": {"nose": contact},
        "rig": rig,
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in builtin_names() if name != "rattling"])
def test_simulated_six_axis_central_contact_equals_one_axis_contact(name):
    one, raw = central_contact(name)
    quiet = {"approach.contacts": 1, "rig.force_sensor.noise_std": 0.0, "rig.contact_plane": 0.0}
    expected = package.simulate(package.load(name, quiet), "none").contacts[0]
    [result] = simulate_six_axes(any_from_plain_data(raw, name)).episodes
    np.testing.assert_allclose(result.restitution, expected.restitution, rtol=1e-9)
    np.testing.assert_allclose(result.reference_restitution, expected.reference_restitution, rtol=1e-6)
    np.testing.assert_allclose(result.effective_mass, one.bodies.mass, rtol=1e-12)
    error = expected.restitution**2 - expected.reference_restitution**2
    np.testing.assert_allclose(result.energy_error, error, rtol=1e-5)


@pytest.mark.slow
def test_unusable_six_axis_starting_states_are_rejected():
    above = APART | {"start.chaser.position": [0, 0, 6.3]}
    legs = {"rig.simulator.base": [[0, 0, 0]] * 6}
    for name, changes, reason in (
        ("hydraulic-hexapod", {**above, "rig.simulator.stroke": [1.6, 1.9]},
         "rig.simulator.stroke: found legs from "),
        ("hydraulic-hexapod", above | legs, "rig.simulator.base: found legs that are nearly singular"),
        ("ring-capture", {**APART, "contact": {}, "start.chaser.position": [0.04, 0.06, 2.19]},
         "latch.hooks.depth: found 0.0002 m, with which the latch catches"),
        ("ring-capture", {"approach.angular_velocity": [0, 60, 0]},
         "approach.angular_velocity: found a rotation by 1.22 rad at the start, expected at most 1 rad"),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            simulate_six_axes(load_any(name, changes).mechanism)
        assert str(caught.value).startswith(f"{name}: {reason}")
    for changes, reason in (
        ({"approach.offset": [9.0, 0.0]}, "approach.offset: found a chaser that passes the target"),
        (
            {"approach.velocity": [0, 0, -5.0]},
            "approach.velocity: found a speed of 5 m/s between the shapes of contact.tip, expected at most",
        ),
        (
            {"rig.simulator.natural_frequency": {"translation": 14.0, "rotation": 2e4}},
            "rig.simulator: found a pole of 1.26e+05 rad/s at a control period of 0.001 s, expected at most",
        ),
        ({"approach.duration": 999.0, "rig.control_period": 1e-5}, "approach.duration: found 999.02 s"),
        (
            {**APART, "start.chaser.position": [0, 0, 2.2]},
            "start.chaser.position: found a contact at the start",
        ),
    ):
        with pytest.raises(InputError) as caught:
            simulate_six_axes(load_any("probe-drogue", changes).mechanism)
        assert str(caught.value).startswith("probe-drogue: " + reason)


@pytest.mark.slow
@pytest.mark.parametrize("name", six_axis_names())
def test_simulate_command_runs_a_six_axis_builtin_mechanism(jaxhil, tmp_path, name):
    picture, log = tmp_path / "run.png", tmp_path / "run.csv"
    ran = jaxhil("simulate", name, "--json", "--plot", picture, "--log", log)
    assert ran.code == 1 and ran.err.startswith("wrote "), ran.err
    document = json.loads(ran.out)
    check_table(np.genfromtxt(log, delimiter=",", names=True), load_any(name).mechanism, document["final"])
    assert document["axes"] == 6 and document["verdict"] == "bad"
    [episode] = document["episodes"]
    captured = name == "ring-capture"
    assert (episode["energy_error"] > 1 or captured) and 0.3 < episode["twist_error"] < 3
    parts = [episode[f"{part}_part"] for part in ("normal", "lateral", "rotational")]
    np.testing.assert_allclose(np.linalg.norm(parts), episode["twist_error"], rtol=1e-6)
    assert episode["status"] == document["status"] == ("captured" if captured else "rebounded")
    assert (document["meaning"]["frequency"] is None) == captured
    # Without an external force momentum is constant: the target was at rest.
    mechanism = load_any(name).mechanism
    momenta = [mechanism.target.mass * np.array(document["final"]["v1"])]
    momenta.append(mechanism.chaser.mass * np.array(document["final"]["v2"]))
    ideal_momenta = [mechanism.target.mass * np.array(document["reference_final"]["v1"])]
    ideal_momenta.append(mechanism.chaser.mass * np.array(document["reference_final"]["v2"]))
    np.testing.assert_allclose(sum(momenta), sum(ideal_momenta), rtol=1e-9)
    assert picture.read_bytes().startswith(b"\x89PNG")
    alone = json.loads(jaxhil("simulate", name, "--reference", "--json").out)
    ideal_episode = alone["episodes"][0]
    assert alone["status"] == episode["status"] and "energy_error" not in ideal_episode
    for figure in ("effective_mass", "point", "reference_peak_force", "reference_peak_moment"):
        np.testing.assert_allclose(
            ideal_episode[figure], episode[figure], rtol=1e-3, atol=1e-6, err_msg=figure
        )
    film = tmp_path / "run.gif"
    ran = jaxhil("simulate", name, "--json", "--compensator", "phase_lead", "--animate", film)
    assert ran.code == 1, ran.err
    assert film.read_bytes().startswith(b"GIF8")
    lead = json.loads(ran.out)
    assert lead["episodes"][0]["energy_error"] < episode["energy_error"]
    leads = {f"lag_lead_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")}
    assert set(lead["gains"]) == {"phase_lead", "lead_filter", *leads}


def check_table(ticks, mechanism, final):
    """Check that bodies, poses and wrenches of a table are consistent until the end of the run."""

    def of(name, suffixes):
        return np.stack([ticks[f"{name}_{suffix}"] for suffix in suffixes.split()], axis=1)

    period = mechanism.rig.control_period
    np.testing.assert_allclose(ticks["time"], period * np.arange(round(final["time"] / period)))
    places, turns, velocities = {}, {}, {}
    for body, key in (("target", "v1"), ("chaser", "v2")):
        velocities[body] = np.vstack([of(body, "vx vy vz"), final[key]])
        turns[body] = Rotation.from_quat(of(body, "qx qy qz qw"))
        own = getattr(mechanism, body)
        assert not np.any(own.interface_rotation)
        places[body] = of(body, "x y z") + turns[body].apply(own.interface)
    # Pose of C relative to T.
    back = turns["target"].inv()
    np.testing.assert_allclose(
        back.apply(places["chaser"] - places["target"]), of("desired", "x y z"), atol=1e-12
    )
    turned = (back * turns["chaser"]).as_rotvec()
    np.testing.assert_allclose(turned, of("desired", "rx ry rz"), atol=1e-12)
    # Effect of the command on the chaser in a period.
    force = turns["target"].apply(of("command", "fx fy fz"))
    change = mechanism.chaser.mass * np.diff(velocities["chaser"], axis=0)
    np.testing.assert_allclose(change, period * force, atol=1e-9 * np.abs(force).max())
    np.testing.assert_allclose(mechanism.target.mass * np.diff(velocities["target"], axis=0), -change,
                               atol=1e-9 * np.abs(force).max())  # fmt: skip
    # The real contact force is nonzero if a pair of shapes penetrates.
    depths = [ticks[name] for name in ticks.dtype.names if name.startswith("depth_")]
    forces = [ticks[name] for name in ticks.dtype.names if name.startswith("force_")]
    assert len(depths) == len(forces) > 0 and np.any(np.array(forces)[np.array(depths) > 0] > 0)
    assert not np.any(np.array(forces)[np.array(depths) <= 0])


@pytest.mark.slow
def test_simulate_command_runs_a_six_axis_flight_without_contact(jaxhil, tmp_path):
    state = "{{position=[0,0,{}], attitude=[1,0,0,0], velocity=[0,0,0], angular_velocity=[0,{},0]}}"
    start = f"start={{duration=0.2, target={state.format(0, 0)}, chaser={state.format(3, 0.5)}}}"
    overrides = [start, "contact={}", "latch={}", "uncertainty={}"]
    changes = ["--unset", "approach", *(part for one in overrides for part in ("--set", one))]
    files = {option: tmp_path / f"run.{ending}" for option, ending in
             (("--plot", "png"), ("--log", "csv"), ("--animate", "gif"))}  # fmt: skip
    written = [part for pair in files.items() for part in pair]
    ran = jaxhil("simulate", "ring-capture", *changes, *written, "--json")
    assert ran.code == 1 and ran.err.count("wrote ") == 3, ran.err
    document, turned = json.loads(ran.out), Rotation.from_rotvec([0, 0.1, 0])
    ran = jaxhil("simulate", "ring-capture", *changes, "--reference", "--json")
    assert ran.code == 1 and json.loads(ran.out) == {
        **{key: document[key] for key in ("mechanism", "axes", "reference_final", "status")},
        "episodes": [],
    }
    assert document["status"] == "miss" and document["final"]["time"] == 0.2
    position = np.array([-0.05, 0.02, 1.8]) + turned.apply([0.01, 0.04, -1.0])
    for final in ("final", "reference_final"):
        np.testing.assert_allclose(document[final]["pose"], [*position, 0, 0.1, 0], atol=1e-9)
    ticks = np.genfromtxt(files["--log"], delimiter=",", names=True)
    assert len(ticks) == 200 and not any(name.startswith("depth") for name in ticks.dtype.names)
    np.testing.assert_allclose(ticks["desired_ry"], 0.5 * ticks["time"], atol=1e-12)


@pytest.mark.slow
def test_too_stiff_six_axis_friction_is_named_in_error():
    """The ideal contact would need steps of 1e-9 s."""
    stiff = {"contact.tip.friction.coefficient": 10.0, "contact.tip.friction.slip": 1e-9, "uncertainty": {}}
    with pytest.raises(InputError, match=r"^probe-drogue: contact\.tip\.friction\.slip: found 1e-09 m/s"):
        package.simulate(package.load("probe-drogue", stiff))


@pytest.mark.slow
def test_simulate_reports_shapes_that_pass_through_each_other():
    soft = {"contact.tip.stiffness": 3e4, "approach.velocity": [0, 0, -0.5], "uncertainty": {}}
    run = package.simulate(package.load("probe-drogue", soft))
    assert run.episodes[0].penetration > 0.9 and "times the size of the shapes" in run.summary.warnings[-1]
    gentle = package.simulate(package.load("probe-drogue"))
    assert gentle.episodes[0].penetration < 0.1 and not gentle.summary.warnings


@pytest.mark.slow
def test_hexapod_run_ends_if_a_leg_exceeds_its_maximum_length():
    free = {**APART, "start.duration": 0.2, "start.chaser.position": [0.0, 0.0, 6.3]}
    free |= {"start.chaser.velocity": [0.0, 0.0, 0.5], "contact": {}, "rig.simulator.stroke": [1.6, 2.17]}
    mechanism = load_any("hydraulic-hexapod", free).mechanism
    run = simulate_six_axes(mechanism)
    simulator = mechanism.rig.simulator
    legs = [
        np.linalg.norm(np.array(simulator.platform) + simulator.height + at[:3] - simulator.base, axis=1)
        for at in (*run.ticks.desired, np.array(run.final.pose))
    ]
    assert run.status == "reach" and np.all(run.ticks.desired[:, 3:] == 0)
    assert np.max(legs[-1]) > 2.17 >= np.max(legs[:-1])


@pytest.mark.slow
def test_six_axis_bodies_at_rest_with_noise_are_not_reported_as_divergent():
    """The initial energy is zero, so noise exceeds any multiple of it."""
    rest = {"attitude": [1, 0, 0, 0], "velocity": [0, 0, 0], "angular_velocity": [0, 0, 0]}
    bodies = {"target": {"position": [0, 0, 0], **rest}, "chaser": {"position": [0, 0, 3], **rest}}
    overrides = {"approach": None, "start": {"duration": 0.2, **bodies}, "uncertainty": {}}
    run = package.simulate(package.load("probe-drogue", overrides))
    assert run.status == "miss" and run.final.time == pytest.approx(0.2)


def test_unsupported_six_axis_options_are_rejected_with_one_line_message(jaxhil, tmp_path):
    for arguments, reason in (
        (["simulate", "petals", "--setting", "x"], "--setting: found 'x', expected none: compensators"),
        (
            ["simulate", "petals", "--animate", "x.avi"],
            "--animate: found 'x.avi', expected a name that ends in .gif",
        ),
        (["simulate", "petals", "--compensator", "passivity"], "response_error for six axes"),
        (["simulate", "petals", "--reference", "--plot", "x.png"], "expected none together with --reference"),
        (
            ["simulate", "rig-300kg", "--reference"],
            "--reference: found a one-axis mechanism, expected a six-axis mechanism",
        ),
        (
            ["simulate", "rig-300kg", "--animate", "x.gif"],
            "expected no animation of a one-axis mechanism",
        ),
    ):
        ran = jaxhil(*arguments)
        assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1 and reason in ran.err


def test_init_command_copies_a_six_axis_builtin_with_new_name(jaxhil, tmp_path):
    path = tmp_path / "mine.toml"
    assert jaxhil("init", "petals", "-o", path).code == 0
    mine, builtin = load_any(path).mechanism, load_any("petals").mechanism
    changed = {"name": "mine", "source": mine.source}
    assert to_plain_data(mine) == to_plain_data(builtin) | changed and "built-in petals" in mine.source
