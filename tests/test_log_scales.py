"""Scales of forces, positions and velocities, checked by the momentum of the model."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from log_cases import MASS, PERIOD, mapping, read, touches, write_csv

from jaxhil.errors import InputError
from tuning.identification.logs.campaign import read_campaign
from tuning.identification.logs.force_command_check import check_command
from tuning.identification.logs.lost_rows import LogSegment, detect_integrator
from tuning.identification.logs.scale_fit import fit_scale
from tuning.identification.logs.scales import ask_for_length_unit, ask_for_unit

LBF, INCH = 4.4482216152605, 0.0254
LOG = touches(2, noise=0.3)
ALL = ("xd", "xm", "vd")


def scaled(log, **factors):
    return log | {name: factor * log[name] for name, factor in factors.items()}


def rounded(log, **quanta):
    return log | {name: quantum * np.round(log[name] / quantum) for name, quantum in quanta.items()}


def drop_rows(log, share, seed=0):
    """Return the log without a random `share` of its rows."""
    rows = np.random.default_rng(seed).uniform(size=len(log["t"])) >= share
    return {name: column[rows] for name, column in log.items()}


def scatter(log, std, seed=1, samples=False):
    """Return the log with random errors of the time stamps, with standard deviation `std` [s].

    With `samples`, the readings are interpolated to these times, as if the samples themselves were late or
    early.
    """
    late = np.clip(std * np.random.default_rng(seed).standard_normal(len(log["t"])), -4e-4, 4e-4)
    times = log["t"] + late
    if samples:
        log = {name: np.interp(times, log["t"], column) for name, column in log.items()}
    return log | {"t": times}


def refused(tmp_path, log, **changes):
    path = write_csv(tmp_path / "a.csv", log)
    with pytest.raises(InputError) as caught:
        read(path, **changes)
    result = str(caught.value)
    assert result.isprintable() and result.startswith(f"{path}: ")
    return result


NO_COMMAND = {"force_command": None}


@pytest.mark.parametrize(
    ("factors", "said", "reason"),
    [
        ({"F": 1 / LBF}, {}, "times the impulse that reverses 350 kg, expected 0.48 to 2 times"),
        ({"F": 1 / LBF}, {}, "(force in lbf, read as N?)"),
        ({"F": 1 / LBF}, NO_COMMAND, "force in lbf, read as N"),
        ({"F": LBF}, NO_COMMAND, "force in N, read as lbf"),
        ({"F": 1 / 9.80665}, NO_COMMAND, "force in kgf, read as N"),
        ({"Fc": 1 / LBF}, {}, "0.2248 times the force that moves"),
        ({"Fc": 1 / LBF}, {}, "within 1 % (force in lbf, read as N?); correct unit or mass"),
        ({"F": 1 / LBF, "Fc": 1 / LBF}, {}, "(as if the mass were 78.68 kg)"),
        (dict.fromkeys(ALL, 1 / 2.54), {}, "2.54 times the force that moves"),
        (dict.fromkeys(ALL, 1 / 2.54), {}, "(positions in in, read as cm?)"),
        (dict.fromkeys(ALL, 1 / 2.54), NO_COMMAND, "positions in in, read as cm"),
        (dict.fromkeys(ALL, 2.54), {}, "(positions in cm, read as in?)"),
        (
            {"xm": 1 / 2.54},
            {},
            "times the motion of position_desired, expected 0.5 to 2 (in in, read as cm?)",
        ),
        (
            {"vd": 1 / 2.54},
            {},
            "velocity_desired: found 0.3937 times the rate of position_desired, expected 1",
        ),
        ({"vd": -1.0}, {}, "velocity_desired: found -1 times the rate"),
    ],
)
def test_log_channel_in_wrong_unit_is_rejected_with_factor_and_unit(tmp_path, factors, said, reason):
    assert reason in refused(tmp_path, scaled(LOG, **factors), **said)


@pytest.mark.parametrize("seed", range(20))
def test_impulse_of_weak_contact_in_strong_noise_is_accepted(tmp_path, seed):
    # The peak is 33 N, the noise 10 N: the noise hides the ends of the contact.
    log = {name: column[140:425] for name, column in touches(2, 5e-3, noise=10.0, seed=seed).items()}
    assert len(read(write_csv(tmp_path / "a.csv", log), force_command=None).runs) == 1


def test_mass_error_of_a_few_percent_is_detected_from_log(tmp_path):
    result = refused(tmp_path, scaled(LOG, Fc=1.03))
    assert (
        "found 1.03 times the force that moves 350 kg like position_desired (as if the mass were 360.5 kg)"
        in result
    )
    assert read(write_csv(tmp_path / "b.csv", scaled(LOG, Fc=1.005))).notes == ()


REAL = {
    "lost rows": lambda log: drop_rows(log, 0.01),
    "lost rows and jitter": lambda log: scatter(drop_rows(log, 0.01), 5e-5),
    "many lost rows": lambda log: drop_rows(log, 0.05),
    "samples that scatter": lambda log: drop_rows(scatter(log, 5e-5, samples=True), 0.01),
    "1 mN and 1 nm": lambda log: rounded(log, Fc=1e-3, xd=1e-9),
    "0.1 N and 0.1 um": lambda log: rounded(log, Fc=0.1, xd=1e-7, vd=1e-6),
    "float32": lambda log: (
        {name: one if name == "t" else one.astype(np.float32) for name, one in log.items()}
    ),
}


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("without", [(), ("velocity_desired",)])
def test_force_command_column_is_used_in_rounded_logs(tmp_path, name, without):
    log, gone = REAL[name](LOG), dict.fromkeys(without)
    result = read(write_csv(tmp_path / "a.csv", log), **gone)
    assert result.notes == () and all(run.force_command is not None for run in result.runs)
    assert 'expected "tick", with which force_command' in refused(
        tmp_path, log, timing={"row": "sent"}, **gone
    )
    assert "(as if the mass were 367.5 kg)" in refused(tmp_path, scaled(log, Fc=1.05), **gone)
    assert "accelerate the approach" in refused(tmp_path, scaled(log, Fc=-1.0), **gone)


def test_uninformative_force_command_column_is_ignored_with_a_note(tmp_path):
    noise = LOG | {"Fc": 5.0 * np.random.default_rng(0).standard_normal(len(LOG["t"]))}
    result = read(write_csv(tmp_path / "a.csv", noise))
    (note,) = result.notes
    assert "a.csv: force_command: ignored, because M x_d'' = -F_c leaves" in note
    assert all(run.force_command is None for run in result.runs)
    result = read(write_csv(tmp_path / "b.csv", LOG | {"Fc": 0.0 * LOG["Fc"], "vd": 0.0 * LOG["vd"]}))
    assert "force_command: ignored, because it is 0 N in every contact" in "\n".join(result.notes)
    # Without force_command, the measured force is compared with the change of momentum.
    assert "force in lbf" in refused(tmp_path, scaled(noise, F=1 / LBF))


def test_velocity_column_that_contradicts_position_is_ignored_with_a_note(tmp_path):
    noise = LOG | {"vd": 5e-3 * np.random.default_rng(0).standard_normal(len(LOG["t"]))}
    result = read(write_csv(tmp_path / "a.csv", noise))
    assert "velocity_desired: ignored, because it is not the rate of position_desired" in "\n".join(
        result.notes
    )
    assert all(run.velocity_desired is None for run in result.runs)


def test_undetermined_tick_of_log_readings_is_reported(tmp_path):
    coarse = rounded(scatter(LOG, 2e-4, samples=True), xd=2e-6, vd=1e-4)
    assert "timing.row: not checked: force_command is too coarse" in "\n".join(
        read(write_csv(tmp_path / "a.csv", coarse)).notes
    )


def test_damping_by_compensator_and_dead_zone_are_not_mistaken_for_wrong_unit(tmp_path):
    log = touches(1, speed=12e-3, noise=0.0)
    dead = log | {"F": np.sign(log["F"]) * np.maximum(np.abs(log["F"]) - 45.0, 0.0)}
    impulse = np.sum(dead["F"]) / np.sum(log["F"])
    assert impulse < 0.5
    read(write_csv(tmp_path / "a.csv", dead), **NO_COMMAND)
    assert "times the impulse" in refused(tmp_path, scaled(dead, F=1 / LBF), **NO_COMMAND)


# If rounding dominates differences of nearby rows, these alone favour the wrong row convention.
@example(factor=1.0, quantum=1e-8, noise=0.0, lost=0.1, seed=1)
@settings(deadline=None, max_examples=25)
@given(
    factor=st.sampled_from([1.0, 1 / LBF, LBF, 2.54, 1 / 2.54, 1e3, 1.2]),
    quantum=st.sampled_from([0.0, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6]),
    noise=st.sampled_from([0.0, 0.3, 3.0]),
    lost=st.sampled_from([0.0, 0.01, 0.1]),
    seed=st.integers(0, 99),
)
def test_force_command_column_is_read_correctly_or_rejected_in_any_log(factor, quantum, noise, lost, seed):
    log = {name: column[:500] for name, column in touches(1, noise=noise, seed=seed).items()}
    x = quantum * np.round(log["xd"] / quantum) if quantum else log["xd"]
    valid = np.random.default_rng(seed).uniform(size=len(x)) >= lost
    force = np.where(valid, factor * log["Fc"], np.nan)
    channels = {"position_desired": x, "velocity_desired": log["vd"], "force_command": force}
    stretch = LogSegment(np.arange(len(x)), channels, valid)
    touched = np.flatnonzero(log["Fc"])
    contacts = [(int(touched[0]), int(touched[-1]) + 1)]
    try:
        holds, _ = check_command("a", stretch, contacts, PERIOD, MASS, "tick", "semi_implicit_euler")
    except InputError as error:
        result = float(str(error).split("force_command: found ")[1].split(" times")[0])
        assert factor != 1.0 and result == pytest.approx(factor, rel=0.05)
        return
    assert factor == 1.0 or not holds
    assert holds or quantum >= 1e-6


@pytest.mark.parametrize("quantum", [0.0, 1e-9, 1e-7, 1e-6])
def test_integrator_is_identified_from_rounded_log(quantum):
    log = touches(1, noise=1.0)
    v = log["vd"][:500]
    ways = {"semi_implicit_euler": v[1:], "explicit_euler": v[:-1], "zoh": (v[1:] + v[:-1]) / 2}
    ways = {name: -1.1e-3 + PERIOD * np.cumsum(np.append(0.0, step)) for name, step in ways.items()}
    for name, position in ways.items():
        coarse = quantum * np.round(position / quantum) if quantum else position
        assert detect_integrator(coarse, v, PERIOD) == name


@pytest.mark.parametrize("rows", (3, 19))
def test_integrator_of_short_rounded_log_is_unknown(rows):
    v = 0.01 + 1e-4 * np.arange(rows)
    assert detect_integrator(1e-3 * np.round(PERIOD * np.cumsum(v) / 1e-3), v, PERIOD) is None


def test_scale_fit_has_stated_standard_error():
    random, off = np.random.default_rng(0), []
    unit = np.sin(np.arange(400) / 20.0)
    for _ in range(300):
        noise = np.convolve(random.standard_normal(407), np.ones(8), "valid")
        fit = fit_scale(2.0 * unit + noise, unit, 8)
        off.append((fit.slope - 2.0) / fit.error)
    assert 0.6 < np.std(off) < 1.3
    assert fit_scale(np.zeros(9), np.ones(9)) is None and fit_scale(np.ones(9), np.zeros(9)) is None


def test_wrong_units_are_named_by_conversion_factor():
    assert ask_for_unit((0.225,), 0.02) == " (force in lbf, read as N?)"
    assert ask_for_unit((1.3,), 0.02) == ask_for_unit((-4.448,), 0.02) == ""
    assert ask_for_length_unit(1 / 25.4, 0.01) == " (in in, read as mm?)"


def test_campaign_of_several_log_files_reports_the_file_with_wrong_unit(tmp_path):
    good, bad = write_csv(tmp_path / "a.csv", LOG), write_csv(tmp_path / "b.csv", scaled(LOG, F=1 / LBF))
    with pytest.raises(InputError, match=r"b.csv: force_measured: found 0.2"):
        read_campaign([good, bad], mapping())


def test_note_that_applies_to_several_logs_is_printed_once(tmp_path):
    log = LOG | {"vd": 0.0 * LOG["vd"]}  # loggers write a channel like this if it is not connected
    paths = [write_csv(tmp_path / f"{name}.csv", log) for name in "abc"]
    (note,) = read_campaign(paths, mapping()).notes
    assert note.startswith(f"{paths[0]} and 2 more: velocity_desired: ignored")
