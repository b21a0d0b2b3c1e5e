"""Shadow mode: a controller's commands on logs equal the logged ones, and causes of differences are named."""

import functools
import json

import bundles
import numpy as np
import pytest
import shadow_logs
from gain_documents import sign
from shadow_logs import write_columns
from six_axis_documents import LIMITS, six_axis_document

import jaxhil as package
import tuning
from jaxhil.errors import InputError
from jaxhil.rig import Controller
from jaxhil.rig.flight_recorder import COORDINATES, TWIST, WRENCH
from jaxhil.rig.six_axes import Controller6
from jaxhil.simulation.gain_file import check_document
from tuning.identification.logs.six_axis_mapping import load_six_axis_mapping

HEAD = 'schema = "jaxhil/log/1"\n[channels]\n'
RUNS = '[[runs]]\nfiles = "*"\nkind = "contact"\n'
CHANNELS = "\n".join(
    f'{name} = "{name}"'
    for name in (
        *("time", "force_measured", "force_command", "position_desired", "velocity_desired"),
        "position_measured",
    )
)


class Result:
    """Stand-in for a result of `tuning.tune`."""

    def __init__(self, document):
        self.document = document


@functools.cache
def gains(**limits):
    """Return the gains of `rig-300kg` with the phase lead, and the limits."""
    document = bundles.document("rig-300kg", "phase_lead")
    units = {"restitution_margin": "1", "equivalent_mass": "kg", "missed_in_a_row": "1"}
    document["limits"] = {name: {"value": value, "unit": units[name]} for name, value in limits.items()}
    return Result(sign(document))


@functools.cache
def recorded(force_lag=shadow_logs.FORCE_LAG):
    """Return the columns of a log of two contacts."""
    document = gains().document
    return shadow_logs.record_contacts(
        lambda: Controller.from_dict(document), document["mechanism"], force_lag=force_lag
    )


def shadowed(tmp_path, columns, form=repr, **options):
    """Return the document of shadow mode on these columns."""
    return tuning.shadow(gains(), write_columns(tmp_path / "log.csv", columns, form), **options).document


def shares(document):
    return [contact["share"] for contact in document["contacts"]]


def changed(**columns):
    """Return the columns of `recorded`, with the given columns in place of those with the same names."""
    return {**recorded(), **columns}


def delayed(values, rows):
    """Return a column that is later by some rows within both runs."""
    return np.concatenate([np.concatenate([np.zeros(rows), half[:-rows]]) for half in np.split(values, 2)])


def test_controller_in_shadow_mode_repeats_its_own_log_to_the_bit(tmp_path):
    document = shadowed(tmp_path, recorded())
    assert shares(document) == [0.0, 0.0] and document["verdict"] == "good"
    assert document["findings"] == document["notes"] == document["reasons"] == []
    assert [contact["compared"] for contact in document["contacts"]] == [259, 259]
    assert document["contacts"][1]["begin"] == pytest.approx(0.26, abs=1e-9)


def test_shadow_commands_equal_commands_of_simulated_log(tmp_path):
    run = package.simulate("rig-300kg", "phase_lead")
    run.to_csv(tmp_path / "run.csv")
    document = tuning.shadow(gains(), tmp_path / "run.csv").document
    assert shares(document)[0] < 1e-12 and document["findings"] == [] and document["verdict"] == "good"


@pytest.mark.parametrize("kind", ["force_measured", "force_command"])
def test_shadow_mode_reports_flipped_sign(tmp_path, kind):
    document = shadowed(tmp_path, changed(**{kind: -recorded()[kind]}))
    [line] = document["findings"]
    assert f"log.csv: {kind}: the sign is flipped" in line and min(shares(document)) > 1.0


def test_shadow_mode_reports_lost_rows_and_missed_ticks(tmp_path):
    present = np.delete(np.arange(520), [100, 101, 350])
    document = shadowed(tmp_path, {name: values[present] for name, values in recorded().items()})
    [line] = document["findings"]
    assert "3 rows are lost (gaps: 2, the longest with 2, the first at 0.1020 s)" in line
    assert [contact["missed"] for contact in document["contacts"]] == [2, 1]
    [fault] = document["contacts"][0]["faults"]
    assert (fault["name"], fault["ticks"]) == ("missed_tick", 1)
    assert fault["first"] == pytest.approx(0.102, abs=1e-9)


@pytest.mark.parametrize("rows, words", [(2, "2.00 ms longer"), (-3, "3.00 ms shorter")])
def test_shadow_mode_reports_commands_of_another_delay(tmp_path, rows, words):
    command = recorded()["force_command"]
    late = delayed(command, rows) if rows > 0 else -delayed(-command[::-1], -rows)[::-1]
    [line] = shadowed(tmp_path, changed(force_command=late))["findings"]
    assert f"those of a controller whose delay is {words}" in line


