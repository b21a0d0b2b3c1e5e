"""Wrong descriptions of log channels, detected by the motion of the numerical model."""

from unittest.mock import patch

import numpy as np
import pytest
from log_cases import LAG, MASS, PERIOD, STIFFNESS, read, sway, touches, write_csv

from jaxhil.errors import InputError
from tuning.identification.logs import checks

LOG = touches(2, noise=0.0)


def message(path, kind="contact", **changes):
    with pytest.raises(InputError) as caught:
        read(path, kind, **changes)
    assert str(caught.value).isprintable() and str(caught.value).startswith(f"{path}: ")
    return str(caught.value)


def model(integrator, row, sign=1):
    """Return commands of a model under a given force, and the rows in which a logger writes the commands."""
    times = PERIOD * np.arange(900)
    force = 40 * np.sin(np.pi * times / 0.25) ** 2 * ((times > 0.1) & (times < 0.6))
    x, v, result = -5e-3, 0.02, []
    for one in force:
        result.append((x, v))
        a = -one / MASS
        if integrator == "semi_implicit_euler":
            v += PERIOD * a
            x += PERIOD * v
        elif integrator == "zoh":
            x, v = x + PERIOD * v + PERIOD**2 * a / 2, v + PERIOD * a
        else:
            x, v = x + PERIOD * v, v + PERIOD * a
    x, v = np.array(result).T
    shift = 1 if row == "sent" else 0
    xd, vd, force = x[shift:], v[shift:], force[: len(x) - shift]
    xm = np.concatenate([x[0] - 2e-5 * np.arange(LAG, 0, -1), x[:-LAG]])[: len(xd)]
    return {"t": times[: len(xd)], "xd": xd, "xm": xm, "F": force, "vd": vd, "Fc": sign * force}


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "zoh", "explicit_euler"])
@pytest.mark.parametrize("row", ["tick", "sent"])
def test_log_readings_assigned_to_wrong_tick_are_detected_for_any_integrator(tmp_path, integrator, row):
    path = write_csv(tmp_path / "a.csv", model(integrator, row))
    assert read(path, timing={"row": row}).runs[0].kind == "contact"
    other = "tick" if row == "sent" else "sent"
    assert f'timing.row: found "{other}"' in (result := message(path, timing={"row": other}))
    assert f'expected "{row}", with which ' in result and f"(integrator {integrator})" in result
    if row == "tick":
        assert read(path, timing={"row": "after"}).notes == ()


def test_wrong_sign_or_mass_for_logged_force_command_is_detected(tmp_path):
    path = write_csv(tmp_path / "a.csv", model("zoh", "tick", sign=-1))
    assert "force_command: found forces that accelerate the approach" in message(path)
    assert read(path, force_command={"column": "Fc", "sign": -1}).notes == ()
    assert "moves 350 kg like position_desired (as if the mass were 175 kg)" in message(
        path, force_command={"column": "Fc", "sign": -1, "scale": 0.5}
    )
    coarse = model("zoh", "tick")
    coarse["xd"] = np.round(coarse["xd"], 6)
    path = write_csv(tmp_path / "b.csv", coarse)
    assert read(path).notes == ()
    assert "(as if the mass were 175 kg)" in message(path, force_command={"column": "Fc", "scale": 0.5})
    assert 'expected "tick", with which force_command' in message(path, timing={"row": "sent"})


@pytest.mark.parametrize(
    ("channels", "reason"),
    [
        ({"force_measured": {"column": "F", "sign": -1}}, "found F < 0 in contacts that push"),
        (
            {name: {"column": column, "sign": -1} for name, column in
             (("force_measured", "F"), ("position_desired", "xd"), ("position_measured", "xm"))},
            "with one surface: sign = -1 in the channels of force, position",
        ),
        ({"force_measured": {"column": "F", "unit": "kN"}}, "times the impulse that reverses 350 kg"),
        ({"force_measured": {"column": "F", "unit": "mN"}}, "found 0.001 times the impulse"),
        ({"position_measured": {"column": "xm", "unit": "mm"}}, "found a stroke of 1.3e-06 m"),
        ({"position_measured": {"column": "xm", "sign": -1}}, "found a motion against position_desired"),
        ({"position_desired": "xm", "position_measured": "xd"}, "a later one (are the two swapped?)"),
        ({"position_desired": {"column": "xd", "unit": "mm"}}, "found a stroke of 1.27e-06"),
        ({"position_desired": {"column": "xd", "scale": 1e3}}, "found speeds of 5 m/s, expected at most"),
        ({"position_measured": "still"}, "found 0 m in every row, expected"),
        ({"force_measured": "still"}, "force_measured: found 0 N in every row"),
        ({"position_desired": "still"}, "m in every row, expected a motion"),
    ],
)  # fmt: skip
def test_wrong_units_wrong_signs_and_swapped_log_channels_are_detected(tmp_path, channels, reason):
    path = write_csv(tmp_path / "a.csv", LOG | {"still": np.zeros(1200)})
    assert reason in message(path, force_command=None, velocity_desired=None, **channels)


