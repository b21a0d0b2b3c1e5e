"""The runtime controller: gain files, laws against plain matrix equations, life cycle."""

import json
import math
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gain_documents import GAINS, gain_document, sign
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxhil.runtime
from jaxhil.runtime import Controller, GainFileError, digest
from jaxhil.runtime.filters import DelayLine, LeadFilter, VelocityFilter
from jaxhil.runtime.laws.identification import ContactIdentification

RUNTIME = Path(jaxhil.runtime.__file__).parent
Reading = tuple[float, float, float, float]


def readings(count: int, *, seed: int = 0, two_sided: float = 0.0) -> list[Reading]:
    """Noisy readings (F, x_d, v_d, x_m) of a contact and, with a gap, of the far surface too."""
    rng = random.Random(seed)
    stiffness, damping, rate = 1.2e5, 300.0, 25.0
    amplitude = 2e-4 + two_sided
    found = []
    for n in range(count):
        t = n * 1e-3 - 0.01
        x, v = amplitude * math.sin(rate * t), amplitude * rate * math.cos(rate * t)
        late = t - 0.009
        xl, vl = amplitude * math.sin(rate * late), amplitude * rate * math.cos(rate * late)
        depth = xl if xl > 0 else min(xl + two_sided, 0.0) if two_sided else 0.0
        force = stiffness * depth + damping * vl if depth else 0.0
        measured = amplitude * math.sin(rate * (t - 0.006)) + rng.gauss(0.0, 1e-7)
        found.append((force + rng.gauss(0.0, 1.0), x, v, measured))
    return found


def run(controller: Controller, ticks: list[Reading]) -> list[float]:
    return [controller.step(*tick) for tick in ticks]


def by_matrices(document: dict[str, Any], ticks: list[Reading]) -> tuple[np.ndarray, np.ndarray]:
    """F_c and theta per tick of the response-error law, written with whole signals and matrices.

    Lead and velocity are state-space models discretised by the bilinear transform; the delay is an
    interpolation of the whole record, the contact's share of each period a length on the polygon;
    the identification is textbook recursive least squares, weighted, with its covariance bounded.
    """
    gain = {name: entry["value"] for name, entry in document["gains"].items()}
    period = document["control_period"]
    clearance = document["mechanism"]["contact"].get("clearance", np.inf)
    force, desired, velocity, measured = np.array(ticks).T
    count = len(force)

    lag, lead = gain["lead_filter"], gain["phase_lead"] + gain["lead_filter"]
    led = bilinear(-1 / lag, 1 - lead / lag, 1 / lag, lead / lag, period, force, 0.0, 0.0)

    def differentiate(signal: np.ndarray) -> np.ndarray:
        tau = gain["velocity_filter"]
        before = signal[0] - period * velocity[0]
        # The steady state of s/(1 + tau s) in uniform motion: x - tau x'.
        state = before - tau * velocity[0]
        return bilinear(-1 / tau, -1 / tau, 1 / tau, 1 / tau, period, signal, state, before)

    times = period * np.arange(count)
    past = period * np.arange(-200, 0)
    aligned = np.interp(
        times - gain["identification_delay"],
        np.concatenate([past, times]),
        np.concatenate([measured[0] + past * velocity[0], measured]),
    )
    measured_velocity, aligned_velocity = differentiate(measured), differentiate(aligned)
    depth = np.where(aligned > 0, aligned, np.where(aligned < -clearance, aligned + clearance, 0.0))
    start = aligned[0] - period * velocity[0]
    contact = triangle(measure(aligned, start, 0.0, np.inf) + measure(aligned, start, -np.inf, -clearance))
    size = np.abs(force)
    weight = contact * triangle(measure(size, 0.0, gain["contact_threshold"], np.inf))

    theta = np.array([gain["initial_stiffness"], gain["initial_damping"]])
    initial = gain["stiffness_covariance"], gain["damping_covariance"]
    covariance = np.diag(initial)
    history = np.empty((count, 2))
    for n in range(count):
        phi = np.array([depth[n], aligned_velocity[n]])
        kept = 1.0 - weight[n] * (1.0 - gain["forgetting"])
        column = weight[n] * covariance @ phi / (kept + weight[n] * phi @ covariance @ phi)
        theta = theta + column * (force[n] - phi @ theta)
        covariance = bounded((covariance - np.outer(column, phi @ covariance)) / kept, initial)
        history[n] = theta
    response = gain["response_error"] * history[:, 0] * (desired - measured)
    response += gain["response_error_damping"] * history[:, 1] * (velocity - measured_velocity)
    return led + contact * response, history


