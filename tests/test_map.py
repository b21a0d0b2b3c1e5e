"""Stability maps: theory, growth rate compared with long simulations, margins, and rejected arguments."""

import cmath
import json
import math
import time

import numpy as np
import pytest
from clusters import started
from continuous import delayed_restitution

import jaxhil
import tuning
from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.simulation.scenario import build_scenarios
from tuning.stability_map import grid
from tuning.stability_map.closed_forms import critical_delay, restitution_by_root, restitution_by_series
from tuning.stability_map.contact_growth import LINEAR_COMPENSATORS, compute_growth

SOFT = {  # one contact of about 4.8 s; other dynamics are much faster
    "approach.contacts": 1, "contact.stiffness": [150.0], "contact.damping": [0.4], "uncertainty": {},
}  # fmt: skip
IDEAL = {
    "approach.contacts": 1, "contact.law": "linear", "rig.simulator": {"model": "ideal"}, "uncertainty": {},
}  # fmt: skip
RIGS = {
    "as it is": {},
    "lag, jumps, latency": {
        "rig.force_sensor.time_constant": 0.003, "rig.command_hold": "zoh", "rig.command_latency": 1,
    },
    "other integrator, other simulator": {
        "rig.integrator": "explicit_euler", "rig.control_period": 0.004,
        "rig.simulator": {"model": "transfer_function", "numerator": [0.01, 1.0],
                          "denominator": [1e-6, 4e-4, 0.03, 1.0]},
    },
    "ideal, zero-order hold": {
        "rig.integrator": "zoh", "rig.simulator": {"model": "ideal", "delay": 0.0013},
    },
}  # fmt: skip


def simulated_growth(run, period):
    """Return ln|z|/T of the slowest mode z^n of x_d in contact, after all faster modes have decayed."""
    position = run.position_desired
    begin, step = round(1.5 / period), round(0.7 / period)
    end = np.flatnonzero(position > 0)[-1] - round(0.2 / period)
    now, later, last = (position[begin + k * step : end - (2 - k) * step] for k in range(3))
    # The mode satisfies x(n + 2s) = 2 Re z^s x(n + s) - |z|^(2s) x(n).
    solved = np.linalg.lstsq(np.stack([later, -now], axis=1), last, rcond=None)[0]
    return math.log(solved[1]) / (2 * step * period)


@pytest.mark.slow
@pytest.mark.parametrize("changes", RIGS.values(), ids=RIGS)
@pytest.mark.parametrize("compensator", LINEAR_COMPENSATORS)
def test_stability_map_growth_rate_equals_growth_in_long_simulated_contact(compensator, changes):
    mechanism = jaxhil.load("varying", SOFT | changes)
    result = compute_growth(
        mechanism, compensator, literature_gains(mechanism, compensator), build_scenarios(mechanism)
    )
    run = jaxhil.simulate(mechanism, compensator)
    expected = simulated_growth(run, mechanism.rig.control_period)
    assert result.per_second == pytest.approx(expected, rel=1e-5, abs=1e-8)


@pytest.mark.slow
def test_stability_map_derivative_for_each_gain_matches_finite_difference():
    mechanism = jaxhil.load("varying", {"uncertainty": {}})
    gains, scenarios = literature_gains(mechanism, "phase_lead"), build_scenarios(mechanism)
    slopes = compute_growth(mechanism, "phase_lead", gains, scenarios).by_gain
    for name, value in gains.items():
        step, at = 1e-3 * value, {}
        for side in (-2, -1, 1, 2):
            moved = compute_growth(mechanism, "phase_lead", gains | {name: value + side * step}, scenarios)
            at[side] = moved.spectral_radius
        # The error is of fourth order in the step; a smaller step would be dominated by rounding.
        difference = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)
        assert slopes[name] == pytest.approx(difference, rel=1e-5)


