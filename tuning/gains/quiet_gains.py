"""Search for the quietest gains whose error is within a limit, for rigs with noisy sensors.

Gains are quiet if they amplify sensor noise little and cause small peaks of the force command. The most
accurate gains need phase lead, which amplifies noise and raises the peaks. A second search therefore starts
at the most accurate gains. It gives errors within a tolerance below the limit almost no weight
(`Objective.tolerance`), and minimises the root of

    (N / max(N_0, 1))^2 + (rms(C) / max(rms(C_0), 0.5))^2

N is the noise amplification minus 1, and C is the relative excess of the peak command over the ideal
contact's peak force (`Objective`). N_0 and C_0 are those of the most accurate gains; 1 and 0.5 are the values
above which tuning warns. Without C, the search would reduce the noise at the cost of higher peaks.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxhil.mechanism.structs import Mechanism
from tuning.gains.multistart_solver import StartResult
from tuning.gains.noise import compute_noise_amplification, has_noise_trade_off
from tuning.gains.objective import Objective
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, has_sensor_noise
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import select_distant_points

MAX_PEAK_RATIO = 1.5  # peak command divided by the ideal contact's peak force [1], above which tune warns
MAX_NOISE_AMPLIFICATION = 2.0  # amplification of the force sensor's noise [1], above which tune warns
# The rms error on fresh scenarios may be larger by the fraction (this number) / sqrt(number of scenarios):
# two standard errors of the rms of numbers with a kurtosis of 10.
GENERALISATION_MARGIN = 3.0
# Penalty of the most accurate gains, in multiples of the error limit. It is small, so that the error stays
# within the tolerance.
QUIET_PENALTY_WEIGHT = 0.1


class CommandExcess(NamedTuple):
    """Amounts by which noise amplification and peak command ratio exceed 1, for one set of gains."""

    noise: float  # amplification of the force sensor's noise minus 1, at least 0 [1]
    peaks: float  # rms of max(0, peak command / peak force of the ideal contact - 1) [1]


def is_quiet_search_needed(task: TuneTask, settings: TuneSettings) -> bool:
    """Return whether gains with little noise are requested, a sensor has noise, and gains affect it."""
    return (
        settings.quiet
        and isinstance(task.mechanism, Mechanism)
        and has_noise_trade_off(task.compensator)
        and has_sensor_noise(task.mechanism)
    )


def compute_training_tolerance(limit: float, scenarios: int) -> float:
    """Return the largest rms training error [1] for which fresh scenarios probably meet the error limit."""
    return limit / (1 + GENERALISATION_MARGIN / math.sqrt(scenarios))


def build_least_error_objective(objective: Objective) -> Objective:
    """Return `objective` with a tolerance of 0, for the search for the most accurate gains.

    A tolerance of 0 does not change the objective, but lets this search share the compiled program of the
    search for quiet gains, which has a tolerance.
    """
    return replace(objective, tolerance=0.0)


def build_quiet_objective(objective: Objective, scenarios: int, accurate: CommandExcess) -> Objective:
    """Return the objective for tuning quiet gains.

    The objective divides each penalty by the penalty's value at the most accurate gains or, if this value is
    small, by a minimum.
    """
    return replace(
        objective,
        tolerance=compute_training_tolerance(objective.limit, scenarios),
        noise_weight=QUIET_PENALTY_WEIGHT / max(accurate.noise, MAX_NOISE_AMPLIFICATION - 1),
        command_weight=QUIET_PENALTY_WEIGHT / max(accurate.peaks, MAX_PEAK_RATIO - 1),
    )


def compute_command_excess(
    validation: Validation, task: int, start: StartResult, objective: Objective
) -> CommandExcess:
    """Compute the `CommandExcess` of the gains in the solver result `start`, on the training scenarios."""
    tuned_task = validation.tasks[task]
    without, beside = (
        float(validation.losses(weighted, [task], start.coordinates[None, None])[0, 0])
        for weighted in (replace(objective, command_weight=weight) for weight in (0.0, 1.0))
    )
    noise = max(
        0.0, compute_noise_amplification(tuned_task.mechanism, tuned_task.compensator, start.gains) - 1
    )
    return CommandExcess(noise, math.sqrt(max(0.0, beside**2 - without**2)) / objective.limit)


def choose_quiet_starts(starts: Sequence[StartResult], number: int) -> Float[np.ndarray, "number gains"]:
    """Choose starts for the search for quiet gains: the best distinct results of the first search."""
    ranked = sorted((start for start in starts if math.isfinite(start.rms)), key=lambda start: start.rms)
    return select_distant_points(
        np.stack([start.coordinates for start in ranked]), None, min(number, len(ranked))
    )