def bounded(covariance: np.ndarray, most: tuple[float, float]) -> np.ndarray:
    """The covariance with d_1 = P_11 - P_12^2/P_22 and d_2 = P_22 at most their initial values."""
    factor = np.array([[1.0, covariance[0, 1] / covariance[1, 1]], [0.0, 1.0]])
    d_1 = covariance[0, 0] - factor[0, 1] * covariance[0, 1]
    return factor @ np.diag([min(d_1, most[0]), min(covariance[1, 1], most[1])]) @ factor.T


def measure(signal: np.ndarray, start: float, low: float, high: float) -> np.ndarray:
    """The share of each period that the polygon through `start` and the signal lies in (low, high)."""
    ends = np.stack([np.concatenate([[start], signal[:-1]]), signal])
    bottom, top = ends.min(axis=0), ends.max(axis=0)
    inside = np.maximum(np.minimum(top, high) - np.maximum(bottom, low), 0.0)
    still = (signal > low) & (signal < high)
    return np.divide(inside, top - bottom, out=still.astype(float), where=top > bottom)


def triangle(share: np.ndarray) -> np.ndarray:
    """Two periods' triangle over the time beyond a threshold, of which each period has a share."""
    before = np.concatenate([[0.0], share[:-1]])
    return (share**2 + before**2) / 2 + share * before * (2 - share - before)


def bilinear(
    a: float,
    b: float,
    c: float,
    d: float,
    period: float,
    signal: np.ndarray,
    state: float,
    before: float,
) -> np.ndarray:
    """Trapezoidal simulation of z' = a z + c u, y = b z + d u, from the sample before the first.

    For the lead, (1 + T_1 s)/(1 + T_2 s) = T_1/T_2 + (1 - T_1/T_2)/(1 + T_2 s); for the filtered
    derivative, 1/tau - (1/tau)/(1 + tau s).
    """
    output = np.empty(len(signal))
    previous = before
    for n, value in enumerate(signal):
        state = ((1 + a * period / 2) * state + c * period / 2 * (previous + value)) / (1 - a * period / 2)
        previous = value
        output[n] = b * state + d * value
    return output


# Laws


def test_no_compensation_returns_the_measured_force():
    ticks = readings(50)
    controller = Controller.from_dict(gain_document("none"))
    assert run(controller, ticks) == [tick[0] for tick in ticks]
    assert controller.identified == (0.0, 0.0)


def test_phase_lead_is_the_tustin_transfer_function():
    """The response to a sine settles on the discrete transfer function's gain and phase."""
    lead, lag, period, omega = 0.008, 0.001, 0.001, 40.0
    controller = Controller.from_dict(gain_document("phase_lead", phase_lead=lead, lead_filter=lag))
    output = [controller.step(math.sin(omega * n * period), 0.0, 0.0, 0.0) for n in range(400)]
    s = 2 / period * complex(0.0, math.tan(omega * period / 2))
    transfer = (1 + (lead + lag) * s) / (1 + lag * s)
    for n in range(300, 400):
        expected = (transfer * complex(math.cos(omega * n * period), math.sin(omega * n * period))).imag
        assert output[n] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.0004, 0.001, 0.008, 0.0083])
@pytest.mark.parametrize("clearance", [None, 0.001])
def test_response_error_agrees_with_matrix_equations(delay, clearance):
    document = gain_document(clearance=clearance, identification_delay=delay)
    ticks = readings(400, two_sided=clearance or 0.0)
    controller = Controller.from_dict(document)
    expected, theta = by_matrices(document, ticks)
    forces, identified = [], []
    for tick in ticks:
        forces.append(controller.step(*tick))
        identified.append(controller.identified)
    assert not np.allclose(theta[-1], theta[0], rtol=1e-3)
    np.testing.assert_allclose(forces, expected, atol=1e-9 * np.abs(expected).max(), rtol=0)
    np.testing.assert_allclose(np.array(identified), theta, rtol=1e-8)
    assert controller.status == "ok"


