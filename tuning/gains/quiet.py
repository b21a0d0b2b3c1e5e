"""The quietest gains whose error is within a limit: what is searched for where sensors are noisy.

The least error is bought with lead, which amplifies the noise of the force sensor, and with kicks of the
force command. So the search goes on from the gains of least error: within a tolerance, below the limit, the
error counts next to nothing (`Objective.tolerance`), and what is minimised is the root of

    (N / max(N_0, 1))^2 + (rms(C) / max(rms(C_0), 0.5))^2

with N and C of `Objective`: how much the noise's amplification exceeds 1, and peaks exceed those of the ideal
contact. N_0 and C_0 are those of the gains of least error; 1 and 0.5 are the bounds of the warnings. Without
C the amplification would be traded for kicks.
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

MAX_PEAK_RATIO = 1.5  # of the peak command over the ideal contact's peak force [1], beyond which tune warns
MAX_NOISE_AMPLIFICATION = 2.0  # of the force sensor's noise [1], likewise
# Over the root of the number of scenarios, by how much their rms error may be exceeded in others: two
# standard errors of the rms of numbers whose kurtosis is 10.
MARGIN = 3.0
# Limits of the error that the command of the gains of least error is worth [1]: little, so that the error
# ends at the tolerance and not beyond it.
WEIGHT = 0.1


class Loudness(NamedTuple):
    """What gains do to the command beyond what is needed."""

    noise: float  # amplification of the force sensor's noise beyond 1 [1]
    peaks: float  # rms excess of the peak command over the ideal contact's peak force, relative to it [1]


def is_quiet(task: TuneTask, settings: TuneSettings) -> bool:
    """Return whether the quietest gains are wanted of a task: if asked for, and there is noise to amplify."""
    return (
        settings.quiet
        and isinstance(task.mechanism, Mechanism)
        and has_trade_off(task.compensator)
        and has_sensor_noise(task.mechanism)
    )


def tolerance_of(limit: float, scenarios: int) -> float:
    """Return the rms error [1] on so many training scenarios at which others can be expected to be within the
    limit."""
    return limit / (1 + MARGIN / math.sqrt(scenarios))


def least_error(objective: Objective) -> Objective:
    """Return the objective of the first search, in the program that also serves the second."""
    return replace(objective, tolerance=0.0)


def quietest(objective: Objective, scenarios: int, accurate: Loudness) -> Objective:
    """Return the objective of the second search, with the loudness of the gains of least error."""
    return replace(
        objective,
        tolerance=tolerance_of(objective.limit, scenarios),
        noise_weight=WEIGHT / max(accurate.noise, MAX_NOISE_AMPLIFICATION - 1),
        command_weight=WEIGHT / max(accurate.peaks, MAX_PEAK_RATIO - 1),
    )


def loudness_of(validation: Validation, task: int, start: Start, objective: Objective) -> Loudness:
    """Return the loudness of a start's gains on the training scenarios."""
    own = validation.tasks[task]
    without, beside = (
        float(validation.losses(weighed, [task], start.coordinates[None, None])[0, 0])
        for weighed in (replace(objective, command_weight=weight) for weight in (0.0, 1.0))
    )
    noise = max(0.0, amplification(own.mechanism, own.compensator, start.gains) - 1)
    return Loudness(noise, math.sqrt(max(0.0, beside**2 - without**2)) / objective.limit)


def begin_at(starts: Sequence[Start], number: int) -> Float[np.ndarray, "number gains"]:
    """Return coordinates to start the second search at: the best ends of the first that lie apart."""
    ranked = sorted((start for start in starts if math.isfinite(start.rms)), key=lambda start: start.rms)
    return apart(np.stack([start.coordinates for start in ranked]), None, min(number, len(ranked)))