def test_wrong_log_channels_of_a_run_without_contact_are_detected(tmp_path):
    path = write_csv(tmp_path / "a.csv", sway() | {"slow": 1e-3 * sway()["xm"]})
    assert read(path, "free").notes == ()
    assert "ticks earlier than position_desired" in message(
        path, "free", position_desired="xm", position_measured="xd"
    )
    assert "0.01 times the stroke" in message(path, "free", position_measured={"column": "slow", "scale": 10})
    fast = write_csv(tmp_path / "b.csv", sway(amplitude=0.3))
    assert "found speeds of" in message(fast, "free")
    noise = sway() | {"xm": 1e-3 * np.random.default_rng(0).standard_normal(800)}
    (note,) = read(write_csv(tmp_path / "c.csv", noise), "free").notes
    assert "hardly follows position_desired" in note
    assert read(write_csv(tmp_path / "d.csv", sway(amplitude=0.0)), "rest").runs[0].kind == "rest"


@pytest.mark.parametrize("delay", [5, 12])
def test_short_motion_with_a_single_frequency_is_not_taken_for_a_reversed_one(tmp_path, delay):
    """With a delay of 12 ms, the correlation is largest, and negative, 4 ms before the motion."""
    times = PERIOD * np.arange(-delay, 170)
    x = 1e-5 * np.sin(2 * np.pi * 30 * times + 2.2) * np.linspace(1.5, 0.1, len(times))
    log = {"t": times[delay:] - times[0], "xd": x[delay:], "xm": x[:-delay]}
    with patch.object(checks, "MIN_LOG_ROWS", 100):
        assert read(write_csv(tmp_path / "a.csv", log), "free").runs


def test_log_readings_that_repeat_for_several_rows_are_reported(tmp_path):
    log = sway() | {"xm": np.repeat(sway()["xm"][::4], 4)}
    (note,) = read(write_csv(tmp_path / "a.csv", log), "free").notes
    assert "repeated in 75 % of rows, as if each reading was held for 4 rows" in note
    rounded = sway() | {"xm": np.round(sway()["xm"], 5)}
    assert read(write_csv(tmp_path / "b.csv", rounded), "free").notes == ()


def test_press_log_requires_force_that_rises_with_depth_and_clipping_is_reported(tmp_path):
    press = sway()
    press["F"] = STIFFNESS * np.maximum(press["xm"] + 5e-4, 0.0)
    path = write_csv(tmp_path / "a.csv", press)
    assert read(path, "press").runs[0].kind == "press"
    wrong = {"column": "F", "sign": -1}
    assert "force_measured: found a force that decreases when" in message(path, "press", force_measured=wrong)
    clipped = LOG | {"F": np.minimum(LOG["F"], 20.0)}
    notes = read(write_csv(tmp_path / "b.csv", clipped), force_command=None).notes
    assert any("rows have the largest reading" in note for note in notes)


@pytest.mark.parametrize("every", [2, 5])
def test_log_commands_and_forces_sampled_at_another_rate_are_detected(tmp_path, every):
    def held(values):
        return np.repeat(values[::every], every)[: len(values)]

    path = write_csv(tmp_path / "a.csv", sway() | {"xd": held(sway()["xd"])})
    assert f"position_desired: found a new command every {every} rows, expected one" in message(path, "free")
    assert read(path, "free", timing={"command_hold": "zoh"}).runs[0].kind == "free"
    path = write_csv(tmp_path / "b.csv", LOG | {"F": held(LOG["F"])})
    (note,) = read(path, force_command=None).notes
    assert f"force_measured: a new reading only every {every} rows" in note
    # A steady motion in steps of the last digit also changes at regular intervals.
    slow = {"t": PERIOD * np.arange(800), "xd": 1e-5 * (np.arange(800) // every), "xm": sway()["xm"]}
    slow["xm"] = np.concatenate([np.zeros(LAG), slow["xd"][:-LAG]])
    assert read(write_csv(tmp_path / "c.csv", slow), "free").runs[0].kind == "free"


def far_side():
    """Simulate a contact, and the flight to a contact on the far side of a clearance of 2 mm."""
    log = touches(2)
    back = int(np.flatnonzero(np.diff(np.sign(log["vd"])) > 0)[0]) + 1  # start of the commanded return motion
    other = {name: -column for name, column in log.items() if name != "t"}
    other = other | {name: other[name] - 2e-3 for name in ("xd", "xm")}
    both = {name: np.concatenate([log[name][:back], other[name]]) for name in other}
    return both | {"t": PERIOD * np.arange(back + len(log["t"]))}, back


@pytest.mark.parametrize("gone", [(), ("velocity_desired", "force_command")])
def test_log_contacts_on_the_far_side_of_a_clearance_are_rejected(tmp_path, gone):
    """Their forces must not be mistaken for forces in a wrong unit."""
    log, back = far_side()
    path = write_csv(tmp_path / "a.csv", log)
    with pytest.raises(InputError, match=r"row \d+: found a contact at the second surface") as caught:
        read(path, **dict.fromkeys(gone))
    first = back + int(np.argmax(log["F"][back:] < -2.0))
    assert int(str(caught.value).split("row ")[1].split(":")[0]) == pytest.approx(first + 1, abs=5)


@pytest.mark.parametrize("rows", range(150, 180))
def test_log_that_ends_soon_after_a_pulling_force_is_accepted(rows):
    pull = np.where((np.arange(rows) > 100) & (np.arange(rows) < 140), -1.0, 0.0)
    checks._check_one_side("a.csv", pull, np.linspace(0.0, 1e-3, rows), PERIOD, MASS)
