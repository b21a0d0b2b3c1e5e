"""Two studies of a sweep: Sobol indices of the uncertain inputs, and the probability of a rare failure.

Both studies select scenarios as points of the unit cube of all uncertain numbers, and run them with the
sweep's program. Sensor noise is one more uncertain input; an index selects its realisation.
"""

from typing import NamedTuple

import numpy as np

from jaxhil.mechanism.correlation import find_correlated_groups
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.uncertainty import count_dimensions
from tuning.statistics.sobol_indices import saltelli_design, sobol_indices
from tuning.statistics.subset_simulation import (
    CHAIN_LENGTH,
    MAX_LEVELS,
    SubsetSimulation,
    convert_to_uniform,
    subset_simulation,
)
from tuning.sweeps.chunks import SweepProgram
from tuning.sweeps.columns import SCENARIO_OUTCOMES, UNLIKE_IDEAL
from tuning.sweeps.point_batches import LOCAL_RUN, PointRunSettings, run_points
from tuning.sweeps.tally import compute_error_sizes

NOISE_INPUT = "sensor noise"
KEY_SEPARATOR = " + "  # between the keys of correlated numbers, which together are one input
CAP_IN_LIMITS = 10.0  # cap on |error| for Sobol indices, in multiples of the error limit
CAP_WITHOUT_LIMIT = 10.0  # cap on |error| [1] if there is no error limit
SUBSET_SAMPLES, SUBSET_REPLICATES = 1000, 10  # samples per level and replicate, number of replicates
# Largest plausible ratio of the replicates' spread to the spread that the formula predicts [1]; a larger
# ratio means that the replicates found different failure regions.
MAX_SPREAD_RATIO = 2.0


class InputIndices(NamedTuple):
    """Sobol indices of an uncertain input, with 95 % intervals; NaN if the error does not vary."""

    input: str  # key of the input, or the keys of correlated inputs, joined by `KEY_SEPARATOR`
    first_order: float  # first-order index [1]: share of the variance without interactions
    first_order_low: float  # low end of the first-order index's interval [1]
    first_order_high: float  # high end of the first-order index's interval [1]
    total: float  # total index [1]: share of the variance with all interactions
    total_low: float  # low end of the total index's interval [1]
    total_high: float  # high end of the total index's interval [1]


class ErrorIndices(NamedTuple):
    """Sobol indices of a scenario's worst |error|, with errors above `cap` set to `cap`."""

    inputs: tuple[InputIndices, ...]  # in descending order of the total index
    cap: float  # largest |error| that the indices distinguish [1]
    evaluations: int  # number of scenarios that were run
    capped: int  # number of scenarios whose error was clipped or missing


def compute_error_indices(
    sweep: SweepProgram, number: int, running: PointRunSettings = LOCAL_RUN
) -> ErrorIndices:
    """Compute Sobol indices of the worst |error| from `number` * (inputs + 2) scenarios.

    `number` is a power of two. Each uncertain key of the mechanism file, even a list, is one input.
    Correlated keys are one input together, because the indices assume independent inputs. The phases of all
    contacts are one input. Sensor noise is also one input; the sets A and B of the design (`saltelli_design`)
    have different noise. A scenario whose |error| exceeds the cap, or that has no error, counts as the cap,
    so that a few diverging scenarios do not dominate the variance.
    """
    inputs = group_independent_inputs(sweep.mechanism)
    names, entries = list(inputs), [len(columns) for columns in inputs.values()]
    if _has_noise(sweep):
        # This column of the design only selects one of two realisations of the noise.
        names, entries = [*names, NOISE_INPUT], [*entries, 1]
    order = np.argsort(np.concatenate(list(inputs.values())))
    points = saltelli_design(entries, number, sweep.manifest.seed)[:, order]
    block, row = np.divmod(np.arange(len(points)), number)
    of_b = (block == 1) | ((block == len(points) // number - 1) & _has_noise(sweep))
    sizes = compute_error_sizes(run_points(sweep, points, row + number * of_b, running))
    limit = sweep.manifest.limit
    cap = CAP_IN_LIMITS * limit if limit else CAP_WITHOUT_LIMIT
    indices = sobol_indices(sizes, entries, number, sweep.manifest.seed, cap=cap)
    numbers = np.stack([*indices.first_order, *indices.total], axis=1)
    results = [InputIndices(name, *row.tolist()) for name, row in zip(names, numbers, strict=True)]
    results.sort(key=lambda result: -np.nan_to_num(result.total))
    return ErrorIndices(tuple(results), cap, len(points), int(np.sum(sizes >= cap)))


def group_independent_inputs(mechanism: AnyMechanism) -> dict[str, np.ndarray]:
    """Return the indices of each input's dimensions in the unit cube; correlated keys are one input."""
    columns = count_dimensions(mechanism)
    ends = dict(zip(columns, np.cumsum(list(columns.values())), strict=True))
    group = {key: keys for keys in find_correlated_groups(mechanism) for key in keys}
    return {
        KEY_SEPARATOR.join(keys): np.concatenate(
            [np.arange(ends[key] - columns[key], ends[key]) for key in keys]
        )
        for keys in dict.fromkeys(group.get(key, (key,)) for key in columns)
    }


def count_most_scenarios() -> int:
    """Return the largest number of scenarios that `estimate_rare_failure` can run.

    Each level except the first reuses some scenarios of the previous level.
    """
    new = SUBSET_SAMPLES - SUBSET_SAMPLES // CHAIN_LENGTH
    return SUBSET_REPLICATES * (SUBSET_SAMPLES + (MAX_LEVELS - 1) * new)


def estimate_rare_failure(
    sweep: SweepProgram,
    limit: float,
    running: PointRunSettings = LOCAL_RUN,
    samples: int = SUBSET_SAMPLES,
    replicates: int = SUBSET_REPLICATES,
) -> SubsetSimulation:
    """Estimate the probability that a scenario fails, by subset simulation.

    A scenario fails if its worst |error| exceeds `limit` [1]. A failure for another reason counts as an
    infinite error. Every proposed scenario has a new realisation of sensor noise. The Markov chain accepts or
    rejects scenario and realisation together, so that the scenarios have the correct distribution.
    """
    unlike, run = SCENARIO_OUTCOMES.index(UNLIKE_IDEAL), 0

    def performance(normals: np.ndarray) -> np.ndarray:
        nonlocal run
        indices = np.arange(run, run + len(normals))
        rows = run_points(sweep, convert_to_uniform(normals), indices, running)
        run += len(normals)
        return np.where(rows["outcome"] >= unlike, np.inf, compute_error_sizes(rows))

    inputs = sum(count_dimensions(sweep.mechanism).values())
    return subset_simulation(performance, inputs, limit, sweep.manifest.seed, samples, replicates)


def is_spread_beyond_formula(rare: SubsetSimulation) -> bool:
    """Return whether the replicates differ more than the variance formula for a single run can explain."""
    return rare.coefficient_of_variation > MAX_SPREAD_RATIO * rare.formula_coefficient_of_variation


def _has_noise(sweep: SweepProgram) -> bool:
    return any(getattr(sweep.loop, f"has_{kind}noise", False) for kind in ("", "force_", "position_"))
