"""Two studies beside a sweep: which uncertain input drives the error, and how probable a rare failure is.

Both choose their scenarios themselves, as points of the unit box of all uncertain numbers, and run them
through the sweep's own program. The sensors' noise is one more uncertain input, not a number that can be
chosen: its realisation is addressed by an index.
"""

from typing import NamedTuple

import numpy as np

from jaxhil.mechanism.correlation import correlated_groups
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.uncertainty import dimensions
from tuning.statistics.sobol_indices import saltelli_design, sobol_indices
from tuning.statistics.subset_simulation import (
    LEVELS,
    STEPS,
    SubsetSimulation,
    subset_simulation,
    to_uniform,
)
from tuning.sweeps.chunks import Sweep
from tuning.sweeps.columns import OUTCOMES, UNLIKE
from tuning.sweeps.points import HERE, Running, run_points
from tuning.sweeps.tally import error_sizes

NOISE = "sensor noise"
TOGETHER = " + "  # between keys that are one input
CAP_LIMITS = 10.0  # largest error that drivers look at, over the limit
CAP_UNLIMITED = 10.0  # the same where there is no limit
SAMPLES, REPLICATES = 1000, 10  # of subset simulation: per level and replicate, and how often it runs
FAR_ABOVE = 2.0  # replicates that spread so much more than the formula says have not seen the same failures


class InputIndices(NamedTuple):
    """The Sobol indices of an uncertain input, with intervals of 95 %; nan where nothing varies."""

    input: str  # its key, or the keys of numbers that vary together, joined by `TOGETHER`
    first_order: float  # its own share of the variance
    first_order_low: float  # end of the interval
    first_order_high: float  # end of the interval
    total: float  # its share with all interactions
    total_low: float  # end of the interval
    total_high: float  # end of the interval


class ErrorIndices(NamedTuple):
    """Sobol indices of the worst |error| cut at `cap`."""

    inputs: tuple[InputIndices, ...]  # those of largest total index first
    cap: float
    evaluations: int  # scenarios that were run
    capped: int  # how many of them reached the cap or had no error


def error_indices(sweep: Sweep, number: int, running: Running = HERE) -> ErrorIndices:
    """Sobol indices of the worst |error|, from `number` (a power of two) times inputs + 2 scenarios.

    An input is a key of the mechanism's uncertainty, with all its entries; keys that are correlated are one,
    since the indices presume independent inputs; the phases of all contacts are one, and so is noise where
    sensors have any: the scenarios of A have one realisation each, those of B another. An error beyond
    `CAP_LIMITS` limits, or a run without one, counts as that, lest a few runs that diverge make up all of the
    variance.
    """
    inputs = independent_inputs(sweep.mechanism)
    names, entries = list(inputs), [len(columns) for columns in inputs.values()]
    if _noisy(sweep):
        # A column of the design that stands for nothing but which realisation it is.
        names, entries = [*names, NOISE], [*entries, 1]
    order = np.argsort(np.concatenate(list(inputs.values())))
    points = saltelli_design(entries, number, sweep.manifest.seed)[:, order]
    block, row = np.divmod(np.arange(len(points)), number)
    of_b = (block == 1) | ((block == len(points) // number - 1) & _noisy(sweep))
    sizes = error_sizes(run_points(sweep, points, row + number * of_b, running))
    limit = sweep.manifest.limit
    cap = CAP_LIMITS * limit if limit else CAP_UNLIMITED
    indices = sobol_indices(sizes, entries, number, sweep.manifest.seed, cap=cap)
    numbers = np.stack([*indices.first_order, *indices.total], axis=1)
    found = [InputIndices(name, *row.tolist()) for name, row in zip(names, numbers, strict=True)]
    found.sort(key=lambda one: -np.nan_to_num(one.total))
    return ErrorIndices(tuple(found), cap, len(points), int(np.sum(sizes >= cap)))


def independent_inputs(mechanism: AnyMechanism) -> dict[str, np.ndarray]:
    """The columns that each input has among those of `dimensions`: a key's, or those of all keys that are
    correlated."""
    columns = dimensions(mechanism)
    ends = dict(zip(columns, np.cumsum(list(columns.values())), strict=True))
    group = {key: keys for keys in correlated_groups(mechanism) for key in keys}
    return {
        TOGETHER.join(keys): np.concatenate([np.arange(ends[key] - columns[key], ends[key]) for key in keys])
        for keys in dict.fromkeys(group.get(key, (key,)) for key in columns)
    }


def most_scenarios(samples: int = SAMPLES, replicates: int = REPLICATES) -> int:
    """That `rare_failure` runs: each level but the first begins with a part of those of the last."""
    return replicates * (samples + (LEVELS - 1) * (samples - samples // STEPS))


def rare_failure(
    sweep: Sweep,
    limit: float,
    running: Running = HERE,
    samples: int = SAMPLES,
    replicates: int = REPLICATES,
) -> SubsetSimulation:
    """Subset simulation of the probability that a scenario fails, with `limit` in the place of the sweep's.

    The performance is the worst |error|, infinite where the scenario fails otherwise. Noise has a realisation
    of its own in every scenario. A chain that accepts a scenario accepts its noise with it: that is a
    proposal of noise independent of the last, so that the chain is as valid as without noise.
    """
    unlike, run = OUTCOMES.index(UNLIKE), 0

    def performance(normals: np.ndarray) -> np.ndarray:
        nonlocal run
        indices = np.arange(run, run + len(normals))
        rows = run_points(sweep, to_uniform(normals), indices, running)
        run += len(normals)
        return np.where(rows["outcome"] >= unlike, np.inf, error_sizes(rows))

    inputs = sum(dimensions(sweep.mechanism).values())
    return subset_simulation(performance, inputs, limit, sweep.manifest.seed, samples, replicates)


def spread_beyond_formula(rare: SubsetSimulation) -> bool:
    """Whether replicates differ by far more than one run's chains can explain."""
    return rare.coefficient_of_variation > FAR_ABOVE * rare.formula_coefficient_of_variation


def _noisy(sweep: Sweep) -> bool:
    return any(getattr(sweep.loop, f"has_{kind}noise", False) for kind in ("", "force_", "position_"))