@pytest.mark.parametrize("name", sorted(set(GAINS) - {"position_lead"}))
def test_a_law_that_leads_the_force_commands_the_position_itself(name):
    controller = Controller.from_dict(gain_document(name))
    assert controller.position_command(0.25, 3.0, -7.0) == 0.25


def test_response_term_acts_where_the_aligned_position_is_in_contact():
    controller = Controller.from_dict(gain_document(identification_delay=0.0, initial_stiffness=1e5))
    # No force, so nothing is identified: only the side of the surface decides, and for how long.
    for measured, stiffness in [(-1e-4, 0.0), (1e-4, 9e4), (-1e-9, 0.0), (0.0, 0.0), (1e-9, 9e4)]:
        controller.reset()
        forces = [controller.step(0.0, measured + 1e-5, 0.0, measured) for _ in range(4)]
        expected = stiffness * 1e-5 * np.array([0.5, 1.0, 1.0, 1.0])
        assert forces == pytest.approx(expected, rel=1e-12)


def test_response_term_fades_by_where_the_surface_was_left():
    document = gain_document(identification_delay=0.0, initial_stiffness=1e5, response_error_damping=0.0)
    for left in (0.0, 0.25, 0.5, 1.0):  # of the period after the last tick in contact
        controller = Controller.from_dict(document)
        places = [1e-6, 1e-6, left * 1e-6, (left - 1) * 1e-6, -1e-6, -1e-6]
        forces = [controller.step(0.0, x + 1e-5, 0.0, x) for x in places]
        expected = [1 - (1 - left) ** 2 / 2, left**2 / 2, 0.0]
        assert forces[3:] == pytest.approx([9e4 * 1e-5 * gate for gate in expected], rel=1e-12)


# Parts


def test_lead_filter_passes_a_constant_and_leads_a_ramp():
    constant, ramp = LeadFilter(0.02, 0.003, 0.001), LeadFilter(0.02, 0.003, 0.001)
    settled = [(constant.step(7.0), ramp.step(n * 0.001)) for n in range(200)][-1]
    assert settled == pytest.approx((7.0, 0.199 + 0.02), rel=1e-12)


def test_velocity_filter_starts_in_uniform_motion():
    velocity = VelocityFilter(0.004, 0.001)
    velocity.start(-2.0, 0.5)
    assert [velocity.step(-2.0 + 0.0005 * n) for n in range(50)] == pytest.approx([0.5] * 50, rel=1e-11)


@given(periods=st.floats(0.0, 40.0))
@settings(max_examples=50, deadline=None)
def test_delay_line_interpolates_its_samples(periods):
    period, speed = 0.002, 0.3
    samples = [1.0 + math.sin(0.7 * n) for n in range(60)]
    line = DelayLine(periods * period, period)
    line.start(samples[0], speed)
    delayed = [line.step(sample) for sample in samples]
    index = np.arange(-60, 60)
    record = np.concatenate([samples[0] + index[:60] * period * speed, samples])
    expected = np.interp(np.arange(60) - periods, index, record)
    np.testing.assert_allclose(delayed, expected, atol=1e-8)


def test_delay_line_keeps_whole_delays_whole():
    # 0.003/0.001 and its like round either way.
    for whole in range(40):
        line = DelayLine(whole * 0.001, 0.001)
        line.start(0.0, 0.0)
        delayed = [line.step(float(n % 2)) for n in range(100)]
        assert delayed[whole:] == pytest.approx([float(n % 2) for n in range(100 - whole)], abs=2e-9)


def test_delay_line_refuses_an_absurd_delay():
    with pytest.raises(ValueError, match="periods"):
        DelayLine(1e9, 1e-3)


