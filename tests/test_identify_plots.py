"""Plots of an identification: measurements, estimates, and reproducible files."""

import campaigns
import numpy as np
import pytest

import jaxhil as package
from tuning.cli.commands.identify import PLOTS
from tuning.cli.commands.identify_tables import build_estimate_entry
from tuning.identification.identify import IdentificationOptions, identify
from tuning.plots.identification import (
    draw_identification,
    plot_bode,
    plot_contacts,
    plot_estimates,
    plot_force_delay,
    plot_residuals,
)


@pytest.fixture(scope="module")
def identified():
    campaign = campaigns.campaign("clean", 0, speeds=(0.003, 0.006, 0.012), seconds=20.0)
    return identify(campaign, options=IdentificationOptions(law="kelvin_voigt", order=2, hold_out=0.0))


def line(axes, label):
    (drawn,) = (curve for curve in axes.get_lines() if curve.get_label() == label)
    return np.asarray(drawn.get_xdata()), np.asarray(drawn.get_ydata())


def test_bode_plot_shows_response_of_the_rig(identified):
    size, phase, off, coherence = plot_bode(identified.motion).axes
    frequency, measured = line(size, "measured")
    s, w = 2j * np.pi * frequency, 2.0 * np.pi * 12.0
    # Linear interpolation between ticks adds no delay and attenuates by sinc^2.
    true = np.exp(-0.0043 * s) / (1.0 + 2.0 * 0.8 * s / w + (s / w) ** 2) * np.sinc(1e-3 * frequency) ** 2
    np.testing.assert_allclose(10.0 ** (measured / 20.0), np.abs(true), rtol=0.02)
    np.testing.assert_allclose(line(phase, "model")[1], np.degrees(np.unwrap(np.angle(true))), atol=1.0)
    share, chance = line(off, "|measured / model - 1|")[1], line(off, "95 % of noise")[1]
    assert 0.85 < np.mean(share < chance) <= 1.0 and line(coherence, "coherence")[1].min() > 0.99
    assert {axes.get_xlabel() for axes in (off, coherence)} == {"frequency [Hz]"}


def test_contact_plots_show_contacts_and_residuals(identified):
    left_axes, right_axes = plot_force_delay(identified.contact, 0.0037).axes
    profile = line(left_axes, "profile of the likelihood")
    assert profile[1].max() == 1.0 and abs(profile[0][np.argmax(profile[1])] - 3.7) < 0.5
    assert line(left_axes, "prior")[0][0] == pytest.approx(3.7) and "correlation 0." in right_axes.get_title()
    panels = plot_contacts(identified.contact).axes
    assert len(panels) == 6 and panels[0].get_title() == "contact 1" and panels[2].get_title() == "contact 3"
    for axes, speed in zip(panels[:3], (0.003, 0.006, 0.012), strict=True):
        measured, model = line(axes, "measured")[1], line(axes, "model")[1]
        assert np.nanstd(measured - model) < 0.7 and model.max() > 3e3 * speed
    over_time, _, correlations, _ = plot_residuals(identified.contact).axes
    shown = line(over_time, "all contacts")[1]
    assert 0.9 < shown.std() < 1.1 and np.abs(line(correlations, "correlation")[1]).max() < 0.1


def test_comparison_plot_shows_prior_beside_estimates(identified):
    entries = [build_estimate_entry(estimate, package.load("rig-300kg")) for estimate in identified.estimates]
    (axes,) = plot_estimates(entries).axes
    names = [tick.get_text() for tick in axes.get_yticklabels()]
    row = next(i for i, name in enumerate(names) if name.startswith("rig.simulator.delay"))
    share, rows = line(axes, "prior")
    value = identified["rig.simulator.delay"].value
    assert share[list(rows).index(row)] == pytest.approx(100.0 * (0.004 / value - 1.0))
    assert not [name for name in names if name.startswith("rig.contact_plane")]


@pytest.mark.slow
def test_identification_plots_are_reproducible(identified, tmp_path):
    from jaxhil.simulation.contact_plot import save_figure

    entries = [build_estimate_entry(estimate, None) for estimate in identified.estimates]
    for again in ("one", "other"):
        for name, figure in draw_identification(identified, entries).items():
            save_figure(figure, tmp_path / again / name)
    for name in PLOTS:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
