"""Fits of long press runs: pseudo-rows, which replace many rows, and independent noise filters."""

from dataclasses import replace
from types import SimpleNamespace

import campaigns
import numpy as np
import pytest

from jaxhil.contact.laws import find_contact_law
from tuning.identification.contact_laws import kelvin_voigt
from tuning.identification.contact_problem import ContactProblem
from tuning.identification.contact_runs import split_long_run
from tuning.identification.deep_contact import (
    LANES_FOR_LAW_CHOICE,
    find_deep_lanes,
    select_representative_lanes,
    summarise_deep_lanes,
)
from tuning.identification.force_readings import ForceReadings
from tuning.identification.motion import MotionResponse
from tuning.identification.rational import STRUCTURES, MotionModel
from tuning.identification.records import CampaignTiming

TIMING = CampaignTiming(0.001, "linear", 0, "tick", None)
MODEL = MotionModel(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
NEAR = (0.0037, 0.0)  # true delay [s] and surface position [m]
HERTZ = find_contact_law("hunt_crossley").regression(SimpleNamespace(exponent=1.5))
(KINKED,) = find_contact_law("piecewise_linear").families(0.0008, 1)
COLOURED = (1.0, -0.6, 0.1)


def problem(law, time_constant=0.0, whitening=(1.0,), threshold=0.0, seconds=12.0):
    """Return contacts and a long press run of the same rig."""
    kind, rng = campaigns.KINDS["clean"], np.random.default_rng(1)
    press = campaigns._press_run(kind, rng, seconds=seconds, depth=0.0008)
    runs = [*split_long_run(press, 0.001), *campaigns._touch_runs(kind, rng, (0.003, 0.006, 0.012))]
    readings = ForceReadings.of(runs, 0.5, whitening, threshold)
    if threshold:
        # A dead zone has the effect of a more distant surface, so the dead zone must be known.
        readings = replace(readings, bias=(0.0, 0.01))
    return ContactProblem(MotionResponse(MODEL, runs, TIMING, 0.022), readings, law, None, time_constant)


@pytest.mark.parametrize("law", [kelvin_voigt(), HERTZ], ids=["kelvin_voigt", "hertz"])
@pytest.mark.parametrize(
    "lag, whitening", [(0.0, (1.0,)), (0.0015, (1.0,)), (0.0, COLOURED), (0.001, COLOURED)]
)
@pytest.mark.parametrize("threshold", [0.0, 0.5])
def test_pseudo_rows_of_a_long_press_run_have_the_misfit_of_all_rows(law, lag, whitening, threshold):
    full = problem(law, lag, whitening, threshold)
    few = summarise_deep_lanes(full, (NEAR[0] - lag, 0.0))
    assert few is not full
    for delay, plane in ((0.0037, 0.0), (0.0032, 3e-6), (0.0051, -2e-6)):
        exact, fit = full.at(delay - lag, plane), few.at(delay - lag, plane)
        std = np.sqrt(np.diag(exact.covariance))
        assert np.all(np.abs(fit.coefficients - exact.coefficients) < 0.02 * std)
        scale = np.outer(std, std)
        np.testing.assert_allclose(fit.covariance / scale, exact.covariance / scale, rtol=0, atol=1e-4)
        # The misfit changes by twice the residual times the error of the force.
        assert abs(fit.misfit - exact.misfit) < 0.02 * np.sqrt(exact.misfit)
        assert fit.curvature == pytest.approx(exact.curvature, rel=1e-3)
        assert abs(fit.slope - exact.slope) < 0.02 * np.sqrt(exact.curvature) * np.sqrt(exact.misfit)
        (across,) = few.fit_surfaces(delay - lag, np.array([plane]))
        assert across.misfit == pytest.approx(fit.misfit, rel=1e-9)
    # Pseudo-rows are used: only contacts and both ends of the press run are computed row by row.
    assert len(few.tables) > 0 and len(few.others.used_rows) < 0.6 * len(full.used_rows)


@pytest.mark.parametrize(
    "law, plane", [(kelvin_voigt(), 9e-4), (KINKED.make(8e-4), 0.0)], ids=["shallow", "kinks in the force"]
)
def test_long_press_run_uses_all_rows_if_pseudo_rows_are_inaccurate(law, plane):
    full = problem(law)
    few = summarise_deep_lanes(full, NEAR)
    exact, fit = full.at(0.0037, plane), few.at(0.0037, plane)
    np.testing.assert_array_equal(fit.coefficients, exact.coefficients)
    assert fit.misfit == exact.misfit


def test_short_contacts_are_never_replaced_by_pseudo_rows():
    full = problem(kelvin_voigt())
    deep = find_deep_lanes(full.motion, 0.0)
    assert deep.sum() >= 8 and not deep[-3:].any()
    short = problem(kelvin_voigt(), seconds=4.0)
    assert summarise_deep_lanes(short, NEAR) is short
    long = problem(kelvin_voigt(), seconds=40.0)
    lanes, total = select_representative_lanes(long), long.readings.force.shape[1]
    assert len(lanes) < LANES_FOR_LAW_CHOICE + 8 < total and {total - 3, total - 2, total - 1} < {*lanes}


@pytest.mark.parametrize("whitening", [(1.0,), COLOURED])
def test_noise_filter_of_a_run_does_not_depend_on_other_runs(whitening):
    full = problem(kelvin_voigt(), 0.0015, whitening, seconds=5.0)
    values = np.array([1.2e5, 650.0, 0.3])
    together = full.force(0.002, 0.0, values)
    inner = full.at(0.002, 0.0)
    misfit = 0.0
    for lane in range(together.shape[1]):
        lanes = np.array([lane])
        alone = ContactProblem(
            full.motion.of(lanes), full.readings.select_lanes(lanes), full.law, None, 0.0015
        )
        np.testing.assert_allclose(
            alone.force(0.002, 0.0, values)[:, 0], together[:, lane], rtol=0, atol=1e-9
        )
        residuals = alone.whiten(alone.readings.force - alone.force(0.002, 0.0, inner.coefficients))
        misfit += float(np.sum((residuals[alone.readings.counts] / 0.5) ** 2))
    assert misfit == pytest.approx(inner.misfit, rel=1e-9)


def test_fit_of_a_long_press_run_is_reproducible():
    fits = [summarise_deep_lanes(problem(kelvin_voigt()), (0.0037, 0.0)).at(0.00371, 1e-6) for _ in range(2)]
    np.testing.assert_array_equal(fits[0].coefficients, fits[1].coefficients)
