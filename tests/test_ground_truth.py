"""Closed loop compared with the closed forms of model.md, section 6, and with SciPy for T -> 0.

The order of convergence refers to the root mean square of the error for several contact phases and, with a
delay, several contact frequencies within 10 %. At a single frequency, the error varies irregularly with T,
because the last sample before separation lies differently.
"""

from math import pi

import continuous
import numpy as np
import pytest
from lanes import (
    IDEAL,
    MASS,
    SECOND_ORDER,
    VELOCITY,
    first_contact,
    grid,
    join,
    mechanism,
    run_record,
    spread,
    validated,
)
from scipy.special import lambertw

from jaxhil.simulation.loop_construction import build_loop

OMEGA = 2 * pi * 3.0
STIFFNESS = MASS * OMEGA**2
PERIODS = np.array([4e-3, 2e-3, 1e-3, 5e-4])
PHASES = (np.arange(8) + 0.5) / 8
FREQUENCIES = OMEGA * np.linspace(0.95, 1.05, 5)

# (omega tau, damping ratio, tension): restitution for T -> 0, order of convergence.
LIMITS = {
    "undelayed": ((0.0, 0.0, False), 1.0, 2),
    "delay 0.05": ((0.05, 0.0, False), 1.081644885391, 2),
    "delay 0.2": ((0.2, 0.0, False), 1.364341497637, 2),
    "ends at F = 0, 0.05": ((0.0, 0.05, False), continuous.separates_at_no_force(0.05), 1),
    "ends at F = 0, 0.3": ((0.0, 0.3, False), continuous.separates_at_no_force(0.3), 1),
    "ends at d = 0, 0.05": ((0.0, 0.05, True), continuous.separates_at_surface(0.05), 1),
    "ends at d = 0, 0.3": ((0.0, 0.3, True), continuous.separates_at_surface(0.3), 1),
}


def fitted_order(errors):
    """Return the order of convergence of the rms of errors (periods, ...)."""
    rms = np.sqrt(np.mean(errors.reshape(len(PERIODS), -1) ** 2, axis=1))
    return np.polyfit(np.log(PERIODS), np.log(rms), 1)[0]


@pytest.fixture(scope="module")
def kelvin_voigt():
    """Return restitution and work (in M v^2 / 2) of every entry of LIMITS: (periods, frequencies, phases)."""
    parsed = validated(mechanism({}, IDEAL, 0.0))
    index, period, omega, phase = grid(np.arange(len(LIMITS)), PERIODS, FREQUENCIES, PHASES)
    delay, ratio, tension = (np.array([limit[0][i] for limit in LIMITS.values()])[index] for i in range(3))
    scenario = spread(
        parsed,
        len(index),
        control_period=period,
        phase=phase,
        contact__stiffness=MASS * omega**2,
        contact__damping=2 * ratio * MASS * omega,
        contact__tension=tension,
        force_sensor__delay=delay / omega,
    )
    result = first_contact(parsed, scenario, energies=True)
    shape = (len(LIMITS), len(PERIODS), len(FREQUENCIES), len(PHASES))
    energy = MASS * VELOCITY**2 / 2
    results = zip(
        result["restitution"].reshape(shape),
        result["work_in"].reshape(shape) / energy,
        result["work_out"].reshape(shape) / energy,
        strict=True,
    )
    return dict(zip(LIMITS, results, strict=True))


# Tests of items 1 and 3 of model.md, section 6.


@pytest.mark.parametrize("name", LIMITS)
def test_restitution_of_kelvin_voigt_contact_converges_to_closed_form(kelvin_voigt, name):
    _, expected, order = LIMITS[name]
    error = kelvin_voigt[name][0] - expected
    assert order - 0.1 < fitted_order(error) < order + 0.4
    # Averaging over the phases cancels most of a smooth contact's error.
    assert np.abs(error[-1]).max() < (2e-5 if order == 2 else 2.5e-3)
    assert abs(error[-1].mean()) < (2e-6 if order == 2 else 1e-3)


def test_delayed_restitution_series_matches_reference_values():
    assert continuous.delayed_restitution(0.05) == pytest.approx(1.081644885391, abs=1e-12)
    assert continuous.delayed_restitution(0.2) == pytest.approx(1.364341497637, abs=1e-12)


@pytest.fixture(scope="module")
def behind_simulator():
    """Return the restitution of linear contact with a second-order simulator and two fractional delays."""
    return continuous.delayed_contact(MASS, VELOCITY, STIFFNESS, (2 * pi * 12.0, 0.8, 0.0037), 0.0083)