def test_shadow_mode_reports_longer_delay_of_the_force_reading(tmp_path):
    assert shadowed(tmp_path, recorded())["findings"] == []
    document = shadowed(tmp_path, recorded(force_lag=shadow_logs.FORCE_LAG + 2))
    [line] = document["findings"]
    assert shares(document) == [0.0, 0.0]
    assert "the delay of the force reading is 1.93 ms longer than in the mechanism" in line


def test_shadow_mode_counts_the_delay_of_a_sensor_filter(tmp_path):
    two_periods = "rig.force_sensor.filter={kind='bessel', order=1, cutoff=79.5775}"
    document = sign(bundles.document("rig-300kg", "phase_lead", overrides=(two_periods,)))
    log = write_columns(tmp_path / "log.csv", recorded(force_lag=shadow_logs.FORCE_LAG + 2))
    findings = tuning.shadow(Result(document), log).document["findings"]
    assert not [finding for finding in findings if "the delay of the force reading" in finding]


def test_shadow_mode_accepts_rounded_logs_of_other_controllers(tmp_path):
    document = shadowed(tmp_path, recorded(), form=lambda value: f"{value:.6g}")
    assert max(shares(document)) < 1e-4 and document["findings"] == []
    other = changed(force_command=0.8 * recorded()["force_command"])
    assert shadowed(tmp_path, other)["findings"] == []


def test_shadow_mode_exits_with_1_if_the_controller_trips(jaxhil, tmp_path):
    force = recorded()["force_measured"].copy()
    force[80:100] = np.nan
    log = write_columns(tmp_path / "log.csv", changed(force_measured=force))
    (tmp_path / "gains.json").write_text(json.dumps(gains().document))
    ran = jaxhil("shadow", tmp_path, log, "--json")
    assert ran.code == 1
    first, second = ran.document["contacts"]
    assert first["trip"]["reason"] == "tripped: force_not_finite (force_measured is nan)"
    assert first["trip"]["time"] == pytest.approx(0.08) and first["compared"] == 79 and first["share"] == 0.0
    assert second["trip"] is None and second["share"] == 0.0
    ran = jaxhil("shadow", tmp_path, log)
    assert ran.code == 1 and "Bad: contact 1 of" in ran.out and "at 0.0800 s" in ran.out


@pytest.mark.parametrize("factor, is_limited", [(1.0, False), (0.8, True), (0.0, True)])
def test_shadow_reports_that_its_verdict_covers_only_trips_if_commands_differ(
    jaxhil, tmp_path, factor, is_limited
):
    log = write_columns(tmp_path / "log.csv", changed(force_command=factor * recorded()["force_command"]))
    (tmp_path / "gains.json").write_text(json.dumps(gains().document))
    ran = jaxhil("shadow", tmp_path, log)
    assert ran.code == 0 and "Good: the controller would not have tripped." in ran.out
    assert ran.out.splitlines()[-1] == f"Next: jaxhil export {tmp_path} -o bundle"
    assert ("This verdict is about trips only" in ran.out) == is_limited
    assert ("has no such range" in ran.out) == (factor == 0.0)


def test_shadow_mode_skips_watchdog_audits_if_logged_commands_differ(tmp_path):
    limited = gains(restitution_margin=1e-9, equivalent_mass=300.0)
    log = write_columns(tmp_path / "log.csv", recorded())
    document = tuning.shadow(limited, log).document
    assert document["verdict"] == "bad" and "restitution" in document["reasons"][0]
    other = changed(force_command=0.8 * recorded()["force_command"])
    document = tuning.shadow(limited, write_columns(tmp_path / "log.csv", other)).document
    assert document["verdict"] == "good" and len(document["notes"]) >= 1
    assert "audit of restitution" in document["notes"][-1]


@pytest.mark.parametrize("row, computing_delay", [("tick", 0), ("sent", 0), ("after", 0), ("tick", 1)])
def test_shadow_mode_follows_the_row_convention(tmp_path, row, computing_delay):
    columns = {name: values[:260] for name, values in recorded().items()}
    ahead = {
        "sent": ["position_desired", "velocity_desired"],
        "after": ["force_measured", "position_measured"],
    }
    for name in ahead.get(row, []):
        columns[name] = np.roll(columns[name], -1)
    columns["force_command"] = np.roll(columns["force_command"], computing_delay)
    columns = {name: values[2:-2] for name, values in columns.items()}
    mapping = tmp_path / "map.toml"
    timing = f'[timing]\nrow = "{row}"\ncomputing_delay = {computing_delay}\n'
    mapping.write_text(f"{HEAD}{CHANNELS}\n{timing}{RUNS}")
    document = shadowed(tmp_path, columns, map=mapping)
    assert shares(document) == [0.0] and document["contacts"][0]["ticks"] >= 254