def test_stability_map_growth_rate_agrees_with_closed_forms():
    phases = np.array([0.02, 0.05, 0.2, 0.7])
    assert restitution_by_series(phases) == pytest.approx(
        [delayed_restitution(phase) for phase in phases], abs=1e-6
    )
    assert np.isnan(restitution_by_series(np.array([-0.1, 1.5]))).all() and restitution_by_series(
        np.zeros(1)
    ) == pytest.approx(1)
    # s^2 = -omega^2 e^(-s tau), time in units of 1/omega: growth and frequency determine the root.
    for phase in phases:
        ratio = math.log(restitution_by_root(phase)) / math.pi
        root = solved_root(phase)
        assert root.real / abs(root.imag) == pytest.approx(ratio, rel=1e-9)
    mass, stiffness, damping = 350.0, 1.2e5, np.array([100.0, 3000.0])
    delay = critical_delay(mass, stiffness, damping)
    for b, tau in zip(damping, delay, strict=True):
        # At the limit M s^2 + (b s + k) e^(-s tau) = 0 has a root on the imaginary axis.
        frequencies = np.geomspace(1, 1e3, 200_001)
        residual = -mass * frequencies**2 + (1j * b * frequencies + stiffness) * np.exp(
            -1j * frequencies * tau
        )
        assert np.min(np.abs(residual)) < 1e-4 * stiffness


def solved_root(phase):
    """Return the root of s^2 + e^(-s phase) = 0 near j by Newton's method."""
    root = 1j
    for _ in range(50):
        grown = cmath.exp(-root * phase)
        root -= (root**2 + grown) / (2 * root - phase * grown)
    return root


@pytest.fixture(scope="module")
def ideal(tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    mechanism = jaxhil.load("varying", IDEAL)
    across, up = "contact.stiffness=5e4:4e5", "rig.force_sensor.delay=0.0005:0.008"
    return tuning.map(mechanism, across, up, points=5, limit=0.2, folder=folder), folder


def test_stability_map_of_uncompensated_contact_agrees_with_theory(ideal):
    result, folder = ideal
    document = json.loads((folder / "map.json").read_text())
    assert (folder / "map.png").stat().st_size > 20_000 and document["sha256"] == result.document["sha256"]
    theory = np.array(document["theory"]["series"])
    assert np.array(document["restitution"]) == pytest.approx(theory, abs=1e-3)
    assert np.array(document["error"]) == pytest.approx(theory - 1, abs=1e-3)
    root = np.array(document["theory"]["characteristic_root"])
    assert document["spectral_radius"]["values"] == pytest.approx(spectral_radius_of(result, root), abs=1e-5)


def spectral_radius_of(e, restitution):
    """Return the spectral radius for which half an oscillation has this restitution."""
    stiffness, delay = np.meshgrid(e.x, e.y)
    frequency = np.sqrt(stiffness / 350.0)
    roots = np.vectorize(solved_root)(frequency * delay)
    assert np.exp(np.pi * roots.real / abs(roots.imag)) == pytest.approx(restitution, rel=1e-9)
    return np.exp(roots.real * frequency * 0.001)


def test_margins_of_stability_map_end_at_the_error_limit(ideal):
    result, _ = ideal
    nominal = result.document["nominal"]
    [stiffness, delay] = (nominal["margins"]["error"][axis] for axis in "xy")
    assert stiffness["low"] is None and delay["low"] is None and nominal["margins"]["spectral_radius"] is None
    phase = math.sqrt(124355.0 / 350.0) * delay["high"]
    assert delayed_restitution(phase) == pytest.approx(1.2, abs=1e-3)
    nominal_phase = math.sqrt(124355.0 / 350.0) * 0.004
    assert nominal["restitution"] == pytest.approx(delayed_restitution(nominal_phase), abs=1e-3)
    assert math.sqrt(stiffness["high"] / 350.0) * 0.004 == pytest.approx(phase, rel=1e-2)


def test_stability_map_has_the_requested_axes(ideal):
    result, _ = ideal
    assert result.x[[0, -1]] == pytest.approx([5e4, 4e5]) and result.y[[0, -1]] == pytest.approx([5e-4, 8e-3])
    assert result.error.shape == (5, 5) and result.document["x"]["nominal"] == 124355.0


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        (("contact.stifness", "rig.force_sensor.delay"), "--x: found 'contact.stifness'"),
        (("contact.stiffness=2:1", "rig.force_sensor.delay"), "LOW < HIGH"),
        (("contact.stiffness=-1:1", "rig.force_sensor.delay"), "contact.stiffness[0]: found -1.0"),
        (("contact.stiffness[3]", "rig.force_sensor.delay"), "--x contact.stiffness[3]: found the shape"),
        (("contact.stiffness", "contact.stiffness"), "--y: found contact.stiffness"),
        (("contact.stiffness", "rig.force_sensor.bias"), "expected rig.force_sensor.bias=LOW:HIGH"),
        (("contact.stiffness", "gains.lead"), "--y: found 'gains.lead', expected no gain"),
        (("contact.stiffness", "rig.simulator.time_constant"), "found no value"),
    ],
)
def test_stability_map_rejects_unusable_arguments(jaxhil, tmp_path, axes, said):
    ended = jaxhil("map", "varying", "--x", axes[0], "--y", axes[1], "-o", str(tmp_path))
    assert ended.code == 2 and said in ended.err and ended.out == ""