# Hold, latency, and their mean delay in periods (item 7), by which the transport delay is shortened.
@pytest.mark.parametrize(
    "hold, latency, periods", [("linear", 0, 0.0), ("linear", 1, 1.0), ("zoh", 0, -0.5), ("zoh", 1, 0.5)]
)
def test_restitution_with_simulator_and_two_delays_converges_to_continuous_solution(
    behind_simulator, hold, latency, periods
):
    rig = {"command_hold": hold, "command_latency": latency}
    parsed = validated(mechanism({"stiffness": [STIFFNESS]}, SECOND_ORDER, 0.0083, **rig))
    period, phase = grid(PERIODS, (np.arange(32) + 0.5) / 32)
    delay = 0.0037 - periods * period
    force_delay = 0.0083 + np.minimum(delay, 0)
    scenario = spread(
        parsed,
        len(period),
        control_period=period,
        phase=phase,
        simulator__delay=np.maximum(delay, 0),
        force_sensor__delay=force_delay,
    )
    error = first_contact(parsed, scenario)["restitution"].reshape(len(PERIODS), -1) - behind_simulator
    assert 1.8 < fitted_order(error) < 2.4
    # A hold or latency wrong by half a period would give 0.035 at T = 4 ms, 0.004 at 0.5 ms.
    assert np.abs(error[0]).max() < 3e-3 and np.abs(error[-1]).max() < 3e-5
    assert abs(error[-1].mean()) < 1e-5


# Item 2.


@pytest.mark.parametrize("name, phase", [("delay 0.05", 0.05), ("delay 0.2", 0.2)])
def test_restitution_of_delayed_contact_is_close_to_characteristic_root(kelvin_voigt, name, phase):
    root = 2 * lambertw(0.5j * phase)
    growth = np.exp(pi * root.real / abs(root.imag))
    excess = kelvin_voigt[name][0][-1].mean() - growth
    # The series lies above by 0.05 (omega tau)^4.
    assert excess == pytest.approx(0.05 * phase**4, rel=0.15, abs=1e-6)


# Tests of item 9 of model.md, section 6, and of nonlinear contact laws.

LAYERS = {"law": "piecewise_linear", "depths": [1e-4, 2e-4], "stiffness": [[8e4, 1.6e5, 3.2e5]]}


def layered_force(depth, rate, damping):
    slopes, edges = LAYERS["stiffness"][0], [0.0, *LAYERS["depths"], 1.0]
    parts = [k * np.clip(depth - a, 0.0, b - a) for k, a, b in zip(slopes, edges, edges[1:], strict=False)]
    return sum(parts) + damping * rate


NONLINEAR = {
    "hertz": ({"law": "hunt_crossley", "stiffness": [1e7]}, lambda d, r: 1e7 * max(d, 0) ** 1.5, 2),
    "hunt-crossley": (
        {"law": "hunt_crossley", "stiffness": [1e7], "damping": [25.0]},
        lambda d, r: 1e7 * max(d, 0) ** 1.5 * (1 + 37.5 * r),
        2,
    ),
    "quadratic": (
        {"law": "hunt_crossley", "stiffness": [4e8], "damping": [10.0], "exponent": 2.0},
        lambda d, r: 4e8 * max(d, 0) ** 2 * (1 + 15 * r),
        2,
    ),
    "layers": (LAYERS, lambda d, r: layered_force(d, r, 0.0), 2),
    "damped layers": ({**LAYERS, "damping": [400.0]}, lambda d, r: layered_force(d, r, 400.0), 1),
}


@pytest.fixture(scope="module")
def nonlinear():
    """Return (restitution, peak force, W_in, W_out) by name, (4, periods, phases); work in M v^2 / 2."""
    results = {}
    period, phase = grid(PERIODS, (np.arange(32) + 0.5) / 32)
    for group in (("hertz", "hunt-crossley", "quadratic"), ("layers", "damped layers")):
        parsed = [validated(mechanism(NONLINEAR[name][0], IDEAL, 0.0)) for name in group]
        scenario = join(spread(m, len(period), control_period=period, phase=phase) for m in parsed)
        result = first_contact(parsed[0], scenario, energies=True)
        energy = MASS * VELOCITY**2 / 2
        table = np.stack(
            [
                result["restitution"],
                result["peak_force"],
                result["work_in"] / energy,
                result["work_out"] / energy,
            ]
        )
        results |= zip(group, np.moveaxis(table.reshape(4, len(group), len(PERIODS), -1), 1, 0), strict=True)
    return results


@pytest.mark.parametrize("name", NONLINEAR)
def test_restitution_of_nonlinear_contact_converges_to_continuous_solution(nonlinear, name):
    _, law, order = NONLINEAR[name]
    depths = tuple(LAYERS["depths"]) if "layers" in name else ()
    expected, expected_peak = continuous.contact(MASS, VELOCITY, law, depths)
    restitution, peak = nonlinear[name][:2]
    error = restitution - expected
    # Onsets softer than linear ones converge faster.
    assert order - 0.2 < fitted_order(error) < order + (0.3 if order == 1 else 1)
    assert np.abs(error[-1]).max() < (1e-4 if order == 2 else 1e-3)
    assert peak[-1] == pytest.approx(expected_peak, rel=1e-3)