@given(seed=st.integers(0, 2**32 - 1), forgetting=st.floats(0.9, 1.0))
@settings(max_examples=30, deadline=None)
def test_identification_is_weighted_recursive_least_squares(seed, forgetting):
    """With its bound on the covariance."""
    rng = np.random.default_rng(seed)
    identification = ContactIdentification(2.0, -1.0, 5.0, 0.5, forgetting)
    theta, covariance = np.array([2.0, -1.0]), np.diag([5.0, 0.5])
    for weight in rng.choice([0.0, 0.3, 1.0], 40):
        phi, force = rng.normal(size=2), rng.normal()
        kept = 1.0 - weight * (1.0 - forgetting)
        column = weight * covariance @ phi / (kept + weight * phi @ covariance @ phi)
        theta = theta + column * (force - phi @ theta)
        covariance = bounded((covariance - np.outer(column, phi @ covariance)) / kept, (5.0, 0.5))
        identification.update(force, phi[0], phi[1], weight)
    found = [identification.stiffness, identification.damping]
    np.testing.assert_allclose(found, theta, rtol=1e-8, atol=1e-10)
    expected = [covariance[0, 0], covariance[0, 1], covariance[1, 1]]
    scale = np.abs(covariance).max()
    np.testing.assert_allclose(identification.covariance, expected, rtol=0, atol=1e-9 * scale)


def test_covariance_does_not_wind_up():
    """Held still, a contact tells nothing of the damping, nor one without depth of the stiffness."""
    for deflection, rate in ((2e-4, 0.0), (0.0, 1e-3), (0.0, 0.0)):
        identification = ContactIdentification(1e5, 100.0, 1e12, 1e6, 0.8)
        for _ in range(100_000):
            identification.update(1.5e5 * deflection + 420.0 * rate, deflection, rate, 1.0)
        kk, kb, bb = identification.covariance
        assert 0.0 < kk <= 1e12 and kb == 0.0 and 0.0 < bb <= 1e6
        assert max(kk / 1e12, bb / 1e6) == 1.0


def test_identification_finds_stiffness_and_damping():
    identification = ContactIdentification(0.0, 0.0, 1e16, 1e14, 1.0)
    for n in range(100):
        p, v = 1e-4 * math.sin(0.03 * n), 2e-3 * math.cos(0.03 * n)
        identification.update(1.5e5 * p + 420.0 * v, p, v, 1.0)
    assert identification.stiffness == pytest.approx(1.5e5, rel=1e-6)
    assert identification.damping == pytest.approx(420.0, rel=1e-6)


# Life cycle


@pytest.mark.parametrize("name", sorted(GAINS))
def test_runs_repeat_bit_for_bit_after_reset(name):
    ticks = readings(300)
    controller = Controller.from_dict(gain_document(name))
    first = run(controller, ticks)
    controller.reset()
    again = run(controller, ticks)
    fresh = run(Controller.from_dict(gain_document(name)), ticks)
    assert [value.hex() for value in first] == [value.hex() for value in again]
    assert [value.hex() for value in first] == [value.hex() for value in fresh]
    assert all(type(value) is float for value in first)


def test_numpy_scalars_and_integers_give_the_same_plain_floats():
    ticks = readings(200)
    document = gain_document()
    plain = run(Controller.from_dict(document), ticks)
    controller = Controller.from_dict(document)
    scalars = [controller.step(*np.array(tick)) for tick in ticks]
    assert scalars == plain
    assert all(type(value) is float for value in scalars)


def test_reset_forgets_and_next_contact_keeps_what_was_identified():
    ticks = readings(300)
    controller = Controller.from_dict(gain_document())
    run(controller, ticks)
    stiffness, damping = controller.identified
    assert stiffness != 8e4

    controller.next_contact()
    assert controller.identified == (stiffness, damping)
    carried = run(controller, ticks)
    # All but the identified parameters is fresh: as if they had been the initial ones.
    known = gain_document()
    known["gains"]["initial_stiffness"]["value"] = stiffness
    known["gains"]["initial_damping"].update(value=damping, lower=-1e6)
    assert carried == run(Controller.from_dict(sign(known)), ticks)

    controller.reset()
    assert controller.identified == (8e4, 50.0)


