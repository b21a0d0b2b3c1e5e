"""Pictures of an identification show what was measured and found; drawn alike each time."""

import campaigns
import numpy as np
import pytest

import jaxhil as package
from tuning.cli.commands.identify import PICTURES, _entry
from tuning.identification.estimate import Options, identify
from tuning.identification.pictures import bode, compare, contacts, delay, draw, residuals


@pytest.fixture(scope="module")
def found():
    campaign = campaigns.campaign("clean", 0, speeds=(0.003, 0.006, 0.012), seconds=20.0)
    return identify(campaign, options=Options(law="kelvin_voigt", order=2, hold_out=0.0))


def line(axes, label):
    (drawn,) = (one for one in axes.get_lines() if one.get_label() == label)
    return np.asarray(drawn.get_xdata()), np.asarray(drawn.get_ydata())


def test_the_response_drawn_is_the_rig_s(found):
    size, phase, off, coherence = bode(found.motion).axes
    frequency, measured = line(size, "measured")
    s, w = 2j * np.pi * frequency, 2.0 * np.pi * 12.0
    # A line between ticks is late by nothing, and smaller by sinc^2.
    true = np.exp(-0.0043 * s) / (1.0 + 2.0 * 0.8 * s / w + (s / w) ** 2) * np.sinc(1e-3 * frequency) ** 2
    np.testing.assert_allclose(10.0 ** (measured / 20.0), np.abs(true), rtol=0.02)
    np.testing.assert_allclose(line(phase, "model")[1], np.degrees(np.unwrap(np.angle(true))), atol=1.0)
    share, chance = line(off, "measured off the model")[1], line(off, "95 % of noise")[1]
    assert 0.85 < np.mean(share < chance) <= 1.0 and line(coherence, "coherence")[1].min() > 0.99
    assert {axes.get_xlabel() for axes in (off, coherence)} == {"frequency [Hz]"}


def test_touches_are_drawn_with_what_the_law_leaves(found):
    left, right = delay(found.contact, 0.0037).axes
    profile = line(left, "profile of the likelihood")
    assert profile[1].max() == 1.0 and abs(profile[0][np.argmax(profile[1])] - 3.7) < 0.5
    assert line(left, "prior")[0][0] == pytest.approx(3.7) and "correlation 0." in right.get_title()
    panels = contacts(found.contact).axes
    assert len(panels) == 6 and panels[0].get_title() == "touch 0" and panels[2].get_title() == "touch 2"
    for axes, speed in zip(panels[:3], (0.003, 0.006, 0.012), strict=True):
        measured, model = line(axes, "measured")[1], line(axes, "model")[1]
        assert np.nanstd(measured - model) < 0.7 and model.max() > 3e3 * speed
    over_time, _, own, _ = residuals(found.contact).axes
    shown = line(over_time, "all touches")[1]
    assert 0.9 < shown.std() < 1.1 and np.abs(line(own, "correlation")[1]).max() < 0.1


def test_the_prior_is_drawn_beside_the_estimates(found):
    entries = [_entry(one, package.load("rig-300kg")) for one in found.estimates]
    (axes,) = compare(entries).axes
    names = [tick.get_text() for tick in axes.get_yticklabels()]
    row = next(i for i, one in enumerate(names) if one.startswith("rig.simulator.delay"))
    share, rows = line(axes, "prior")
    value = found["rig.simulator.delay"].value
    assert share[list(rows).index(row)] == pytest.approx(100.0 * (0.004 / value - 1.0))
    assert not [one for one in names if one.startswith("rig.contact_plane")]


@pytest.mark.slow
def test_pictures_come_out_the_same_twice(found, tmp_path):
    from jaxhil.simulation.contact_plot import save

    entries = [_entry(one, None) for one in found.estimates]
    for again in ("one", "other"):
        for name, figure in draw(found, entries).items():
            save(figure, tmp_path / again / name)
    for name in PICTURES:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