@pytest.mark.slow
def test_stability_map_reaches_theoretical_limits_at_small_control_periods():
    """Compare with model.md, items 1, 2 and 5, to 1e-3."""
    axes = "contact.stiffness=5e4:2e5", "rig.force_sensor.delay=0.0005:0.008"
    for period, allowed in ((4e-4, 1e-3), (1e-4, 1e-4)):
        result = tuning.map(jaxhil.load("varying", IDEAL | {"rig.control_period": period}), *axes, points=12)
        theory = np.array(result.document["theory"]["series"], float)
        error = np.max(np.abs(result.restitution - theory))
        print(f"\nT = {period:g} s: |e - e of item 1| at most {error:.2g}", end="")
        assert error < allowed
    damped = IDEAL | {"contact.law": "kelvin_voigt", "contact.damping": [500.0], "rig.control_period": 1e-4}
    mechanism = jaxhil.load("varying", damped)
    limit = float(critical_delay(np.array(350.0), np.array(124355.0), np.array(500.0)))
    low, high = 0.5 * limit, 2 * limit
    for _ in range(30):
        middle = (low + high) / 2
        scenarios = build_scenarios(mechanism, {"rig.force_sensor.delay": np.array([middle])})
        grows = compute_growth(mechanism, "none", {}, scenarios).spectral_radius > 1
        low, high = (low, middle) if grows else (middle, high)
    print(f"\ncritical delay {1e3 * low:.6f} ms, by item 5 {1e3 * limit:.6f} ms")
    assert low == pytest.approx(limit, rel=1e-3)


@pytest.mark.slow
@pytest.mark.users_options
@pytest.mark.parametrize("compensator", sorted(COMPENSATORS))
def test_stability_map_of_100_by_100_points_takes_at_most_20_s(compensator):
    axes = "contact.stiffness", "rig.force_sensor.delay=0.001:0.008"
    took = spent = 0.0
    for _ in range(2):
        begun, before = time.monotonic(), time.process_time()
        tuning.map("varying", *axes, compensator)
        took, spent = time.monotonic() - begun, time.process_time() - before
    print(f"\n{compensator}: 100 x 100 points, warm: {took:.1f} s, {spent:.1f} s of all cores' time")
    # CPU time of two cores, whatever else runs on them.
    assert spent < 2 * 20


@pytest.mark.slow
@pytest.mark.users_options
def test_stability_map_computed_on_a_cluster_is_bit_identical(tmp_path):
    asked = {"x": "rig.force_sensor.delay", "y": "contact.stiffness", "points": 60}
    here = tuning.map("varying", **asked)
    with started(tmp_path) as cluster:
        cluster.worker()
        cluster_result = tuning.map("varying", scheduler=cluster.address, **asked)
    assert cluster_result.document == here.document


def test_interrupted_stability_map_computation_resumes(tmp_path, monkeypatch):
    monkeypatch.setattr(grid, "MAX_TILE_RUNS", 128)
    asked = {"x": "rig.force_sensor.delay", "y": "contact.stiffness", "points": 8}
    whole = tuning.map("varying", **asked, folder=tmp_path / "whole")
    run_part, runs = grid.run_tile, []

    def interrupted(*part):
        if len(runs) == 2:
            raise KeyboardInterrupt
        runs.append(part)
        return run_part(*part)

    with monkeypatch.context() as patched:
        patched.setattr(grid, "run_tile", interrupted)
        with pytest.raises(KeyboardInterrupt):
            tuning.map("varying", **asked, folder=tmp_path / "map")
    monkeypatch.setattr(grid, "run_tile", lambda *part: runs.append(part) or run_part(*part))
    again = tuning.map("varying", **asked, folder=tmp_path / "map", resume=True)
    assert again.document == whole.document
    assert len(runs) == -(-grid.count_runs(8) // 128)
    assert not (tmp_path / "map" / ".pieces").exists()