@pytest.mark.parametrize("name", sorted(GAINS))
@pytest.mark.parametrize("position", range(5))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_input_that_is_not_finite_trips_until_reset(name, position, value):
    controller = Controller.from_dict(gain_document(name))
    readings = (100.0, 1e-3, 0.0, 1e-3)
    healthy = controller.step(*readings, 0.0)
    assert healthy != 0.0
    bad = [*readings, 0.001]
    bad[position] = value
    names = ["force_measured", "position_desired", "velocity_desired", "position_measured", "time"]
    fault = ["force_not_finite", "model_not_finite", "model_not_finite", "position_not_finite", "clock"]
    assert controller.step(*bad) == 0.0
    assert controller.status == f"tripped: {fault[position]} ({names[position]} is {value!r})"
    assert controller.step(*readings, 0.002) == 0.0
    controller.next_contact()
    assert controller.step(*readings, 0.003) == 0.0
    assert controller.status.startswith("tripped: ")
    assert controller.reset()
    assert controller.status == "ok"
    assert controller.step(*readings, 0.004) == healthy


def test_input_that_is_no_number_trips():
    controller = Controller.from_dict(gain_document())
    assert controller.step(None, 0.0, 0.0, 0.0) == 0.0  # type: ignore[arg-type]
    assert controller.status == "tripped: force_not_finite (force_measured is null)"


def test_force_that_overflows_trips():
    controller = Controller.from_dict(gain_document("phase_lead"))
    assert controller.step(1.7e308, 0.0, 0.0, 0.0) == 0.0
    assert controller.status == "tripped: command_not_finite"


def test_position_command_that_is_not_finite_trips_and_holds():
    controller = Controller.from_dict(gain_document())
    assert controller.position_command(-0.02, 0.005, 0.0) == -0.02
    assert controller.position_command(math.nan, 0.005, 0.0) == -0.02
    assert controller.status == "tripped: model_not_finite (the numerical model's motion)"
    assert controller.step(10.0, 0.0, 0.0, 0.0) == 0.0


def test_missed_ticks_are_counted():
    controller = Controller.from_dict(gain_document("none"))
    for time in (0.0, 0.001, 0.0024, 0.0034, 0.0054, 0.0094):
        controller.step(1.0, 0.0, 0.0, 0.0, time)
    # Gaps of 1, 1.4, 1, 2 and 4 periods.
    assert controller.missed_ticks == 4
    controller.next_contact()
    controller.step(1.0, 0.0, 0.0, 0.0, 5.0)
    assert controller.missed_ticks == 4
    controller.step(1.0, 0.0, 0.0, 0.0)
    controller.reset()
    assert controller.missed_ticks == 0


def test_controllers_share_no_state():
    ticks = readings(200)
    alone = run(Controller.from_dict(gain_document()), ticks)
    first, second = Controller.from_dict(gain_document()), Controller.from_dict(gain_document())
    interleaved = []
    for tick in ticks:
        interleaved.append(first.step(*tick))
        second.step(50.0, 1e-3, 0.1, 2e-3)
    assert interleaved == alone


# Gain files


def refused(document: Any, *words: str) -> str:
    with pytest.raises(GainFileError) as caught:
        Controller.from_dict(document)
    message = str(caught.value)
    assert message.isprintable() and len(message) < 400
    for word in words:
        assert word in message
    return message


def paths(node: Any, path: tuple = ()) -> list[tuple]:
    """The paths of every entry, at any depth."""
    found = [path] if path else []
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in entries:
        found += paths(value, (*path, key))
    return found


def at(document: Any, path: tuple) -> Any:
    for key in path:
        document = document[key]
    return document


SIGNED = [
    (name, path)
    for name in sorted(GAINS)
    for path in paths(gain_document(name))
    if path[0] not in ("created", "timings")
]
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda values: st.lists(values, max_size=2) | st.dictionaries(st.text(max_size=4), values, max_size=2),
    max_leaves=4,
)


