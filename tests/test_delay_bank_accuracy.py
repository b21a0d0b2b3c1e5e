"""What the bank of delays leaves of contacts whose force delay is unknown; prints its figures with
`pytest -m slow -s tests/test_delay_bank_accuracy.py`."""

import math

import numpy as np
import pytest
from c99_cases import ROW
from rig_lock_step import controller
from test_law_status import run

from jaxhil.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.evaluation import evaluate
from jaxhil.simulation.scenario import build_scenarios

pytestmark = pytest.mark.slow
LAW = "retrospective_delay_bank"
SUITES = ("noisy", "damped", "hertz", "hardening", "layered")
PLANES = 'uncertainty."rig.contact_plane"={distribution="uniform",low=-1e-3,high=1e-3}'
PLANE = 'uncertainty."rig.contact_plane"={distribution="uniform",low=-1e-9,high=1e-9}'
OFF = PLANE.replace("-1e-9", "4.999e-6").replace("1e-9", "5.001e-6")
QUIET = "rig.force_sensor.noise_std=0.0"
DELAYS = 'uncertainty."rig.force_sensor.delay"={distribution="uniform",low=0.007,high=0.009}'


@pytest.fixture(scope="module")
def repeated():
    """Four contacts of the layered suite whose force delay is unknown to +-1 ms, under the law."""
    mechanism = load("suite-layered", ["approach.contacts=4", DELAYS]).mechanism
    drawn = draw(mechanism, 64, 9)
    scenarios = build_scenarios(mechanism, drawn, 9)
    gains = literature_gains(mechanism, LAW)
    assert gains["delay_spread"] == pytest.approx(0.001)
    loop = build_loop(mechanism, LAW, scenarios)
    return drawn["rig.force_sensor.delay"], evaluate(loop, gains, scenarios)


def test_an_unknown_delay_is_found_and_leaves_little(repeated):
    delays, outcome = repeated
    assert np.all(outcome.good)
    rms = np.sqrt(np.mean(np.asarray(outcome.error) ** 2, axis=1))
    found = np.asarray(outcome.metrics.force_delay) - delays
    assert rms[0] < 0.004 and rms[-1] < 0.003
    assert np.sqrt(np.mean(found[-1] ** 2)) < 1.5e-4 < 3 * np.sqrt(np.mean(found[0] ** 2))


def restitution(mechanism):
    """Of linear damped contact that does not adhere: the force is 0 where the speed is greatest."""
    [stiffness], [damping] = mechanism.contact.stiffness, mechanism.contact.damping
    ratio = damping / (2 * math.sqrt(stiffness * mechanism.bodies.mass))
    return math.exp(-ratio / math.sqrt(1 - ratio**2) * (math.pi - 2 * math.asin(ratio)))


@pytest.mark.parametrize("plane", ["told", "unknown"])
@pytest.mark.parametrize("suite", SUITES)
def test_what_an_unknown_delay_leaves_on_the_standard_suites(suite, plane, capsys):
    """Eight contacts of 100 scenarios, the delay unknown to +-1 ms, the phase drawn for each; the surface
    told, or unknown to +-1 mm."""
    changes = ["approach.contacts=8", DELAYS, PLANES if plane == "unknown" else PLANE]
    mechanism = load(f"suite-{suite}", changes).mechanism
    scenarios = build_scenarios(mechanism, draw(mechanism, 100, 77), 77)
    outcome = evaluate(build_loop(mechanism, LAW, scenarios), literature_gains(mechanism, LAW), scenarios)
    assert np.all(outcome.good[:8])
    rms = 100 * np.sqrt(np.mean(np.asarray(outcome.error)[:8] ** 2, axis=1))
    with capsys.disabled():
        print(
            f"\n{suite:10s} plane {plane:8s} rms [%], contacts 1, 2, 4, 8:", *np.round(rms[[0, 1, 3, 7]], 2)
        )
    dissipates = suite in ("noisy", "damped")
    first, eighth = {"told": (0.75 if dissipates else 0.4, 0.3), "unknown": (0.85, 0.45)}[plane]
    # Damped contacts slow down from one to the next, which makes more of the noise: see below.
    assert (rms[0] <= first and rms[7] <= eighth) if suite != "damped" else rms[0] <= 1.0


def errors_at_one_speed(told, suite, changes, number, contacts=8):
    """e - e* [%] of contacts one after the other, the phase drawn anew for each, e* of each scenario, and
    what the law said of the last; the law knows what `told` says."""
    drawn = draw(load(f"suite-{suite}", changes).mechanism, number, 79)
    drawn.pop("approach.phase")
    errors, exact, said = np.empty((number, contacts)), np.empty(number), []
    for place in range(number):
        values = {path: each[place].tolist() for path, each in drawn.items()}
        one = controller(told, LAW, literature_gains(told, LAW))
        for contact in range(contacts):
            values["approach.phase"] = np.random.default_rng([place, contact]).random()
            settings = [f"{path}={value}" for path, value in values.items()]
            mechanism = load(f"suite-{suite}", [*changes, *settings]).mechanism
            exact[place] = restitution(mechanism) if suite == "damped" else 1.0
            velocity = run(mechanism, one, contact).rows[:, ROW.index("velocity")]
            errors[place, contact] = 100 * (abs(velocity[-1]) / velocity[0] - exact[place])
            one.next_contact()
        said.append(one.last_contact.status)
    return errors, exact, said


