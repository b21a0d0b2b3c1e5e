"""Monitor: contacts of an independent simulator compared with a mechanism file."""

from dataclasses import replace

import campaign_kinds
import campaigns
import numpy as np
import pytest

import jaxhil as package
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from tuning.identification.mechanism_check import check_against_mechanism
from tuning.identification.mechanism_file import to_toml
from tuning.identification.monitor.metrics import BIAS_INDEX, METRIC_NAMES, NOISE_INDEX
from tuning.identification.monitor.monitor import monitor_contacts
from tuning.identification.monitor.uncertain_parameters import list_uncertain_parameters

SPEEDS = (0.006, 0.012) * 3
STATED = {
    "contact.stiffness": {"distribution": "normal", "std": 120.0},
    "contact.damping": {"distribution": "normal", "std": 4.0},
    "rig.force_sensor.delay": {"distribution": "normal", "std": 3e-5},
    "rig.contact_plane": {"distribution": "normal", "std": 2e-7},
}


def file_of(kind, stated=None):
    """Write a mechanism file with the true values of this kind of rig."""
    bodies = {"equivalent_mass": kind.mass}
    document = {"schema": "jaxhil/mechanism/1", "name": "known", "bodies": bodies, "rig": kind.rig}
    document |= {"approach": {"velocity": 0.006}, "contact": kind.contact}
    return from_plain_data(document | {"uncertainty": STATED if stated is None else stated}, "known")


def noiseless(kind):
    """Return the rig without noise and quantisation."""
    sensors = ("force_sensor", "position_sensor")
    kept = {
        sensor: {k: v for k, v in kind.rig[sensor].items() if k not in ("noise_std", "quantum")}
        for sensor in sensors
    }
    return replace(kind, rig={**kind.rig, **kept})


def contacts(kind, seed=0, speeds=SPEEDS, name="monitored"):
    campaigns.KINDS[name] = replace(
        kind, rig={**kind.rig, "force_sensor": {"noise_std": 0.0, **kind.rig["force_sensor"]},
                   "position_sensor": {"noise_std": 0.0, **kind.rig["position_sensor"]}}
    )  # fmt: skip
    try:
        return campaigns.campaign(name, seed, speeds=speeds, seconds=0, rest=0)
    finally:
        del campaigns.KINDS[name]


def changed_kind(kind, **sections):
    """Return the kind with changed numbers in its rig."""
    return replace(kind, rig=kind.rig | {one: kind.rig[one] | table for one, table in sections.items()})


CLEAN = campaigns.KINDS["clean"]
EVERY = ("lagging", "stiffnesses", "dead_zone")
RARER = ("clean", "third_order", "resonance", "hertz", "layered")


@pytest.fixture(scope="module")
def silent():
    """Return a campaign of one contact without noise."""
    return contacts(noiseless(CLEAN), speeds=(0.006,))


@pytest.mark.parametrize(
    "effect, finding",
    [
        ({"filter": {"kind": "butterworth", "order": 2, "cutoff": 250.0}}, "a butterworth filter of order 2"),
        ({"dead_zone": 4.0, "dead_zone_kind": "cut"}, "a cut dead zone of 4 N"),
        ({"jitter": 1e-4}, "jitter = 0.0001 s"),
        ({"loss_probability": 0.01}, "loss_probability = 0.01"),
    ],
)
def test_file_with_unmodelled_effect_is_rejected_by_monitor_and_not_good_in_identify(silent, effect, finding):
    kind = noiseless(CLEAN)
    changed = file_of(changed_kind(kind, force_sensor=effect))
    with pytest.raises(package.InputError, match=f"found {finding}, expected none: monitor does not"):
        monitor_contacts(silent, changed)
    result = check_against_mechanism(silent, changed)
    assert not result.good
    is_modelled = effect.keys() & {"filter", "dead_zone"} != set()
    assert is_modelled != any(line.finding.startswith(finding) for line in result.lines)
    assert is_modelled != (f"{finding}, which `identify` does not model" in result.verdict)


def test_file_with_drift_of_the_bias_is_rejected_by_monitor(silent):
    changed = file_of(changed_kind(noiseless(CLEAN), force_sensor={"bias_random_walk": 0.1}))
    with pytest.raises(package.InputError, match=r"bias_random_walk = 0[.]1 N/sqrt\(s\), expected none"):
        monitor_contacts(silent, changed)


def test_file_with_missed_ticks_in_its_uncertainty_is_rejected_by_monitor(silent):
    key = "rig.missed_tick_probability"
    changed = file_of(noiseless(CLEAN), {key: {"distribution": "uniform", "low": 0.0, "high": 0.01}})
    with pytest.raises(package.InputError, match=f"{key}: found missed_tick_probability in .uncertainty"):
        monitor_contacts(silent, changed)


