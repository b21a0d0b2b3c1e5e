"""Confidence intervals of a failure probability: stated coverage without excessive width."""

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import ndtri
from scipy.stats import qmc

from tuning.statistics.intervals import (
    IntervalEstimate,
    SequentialState,
    binomial_interval,
    confidence_sequence,
    estimate_sequence_scenarios,
    is_narrow_enough,
    lognormal_interval,
    replicate_interval,
    update_sequence,
)

BAR = 0.935  # required coverage of repeated sweeps for intervals of stated 95 %
PROBABILITIES = (0.5, 0.2, 0.05, 0.01, 0.001)


def covered(interval, probability):
    return np.mean((interval.low <= probability) & (probability <= interval.high))


def test_binomial_interval_matches_scipy():
    for failures, number in ((0, 10), (10, 10), (1, 1), (3, 40), (500, 1000), (7, 10**6)):
        expected = stats.binomtest(failures, number).proportion_ci(0.95, method="exact")
        result = binomial_interval(failures, number)
        np.testing.assert_allclose([result.low, result.high], expected, rtol=1e-10)
        assert result.value == failures / number
    both = binomial_interval([0, 3], [10, 40], level=0.9)
    assert both.low.shape == (2,) and both.low[0] == 0.0
    assert both.high[1] == pytest.approx(stats.beta.ppf(0.95, 4, 37), rel=1e-12)


@pytest.mark.parametrize("interval", (binomial_interval, confidence_sequence))
def test_probability_interval_without_scenarios_is_zero_to_one(interval):
    none = interval(0, 0)
    assert np.isnan(none.value) and none.low == 0.0 and none.high == 1.0


@pytest.mark.parametrize("number", (20, 200, 2000))
def test_binomial_interval_has_stated_coverage_for_every_probability(number):
    failures = np.arange(number + 1)
    interval = binomial_interval(failures, number)
    for probability in np.linspace(0.0005, 0.9995, 97):
        weights = stats.binom.pmf(failures, number, probability)
        inside = (interval.low <= probability) & (probability <= interval.high)
        assert np.sum(weights[inside]) >= 0.95


@pytest.mark.parametrize("probability", PROBABILITIES)
def test_binomial_interval_covers_truth_over_repeated_sweeps(probability, capsys):
    """Run 1000 sweeps with P(|x| > limit) for standard normal x."""
    rng = np.random.default_rng(0)
    limit = stats.norm.isf(probability / 2)
    failures = np.array([np.sum(np.abs(rng.standard_normal(1000)) > limit) for _ in range(1000)])
    interval = binomial_interval(failures, 1000)
    coverage, width = covered(interval, probability), np.mean(interval.width)
    with capsys.disabled():
        print(f"\nexact, p = {probability}: coverage {coverage:.3f}, mean width {width:.5f}", end="")
    assert coverage >= BAR
    assert width < 2 * 1.96 * np.sqrt(probability / 1000) + 0.004


def test_confidence_sequence_equals_mixture_martingale():
    """Compute the ratio of the mixture likelihood to the likelihood of p by quadrature."""
    failures, number = 3, 50
    result = confidence_sequence(failures, number)
    prior = stats.beta(0.5, 0.5)
    mixture, _ = integrate.quad(
        # The substitution p = sin^2(theta) removes the singularities of the prior.
        lambda angle: (
            prior.pdf(np.sin(angle) ** 2)
            * 2
            * np.sin(angle)
            * np.cos(angle)
            * stats.binom.pmf(failures, number, np.sin(angle) ** 2)
        ),
        0,
        np.pi / 2,
        epsabs=1e-14,
    )
    for end in (result.low, result.high):
        assert mixture / stats.binom.pmf(failures, number, end) == pytest.approx(20.0, rel=1e-6)
    assert result.low < 3 / 50 < result.high


def test_confidence_sequence_is_correct_at_extreme_counts():
    number = np.array([1, 10, 10**6, 10**9])
    none, all_failed = confidence_sequence(0, number), confidence_sequence(number, number)
    assert np.all(none.low == 0.0) and np.all(all_failed.high == 1.0)
    np.testing.assert_allclose(none.high, 1.0 - all_failed.low, rtol=0, atol=1e-13)
    assert none.high[2] < 1.2e-5 and np.all(np.diff(none.high) < 0)
    rare = confidence_sequence(1, 10**6)
    assert 0 < rare.low < 1e-6 < rare.high < 2e-5
    exact = binomial_interval(100_000, 10**6)
    assert 1 < confidence_sequence(100_000, 10**6).width / exact.width < 2.4


def walks(probability, repeats=1000, looks=150, step=25):
    """Return failures and scenarios so far, at each interim look of many sweeps, (repeats, looks)."""
    rng = np.random.default_rng(1)
    failures = np.cumsum(rng.binomial(step, probability, (repeats, looks)), axis=1)
    return failures, np.broadcast_to(step * np.arange(1, looks + 1), failures.shape)