def test_shadow_mode_divides_logs_without_contact_index_between_contacts(tmp_path):
    (tmp_path / "map.toml").write_text(f"{HEAD}{CHANNELS}\n{RUNS}")
    document = shadowed(tmp_path, recorded(), map=tmp_path / "map.toml")
    begins = [contact["begin"] for contact in document["contacts"]]
    assert len(begins) == 2 and 0.2 < begins[1] < 0.3


SIX_NAMES = {
    "wrench_measured": WRENCH,
    "pose_desired": COORDINATES,
    "pose_measured": COORDINATES,
    "twist_desired": TWIST,
    "wrench_command": WRENCH,
}


def six_axis_log():
    """Return the columns of a six-axis log: a controller's commands for smooth readings."""
    document = six_axis_document("none", limits=LIMITS)
    controller, columns = Controller6.from_dict(document), {"time": 1e-3 * np.arange(200)}
    phase = 2 * np.pi * (np.outer(columns["time"], [1.1, 2.3, 1.7, 2.9, 0.7, 1.3]) + np.arange(6) / 7)
    pose, twist = 1e-3 * np.sin(phase), 1e-3 * np.cos(phase)
    signals = {
        "wrench_measured": 20 * np.sin(phase + 1) + 1e-3 * phase,
        "pose_desired": pose,
        "pose_measured": pose + 1e-4 * np.cos(phase + 2),
        "twist_desired": twist,
    }
    controller.pose_command(pose[0].tolist(), twist[0].tolist())
    inputs = [signals[name] for name in ("wrench_measured", "pose_desired", "twist_desired", "pose_measured")]
    commands = []
    for row, readings in enumerate(zip(*inputs, columns["time"], strict=True)):
        commands.append(controller.step(*readings))
        if row < 199:
            controller.pose_command(pose[row + 1].tolist(), twist[row + 1].tolist())
    signals["wrench_command"] = np.array(commands)
    for name, values in signals.items():
        columns |= {f"{name}_{suffix}": values[:, n] for n, suffix in enumerate(SIX_NAMES[name])}
    return document, columns


def six_axis_mapping(**changes):
    channels = {
        name: f"{{ columns = {json.dumps([f'{name}_{suffix}' for suffix in suffixes])} }}"
        for name, suffixes in SIX_NAMES.items()
    }
    lines = [f"{name} = {text}" for name, text in (channels | changes).items()]
    return f'{HEAD}time = "time"\n' + "\n".join(lines) + f"\n{RUNS}"


@pytest.mark.slow
def test_shadow_mode_reads_six_axis_logs_in_other_units(tmp_path):
    document, columns = six_axis_log()
    (tmp_path / "map.toml").write_text(six_axis_mapping())
    log = write_columns(tmp_path / "log.csv", columns)
    result = tuning.shadow(Result(document), log, map=tmp_path / "map.toml").document
    [contact] = result["contacts"]
    assert contact["share"] == 0.0 and contact["compared"] == 200 and contact["missed"] == 0
    assert contact["differences"]["moment"]["range"] > 1.0
    names = [f"pose_desired_{suffix}" for suffix in COORDINATES]
    scales = [1e3] * 3 + [180 / np.pi] * 3
    write_columns(log, columns | {n: s * columns[n] for n, s in zip(names, scales, strict=True)})
    units = f'{{ columns = {json.dumps(names)}, units = ["mm", "deg"] }}'
    (tmp_path / "map.toml").write_text(six_axis_mapping(pose_desired=units))
    [contact] = tuning.shadow(Result(document), log, map=tmp_path / "map.toml").document["contacts"]
    assert contact["share"] < 1e-9