@pytest.mark.parametrize("name", (*EVERY, *(pytest.param(one, marks=pytest.mark.slow) for one in RARER)))
def test_monitor_reports_no_deviation_for_exact_file_without_noise(name):
    kind = noiseless(campaigns.KINDS[name])
    stated = {k: v for k, v in STATED.items() if k == "rig.force_sensor.delay"}
    result = monitor_contacts(contacts(kind, speeds=(0.006, 0.012, 0.006)), file_of(kind, stated))
    value = np.array([contact.value for contact in result.contacts])
    is_finite = np.isfinite(value).any(axis=0)
    assert (
        is_finite[:4].all() and is_finite[BIAS_INDEX] == (name != "dead_zone") and not is_finite[NOISE_INDEX]
    )
    # The generator integrates numerically the lag of a force that begins with a jump.
    allowed = 2e4 if name == "lagging" else 1.0
    bound = allowed * np.array([1e-9, 1e-5, 5e-8, 1e-9, 1e-9, np.inf, 1e-9])
    assert np.all(np.abs(np.nan_to_num(value)) < bound)


def test_monitor_deviations_of_matching_rig_scatter_as_predicted():
    result = monitor_contacts(contacts(CLEAN, seed=3), file_of(CLEAN))
    assert result.state == "good" and result.alarm is None and result.changes == ()
    z = np.array([contact.z for contact in result.contacts])
    assert z.shape == (6, len(METRIC_NAMES)) and 0.7 < z.std() < 1.3
    assert "all of 6 contacts" in result.verdict


CHANGES = {
    # rig with a changed value, metric that shows the change, expected value of this metric, and tolerance
    "stiffness": (replace(CLEAN, contact=campaign_kinds.voigt((1.236e5,))), "stiffness", 0.03, 0.003),
    "delay": (changed_kind(CLEAN, force_sensor={"delay": 0.0043}), "apparent damping", -72.0, 12.0),
    "motion": (changed_kind(CLEAN, simulator={"delay": 0.0047}), "lag of motion", 4e-4, 6e-5),
    "bias": (changed_kind(CLEAN, force_sensor={"bias": 3.0}), "bias", 3.0, 0.1),
    "noise": (changed_kind(CLEAN, force_sensor={"noise_std": 1.0}), "noise", 1.0, 0.1),
}
DAILY = ("delay", "noise")


@pytest.mark.parametrize(
    "what", [pytest.param(one, marks=() if one in DAILY else pytest.mark.slow) for one in CHANGES]
)
def test_monitor_detects_and_names_a_changed_parameter(what):
    other, name, value, within = CHANGES[what]
    before, after = contacts(CLEAN, seed=1, speeds=SPEEDS[:3]), contacts(other, seed=2, speeds=SPEEDS[:3])
    result = monitor_contacts(replace(before, runs=(*before.runs, *after.runs)), file_of(CLEAN))
    assert (
        result.state == "bad"
        and result.since == 3
        and [one.state for one in result.contacts[:3]] == ["good"] * 3
    )
    (change,) = (one for one in result.changes if one.name == name)
    assert change.value == pytest.approx(value, abs=within) and change.std < within
    assert f"since contact 4 of 6 (touch_0.csv): {result.changes[0].name}" in result.verdict


def test_monitor_state_is_watch_if_change_lies_within_stated_uncertainty():
    wide = STATED | {"contact.stiffness": {"distribution": "uniform", "factor": [0.8, 1.2]}}
    before = contacts(CLEAN, seed=4, speeds=SPEEDS)
    after = contacts(replace(CLEAN, contact=campaign_kinds.voigt((1.3e5,))), seed=5, speeds=SPEEDS[:2])
    result = monitor_contacts(replace(before, runs=(*before.runs, *after.runs)), file_of(CLEAN, wide))
    assert result.state == "watch" and result.since == 6 and "covers it" in result.verdict