@given(place=st.sampled_from(SIGNED), value=JSON_VALUES, remove=st.booleans())
@settings(max_examples=300, deadline=None)
def test_any_mutation_of_one_field_is_refused(place, value, remove):
    name, path = place
    document = gain_document(name)
    container, key = at(document, path[:-1]), path[-1]
    if remove:
        del container[key]
    elif json.dumps(container[key], sort_keys=True) == json.dumps(value, sort_keys=True):
        return
    else:
        container[key] = value
    refused(document)


@given(value=JSON_VALUES, path=st.sampled_from([p for n, p in SIGNED if n == "response_error"]))
@settings(max_examples=300, deadline=None)
def test_mutations_signed_anew_load_or_are_refused_with_one_line(path, value):
    document = gain_document()
    at(document, path[:-1])[path[-1]] = value
    try:
        sign(document)
    except ValueError:
        refused(document)
        return
    try:
        controller = Controller.from_dict(document)
    except GainFileError as error:
        assert str(error).isprintable()
    else:
        controller.step(100.0, 1e-3, 0.0, 1e-3)


@pytest.mark.parametrize("name", sorted(GAINS))
def test_file_and_dictionary_give_the_same_controller(name, tmp_path):
    document = gain_document(name)
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(document, indent=2), encoding="utf-8")
    ticks = readings(100)
    assert run(Controller.from_file(path), ticks) == run(Controller.from_dict(document), ticks)


def test_digest_covers_content_but_not_date_and_timings():
    document = gain_document()
    stated = document["sha256"]
    document["created"], document["timings"] = "later", {}
    assert digest(document) == stated
    Controller.from_dict(document)
    assert digest(dict(reversed(document.items()))) == stated
    document["seed"] = 1
    assert digest(document) != stated
    # Recorded from `sha256sum` over the canonical text itself.
    assert digest({"b": 1.5, "a": "\u00e9", "sha256": "", "created": "", "timings": {}}) == (
        "58cb8a469294078eeafef7f1c22eb93d48a3fe96f63021dee6f65daf4b817635"
    )


def change(*path_and_value: Any) -> dict[str, Any]:
    """A response-error document with one entry replaced, or removed where the value is `...`."""
    *path, key, value = path_and_value
    document = gain_document()
    container = at(document, tuple(path))
    if value is ...:
        del container[key]
    else:
        container[key] = value
    return sign(document)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("compensator", "pid"), ["compensator", "'pid'", "response_error"]),
        (("compensator", ["none"]), ["compensator", "a list"]),
        (("compensator", "none"), ["gains", "extra", "no gains"]),
        (("gains", ...), ["gains", "nothing"]),
        (("gains", "forgetting", ...), ["gains.forgetting", "nothing"]),
        (("gains", "speed", {}), ["extra gain 'speed'"]),
        (("gains", "forgetting", 0.99), ["gains.forgetting", "0.99", "an object"]),
        (("gains", "phase_lead", "unit", "ms"), ["gains.phase_lead.unit", "'ms'", "'s'"]),
        (("gains", "phase_lead", "unit", ...), ["gains.phase_lead.unit", "nothing"]),
        (("gains", "phase_lead", "value", 0.06), ["phase_lead.value", "0.06", "0.0 to 0.05"]),
        (("gains", "phase_lead", "value", -1e-9), ["phase_lead.value", "0.0 to 0.05"]),
        (("gains", "phase_lead", "value", True), ["phase_lead.value", "true", "finite number"]),
        (("gains", "phase_lead", "value", "0"), ["phase_lead.value", "'0'", "finite number"]),
        (("gains", "phase_lead", "value", 10**400), ["phase_lead.value", "finite number"]),
        (("gains", "phase_lead", "lower", ...), ["phase_lead.lower", "nothing"]),
        (("gains", "phase_lead", "upper", None), ["phase_lead.upper", "null"]),
        (("gains", "lead_filter", {"value": 0, "unit": "s", "lower": 0, "upper": 1}), ["> 0.0"]),
        (("gains", "forgetting", {"value": 2, "unit": "1", "lower": 0, "upper": 3}), ["<= 1.0"]),
        (
            (
                "gains",
                "identification_delay",
                {"value": 1e9, "unit": "s", "lower": 0, "upper": 1e9},
            ),
            ["gains", "periods"],
        ),
        (("control_period", 0), ["control_period", "> 0"]),
        (("control_period", True), ["control_period", "true"]),
        (("control_period", 0.002), ["control_period", "0.002", "0.001"]),
        (("mechanism", ...), ["mechanism", "nothing"]),
        (("mechanism", []), ["mechanism", "a list"]),
        (("mechanism", "rig", ...), ["mechanism.rig", "nothing"]),
        (("mechanism", "rig", "control_period", 0.004), ["control_period", "0.004"]),
        (("mechanism", "contact", ...), ["mechanism.contact", "nothing"]),
        (("mechanism", "contact", "clearance", -1.0), ["mechanism.contact.clearance", "-1.0"]),
    ],
)
def test_content_that_does_not_fit_is_refused_by_key(edit, words):
    refused(change(*edit), *words)


