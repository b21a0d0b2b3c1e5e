"""What eight damped contacts at one speed can tell of an unknown force delay: the exact posterior, in an open
loop. Prints its figures with `pytest -m slow -s tests/test_delay_posterior.py`.

As in `test_delay_bounds` the readings are y = F(X - p) + H V + noise since the surface was met, 0 before; F
has the slopes between the knots of the force-depth map, H = B - K d. Of each contact, and of every tick in
which the surface may have been met, regression gives H, the place p that F tells of, and the likelihood; the
surface lies at p + d between two ticks. Delay d and surface p are the same in every contact. No law whose
slopes are known no better beforehand, and which presumes no damping to be likelier than another, errs less:
that it is known to a control period when a surface was met, and p to what slopes that may wander leave of it,
do not average out as errors of their own would.
"""

import math
from typing import NamedTuple

import numpy as np
import pytest
from scipy.special import ndtr
from test_delay_bounds import FINE, contacts, evenly, path, restitution

from jaxhil.compensators.force_depth_map import KNOTS, WANDERING
from jaxhil.compensators.retrospective_delay_bank import LEAST_PLANE_SPREAD, WIDE
from jaxhil.compensators.retrospective_gains import SHARP

pytestmark = pytest.mark.slow
FARTHEST = 1e-3  # s: delays lie evenly within it
BEFORE = 12  # ticks before the surface is met
BESIDE = 4  # ticks beside the one in which it was met, that are tried
JUMP = 6.0  # 1/s, spread of H and of the force at the entry
DELAYS = np.linspace(-FARTHEST, FARTHEST, 101)
PLACES = np.linspace(-2.5e-3, 2.5e-3, 251)
ONSETS = DELAYS[:, None] + PLACES


class Told(NamedTuple):
    """What one contact tells if its surface was met in one tick."""

    likelihood: float  # ln
    place: float  # of the surface [s]
    variance: float  # of that [s^2]
    low: float  # depth at the tick before [s]
    high: float  # and at this one [s]
    damping: float  # H [1/s]
    precision: float  # of that [s^2]


def contact(stiffness, damping, delay, noise, slope_spread, period, rng):
    """What a contact tells, tick by tick in which it may have been met."""
    time, depth, rate = evenly(stiffness, damping)
    ends = FINE * len(path(stiffness, damping)[0])
    at = np.arange(period * (rng.random() - BEFORE), ends, period)
    x, v = np.interp(at, time, depth), np.interp(at, time, rate)
    older, slower = np.interp(at - delay, time, depth), np.interp(at - delay, time, rate)
    y = np.where(at > delay, stiffness * older + damping * slower, 0) + noise * rng.standard_normal(len(at))
    met = int(np.argmax(at > delay))
    return [_supposed(x, v, y, first, noise, slope_spread) for first in range(met - BESIDE, met + BESIDE + 1)]


def _supposed(x, v, y, first, noise, slope_spread):
    knots, spread = np.array(KNOTS), WIDE["prior_stiffness_spread"]
    ramps = np.clip(x[first:, None] - knots, 0, np.append(np.diff(knots), np.inf))
    phi = np.column_stack([ramps, np.ones_like(x[first:]), v[first:]])
    prior = np.zeros((len(knots) + 2,) * 2)
    prior[:-2, :-2] = spread**2 + slope_spread**2 * np.minimum.outer(knots, knots) / WANDERING
    prior[-2, -2] = prior[-1, -1] = JUMP**2
    mean = np.append(np.full(len(knots), WIDE["prior_stiffness"]), [0, 0])
    missed = y[first:] - phi @ mean
    information = phi.T @ phi / noise**2
    covariance = np.linalg.inv(np.linalg.inv(prior) + information)
    moment = phi.T @ missed / noise**2
    theta = mean + covariance @ moment
    squares = (np.sum(missed**2) + np.sum(y[:first] ** 2)) / noise**2 - moment @ covariance @ moment
    occam = np.linalg.slogdet(np.eye(len(prior)) + prior @ information)[1]
    slope, force = theta[0], theta[-2]
    gradient = np.zeros(len(theta))
    gradient[0], gradient[-2] = force / slope**2, -1 / slope
    variance = gradient @ covariance @ gradient
    return Told(
        -0.5 * (squares + occam), -force / slope, variance, x[first - 1], x[first], theta[-1],
        1 / covariance[-1, -1],
    )  # fmt: skip


