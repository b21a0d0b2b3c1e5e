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
from tuning.gains.noise import amplification, has_trade_off
from tuning.gains.objective import Objective
from tuning.gains.rounds import Start
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import TuneTask, has_sensor_noise
from tuning.gains.validation import Validation
from tuning.optimisation.derivative_free import apart

MAX_PEAK_RATIO = 1.5  # peak command over the ideal contact's peak force [1], beyond which tune warns
MAX_NOISE_AMPLIFICATION = 2.0  # amplification of the force sensor's noise [1], beyond which tune warns
# MARGIN / sqrt(number of scenarios) is the relative excess of the rms error expected on other scenarios: two
# standard errors of the rms of numbers whose kurtosis is 10.
MARGIN = 3.0
# Penalty of the gains of least error, in limits of the error [1]: small, so that the error does not end
# beyond the tolerance.
WEIGHT = 0.1


class Loudness(NamedTuple):
    """Excess noise and excess peaks of the command under some gains."""

    noise: float  # amplification of the force sensor's noise beyond 1 [1]
    peaks: float  # rms excess of the peak command over the ideal contact's peak force, relative to it [1]


def is_quiet(task: TuneTask, settings: TuneSettings) -> bool:
    """Return whether to search for the quietest gains: if requested, and if there is noise to amplify."""
    return (
        settings.quiet
        and isinstance(task.mechanism, Mechanism)
        and has_trade_off(task.compensator)
        and has_sensor_noise(task.mechanism)
    )


def tolerance_of(limit: float, scenarios: int) -> float:
    """Return the rms error [1] on the training scenarios that keeps other scenarios within the limit."""
    return limit / (1 + MARGIN / math.sqrt(scenarios))


def least_error(objective: Objective) -> Objective:
    """Return the objective of the first search, whose program also serves the second."""
    return replace(objective, tolerance=0.0)


def quietest(objective: Objective, scenarios: int, accurate: Loudness) -> Objective:
    """Return the objective of the second search, scaled by the loudness of the gains of least error."""
    return replace(
        objective,
        tolerance=tolerance_of(objective.limit, scenarios),
        noise_weight=WEIGHT / max(accurate.noise, MAX_NOISE_AMPLIFICATION - 1),
        command_weight=WEIGHT / max(accurate.peaks, MAX_PEAK_RATIO - 1),
    )


def loudness_of(validation: Validation, task: int, start: Start, objective: Objective) -> Loudness:
    """Return the loudness of a start's gains on the training scenarios."""
    tuned_task = validation.tasks[task]
    without, beside = (
        float(validation.losses(weighed, [task], start.coordinates[None, None])[0, 0])
        for weighed in (replace(objective, command_weight=weight) for weight in (0.0, 1.0))
    )
    noise = max(0.0, amplification(tuned_task.mechanism, tuned_task.compensator, start.gains) - 1)
    return Loudness(noise, math.sqrt(max(0.0, beside**2 - without**2)) / objective.limit)


def begin_at(starts: Sequence[Start], number: int) -> Float[np.ndarray, "number gains"]:
    """Return the starts of the second search: the best separated final points of the first."""
    ranked = sorted((start for start in starts if math.isfinite(start.rms)), key=lambda start: start.rms)
    return apart(np.stack([start.coordinates for start in ranked]), None, min(number, len(ranked)))
