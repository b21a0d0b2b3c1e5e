"""Runs for `jaxhil compare` of one compensator on one six-axis mechanism."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.uncertainty import draw
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.evaluation import count_lanes
from tuning.statistics.intervals import IntervalEstimate
from tuning.transparency.metrics import compute_error_metrics, compute_ratio_metrics


class SixAxisScenarioSet(NamedTuple):
    """Scenarios of one six-axis mechanism, as NumPy arrays; all compensators use the same scenarios."""

    mechanism: SixAxisMechanism  # mechanism with its uncertainty
    scenarios: Any  # scenarios with their ideal contacts
    common: None = None  # six-axis mechanisms share no program

    @property
    def lanes(self) -> int:
        """Return the number of runs (lanes) that `evaluate` simulates, for progress messages."""
        return count_lanes(self.scenarios)

    def evaluate(
        self, law: str, gains: Mapping[str, float], limit: float, seed: int
    ) -> dict[str, IntervalEstimate]:
        """Simulate a compensator with the given gains in all scenarios, and compute its metrics by name.

        `tuning.transparency.metrics` defines the metrics of the twist error. Two metrics are added:
        `energy_rms`, the rms energy error, and `not_ended`, the number of episodes (contacts with all their
        touches) that did not end.

        Args:
            law: name of the compensator.
            gains: gains by name [SI units].
            limit: limit of the twist error [1].
            seed: seed of the bootstrap.
        """
        model = choose_rig_model(self.mechanism)
        loop = model.loop(self.mechanism, law, self.scenarios)
        values = {name: np.full(self.lanes, value) for name, value in gains.items()}
        outcome = model.evaluate(loop, values, self.scenarios)
        energy, twist = (model.by_error(outcome)[name] for name in ("energy_error", "twist_error"))
        ratios = compute_ratio_metrics(twist, ["peak_ratio", "peak_force_ratio", "duration_ratio"], seed)
        not_ended = float(np.sum(twist.is_scheduled & ~twist.good))
        return {
            "energy_rms": compute_error_metrics(energy, limit, seed)["rms"],
            **compute_error_metrics(twist, limit, seed),
            "peak": ratios.pop("peak_ratio"),
            **ratios,
            "not_ended": IntervalEstimate(not_ended, np.nan, np.nan),
        }


def build_six_axis_scenario_set(mechanism: SixAxisMechanism, scenarios: int, seed: int) -> SixAxisScenarioSet:
    """Draw the scenarios of a mechanism, and compute their ideal contacts, for use by all compensators."""
    model = choose_rig_model(mechanism)
    drawn = model.scenarios(mechanism, draw(mechanism, scenarios, seed), seed)
    return SixAxisScenarioSet(mechanism, model.with_ideal_contacts([drawn])[0])