def likelihood(told):
    """ln of the likelihood of delays and places."""
    most, total = max(each.likelihood for each in told), np.zeros(ONSETS.shape)
    for each in told:
        within = (each.low <= ONSETS) & (each.high > ONSETS)
        here = np.exp(each.likelihood - most - 0.5 * (PLACES - each.place) ** 2 / each.variance)
        total += within * (here / math.sqrt(each.variance))
    return np.log(np.maximum(total, 1e-30 * np.max(total)))


def least(known, slope_spread, turns=8, period=1e-3, number=100):
    """The rms error of e [%] after each of so many contacts (`turns`), by the mean of the posterior; the
    surface `known` so well [m], slopes that wander by `slope_spread` [1/s^2]."""
    rng, errors = np.random.default_rng(0), np.empty((number, turns))
    each, noise, speed = contacts(number)
    for place, (stiffness, damping) in enumerate(each):
        delay = rng.uniform(-FARTHEST, FARTHEST)
        posterior = np.zeros(ONSETS.shape) - 0.5 * (PLACES * speed / known) ** 2
        moments = np.zeros(2)
        for turn in range(turns):
            told = contact(stiffness, damping, delay, noise, slope_spread, period, rng)
            best = max(told, key=lambda one: one.likelihood)
            posterior += likelihood(told)
            moments += best.precision * np.array([best.damping, 1])
            weights = np.sum(np.exp(posterior - np.max(posterior)), axis=1)
            reached = moments[0] / moments[1] + stiffness * DELAYS
            weights *= np.maximum(ndtr(reached * math.sqrt(moments[1])), 1e-12)
            mean = weights @ reached / np.sum(weights)
            errors[place, turn] = restitution(stiffness, max(mean, 0)) - restitution(stiffness, damping)
    return 100 * np.sqrt(np.mean(errors**2, axis=0))


def test_what_eight_damped_contacts_tell_of_the_delay(capsys):
    """Of a surface told to 3 um the eighth contact cannot be met with 0.3 % by slopes that wander as the
    bank's may; it could, if they hardly did, as the bank supposes as well."""
    eighth = {}
    for slopes, spread in (("the bank's", WIDE["prior_slope_spread"]), ("few", SHARP["prior_slope_spread"])):
        for name, known in (("told", LEAST_PLANE_SPREAD), ("unknown", 1e-3)):
            rms = least(known, spread)
            eighth[slopes, name] = rms[7]
            with capsys.disabled():
                print(
                    f"\ndamped, surface {name}, slopes that wander by {spread:.0f} 1/s^2: at least, contacts "
                    f"1, 2, 4, 8:", *np.round(rms[[0, 1, 3, 7]], 2),
                )  # fmt: skip
    assert 0.3 < eighth["the bank's", "told"] < eighth["the bank's", "unknown"] < 0.45
    assert eighth["few", "unknown"] < 0.3


@pytest.mark.parametrize(("period", "bar"), [(0.001, 0.75), (0.00025, 0.3)])
def test_what_the_first_damped_contact_tells_of_the_delay(period, bar, capsys):
    """The surface told to 3 um. That the delay is known to lie within 1 ms and the damping is not negative
    helps: the bounds of `test_delay_bounds` leave it out. At 0.25 ms the bar stays out of reach."""
    rms = least(LEAST_PLANE_SPREAD, WIDE["prior_slope_spread"], 1, period, 400)[0]
    with capsys.disabled():
        print(f"\ndamped, surface told, T = {1e3 * period} ms, first contact: at least {rms:.2f} (bar {bar})")
    assert (rms > bar) == (period < 1e-3)
