"""Result of an identification: estimates, their uncertainty and correlation, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tuning.identification.contact_fit import ContactFit
from tuning.identification.free_motion import FreeMotion
from tuning.identification.noise import SensorNoise
from tuning.identification.validation import CheckResult

UNCERTAINTY_CHECK = "uncertainty of the numbers"  # name of a check
MIN_CONFOUNDED_CORRELATION = 0.95  # magnitude of a correlation, above which two parameters are confounded

PRESS_EXPERIMENT = "a press run with a multisine to 45 Hz"
WIDER_MULTISINE = "a multisine to 1.5 times the bandwidth or more"
# Experiments that separate a pair of parameters, by its keys.
EXPERIMENTS = {
    ("rig.force_sensor.delay", "contact.damping"): PRESS_EXPERIMENT,
    ("rig.force_sensor.time_constant", "contact.damping"): PRESS_EXPERIMENT,
    ("rig.force_sensor.time_constant", "rig.force_sensor.delay"): PRESS_EXPERIMENT,
    ("rig.contact_plane", "rig.force_sensor.delay"): "touches at speeds in the ratio 1:2:4, or a slow press",
    ("contact.stiffness", "rig.contact_plane"): "touches at speeds in the ratio 1:2:4, or a slow press",
    ("rig.simulator.damping_ratio", "rig.simulator.delay"): WIDER_MULTISINE,
    (
        "rig.simulator.delay",
        "rig.simulator.natural_frequency",
    ): WIDER_MULTISINE,
    ("rig.simulator.delay", "rig.simulator.time_constant"): WIDER_MULTISINE,
}


@dataclass(frozen=True)
class Estimate:
    """Estimate of one parameter of the mechanism file."""

    key: str  # dotted path; for an entry of a list it ends in the index
    value: float
    std: float  # in the key's unit; 0 if it was specified
    low: float  # lower end of the 95 % interval
    high: float  # upper end
    unit: str
    is_fixed: bool = False  # whether the prior or the caller specified it


@dataclass(frozen=True)
class Identification:
    """Complete result of an identification."""

    estimates: tuple[Estimate, ...]
    draws: np.ndarray  # (draws, estimates that were not specified), in their order
    combinations: tuple[Estimate, ...]  # combinations that the logs determine better than their parts
    confounded: tuple[tuple[str, str, float, str], ...]  # two keys, correlation, separating experiment
    lines: tuple[CheckResult, ...]
    mechanism: dict[str, Any] | None  # content of a mechanism file; None if something is missing
    limit: float  # largest allowed sum of effects, on e and on e - e*
    notes: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()  # parameters in neither logs nor prior, each with a suitable run
    motion: FreeMotion | None = field(default=None, repr=False)
    contact: ContactFit | None = field(default=None, repr=False)
    force_noise: SensorNoise | None = field(default=None, repr=False)
    position_noise: SensorNoise | None = field(default=None, repr=False)

    @property
    def effect(self) -> float:
        """Return the effect on e of all detected defects and of the parameters' uncertainty."""
        return float(sum(line.counted for line in self.lines))

    @property
    def effect_on_error(self) -> float:
        """Return the effect on e - e* of the same."""
        return float(sum(line.counted_error for line in self.lines))

    @property
    def good(self) -> bool:
        """Return whether both effects are below the limit and at least one check was made."""
        return not self.missing and bool(self.lines) and max(self.effect, self.effect_on_error) < self.limit

    @property
    def worst(self) -> CheckResult | None:
        """Return the line with the largest effect, or None."""
        present = [line for line in self.lines if line.there and line.counts]
        return max(present, key=lambda line: max(line.counted, line.counted_error), default=None)

    @property
    def verdict(self) -> str:
        if self.missing:
            return f"Bad: neither the logs nor a prior tell {' and '.join(self.missing)}; no file is written"
        if not self.lines:
            return "Bad: neither free motion nor contact is in the logs: nothing shows that the file is right"
        change = f"can change e by {self.effect:.2g} and e - e* by {self.effect_on_error:.2g}"
        if self.good:
            return (
                f"Good: what the model leaves and the numbers' uncertainty {change}, "
                f"expected below {self.limit:g}"
            )
        worst = self.worst
        assert worst is not None
        if worst.name == UNCERTAINTY_CHECK:
            return (
                f"Bad: the numbers are too uncertain: {worst.finding}; "
                f"all together {change}, expected below {self.limit:g}"
            )
        location = f" ({worst.where})" if worst.where else ""
        return (
            f"Bad: the model does not explain this rig: {worst.name}{location}: {worst.finding}; "
            f"all defects {change}, expected below {self.limit:g}"
        )

    def __getitem__(self, key: str) -> Estimate:
        """Return the estimate of a key, or of a combination by its name."""
        for estimate in (*self.estimates, *self.combinations):
            if estimate.key == key:
                return estimate
        raise KeyError(key)


def find_confounded_pairs(keys: list[str], draws: np.ndarray) -> tuple[tuple[str, str, float, str], ...]:
    """Return the pairs that the logs hardly separate, their correlation, and a suitable experiment."""
    moving = np.ptp(draws, axis=0) > 0.0
    keys, draws = [key for key, varies in zip(keys, moving, strict=True) if varies], draws[:, moving]
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


def suggest_experiment(one: str, other: str) -> str:
    """Return the experiment that separates two parameters; indices of list entries are ignored."""
    one, other = (key.rstrip("0123456789").rstrip(".") for key in (one, other))
    return EXPERIMENTS.get((one, other)) or EXPERIMENTS.get((other, one), "longer runs, or wider ones")