@pytest.mark.parametrize("name", [name for name in LIMITS if "delay" not in name or name == "undelayed"])
def test_work_of_kelvin_voigt_contact_converges_to_closed_form(kelvin_voigt, name):
    (_, ratio, _), _, order = LIMITS[name]
    restitution, work_in, work_out = kelvin_voigt[name]
    balance = work_out / work_in - restitution**2
    assert order - 0.25 < fitted_order(balance)
    # The sampled force includes the jump b v for up to a period more or less than the mechanism.
    jump = 4 * ratio * OMEGA * PERIODS[-1]
    assert np.abs(balance[-1]).max() < (1e-4 if order == 2 else jump)
    assert np.abs(work_in[-1] - 1).max() < (1e-4 if order == 2 else 2 * jump)


@pytest.mark.parametrize("name", NONLINEAR)
def test_work_of_nonlinear_contact_converges_to_continuous_solution(nonlinear, name):
    restitution, _, work_in, work_out = nonlinear[name]
    order = NONLINEAR[name][2]
    balance = work_out / work_in - restitution**2
    # The damper acts on the hardware velocity and the work uses the model's motion, which differ by a period.
    damped = "damping" in NONLINEAR[name][0]
    assert (1 if damped else order) - 0.3 < fitted_order(balance)
    assert np.abs(balance[-1]).max() < (2e-4 if order == 2 else 2e-3)
    assert np.abs(work_in[-1] - 1).max() < (1e-3 if damped else 2e-4)


# Tests of item 7 of model.md, section 6; the tests above cover hold and latency.


@pytest.mark.parametrize(
    "integrator, latency, periods", [("zoh", 0, 0.5), ("explicit_euler", 0, 1.0), ("zoh", 1, 1.5)]
)
def test_delay_caused_by_integrator_matches_closed_form(integrator, latency, periods):
    rig = {"integrator": integrator, "command_latency": latency}
    parsed = validated(mechanism({"stiffness": [STIFFNESS]}, IDEAL, 0.0, **rig))
    period, phase = grid(PERIODS, PHASES)
    scenario = spread(parsed, len(period), control_period=period, phase=phase)
    restitution = first_contact(parsed, scenario)["restitution"].reshape(len(PERIODS), -1)
    error = restitution - np.array([[continuous.delayed_restitution(OMEGA * periods * T)] for T in PERIODS])
    # The errors are smaller than for a delay of 0.02 T, and of a higher order than for any delay.
    delay = 2 / (pi * OMEGA) * error.mean(axis=1)
    assert np.all(np.abs(delay[1:]) < 0.02 * PERIODS[1:])
    assert 1.7 < fitted_order(error) < 2.6


# Item 10.


def test_noise_of_early_stiffness_estimate_matches_closed_form():
    """Least squares of F on x with an intercept: sigma_k = sigma_F sqrt(12 T) / (v t^1.5).

    A fit to increments of F uses only the noise of the first and last force, so that sigma_k is sqrt(t/(6 T))
    times as large.
    """
    lanes, samples, deviation, period = 1500, 40, 0.01, 1e-3
    # The contact is so soft that x = v t during the fit.
    parsed = validated(
        mechanism(
            {"law": "linear", "stiffness": [200.0]},
            IDEAL,
            0.0,
            period=period,
            force_sensor={"noise_std": deviation},
        )
    )
    keys = np.stack([np.zeros(lanes, np.uint32), np.arange(lanes, dtype=np.uint32)])
    scenario = spread(parsed, lanes, key=keys)
    loop = build_loop(parsed, "none", scenario)
    signals = run_record(loop, {}, scenario, 80)[1].signals
    force, position = np.asarray(signals.force_measured), np.asarray(signals.position_measured)
    first = int(np.argmax(position[:, 0] > 0))
    force, position = force[first : first + samples], position[first : first + samples]
    duration = samples * period
    assert np.ptp(position) == pytest.approx(VELOCITY * (duration - period), rel=2e-3)

    centred = position - position.mean(axis=0)
    fitted = np.sum(centred * force, axis=0) / np.sum(centred**2, axis=0)
    steps = np.diff(position, axis=0)
    on_increments = np.sum(steps * np.diff(force, axis=0), axis=0) / np.sum(steps**2, axis=0)
    predicted = deviation * np.sqrt(12 * period) / (VELOCITY * duration**1.5)
    # The standard deviation over the lanes is known to 4 / sqrt(2 lanes).
    accuracy = 4 / np.sqrt(2 * lanes)
    assert fitted.mean() == pytest.approx(200.0, abs=4 * predicted / np.sqrt(lanes))
    assert fitted.std() == pytest.approx(predicted, rel=accuracy)
    assert on_increments.std() / fitted.std() == pytest.approx(np.sqrt(duration / (6 * period)), rel=accuracy)