def test_schema_and_digest_are_checked_before_the_rest():
    refused({}, "schema", "nothing")
    refused([], "a list")
    refused({"schema": "jaxhil/gains/2"}, "'jaxhil/gains/2'", "'jaxhil/gains/1'")
    document = change("compensator", "pid")
    refused({**document, "sha256": "0" * 64}, "sha256", "0" * 64)
    refused({**document, "sha256": None}, "sha256", "null")
    refused({**document, "seed": math.nan}, "JSON")
    refused({**document, "seed": {1, 2}}, "JSON")


def test_nesting_is_limited():
    deep: Any = 0
    for _ in range(3000):
        deep = [deep]
    document = gain_document()
    document["figures"] = deep
    refused(document, "nesting")
    circle: list = []
    circle.append(circle)
    document["figures"] = circle
    refused(document, "nesting")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "not JSON"),
        (b"{", "not JSON"),
        (b"[1, 2]", "a list"),
        (b"\xff\xfe", "UTF-8"),
        (b"\xef\xbb\xbf{}", "not JSON"),
        (b'{"schema": NaN}', "NaN"),
        (b'{"schema": 1, "schema": 2}', "twice"),
        (b'{"seed": ' + b"9" * 5000 + b"}", "not JSON"),
        (b"[" * 200_000, "nesting"),
        (b" " * (4 * 1024 * 1024 + 1), "at most 4194304 bytes"),
        (b'{"schema": "a\\nb\\u001b\\ud800"}', "schema"),
    ],
    ids=lambda value: None if isinstance(value, str) else repr(value[:12]),
)
def test_unreadable_content_is_refused_with_one_printable_line(content, word, tmp_path):
    path = tmp_path / "gains.json"
    path.write_bytes(content)
    with pytest.raises(GainFileError, match=word) as caught:
        Controller.from_file(path)
    message = str(caught.value)
    assert message.isprintable() and message.startswith(str(path)) and len(message) < 500


def test_unreadable_paths_are_refused(tmp_path):
    for path in (tmp_path / "absent\n.json", tmp_path, "nul\0byte"):
        with pytest.raises(GainFileError, match="cannot be read") as caught:
            Controller.from_file(path)
        assert str(caught.value).isprintable()


def test_whole_numbers_are_numbers():
    document = change("gains", "initial_stiffness", "value", 90000)
    assert Controller.from_dict(document).identified == (90000.0, 50.0)


# The rig's Python: no jax, one file


def test_runs_where_only_the_standard_library_can_be_imported(tmp_path):
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(gain_document()))
    program = f"""
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names | {{"jaxhil"}}:
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Blocker())
sys.path.insert(0, {str(RUNTIME.parents[1])!r})
from jaxhil.runtime import Controller
controller = Controller.from_file({str(path)!r})
print(repr(controller.step(100.0, 1e-3, 0.0, 1e-3)))
"""
    shown = subprocess.run(
        [sys.executable, "-I", "-W", "error", "-c", program],
        capture_output=True,
        text=True,
        check=True,
    )
    expected = Controller.from_dict(gain_document()).step(100.0, 1e-3, 0.0, 1e-3)
    assert float(shown.stdout) == expected
    assert shown.stderr == ""
