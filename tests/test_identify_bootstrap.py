"""Bootstrap over contacts: stated intervals for pure noise, wider intervals if contacts differ."""

from copy import copy
from dataclasses import replace

import campaigns
import numpy as np
import pytest

import jaxhil
from tuning.caches.checkpoints import Checkpoints
from tuning.identification import bootstrap
from tuning.identification.contact_fit import fit_contact
from tuning.identification.contact_laws import kelvin_voigt
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.rational import STRUCTURES, MotionModel


def campaign_with_variation(seed, share, speeds=campaigns.SPEEDS):
    """Return a campaign whose stiffness and damping vary between contacts by this relative amount."""
    whole = campaigns.campaign("clean", seed, speeds=(), seconds=10.0)
    kind, rng = campaigns.KINDS["clean"], np.random.default_rng(seed)
    runs = list(whole.runs)
    for number, speed in enumerate(speeds):
        times = 1.0 + share * rng.standard_normal()
        contact = {**kind.contact, "stiffness": [1.2e5 * times], "damping": [650.0 * times]}
        (run,) = campaigns._touch_runs(replace(kind, contact=contact), rng, (speed,))
        runs.append(replace(run, source=f"{number}.csv"))
    return replace(whole, runs=tuple(runs))


def of(campaign, repeats):
    return identify(
        campaign, options=IdentificationOptions(law="kelvin_voigt", order=2, bootstrap=repeats, hold_out=0.0)
    )


@pytest.fixture(scope="module")
def fit():
    """Fit eight equal contacts."""
    kind, timing = campaigns.KINDS["clean"], campaigns.campaign("clean", 0, (), 0, 0).timing
    runs = campaigns._touch_runs(kind, np.random.default_rng(0), (0.006, 0.012) * 4)
    model = MotionModel(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
    return fit_contact(runs, model, timing, None, kelvin_voigt())


@pytest.mark.parametrize("times", (1.2, 3.0))
def test_bootstrap_widens_parameter_draws_if_fits_scatter_more_than_predicted(fit, monkeypatch, times):
    original = fit.posterior.draws
    monkeypatch.setattr(
        "tuning.identification.bootstrap.fit_bootstrap_samples",
        lambda *_: original.mean(axis=0) + times * (original - original.mean(axis=0)),
    )
    result = bootstrap.bootstrap(fit, 20)
    # The variance of n fits about the truth is n / (n - 1) times that about their own mean.
    expected = times * np.sqrt(8.0 / 7.0) if times > 1.5 else 1.0
    np.testing.assert_allclose(result.draws().std(axis=0), expected * original.std(axis=0), rtol=0.05)
    assert ("those of noise" if times < 1.5 else "the bootstrap's") in result.resampled.split(
        "intervals are "
    )[1]


@pytest.mark.slow
def test_bootstrap_widens_intervals_if_contacts_differ_from_each_other():
    campaign = campaign_with_variation(0, 0.02, (0.012, 0.006) * 4)
    stated, wide = of(campaign, 0), of(campaign, 20)
    assert any("intervals are the bootstrap's" in note for note in wide.notes)
    # 2 % variation over 8 contacts of unequal weight.
    assert 0.004 < wide["contact.stiffness.0"].std / 1.2e5 < 0.015
    assert wide["contact.stiffness.0"].std > 2.0 * stated["contact.stiffness.0"].std
    assert wide["contact.stiffness.0"].value == pytest.approx(stated["contact.stiffness.0"].value, rel=1e-9)
    written = wide.mechanism["uncertainty"]["contact.stiffness"]["std"]
    assert written == pytest.approx(wide["contact.stiffness.0"].std, rel=0.01)


def test_resumed_bootstrap_gives_the_same_draws_as_uninterrupted_bootstrap(fit, tmp_path, monkeypatch):
    done, messages, most = [], [], 2

    def means(drawn, problem, readings, seed, near):
        """Return random numbers instead of fits."""
        if len(done) == most:
            raise KeyboardInterrupt
        done.append(drawn)
        spread = np.array([readings.force[:, lanes].std() for lanes in drawn]) + seed
        return np.outer(spread, np.arange(1.0, 1.0 + fit.posterior.draws.shape[1]))

    monkeypatch.setattr(bootstrap, "fit_resampled_contacts", means)
    with pytest.raises(KeyboardInterrupt):
        bootstrap.bootstrap(fit, 20, checkpoints=Checkpoints(tmp_path))
    most = 100
    again = bootstrap.bootstrap(fit, 20, checkpoints=Checkpoints(tmp_path, resume=True), say=messages.append)
    assert len(done) == 4 and messages == ["bootstrap fits: 15 of 20"]
    whole = bootstrap.bootstrap(fit, 20)
    assert again.resampled == whole.resampled
    np.testing.assert_array_equal(again.posterior.draws, whole.posterior.draws)


def test_bootstrap_checkpoints_of_another_problem_are_rejected(fit, tmp_path, monkeypatch):
    monkeypatch.setattr(bootstrap, "fit_resampled_contacts", lambda drawn, *_: np.zeros((len(drawn), 3)))

    def anew(other_fit, seed=0):
        """Return how many of the four checkpoints of `fit` are rejected for another problem."""
        bootstrap.fit_bootstrap_samples(fit, 20, 0, None, Checkpoints(tmp_path), messages.append)
        checkpoints = Checkpoints(tmp_path, resume=True)
        bootstrap.fit_bootstrap_samples(other_fit, 20, seed, None, checkpoints, messages.append)
        return len(checkpoints.other)

    def changed(owner, **values):
        problem = copy(fit.problem)
        target = problem if owner == "problem" else copy(getattr(problem, owner))
        for name, value in values.items():
            object.__setattr__(target, name, value)
        if owner != "problem":
            setattr(problem, owner, target)
        return replace(fit, problem=problem)

    messages = []
    assert anew(fit) == anew(changed("problem")) == 0
    assert anew(fit, seed=1) == 4
    assert anew(changed("problem", plane=1e-6)) == 4
    assert anew(changed("readings", force=fit.readings.force * (1.0 + 1e-15))) == 4
    assert anew(changed("motion", delay=fit.problem.motion.delay + 1e-15)) == 4
    assert anew(changed("law", shape={"exponent": 1.5})) == 4


def test_bootstrap_rejects_too_few_contacts_and_too_few_repeats():
    few = campaigns.campaign("clean", 0, speeds=(0.006, 0.012, 0.006), seconds=5.0)
    assert "no bootstrap: 3 contacts, 6 are needed" in of(few, 20).notes
    with pytest.raises(jaxhil.InputError, match="bootstrap: found 5, expected 0 or at least 20"):
        of(few, 5)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "repeats"), ((0.0, 40), (0.02, 40)))
def test_bootstrap_intervals_cover_stiffness_with_and_without_variation(share, repeats):
    inside, without, widened = [], [], 0
    for seed in range(repeats):
        campaign = campaign_with_variation(100 + seed, share)
        wide, stated = of(campaign, 40), of(campaign, 0)
        for flags, result in ((inside, wide), (without, stated)):
            stiffness = result["contact.stiffness.0"]
            flags.append(stiffness.low <= 1.2e5 <= stiffness.high)
        widened += any("the bootstrap's" in note for note in wide.notes)
    covered = f"covered {np.mean(inside)}, without {np.mean(without)}, {widened} widened"
    print(f"contacts differ by {share}: {covered}")
    assert np.mean(inside) >= 0.85
    assert widened <= 0.3 * repeats if share == 0.0 else widened == repeats
