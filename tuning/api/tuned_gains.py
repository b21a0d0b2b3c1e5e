"""Results of `tuning.tune`: tuned gains, and points of a Pareto front."""

import functools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning.api import arguments, tune_verdict
from tuning.api.tune_verdict import CommandMetrics

if TYPE_CHECKING:
    from jaxhil.simulation.plausibility import MechanismSummary
    from tuning.gains.pareto import ParetoFront, ParetoPoint
    from tuning.gains.tune import ErrorMetrics, TuneResult

# Names in gain files of those weights that have another name as a field of the objective.
NAMES_IN_FILES = {"transparency_weight": "honesty_weight"}


@dataclass(frozen=True)
class TunedGains:
    """Result of `tune` for one mechanism.

    Attributes:
        tune_result: all results of the tuning (`tuning.gains.tune.TuneResult`).
        mechanism_sha256: SHA-256 digest of the mechanism file.
        limit: largest rms error for which the verdict is good [1].
        pareto: points of the Pareto front; empty if no front was requested.
        extra_periods: part of the mechanism's command latency that a co-simulation with FMUs adds [periods].
    """

    tune_result: "TuneResult"
    mechanism_sha256: str
    limit: float
    pareto: "tuple[TradedGains, ...]" = ()
    extra_periods: int = 0

    @property
    def mechanism(self) -> AnyMechanism:
        """Return the mechanism for which the gains were tuned."""
        return self.tune_result.mechanism

    @property
    def compensator(self) -> str:
        """Return the name of the compensator whose gains were tuned."""
        return self.tune_result.compensator

    @property
    def gains(self) -> dict[str, float]:
        """Return all gains of the compensator by name [SI units], including gains that were not tuned."""
        return self.tune_result.gains

    @property
    def literature(self) -> dict[str, float]:
        """Return the gains by the literature's rule, or those of the chosen setting, by name [SI units]."""
        return self.tune_result.literature

    @property
    def figures(self) -> "dict[str, ErrorMetrics]":
        """Return the error metrics on fresh scenarios for three sets of gains.

        The keys are "before" (no compensation), "literature" and "tuned". Each value has the attributes rms,
        p99, max [1] and more.
        """
        return self.tune_result.figures

    @property
    def parts(self) -> "dict[str, dict[str, ErrorMetrics]]":
        """Return separate metrics of the energy error and the twist error, for six axes.

        The keys are "energy_error" and "twist_error"; each value has the form of `figures`. The dictionary is
        empty for one axis.
        """
        from tuning.gains.tune import compute_metrics_by_error

        return compute_metrics_by_error(self.tune_result)

    @property
    def co_simulation(self) -> dict[str, dict[str, int]]:
        """Return the gain file's entry on the periods that a co-simulation adds; empty if it adds none."""
        return {"co_simulation": {"extra_periods": self.extra_periods}} if self.extra_periods else {}

    @property
    def verdict(self) -> str:
        """Return the verdict, "good" or "bad".

        The verdict is "good" if three conditions hold with and without sensor noise. Every contact ends. The
        rms error is within the limit. Of the real contacts (on the hardware), at least 99 % have at most
        twice the ideal contact's peak force, and 0.5 to 2 times its duration.
        """
        return "good" if tune_verdict.is_good(self.tune_result, self.limit) else "bad"

    @property
    def without_noise(self) -> "ErrorMetrics | None":
        """Return the tuned gains' error metrics on the same scenarios without sensor noise.

        The result is None if the mechanism has no sensor noise.
        """
        return self.tune_result.without_noise

    @functools.cached_property
    def command(self) -> CommandMetrics:
        """Return metrics of the force command with the tuned gains.

        `peak_p99` is the 99th percentile of the command's peak divided by the ideal contact's peak force [1].
        `noise_amplification` is the amplification of the sensor noise [1].
        """
        return tune_verdict.command_metrics(self.tune_result)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence for each metric in `command` that exceeds its bound."""
        return tune_verdict.command_warnings(self.tune_result, self.command)

    @functools.cached_property
    def summary(self) -> "MechanismSummary | None":
        """Return a summary of the mechanism: mass, ideal contacts, rates, and warnings of implausible values.

        The summary is None for six axes. Use the summary of a result of `jaxhil.simulate` instead.
        """
        from jaxhil.simulation import plausibility

        if isinstance(self.mechanism, SixAxisMechanism):
            return None
        return plausibility.summarise_mechanism(self.mechanism)

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """Return the content of the gain file."""
        from tuning.gain_file import build_document
        from tuning.transparency.pushes import PUSH_DEFINITION

        result = self.tune_result
        return build_document(
            result.compensator,
            result.gains,
            result.mechanism,
            self.mechanism_sha256,
            _validity_envelope(result),
            {
                "nominal": result.nominal,
                "robust": result.figures,
                "tuned_intervals": result.intervals.plain() if result.intervals else None,
                **self.parts,
                **self.co_simulation,
                "without_noise": result.without_noise,
                "command": self.command,
                "warnings": self.warnings,
                **(
                    {"honesty": result.transparency, "transparency": PUSH_DEFINITION}
                    if result.transparency
                    else {}
                ),
            },
            result.settings.seed,
            result.timings,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file.

        Raises:
            InputError: If the file cannot be written.
        """
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.check_path("path", path), self.document)


