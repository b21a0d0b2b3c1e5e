"""Logs of an independent rig against mechanisms that are theirs, or nearly."""

from dataclasses import replace

import campaign_rigs
import campaigns
import pytest

from jaxhil.errors import InputError
from tuning.identification.check import check

FEW = (0.003, 0.006, 0.012)


@pytest.fixture(scope="module")
def clean():
    return campaigns.campaign("clean", 0, speeds=FEW, seconds=10.0, rest=2.0)


def worst(found):
    return found.worst.name if found.worst else None


def test_logs_of_the_mechanism_itself_are_good(clean):
    found = check(clean, campaign_rigs.mechanism("clean"))
    assert found.good and found.effect == 0.0 and found.estimates == ()
    names = [line.name for line in found.lines]
    assert "motion model" in names and "contact law" in names and "drift from touch to touch" not in names


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"contact__stiffness": [1.24e5]}, "contact law"),
        ({"force_sensor__delay": 0.0047}, "contact law"),
        ({"rig__contact_plane": 2e-5}, "contact law"),
        ({"contact__damping": [550.0]}, "contact law"),
        ({"simulator__delay": 0.0053}, "motion model"),
        ({"simulator__natural_frequency": 11.5}, "motion model"),
        ({"rig__command_hold": "zoh"}, None),
    ],
)
def test_another_mechanism_is_bad(clean, changed, name):
    """The hold is the logs', not the mechanism's: told with them."""
    found = check(clean, campaign_rigs.mechanism("clean", **changed))
    assert found.good == (name is None)
    assert name in [None, *(line.name for line in found.lines if line.there)]


def test_check_names_the_file_and_time_of_a_touch_that_differs(clean):
    runs = [replace(run, source=f"run_{place}.csv") for place, run in enumerate(clean.runs)]
    place = next(place for place, run in reversed(list(enumerate(runs))) if run.kind == "contact")
    runs[place] = replace(runs[place], force_measured=1.1 * runs[place].force_measured, begin=7.0)
    found = check(replace(clean, runs=tuple(runs)), campaign_rigs.mechanism("clean"))
    (line,) = (line for line in found.lines if line.name == "contact law")
    assert line.there and line.where.startswith(f"run_{place}.csv from 7.")


def test_the_hold_that_logs_are_told_with_is_checked(clean):
    wrong = replace(clean, timing=replace(clean.timing, command_hold="zoh"))
    assert "command hold" in [
        line.name for line in check(wrong, campaign_rigs.mechanism("clean")).lines if line.there
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in campaigns.KINDS if name != "drifting"])
def test_every_kind_of_rig_explains_its_own_logs(name):
    if name in ("coloured", "jitter"):
        pytest.skip("the same rig as clean")
    good = [
        check(campaigns.campaign(name, 60 + seed), campaign_rigs.mechanism(name)).good for seed in range(5)
    ]
    assert all(good)


@pytest.mark.slow
def test_a_drift_is_noticed():
    found = check(campaigns.campaign("drifting", 1), campaign_rigs.mechanism("drifting"))
    assert not found.good and any(line.name.startswith("drift") and line.there for line in found.lines)


def test_what_cannot_be_set_against_logs_is_refused(clean):
    held = replace(clean, runs=tuple(run for run in clean.runs if run.kind == "rest"))
    with pytest.raises(InputError, match="found neither free motion nor contact"):
        check(held, campaign_rigs.mechanism("clean"))
    plastic = campaign_rigs.mechanism("clean", contact__law="elastoplastic", contact__unloading_ratio=2.0,
                                  contact__damping=[0.0])  # fmt: skip
    with pytest.raises(InputError, match=r"contact\.law: found 'elastoplastic', expected linear"):
        check(clean, plastic)