def at_looks(interval, failures, number):
    """Return the interval at every interim look; equal counts are computed only once."""
    pairs, which = np.unique(np.stack([failures.ravel(), number.ravel()]), axis=1, return_inverse=True)
    return IntervalEstimate(*(part[which].reshape(failures.shape) for part in interval(*pairs)))


def ever_outside(interval, probability):
    return np.any((probability < interval.low) | (probability > interval.high), axis=1)


@pytest.mark.parametrize("probability", PROBABILITIES)
def test_confidence_sequence_has_stated_coverage_for_any_stopping_rule(probability, capsys):
    """Unlike exact intervals, these keep their coverage even for a stop at the worst of 150 looks."""
    failures, number = walks(probability)
    missed = np.mean(ever_outside(at_looks(confidence_sequence, failures, number), probability))
    peeked = np.mean(ever_outside(at_looks(binomial_interval, failures, number), probability))
    with capsys.disabled():
        print(f"\nworst look, p = {probability}: coverage {1 - missed:.3f}, exact {1 - peeked:.3f}", end="")
    assert 1 - missed >= 0.95
    assert 1 - peeked < (0.8 if probability > 0.001 else 0.93)


@pytest.mark.parametrize("probability, width", ((0.2, 0.1), (0.05, 0.03), (0.01, 0.01), (0.0, 0.01)))
def test_confidence_sequence_has_stated_coverage_if_stopped_at_a_width(probability, width, capsys):
    rng = np.random.default_rng(2)
    failures = np.cumsum(rng.binomial(100, probability, (1000, 150)), axis=1)
    number = np.broadcast_to(100 * np.arange(1, 151), failures.shape)
    looks = at_looks(confidence_sequence, failures, number)
    # `update_sequence` does this look by look; here for all sweeps at once.
    low, high = np.maximum.accumulate(looks.low, axis=1), np.minimum.accumulate(looks.high, axis=1)
    assert np.mean(np.any(low > high, axis=1)) < 0.01
    narrow = (high - low <= width) & (low <= high)
    assert np.all(np.any(narrow, axis=1))
    stop = np.arange(1000), np.argmax(narrow, axis=1)
    stopped = IntervalEstimate(failures[stop] / number[stop], low[stop], high[stop])
    coverage, mean, needed = covered(stopped, probability), np.mean(stopped.width), np.mean(number[stop])
    with capsys.disabled():
        print(
            f"\nsequential, p = {probability}: coverage {coverage:.3f}, mean width {mean:.5f}, mean number "
            f"{needed:.0f}",
            end="",
        )
    assert coverage >= BAR
    assert 0.7 * width < mean <= width
    # The predicted number of scenarios has the right order of magnitude.
    assert 0.7 < needed / estimate_sequence_scenarios(probability, width) < 1.4
    # Repeat one of the sweeps look by look.
    running = SequentialState()
    for added in np.diff(failures[0], prepend=0):
        if is_narrow_enough(running, width):
            break
        running = update_sequence(running, int(added), 100)
    assert (running.number, running.low, running.high) == (number[stop][0], low[stop][0], high[stop][0])


def test_sequential_interval_is_intersection_of_all_looks_unless_it_is_empty():
    failures, number = walks(0.3, repeats=1, looks=50)
    running = SequentialState()
    for added in np.diff(failures[0], prepend=0):
        running = update_sequence(running, int(added), 25)
    looks = confidence_sequence(failures[0], number[0])
    assert (running.failures, running.number) == (failures[0, -1], 1250)
    assert (running.low, running.high) == (np.max(looks.low), np.min(looks.high))
    # Not Bernoulli trials: 1000 successes, then 1000 failures.
    contradiction = update_sequence(update_sequence(SequentialState(), 0, 1000), 1000, 1000)
    last = confidence_sequence(1000, 2000)
    assert (contradiction.low, contradiction.high) == (last.low, last.high)
    assert SequentialState() == SequentialState(0, 0, 0.0, 1.0, 0.95)


def test_required_number_of_scenarios_is_the_smallest_sufficient_number():
    needed = estimate_sequence_scenarios(0.01, 0.001)
    assert confidence_sequence(0.01 * needed, needed).width <= 0.001
    assert confidence_sequence(0.01 * 0.9 * needed, 0.9 * needed).width > 0.001
    assert estimate_sequence_scenarios(0.0, 1.0) == 1


def scrambled(region, dimensions, points, replicates, rng):
    draws = (qmc.Sobol(dimensions, rng=rng).random(points) for _ in range(replicates))
    return [np.sum(region(draw)) for draw in draws]


REGIONS = {
    # Regions of failure with closed forms: strip, triangle, half space of normals, box.
    "strip": (1, lambda p: lambda x: x[:, 0] < p),
    "triangle": (2, lambda p: lambda x: np.sum(x, axis=1) < np.sqrt(2 * p)),
    "half space": (5, lambda p: lambda x: np.sum(ndtri(x), axis=1) > stats.norm.isf(p) * np.sqrt(5)),
    "box": (6, lambda p: lambda x: np.all(x < p ** (1 / 6), axis=1)),
}