def _validity_envelope(result: "TuneResult") -> dict[str, Any]:
    """Return the ranges of frequency, delay, speed and force in the fresh scenarios, for the gain file."""
    from tuning.gain_file import six_axis_validity_envelope, validity_envelope

    if isinstance(result.mechanism, SixAxisMechanism):
        return six_axis_validity_envelope(result.scenarios, result.outcomes["tuned"])
    return validity_envelope(result.mechanism, result.scenarios)


@dataclass(frozen=True)
class TradedGains:
    """Gains of one point of a Pareto front, which trades off the error against a second cost.

    Attributes:
        tuned: gains that were tuned for the least error, without regard to the second cost.
        front: the whole front (`tuning.gains.pareto.ParetoFront`).
        point: this point of the front (`tuning.gains.pareto.ParetoPoint`).
    """

    tuned: TunedGains
    front: "ParetoFront"
    point: "ParetoPoint"

    @property
    def gains(self) -> dict[str, float]:
        """Return the gains of this point by name [SI units]."""
        return self.point.gains

    @property
    def figures(self) -> "ErrorMetrics":
        """Return the error metrics on fresh scenarios with the gains of this point."""
        return self.point.figures

    @property
    def traded(self) -> dict[str, Any]:
        """Return the JSON entry of this point: weight, cost, error [1], and whether it is on the front.

        The weight is that of the cost in the objective of the tuning. A point is not on the front if
        another point has a smaller error or cost, and neither of them is larger.
        """
        axis = self.front.axis
        return {
            NAMES_IN_FILES.get(axis.weight, axis.weight): self.point.weight,
            axis.cost: self.point.cost,
            "error": self.point.error,
            "on_front": self.point.on_front,
        }

    @functools.cached_property
    def document(self) -> dict[str, Any]:
        """Return the content of the gain file."""
        from tuning.gain_file import build_document

        result, point = self.tuned.tune_result, self.point
        figures: dict[str, Any] = {
            "nominal": {**result.nominal, "tuned": point.nominal},
            "robust": {**result.figures, "tuned": point.figures},
            "tuned_intervals": point.intervals.plain(),
        }
        if point.transparency is not None:
            figures["honesty"] = {**result.transparency, "tuned": point.transparency}
        return build_document(
            result.compensator,
            point.gains,
            result.mechanism,
            self.tuned.mechanism_sha256,
            _validity_envelope(result),
            {**figures, **self.tuned.co_simulation, "pareto": self.traded},
            result.settings.seed,
            {},
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the gain file of this point of the Pareto front.

        Raises:
            InputError: If the file cannot be written.
        """
        from tuning.gain_file import write_gain_file

        write_gain_file(arguments.check_path("path", path), self.document)
