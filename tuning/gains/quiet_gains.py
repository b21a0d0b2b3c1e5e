"""Search of the quietest gains whose error is within a limit, for rigs with noisy sensors.

The least error needs phase lead, which amplifies the force sensor's noise, and peaks of the force command.
So the search continues from the gains of least error. Within a tolerance below the limit the error hardly
counts (`Objective.tolerance`), and the search minimises the root of

    (N / max(N_0, 1))^2 + (rms(C) / max(rms(C_0), 0.5))^2

with N and C of `Objective`: the excess of the noise's amplification over 1, and of the command's peaks over
those of the ideal contact. N_0 and C_0 belong to the gains of least error; 1 and 0.5 are the bounds beyond
which tune warns. Without C the search would reduce the amplification at the cost of higher peaks.
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

MAX_PEAK_RATIO = 1.5  # peak command over the ideal contact's peak force [1], beyond which tune warns
MAX_NOISE_AMPLIFICATION = 2.0  # amplification of the force sensor's noise [1], beyond which tune warns
# MARGIN / sqrt(number of scenarios) is the relative excess of the rms error expected on other scenarios: two
# standard errors of the rms of numbers whose kurtosis is 10.
GENERALISATION_MARGIN = 3.0
# Penalty of the gains of least error, in limits of the error [1]: small, so that the error does not end
# beyond the tolerance.
QUIET_PENALTY_WEIGHT = 0.1


class CommandExcess(NamedTuple):
    """Excess noise and excess peaks of the command under some gains."""

    noise: float  # amplification of the force sensor's noise beyond 1 [1]
    peaks: float  # rms excess of the peak command over the ideal contact's peak force, relative to it [1]


def is_quiet_search_needed(task: TuneTask, settings: TuneSettings) -> bool:
    """Return whether to search for the quietest gains: if requested, and if there is noise to amplify."""
    return (
        settings.quiet
        and isinstance(task.mechanism, Mechanism)
        and has_noise_trade_off(task.compensator)
        and has_sensor_noise(task.mechanism)
    )


def compute_training_tolerance(limit: float, scenarios: int) -> float:
    """Return the rms error [1] on the training scenarios that keeps other scenarios within the limit."""
    return limit / (1 + GENERALISATION_MARGIN / math.sqrt(scenarios))


def build_least_error_objective(objective: Objective) -> Objective:
    """Return the objective of the first search, whose program also serves the second."""
    return replace(objective, tolerance=0.0)


def build_quiet_objective(objective: Objective, scenarios: int, accurate: CommandExcess) -> Objective:
    """Return the objective of the second search, scaled by the loudness of the gains of least error."""
    return replace(
        objective,
        tolerance=compute_training_tolerance(objective.limit, scenarios),
        noise_weight=QUIET_PENALTY_WEIGHT / max(accurate.noise, MAX_NOISE_AMPLIFICATION - 1),
        command_weight=QUIET_PENALTY_WEIGHT / max(accurate.peaks, MAX_PEAK_RATIO - 1),
    )


def compute_command_excess(
    validation: Validation, task: int, start: StartResult, objective: Objective
) -> CommandExcess:
    """Return the loudness of a start's gains on the training scenarios."""
    tuned_task = validation.tasks[task]
    without, beside = (
        float(validation.losses(weighed, [task], start.coordinates[None, None])[0, 0])
        for weighed in (replace(objective, command_weight=weight) for weight in (0.0, 1.0))
    )
    noise = max(
        0.0, compute_noise_amplification(tuned_task.mechanism, tuned_task.compensator, start.gains) - 1
    )
    return CommandExcess(noise, math.sqrt(max(0.0, beside**2 - without**2)) / objective.limit)


def choose_quiet_starts(starts: Sequence[StartResult], number: int) -> Float[np.ndarray, "number gains"]:
    """Return the starts of the second search: the best separated final points of the first."""
    ranked = sorted((start for start in starts if math.isfinite(start.rms)), key=lambda start: start.rms)
    return select_distant_points(
        np.stack([start.coordinates for start in ranked]), None, min(number, len(ranked))
    )