@pytest.mark.parametrize(
    ("case", "changes", "first", "eighth"),
    [
        ("surface unknown", [PLANES], 0.9, 0.32),
        ("surface unknown, no noise", [PLANES, QUIET], 0.8, 0.25),
        ("surface told", [PLANE], 0.85, 0.3),
        ("told, and 5 um off", [OFF], 0.85, 0.45),
    ],
)
def test_what_it_leaves_of_damped_contacts_at_one_speed(case, changes, first, eighth, capsys):
    """Beside it what the control period alone leaves: the first touch is somewhere between two ticks, evenly;
    of eight such errors the mean of the least and the greatest is the best estimate."""
    number = 32
    told = load("suite-damped", [DELAYS, *(PLANE if one == OFF else one for one in changes)]).mechanism
    errors, exact, _ = errors_at_one_speed(told, "damped", [DELAYS, *changes], number)
    stiffness = np.array(draw(told, number, 79)["contact.stiffness"]).reshape(number, -1)[:, 0]
    per_delay = 0.5 * math.pi * np.sqrt(stiffness / told.bodies.mass) * exact
    period = told.rig.control_period
    bounds = 100 * period * np.sqrt(np.mean(per_delay**2)) * np.array([1 / math.sqrt(12), 1 / math.sqrt(180)])
    rms = np.sqrt(np.mean(errors**2, axis=0))
    with capsys.disabled():
        print(
            f"\ndamped, {case}: rms [%], contacts 1, 2, 4, 8:", *np.round(rms[[0, 1, 3, 7]], 2),
            f"; by the control period alone, contacts 1, 8: {bounds[0]:.2f} {bounds[1]:.2f}",
        )  # fmt: skip
    assert rms[0] <= first and rms[7] <= eighth


@pytest.mark.parametrize("delay", ["uncertain by 4 ms", "told"])
@pytest.mark.parametrize("suite", SUITES)
def test_what_a_lag_of_3_ms_that_is_not_told_leaves(suite, delay, capsys):
    """The first damped contact cannot be met with 1 % (`test_delay_bounds`), least of all where what looks
    like a lag may as well be a delay."""
    uncertain = 'uncertainty."rig.force_sensor.delay"={distribution="uniform",low=0.004,high=0.012}'
    told = load(f"suite-{suite}", [PLANES, *([uncertain] if delay != "told" else [])]).mechanism
    errors, _, said = errors_at_one_speed(told, suite, [PLANES, "rig.force_sensor.time_constant=0.003"], 16)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    odd = np.mean([one == "identified" and abs(e) > 1.5 for one, e in zip(said, errors[:, -1], strict=True)])
    with capsys.disabled():
        counts = {status: said.count(status) for status in sorted(set(said))}
        print(
            f"\n{suite}, lag of 3 ms, delay {delay}: rms [%], contacts 1, 2, 4, 8:",
            *np.round(rms[[0, 1, 3, 7]], 2), counts,
        )  # fmt: skip
    first = {"told": 5.0, "uncertain by 4 ms": 6.0}[delay] if suite == "damped" else 1.0
    assert rms[0] <= first and rms[7] <= 1.0
    assert odd == 0


@pytest.mark.parametrize(("lag", "delay"), [(0.001, "told"), (0.003, "told"), (0.001, "uncertain by 1 ms")])
@pytest.mark.parametrize("suite", SUITES)
def test_what_a_lag_that_is_told_leaves(suite, lag, delay, capsys):
    """Where the delay is uncertain as well, of sixteen damped contacts one is called identified that errs."""
    changes = [PLANES, f"rig.force_sensor.time_constant={lag}", *([DELAYS] if delay != "told" else [])]
    told = load(f"suite-{suite}", changes).mechanism
    errors, _, said = errors_at_one_speed(told, suite, changes, 16)
    rms = np.sqrt(np.mean(errors**2, axis=0))
    odd = np.mean([one == "identified" and abs(e) > 1.5 for one, e in zip(said, errors[:, -1], strict=True)])
    with capsys.disabled():
        counts = {status: said.count(status) for status in sorted(set(said))}
        print(
            f"\n{suite}, lag of {1e3 * lag:.0f} ms told, delay {delay}: rms [%], contacts 1, 2, 4, 8:",
            *np.round(rms[[0, 1, 3, 7]], 2), counts,
        )  # fmt: skip
    least_known = suite == "damped" and delay != "told"
    assert np.all(rms[[0, 7]] <= (1.5 if least_known else 0.6))
    assert odd <= (1 / 16 if least_known else 0)


def test_what_an_unknown_delay_leaves_of_damped_contact_is_the_control_periods(capsys):
    """At 0.25 ms the bar is 0.3 %, and the least possible 0.36 % (`test_delay_posterior`)."""
    rms = []
    for period in (0.001, 0.00025):
        mechanism = load("suite-damped", [DELAYS, PLANE, f"rig.control_period={period}"]).mechanism
        scenarios = build_scenarios(mechanism, draw(mechanism, 100, 78), 78)
        outcome = evaluate(build_loop(mechanism, LAW, scenarios), literature_gains(mechanism, LAW), scenarios)
        rms.append(100 * np.sqrt(np.mean(np.asarray(outcome.error)[0] ** 2)))
    with capsys.disabled():
        print(f"\ndamped, first contact, T = 1 and 0.25 ms: {rms[0]:.2f} {rms[1]:.2f} % rms")
    assert rms[1] <= 0.6 * rms[0] <= 0.6