def test_monitor_uses_correlations_stated_in_mechanism_file():
    wide = STATED | {
        "contact.stiffness": {"distribution": "loguniform", "factor": [0.5, 2.0], "independent": True}
    }
    document = to_plain_data(file_of(campaigns.KINDS["stiffnesses"], wide))
    document["correlation"] = {
        "keys": ["contact.damping", "rig.force_sensor.delay"],
        "matrix": [[1.0], [0.9, 1.0]],
    }
    numbers, correlation = list_uncertain_parameters(from_plain_data(document, "known"))
    place = {(one.path, one.entry): i for i, one in enumerate(numbers)}
    damping, delay = place["contact.damping", None], place["rig.force_sensor.delay", None]
    assert correlation[damping, delay] == pytest.approx(0.9, abs=0.01)
    assert numbers[damping].std == pytest.approx(4.0, rel=0.05)
    assert numbers[place["rig.simulator.delay", None]].std == 2e-5
    one = numbers[place["contact.stiffness", (1,)]]
    stepped = one.step_parameter(from_plain_data(document, "known")).contact.stiffness
    # Variance of a loguniform number between m/f and m f: m^2 (f^2 - f^-2)/(4 log f) - mean^2.
    mean = (2.0 - 0.5) / np.log(4.0)
    expected = 2.4e5 * np.sqrt((4.0 - 0.25) / (2.0 * np.log(4.0)) - mean**2)
    assert one.std == pytest.approx(expected, rel=0.05)
    assert stepped == [1.2e5, pytest.approx(2.4e5 + one.std), 7e4]


def written(folder, campaign):
    """Write the contacts as `simulate --log` does, one file each."""
    folder.mkdir()
    columns = ("position_desired", "position_measured", "force_measured", "velocity_desired", "force_command")
    for number, run in enumerate(campaign.runs):
        rows = np.stack([1e-3 * run.tick, *(getattr(run, name) for name in columns)], axis=1)
        header = ",".join(("time", *columns))
        np.savetxt(folder / f"{number:02}.csv", rows, "%.15g", ",", header=header, comments="")
    return sorted(folder.glob("*.csv"))


def test_monitor_command_prints_a_verdict_and_returns_its_exit_code(jaxhil, tmp_path):
    known = tmp_path / "known.toml"
    known.write_text(to_toml(to_plain_data(file_of(CLEAN))))
    logs = written(tmp_path / "same", contacts(CLEAN, seed=3, speeds=SPEEDS[:3]))
    ran = jaxhil("monitor", known, *logs, "--json")
    assert ran.code == 0 and ran.document["state"] == "good" and ran.document["since"] is None
    assert ran.document["contacts"][2]["log"] == "02.csv" and ran.document["sources"].keys() == {
        path.name for path in logs
    }
    assert ran.document["contacts"][0]["figures"].keys() == set(METRIC_NAMES)
    other = changed_kind(CLEAN, force_sensor={"delay": 0.0047})
    ran = jaxhil("monitor", known, *written(tmp_path / "later", contacts(other, seed=3, speeds=SPEEDS[:3])))
    assert ran.code == 1 and "Bad: since contact 1 of 3 (00.csv): apparent damping" in ran.out
    assert "[N s/m]" in ran.out and ran.err == ""


@pytest.mark.parametrize("arguments, words", (
    (["varying"], "logs: found none"),
    (["varying", "LOG", "--map", "FREE"], "found no contact, expected a run of kind contact or tap"),
    (["nowhere.toml", "LOG"], "nowhere"),
    (["TWO", "LOG"], "contact.clearance: found 0.02, expected inf"),
    (["FAR", "LOG"], "rig.contact_plane: found 0.05 m, which no contact in the logs exceeds"),
    (["OTHER", "LOG"], "contact.law: found 'elastoplastic', expected linear, kelvin_voigt"),
))  # fmt: skip
def test_monitor_rejects_unusable_input_with_one_line_message(jaxhil, tmp_path, arguments, words):
    campaign = contacts(CLEAN, speeds=SPEEDS[:1])
    mapping = tmp_path / "map.toml"
    channels = (
        "time = 'time'\nposition_desired = 'position_desired'\nposition_measured = 'position_measured'\n"
    )
    mapping.write_text(
        f"schema = 'jaxhil/log/1'\n[channels]\n{channels}[[runs]]\nfiles = '*'\nkind = 'free'\n"
    )
    two = to_plain_data(package.load("varying", {"contact.clearance": 0.02}))
    other = to_plain_data(package.load("varying"))
    law = {"law": "elastoplastic", "unloading_ratio": 2.0, "damping": [0.0], "stiffness": [1e5]}
    other = other | {"contact": law, "uncertainty": {}}
    paths = {"LOG": written(tmp_path / "logs", campaign)[0], "FREE": mapping}
    far = to_plain_data(package.load("varying", {"rig.contact_plane": 0.05}))
    for name, document in (("TWO", two), ("FAR", far), ("OTHER", other)):
        paths[name] = tmp_path / f"{name}.toml"
        paths[name].write_text(to_toml(document))
    ran = jaxhil("monitor", *(paths.get(argument, argument) for argument in arguments))
    assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1 and words in ran.err
