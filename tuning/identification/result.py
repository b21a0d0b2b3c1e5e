"""Result of an identification: estimates with their uncertainty, checks, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tuning.identification.contact_fit import ContactFit
from tuning.identification.free_motion import FreeMotion
from tuning.identification.noise import NoiseEstimate
from tuning.identification.validation import CheckResult

UNCERTAINTY_CHECK = "uncertainty of the numbers"  # name of the check of the parameters' uncertainty
MIN_CONFOUNDED_CORRELATION = 0.95  # minimum magnitude of the correlation of two confounded parameters

PRESS_EXPERIMENT = "a press run with a multisine to 45 Hz"
WIDER_MULTISINE = "a multisine to 1.5 times the bandwidth or more"
# Experiments that separate two confounded parameters, by the keys of both.
EXPERIMENTS = {
    ("rig.force_sensor.delay", "contact.damping"): PRESS_EXPERIMENT,
    ("rig.force_sensor.time_constant", "contact.damping"): PRESS_EXPERIMENT,
    ("rig.force_sensor.time_constant", "rig.force_sensor.delay"): PRESS_EXPERIMENT,
    ("rig.force_sensor.filter.cutoff", "contact.damping"): PRESS_EXPERIMENT,
    ("rig.force_sensor.filter.cutoff", "rig.force_sensor.delay"): PRESS_EXPERIMENT,
    ("rig.contact_plane", "rig.force_sensor.delay"): "touches at speeds in the ratio 1:2:4, or a slow press",
    ("contact.stiffness", "rig.contact_plane"): "touches at speeds in the ratio 1:2:4, or a slow press",
    ("rig.simulator.damping_ratio", "rig.simulator.delay"): WIDER_MULTISINE,
    (
        "rig.simulator.delay",
        "rig.simulator.natural_frequency",
    ): WIDER_MULTISINE,
    ("rig.simulator.delay", "rig.simulator.time_constant"): WIDER_MULTISINE,
    ("rig.simulator.delay", "rig.simulator.window"): WIDER_MULTISINE,
}


@dataclass(frozen=True)
class ParameterEstimate:
    """Estimate of one parameter of the mechanism file, with its uncertainty.

    Attributes:
        key: Dotted path of the parameter; the path of a list entry ends in its index.
        value: Estimate, in `unit`.
        std: Standard deviation, in `unit`; 0 if the value was specified.
        low: Lower end of the 95 % interval, in `unit`.
        high: Upper end of the 95 % interval, in `unit`.
        unit: SI unit.
        is_fixed: Whether the user or the prior specified the value.
    """

    key: str
    value: float
    std: float
    low: float
    high: float
    unit: str
    is_fixed: bool = False


@dataclass(frozen=True)
class Identification:
    """Complete result of an identification.

    Attributes:
        estimates: Estimates of all parameters.
        draws: Posterior draws of the parameters that were not specified, in the order of `estimates`, shape
            (draws, parameters).
        combinations: Combinations of parameters that the logs determine better than each parameter alone.
        confounded: Pairs of confounded parameters: two keys, their correlation, and the experiment that
            separates the parameters.
        lines: Results of the checks, one for each line of the printed table of checks.
        mechanism: Content of the identified mechanism file, or None if a value is missing or invalid.
        limit: Limit of the total effect of all defects on the restitution e, and also on its error e - e*.
        notes: Further remarks.
        missing: Parameters that neither the logs nor the prior determine, each with advice.
        motion: Fit of the motion simulator, or None.
        contact: Fit of the contact, or None.
        force_noise: Noise of the force sensor at rest, or None.
        position_noise: Noise of the position sensor at rest, or None.
    """

    estimates: tuple[ParameterEstimate, ...]
    draws: np.ndarray
    combinations: tuple[ParameterEstimate, ...]
    confounded: tuple[tuple[str, str, float, str], ...]
    lines: tuple[CheckResult, ...]
    mechanism: dict[str, Any] | None
    limit: float
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    motion: FreeMotion | None = field(default=None, repr=False)
    contact: ContactFit | None = field(default=None, repr=False)
    force_noise: NoiseEstimate | None = field(default=None, repr=False)
    position_noise: NoiseEstimate | None = field(default=None, repr=False)

    @property
    def effect(self) -> float:
        """Return the effect on e of all detected defects and of the parameters' uncertainty."""
        return float(sum(line.effect_in_verdict for line in self.lines))

    @property
    def effect_on_error(self) -> float:
        """Return the effect on e - e* of all detected defects and of the parameters' uncertainty."""
        return float(sum(line.error_in_verdict for line in self.lines))

    @property
    def good(self) -> bool:
        """Return whether the model is complete and checked, with effects on e and e - e* below the limit."""
        is_small = max(self.effect, self.effect_on_error) < self.limit
        return not self.missing and self.is_compared and is_small

    @property
    def is_compared(self) -> bool:
        """Return whether any check compares the logs with the model; the uncertainty check does not."""
        return any(line.name != UNCERTAINTY_CHECK for line in self.lines)

    @property
    def worst(self) -> CheckResult | None:
        """Return the check whose defect has the largest effect, or None if there is no defect.

        If another model explains the logs better (see `CheckResult.gain`), but a second one explains them
        even better, return the check of the second model.
        """
        defects = [line for line in self.lines if line.is_significant and line.is_in_verdict]
        worst = max(
            defects, key=lambda line: max(line.effect_in_verdict, line.error_in_verdict), default=None
        )
        return max(defects, key=lambda line: line.gain) if worst is not None and worst.gain > 0.0 else worst

    @property
    def verdict(self) -> str:
        if self.missing:
            return f"Bad: no file is written: logs and prior do not determine {' and '.join(self.missing)}"
        if not self.is_compared:
            return "Bad: the logs have neither free motion nor contact, so that the file cannot be checked"
        change = f"can change e by {self.effect:.2g} and e - e* by {self.effect_on_error:.2g}"
        if self.good:
            return (
                f"Good: model errors and the parameters' uncertainty {change}, expected below {self.limit:g}"
            )
        worst = self.worst
        assert worst is not None
        if worst.name == UNCERTAINTY_CHECK:
            return (
                f"Bad: the parameters are too uncertain: {worst.finding}; "
                f"all together {change}, expected below {self.limit:g}"
            )
        location = f" ({worst.where})" if worst.where else ""
        return (
            f"Bad: the model does not explain this rig: {worst.name}{location}: {worst.finding}; "
            f"all defects {change}, expected below {self.limit:g}"
        )

    def __getitem__(self, key: str) -> ParameterEstimate:
        """Return the estimate of the parameter or combination with this key."""
        for estimate in (*self.estimates, *self.combinations):
            if estimate.key == key:
                return estimate
        raise KeyError(key)


