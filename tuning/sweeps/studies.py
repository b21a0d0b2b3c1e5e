"""Two studies of a sweep: Sobol indices of the uncertain inputs, and the probability of a rare failure.

Both select scenarios as points of the unit box of all uncertain numbers, and run them in the sweep's program.
The sensors' noise is a further uncertain input, whose realisation is selected by an index.
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
KEY_SEPARATOR = " + "  # joins the keys that are one input
CAP_IN_LIMITS = 10.0  # cap on |error| for Sobol indices, in multiples of the limit
CAP_WITHOUT_LIMIT = 10.0  # cap on |error| [1] if there is no limit
SUBSET_SAMPLES, SUBSET_REPLICATES = (
    1000,
    10,
)  # subset simulation: samples per level and replicate, number of replicates
# spread of replicates over the formula's, beyond which they found different failure regions
MAX_SPREAD_RATIO = 2.0


class InputIndices(NamedTuple):
    """Sobol indices of an uncertain input, with 95 % intervals; NaN if the error does not vary."""

    input: str  # its key, or the keys of correlated numbers, joined by `KEY_SEPARATOR`
    first_order: float  # share of the variance without interactions [1]
    first_order_low: float  # low end of the interval
    first_order_high: float  # high end of the interval
    total: float  # share of the variance with all interactions [1]
    total_low: float  # low end of the interval
    total_high: float  # high end of the interval


class ErrorIndices(NamedTuple):
    """Sobol indices of the worst |error| cut at `cap`."""

    inputs: tuple[InputIndices, ...]  # in descending order of the total index
    cap: float
    evaluations: int  # number of scenarios that were run
    capped: int  # number of scenarios that reached the cap or had no error


def compute_error_indices(
    sweep: SweepProgram, number: int, running: PointRunSettings = LOCAL_RUN
) -> ErrorIndices:
    """Compute Sobol indices of the worst |error| from `number` (a power of two) x (inputs + 2) scenarios.

    An input is a key of the mechanism's uncertainty with all its entries. Correlated keys are one input,
    since the indices assume independent inputs. The phases of all contacts are one input, and so is noise, if
    there is any: rows of the design's matrix B have other realisations than those of A. An |error| beyond the
    cap, or a run without an error, counts as the cap, so that a few diverging runs do not dominate the
    variance.
    """
    inputs = group_independent_inputs(sweep.mechanism)
    names, entries = list(inputs), [len(columns) for columns in inputs.values()]
    if _has_noise(sweep):
        # This column only selects between two realisations of the noise.
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
    """Return the columns of each input among those of `count_dimensions`; correlated keys are one input."""
    columns = count_dimensions(mechanism)
    ends = dict(zip(columns, np.cumsum(list(columns.values())), strict=True))
    group = {key: keys for keys in find_correlated_groups(mechanism) for key in keys}
    return {
        KEY_SEPARATOR.join(keys): np.concatenate(
            [np.arange(ends[key] - columns[key], ends[key]) for key in keys]
        )
        for keys in dict.fromkeys(group.get(key, (key,)) for key in columns)
    }


def count_most_scenarios(samples: int = SUBSET_SAMPLES, replicates: int = SUBSET_REPLICATES) -> int:
    """Return the largest number of scenarios that `estimate_rare_failure` runs.

    Each level but the first reuses a share of the scenarios of the level before.
    """
    return replicates * (samples + (MAX_LEVELS - 1) * (samples - samples // CHAIN_LENGTH))


def estimate_rare_failure(
    sweep: SweepProgram,
    limit: float,
    running: PointRunSettings = LOCAL_RUN,
    samples: int = SUBSET_SAMPLES,
    replicates: int = SUBSET_REPLICATES,
) -> SubsetSimulation:
    """Estimate the probability that a scenario fails, by subset simulation, with `limit` [1] on the error.

    The performance is the worst |error|, infinite if the scenario fails for another reason. Every scenario
    has its own realisation of the noise, which a chain accepts or rejects with the scenario. This is an
    independent proposal of the noise, so that the chain keeps its distribution.
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
    """Return whether replicates differ by far more than the formula for one run's chains predicts."""
    return rare.coefficient_of_variation > MAX_SPREAD_RATIO * rare.formula_coefficient_of_variation


def _has_noise(sweep: SweepProgram) -> bool:
    return any(getattr(sweep.loop, f"has_{kind}noise", False) for kind in ("", "force_", "position_"))
