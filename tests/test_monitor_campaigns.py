"""False alarm rates and detection times of the monitor, with files identified from other contacts.

All tests are slow; `test_monitor.py` has a daily sample. `pytest -m slow -s tests/test_monitor_campaigns.py`
prints the results.
"""

from dataclasses import replace

import campaigns
import numpy as np
import pytest

from jaxhil.mechanism.file import from_plain_data
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.monitor.metrics import METRIC_NAMES
from tuning.identification.monitor.monitor import monitor_contacts

pytestmark = pytest.mark.slow
FILES = 8
SPEEDS = np.array([0.003, 0.006, 0.012])
CLEAN = campaigns.KINDS["clean"]


@pytest.fixture(scope="module")
def files():
    """Return files of the same rig, each identified from a different day."""
    result = []
    for seed in range(FILES):
        day = campaigns.campaign("clean", 60_000 + seed)
        options = IdentificationOptions(law="kelvin_voigt", order=2, hold_out=0.0, seed=seed)
        result.append(from_plain_data(identify(day, options=options).mechanism, "identified"))
    return result


def contacts(name, seed, speeds):
    return campaigns.campaign(name, 70_000 + seed, speeds=tuple(speeds), seconds=0, rest=0)


def delayed(seed, speeds, growth):
    """Return contacts during which the force delay increases [s]."""
    runs = []
    for i, speed in enumerate(speeds):
        delay = CLEAN.rig["force_sensor"]["delay"] + growth * i / (len(speeds) - 1)
        rig = CLEAN.rig | {"force_sensor": CLEAN.rig["force_sensor"] | {"delay": delay}}
        campaigns.KINDS["delayed"] = replace(CLEAN, rig=rig)
        runs += contacts("delayed", 1000 * seed + i, (speed,)).runs
    del campaigns.KINDS["delayed"]
    return replace(contacts("clean", seed, SPEEDS), runs=tuple(runs))


def test_monitor_raises_no_alarm_in_500_contacts_of_an_unchanged_rig(files):
    z, alarms, number = [], 0, 0
    for seed, mechanism in enumerate(files):
        speeds = np.random.default_rng(seed).choice(SPEEDS, 250)
        result = monitor_contacts(contacts("clean", seed, speeds), mechanism)
        alarms, number = alarms + (result.alarm is not None), number + len(result.contacts)
        z += [contact.z for contact in result.contacts]
    print(f"{alarms} alarms in {number} contacts")
    for name, mean, std in zip(METRIC_NAMES, np.mean(z, axis=0), np.std(z, axis=0), strict=True):
        print(f"  {name:18s} mean {mean:+.3f}, std {std:.3f} of the predicted")
        assert abs(mean) < 0.2 and abs(std - 1.0) < 0.1
    assert alarms <= number / 500


@pytest.mark.parametrize("number", (15, 60))
def test_monitor_detects_drifts_early(files, number):
    result = {"stiffness [%]": [], "force delay [ms]": []}
    for seed, mechanism in enumerate(files):
        speeds = np.repeat(SPEEDS, 5) if number == 15 else np.random.default_rng(seed).choice(SPEEDS, number)
        stiffer = monitor_contacts(contacts("drifting", seed, speeds), mechanism)
        later = monitor_contacts(delayed(seed, speeds, 0.0006), mechanism)
        assert stiffer.state == later.state == "bad"
        assert "stiffness" in {change.name for change in stiffer.changes}
        assert "apparent damping" in {change.name for change in later.changes}
        result["stiffness [%]"].append(15.0 * stiffer.alarm / (number - 1))
        result["force delay [ms]"].append(0.6 * later.alarm / (number - 1))
    for name, reached in result.items():
        print(f"{number} contacts: {name} when it was found: {np.round(reached, 2)}")
    assert np.median(result["stiffness [%]"]) < 3.0
    if number > 15:
        # The first five of the fifteen contacts are too slow to show a delay.
        assert np.max(result["stiffness [%]"]) < 3.0 and np.max(result["force delay [ms]"]) < 0.3
