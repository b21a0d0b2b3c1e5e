"""Coverage of intervals of complete sweeps, which draw, simulate and count scenarios like the command.

The true probability has a closed form: a linear contact of speed v, stiffness k and equivalent mass m has a
peak force of at most v sqrt(k m), so that a force sensor of range R saturates if v > R / sqrt(k m). For v
uniform between low and high, the probability is (high - R / sqrt(k m)) / (high - low). Ticks are short
compared with the contact, and motion simulator and sensors have no delay.
"""

import math

import msgspec
import numpy as np
import pytest
from cases import IDEAL, MASS, STIFFNESS, mechanism, nominal_gains, validated
from sweep_cases import manifest

from tuning.gain_file import build_document
from tuning.statistics.intervals import is_narrow_enough
from tuning.sweeps.chunks import build_sweep, run_chunk
from tuning.sweeps.tally import (
    ProbabilityEstimate,
    add_to_tally,
    build_empty_tally,
    estimate_failure_probability,
)

pytestmark = pytest.mark.slow

BAR = 0.935  # smallest coverage in repeated sweeps, for intervals of stated 95 %
SWEEPS, NUMBER = 1000, 256
LOOK = 32  # scenarios
LOW, HIGH = 0.002, 0.006  # m/s
SPEEDS = {"approach.velocity": {"distribution": "uniform", "low": LOW, "high": HIGH}}
TRUTHS = 0.3, 0.05


def repeated(truth, sampling):
    """Return the rows of sweeps with different seeds."""
    sensor = {"range": (HIGH - truth * (HIGH - LOW)) * math.sqrt(STIFFNESS * MASS)}
    raw = mechanism({}, IDEAL, 0.0, period=2e-4, force_sensor=sensor)
    parsed = validated({**raw, "uncertainty": SPEEDS})
    document = build_document("none", nominal_gains(parsed, "none"), parsed, "0" * 64, {}, {}, 0, {})
    sweep = build_sweep(manifest(document, NUMBER, sampling=sampling, chunk=NUMBER))
    for seed in range(SWEEPS):
        seeded = msgspec.structs.replace(sweep.manifest, seed=seed)
        yield run_chunk(sweep._replace(manifest=seeded), 0, NUMBER)


def check(intervals: list[ProbabilityEstimate], truth: float, name: str, capsys) -> None:
    inside = np.mean([one.low <= truth <= one.high for one in intervals])
    width = np.mean([one.high - one.low for one in intervals])
    value = np.mean([one.value for one in intervals])
    with capsys.disabled():
        stated = f"coverage {inside:.3f}, mean width {width:.4f}, mean {value:.4f}"
        print(f"\n{name}, p = {truth}: {stated}", end="")
    assert inside >= BAR


@pytest.mark.parametrize("truth", TRUTHS)
@pytest.mark.parametrize("sampling", ["random", "sobol"])
def test_failure_intervals_of_repeated_sweeps_cover_true_probability(truth, sampling, capsys):
    replicates = 16 if sampling == "sobol" else 1
    result = [
        estimate_failure_probability(add_to_tally(build_empty_tally(replicates, NUMBER), rows))
        for rows in repeated(truth, sampling)
    ]
    # The pooled sweeps agree with the closed form itself.
    pooled = np.mean([one.value for one in result])
    assert pooled == pytest.approx(truth, abs=4 * math.sqrt(truth * (1 - truth) / (SWEEPS * NUMBER)))
    check(result, truth, sampling, capsys)


@pytest.mark.parametrize("truth", TRUTHS)
def test_failure_intervals_of_sweeps_stopped_at_a_width_cover_true_probability(truth, capsys):
    result = []
    for rows in repeated(truth, "random"):
        tally = build_empty_tally(1, NUMBER, looked_at=True)
        for first in range(0, NUMBER, LOOK):
            tally = add_to_tally(tally, {name: column[first : first + LOOK] for name, column in rows.items()})
            assert tally.looks is not None
            if is_narrow_enough(tally.looks, 0.3 if truth > 0.1 else 0.12):
                break
        result.append(estimate_failure_probability(tally))
    check(result, truth, "sequential", capsys)
