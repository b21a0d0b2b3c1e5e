"""`check_against_mechanism` on logs of an independent simulator, with right and wrong mechanism files."""

from dataclasses import replace

import campaign_rigs
import campaigns
import pytest

from jaxhil.errors import InputError
from tuning.identification.mechanism_check import check_against_mechanism
from tuning.identification.validation import CheckResult

FEW = (0.003, 0.006, 0.012)


@pytest.fixture(scope="module")
def clean():
    return campaigns.campaign("clean", 0, speeds=FEW, seconds=10.0, rest=2.0)


def worst(result):
    return result.worst.name if result.worst else None


def test_mechanism_check_accepts_logs_of_the_same_mechanism(clean):
    result = check_against_mechanism(clean, campaign_rigs.mechanism("clean"))
    assert result.good and result.effect == 0.0 and result.estimates == ()
    names = [line.name for line in result.lines]
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
def test_mechanism_check_rejects_logs_of_another_mechanism(clean, changed, name):
    result = check_against_mechanism(clean, campaign_rigs.mechanism("clean", **changed))
    assert result.good == (name is None)
    assert name in [None, *(line.name for line in result.lines if line.is_significant)]


def test_mechanism_check_reports_file_and_time_of_deviating_contact(clean):
    runs = [replace(run, source=f"run_{index}.csv") for index, run in enumerate(clean.runs)]
    index = next(index for index, run in reversed(list(enumerate(runs))) if run.kind == "contact")
    runs[index] = replace(runs[index], force_measured=1.1 * runs[index].force_measured, begin=7.0)
    result = check_against_mechanism(replace(clean, runs=tuple(runs)), campaign_rigs.mechanism("clean"))
    (line,) = (line for line in result.lines if line.name == "contact law")
    assert line.is_significant and line.where.startswith(f"run_{index}.csv from 7.")


def test_mechanism_check_detects_wrong_command_hold(clean):
    wrong = replace(clean, timing=replace(clean.timing, command_hold="zoh"))
    assert "command hold" in [
        line.name
        for line in check_against_mechanism(wrong, campaign_rigs.mechanism("clean")).lines
        if line.is_significant
    ]


def test_verdict_names_the_model_that_explains_logs_best(clean):
    result = check_against_mechanism(clean, campaign_rigs.mechanism("clean"))
    hold = CheckResult("command hold", "", True, 0.02, gain=4.0)
    low_pass = CheckResult("filter of the force sensor", "", True, 0.002, gain=40.0)
    assert worst(replace(result, lines=(hold, low_pass))) == low_pass.name
    assert worst(replace(result, lines=(hold, replace(low_pass, gain=2.0)))) == hold.name


@pytest.mark.parametrize("delay", (0.0043, 0.0063))
def test_mechanism_check_compares_motion_in_contact_without_runs_of_free_motion(clean, delay):
    """Without free motion, a wrong delay of the simulator shows only in the positions during contacts."""
    touches = replace(clean, runs=tuple(run for run in clean.runs if run.kind != "free"))
    mechanism = campaign_rigs.mechanism("clean", simulator__delay=delay)
    result = check_against_mechanism(touches, mechanism)
    (line,) = (line for line in result.lines if line.name == "motion in contact")
    late = 1e-3 * float(line.finding.split()[0]) * (1 if "earlier" in line.finding else -1)
    assert late == pytest.approx(delay - 0.0043, abs=1e-4)
    assert (line.is_significant, result.good) == ((True, False) if delay > 0.0043 else (False, True))
    assert delay == 0.0043 or result.effect > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in campaigns.KINDS if name != "drifting"])
def test_mechanism_check_accepts_logs_of_every_kind_of_rig(name):
    if name in ("coloured", "jitter"):
        pytest.skip("the same rig as clean")
    good = [
        check_against_mechanism(campaigns.campaign(name, 60 + seed), campaign_rigs.mechanism(name)).good
        for seed in range(5)
    ]
    assert all(good)


@pytest.mark.slow
def test_mechanism_check_detects_drift():
    result = check_against_mechanism(campaigns.campaign("drifting", 1), campaign_rigs.mechanism("drifting"))
    assert not result.good and any(
        line.name.startswith("drift") and line.is_significant for line in result.lines
    )


def test_mechanism_check_rejects_logs_without_motion_and_unsupported_contact_law(clean):
    at_rest_only = replace(clean, runs=tuple(run for run in clean.runs if run.kind == "rest"))
    with pytest.raises(InputError, match="found neither free motion nor contact"):
        check_against_mechanism(at_rest_only, campaign_rigs.mechanism("clean"))
    plastic = campaign_rigs.mechanism("clean", contact__law="elastoplastic", contact__unloading_ratio=2.0,
                                  contact__damping=[0.0])  # fmt: skip
    with pytest.raises(InputError, match=r"contact\.law: found 'elastoplastic', expected linear"):
        check_against_mechanism(clean, plastic)