def find_confounded_pairs(keys: list[str], draws: np.ndarray) -> tuple[tuple[str, str, float, str], ...]:
    """Find pairs of parameters that the logs hardly distinguish.

    Args:
        keys: Keys of the parameters.
        draws: Posterior draws of the parameters, shape (draws, keys).

    Returns:
        For each pair, the two keys, their correlation, and an experiment that separates the parameters.
    """
    varying = np.ptp(draws, axis=0) > 0.0
    keys, draws = [key for key, varies in zip(keys, varying, strict=True) if varies], draws[:, varying]
    if len(keys) < 2:
        return ()
    correlation = np.corrcoef(draws.T)
    pairs = []
    for i in range(len(keys)):
        for j in range(i):
            if abs(correlation[i, j]) > MIN_CONFOUNDED_CORRELATION:
                pairs.append(
                    (keys[j], keys[i], float(correlation[i, j]), suggest_experiment(keys[i], keys[j]))
                )
    return tuple(pairs)


def suggest_experiment(first: str, other: str) -> str:
    """Return a description of an experiment that separates two confounded parameters, given by their keys."""
    first, other = (key.rstrip("0123456789").rstrip(".") for key in (first, other))
    return EXPERIMENTS.get((first, other)) or EXPERIMENTS.get(
        (other, first), "longer runs, or a wider range of speeds and frequencies"
    )