def test_six_axis_mapping_rejects_wrong_channels(tmp_path):
    document, columns = six_axis_log()
    log = write_columns(tmp_path / "log.csv", columns | {"gap": np.where(columns["time"] > 0.1, np.nan, 0)})
    for change, words in (
        ({"twist_desired": '["a", "b"]'}, "channels.twist_desired.columns: found"),
        (
            {"pose_desired": '{ columns = ["a","b","c","d","e","f"], units = ["mm", "dge"] }'},
            "'dge', expected",
        ),
        ({"wrench_command": '["a", "b", "c", "d", "e", "f"]'}, "column 'a': found no column with this name"),
        ({"force_command": '"a"'}, "force_command"),
        ({"contact_index": '{ column = "time", sign = 0 }'}, "channels.contact_index.sign: found 0"),
        ({"contact_index": '{ column = "time", time = "t" }'}, "channels.contact_index.time: found"),
        ({"contact_index": '"text"'}, "column 'text': found no column"),
        ({"contact_index": '"gap"'}, "column 'gap': found missing values"),
    ):
        (tmp_path / "map.toml").write_text(six_axis_mapping(**change))
        with pytest.raises(InputError) as caught:
            tuning.shadow(Result(document), log, map=tmp_path / "map.toml")
        assert words in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "timing, words",
    [
        ('clock = "separate"', "timing.clock: found separate, expected stamps or index"),
        ("rows_per_period = 2", "timing.rows_per_period: found 2, expected 1"),
    ],
)
def test_six_axis_mapping_rejects_timing_that_its_logs_cannot_have(tmp_path, timing, words):
    (tmp_path / "map.toml").write_text(six_axis_mapping() + f"[timing]\n{timing}\n")
    with pytest.raises(InputError, match=words):
        load_six_axis_mapping(tmp_path / "map.toml")


@pytest.mark.parametrize(
    "mapping, words",
    [
        (f"{HEAD}{CHANNELS}\n[timing]\ncontrol_period = 0.002\n{RUNS}", "expected 0.001 s as in the gains"),
        (
            f"{HEAD}{CHANNELS}\n{RUNS}".replace('force_command = "force_command"', ""),
            "force_command: found no",
        ),
        (f"{HEAD}{CHANNELS}\n{RUNS}".replace('"contact"', '"free"'), "expected runs of kind contact"),
        (f"{HEAD}{CHANNELS}\n{RUNS}".replace('"*"', '"day2_*"'), "no [[runs]] entry matches"),
    ],
)
def test_shadow_mode_rejects_unusable_logs_with_one_line(jaxhil, tmp_path, mapping, words):
    (tmp_path / "map.toml").write_text(mapping)
    log = write_columns(tmp_path / "log.csv", recorded())
    (tmp_path / "gains.json").write_text(json.dumps(gains().document))
    ran = jaxhil("shadow", tmp_path, log, "--map", tmp_path / "map.toml")
    assert ran.code == 2 and ran.out == "" and words in ran.err.splitlines()[-1]
    assert jaxhil("shadow", tmp_path).err == "jaxhil: logs: found none, expected one or more files\n"


@pytest.mark.slow
@pytest.mark.parametrize("mechanism", ["varying", "claw-350kg"])
@pytest.mark.parametrize(
    "compensator", ["response_error", "impulse_ledger", "smith_hybrid", "multi_parameter_lead"]
)
def test_shadow_commands_equal_simulated_commands_of_other_compensators(tmp_path, mechanism, compensator):
    run = package.simulate(mechanism, compensator)
    run.to_csv(tmp_path / "run.csv")
    document = tuning.shadow(Result(bundles.document(mechanism, compensator)), tmp_path / "run.csv").document
    assert max(shares(document)) < 1e-12 and document["verdict"] == "good" and document["findings"] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        ("rig.force_sensor.noise_std=0.5", "rig.position_sensor.noise_std=1e-6"),
        ("contact.clearance=0.02", "approach.contacts=4"),
        ("rig.integrator='zoh'", "rig.command_latency=2"),
    ],
)
def test_shadow_commands_equal_simulated_commands_of_other_rigs(tmp_path, overrides):
    document = bundles.document("rig-300kg", "response_error", overrides)
    values = {name: entry["value"] for name, entry in document["gains"].items()}
    run = package.simulate(check_document(document).mechanism, "response_error", values)
    run.to_csv(tmp_path / "run.csv")
    result = tuning.shadow(Result(document), tmp_path / "run.csv").document
    assert max(shares(result)) < 1e-12 and result["verdict"] == "good" and result["findings"] == []


@pytest.mark.slow
@pytest.mark.parametrize("compensator", ["none", "phase_lead", "response_error", "impulse_ledger"])
def test_shadow_commands_equal_simulated_six_axis_commands(tmp_path, compensator):
    package.simulate("probe-drogue", compensator).to_csv(tmp_path / "run.csv")
    document = tuning.shadow(Result(six_axis_document(compensator)), tmp_path / "run.csv").document
    assert max(shares(document)) < 1e-12 and document["verdict"] == "good"


@pytest.mark.slow
def test_shadow_mode_plots_the_contacts_with_trips_and_largest_differences(jaxhil, tmp_path):
    force = recorded()["force_measured"].copy()
    force[80:100] = np.nan
    (tmp_path / "gains.json").write_text(json.dumps(gains().document))
    log = write_columns(tmp_path / "log.csv", changed(force_measured=force))
    assert jaxhil("shadow", tmp_path, log, "--plot", tmp_path / "plot.png").code == 1
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