def replicated(name, probability, repeats, points=256, replicates=8):
    dimensions, region = REGIONS[name]
    rng = np.random.default_rng(3)
    failures = np.array(
        [scrambled(region(probability), dimensions, points, replicates, rng) for _ in range(repeats)]
    )
    return failures, replicate_interval(failures, points)


@pytest.mark.parametrize("name", REGIONS)
@pytest.mark.parametrize("probability", (0.3, 0.001))
def test_replicate_interval_has_stated_coverage_for_scrambled_sequences(name, probability):
    failures, interval = replicated(name, probability, 60)
    assert covered(interval, probability) >= BAR
    if probability == 0.3:
        # Evenly distributed points give a narrower interval than independent scenarios.
        exact = binomial_interval(np.sum(failures, axis=1), 8 * 256)
        assert np.mean(interval.width) < 0.7 * np.mean(exact.width)


@pytest.mark.slow
@pytest.mark.parametrize("name", REGIONS)
@pytest.mark.parametrize("probability", (0.3, 0.03, 0.001))
def test_replicate_interval_has_stated_coverage_over_a_thousand_sweeps(name, probability, capsys):
    _, interval = replicated(name, probability, 1000)
    coverage, width = covered(interval, probability), np.mean(interval.width)
    with capsys.disabled():
        print(f"\nSobol, {name}, p = {probability}: coverage {coverage:.3f}, mean width {width:.5f}", end="")
    assert coverage >= BAR


@pytest.mark.parametrize("probability", (*PROBABILITIES, 1e-4, 1e-5))
def test_replicate_interval_has_stated_coverage_for_independent_points(probability, capsys):
    failures = np.random.default_rng(4).binomial(1024, probability, (1000, 16))
    interval = replicate_interval(failures, 1024)
    with capsys.disabled():
        print(
            f"\nreplicates, p = {probability}: coverage {covered(interval, probability):.3f}, mean width "
            f"{np.mean(interval.width):.2e}",
            end="",
        )
    assert covered(interval, probability) >= BAR
    exact = binomial_interval(np.sum(failures, axis=1), 1024 * 16)
    assert np.mean(interval.width) < 1.3 * np.mean(exact.width)


@pytest.mark.parametrize("part", (0.0, 0.1, 0.3, 0.5, 0.8))
def test_replicate_interval_has_stated_coverage_for_evenly_spaced_points(part):
    failures = 300 + (np.random.default_rng(5).random((2000, 8)) < part)
    assert covered(replicate_interval(failures, 1024), (300 + part) / 1024) >= BAR


def test_replicate_interval_of_equal_replicates_has_nonzero_width():
    none, every = replicate_interval(np.zeros(16), 1000), replicate_interval(np.full(16, 1000), 1000)
    assert none.value == none.low == 0.0 and every.value == every.high == 1.0
    # The largest p for which, by Cantelli's inequality, none of 16 replicates shows a failure.
    assert (1 + 1000 * none.high / (1 - none.high)) ** -16 == pytest.approx(0.025, rel=1e-9)
    assert none.high == pytest.approx(1 - every.low, rel=1e-12)
    assert none.high > binomial_interval(0, 16000).high


@pytest.mark.parametrize("variation", (0.1, 0.3, 0.6))
@pytest.mark.parametrize("replicates", (5, 10, 20))
def test_lognormal_interval_has_stated_coverage_of_the_mean(variation, replicates):
    rng = np.random.default_rng(8)
    sigma = np.sqrt(np.log1p(variation**2))
    drawn = 1e-5 * np.exp(sigma * rng.standard_normal((4000, replicates)) - sigma**2 / 2)
    ends = np.array([lognormal_interval(row, row, np.zeros(replicates)) for row in drawn])
    assert np.mean((ends[:, 0] <= 1e-5) & (1e-5 <= ends[:, 1])) >= 0.94
    # Estimates that agree by chance still get an interval of nonzero width.
    low, high = lognormal_interval(np.full(10, 1e-5), np.ones(10), np.full(10, 0.3))
    assert low < 0.85e-5 and high > 1.15e-5


@pytest.mark.parametrize(
    "wrong, words",
    (
        (lambda: binomial_interval(3, 2), "failures"),
        (lambda: binomial_interval(-1, 2), "failures"),
        (lambda: confidence_sequence(1, 2, level=1.0), "level: found 1.0"),
        (lambda: replicate_interval([3], 10), "replicates: found 1"),
        (lambda: replicate_interval(3, 10), "replicates: found 0"),
        (lambda: estimate_sequence_scenarios(0.1, 0.0), "width"),
    ),
)
def test_intervals_reject_impossible_counts(wrong, words):
    with pytest.raises(ValueError, match=words):
        wrong()
